// What happened to workers and episodes, each with its reason, the newest first.

import { empty, field, fill, h, select } from "../base/dom.js";
import { clock } from "../base/format.js";

const KEPT_N = 500; // the file has all that are kept; a page that stays open for days must not grow
const SIGNS = { start: "▶", scale: "⇕", crash: "✕", hang: "⏱", replacement: "↻", quarantine: "⊘", waiting: "…", running: "●", degraded: "◐", paused: "⏸", stopping: "◌", done: "✓", failed: "✕" };
const BAD = new Set(["crash", "hang", "quarantine", "failed", "degraded"]);

/** The list; `changed(kind)` is told which kind somebody wants to see, empty for all. */
export function events(changed) {
  const kinds = select([["", "all"], ...Object.keys(SIGNS)], { onchange: () => (changed(kinds.value), draw()) });
  const body = h("ol", { class: "events", reversed: true });
  const count = h("p", { class: "count" });
  const element = h("div", {}, field("Kind", kinds), count, body);
  const kept = [];
  let waits = 0, last = -1;

  function draw() {
    waits = 0;
    const shown = kept.filter((event) => !kinds.value || event.event === kinds.value).reverse();
    fill(body, shown.map(line));
    fill(count, shown.length ? `${shown.length} events${kept.length === KEPT_N ? `, the newest of ${last + 1}` : ""}` : empty(kept.length ? "None of this kind." : "Nothing has happened to workers yet."));
  }

  return {
    element,
    opened: draw,
    choose(kind) {
      const next = Object.hasOwn(SIGNS, kind) ? kind : "";
      if (next !== kinds.value) (kinds.value = next), draw();
    },
    add(event) {
      if (event.number <= last) return;
      last = event.number;
      kept.push(event);
      if (kept.length > KEPT_N) kept.shift();
      waits ||= setTimeout(draw, 100);
    },
  };
}

function line(event) {
  return h("li", { class: BAD.has(event.event) ? "bad" : null },
    h("time", { datetime: event.time }, clock(event.time)), h("span", { class: "kind" }, `${SIGNS[event.event] ?? "·"} ${event.event}`), h("span", {}, event.reason), h("small", {}, event.phase));
}
