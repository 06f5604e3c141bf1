"""A browser that draws nothing in three dimensions, as a script that runs before the page's."""

SCRIPT = """const original = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind.startsWith("webgl") ? null : original.call(this, kind, ...more);
};"""
