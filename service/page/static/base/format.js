// Numbers and times for people.

/** A number with so many significant digits, "–" for none. */
export function number(value, digits = 3) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (Number.isInteger(value)) return String(value);
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e6 || size < 1e-3)) return value.toExponential(digits - 1).replace("-", "−");
  const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(size || 1)));
  return value.toFixed(Math.min(decimals, 6)).replace("-", "−");
}

/** A share in per cent. */
export function share(value) {
  return value === null || value === undefined ? "–" : `${(100 * value).toFixed(value < 0.0995 ? 1 : 0)} %`;
}

/** How long something has lasted (s). */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.floor(seconds / 60)} min ${String(Math.round(seconds % 60)).padStart(2, "0")} s`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

/** The time of day of a time in ISO 8601, with the day unless it is today. */
export function clock(text) {
  const time = new Date(text);
  const today = time.toDateString() === new Date().toDateString();
  return (today ? "" : `${time.toLocaleDateString(undefined, { month: "short", day: "numeric" })} `) + time.toLocaleTimeString(undefined, { hour12: false });
}

const EDGES = [["back", "left", "right"], ["virtual", "left", "right"]];
export const KINDS = ["Delta", "Lambda"], TRIANGLES = ["Δ", "Λ"];

/** The class of a segment: kind, entry edge and exit edge. */
export function className(row) {
  const edge = (number) => (number === null || number === undefined ? "…" : EDGES[row.kind][number]);
  return `${KINDS[row.kind]}: ${edge(row.entry_edge)} → ${edge(row.exit_edge)}`;
}
