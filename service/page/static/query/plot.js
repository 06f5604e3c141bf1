// A plot of a result: one column against another, a line for each value of a third.

import { chart, looks } from "../base/curves.js";
import { field, fill, h, select } from "../base/dom.js";
import { note } from "../base/link.js";

const LINES_N = 30, NOTHING = "-";

/** The plot of rows; `wanted` has the columns x, y, by and the kind of marks, as links keep them. */
export function plot(rows, wanted) {
  const names = rows.length ? Object.keys(rows[0]) : [];
  const numeric = names.filter((name) => rows.some((row) => typeof row[name] === "number"));
  if (numeric.length < 2) return { element: h("div"), close: () => {} };
  const axes = ["iteration", "step", "time_s", "version", "episode_id"];
  const guess = { x: axes.find((name) => numeric.includes(name)) ?? numeric[0], by: names.find((name) => !numeric.includes(name)) ?? NOTHING, marks: "lines" };
  guess.y = numeric.find((name) => name !== guess.x && !axes.includes(name)) ?? numeric.find((name) => name !== guess.x);
  const chosen = (key, among) => (among.includes(wanted[key]) ? wanted[key] : guess[key]);
  const x = select(numeric, { value: chosen("x", numeric), onchange: draw }), y = select(numeric, { value: chosen("y", numeric), onchange: draw });
  const by = select([[NOTHING, "nothing"], ...names], { value: chosen("by", [NOTHING, ...names]), onchange: draw });
  const marks = select(["lines", "points"], { value: chosen("marks", ["lines", "points"]), onchange: draw });
  const place = h("div");
  const element = h("details", { open: true }, h("summary", {}, "Plot"), h("div", { class: "row" }, field("Across", x), field("Up", y), field("A line for each", by), field("Marks", marks)), place);
  let drawn = null;

  function draw(event) {
    if (event) note({ x: x.value, y: y.value, by: by.value, marks: marks.value });
    drawn?.close();
    const groups = new Map();
    for (const row of rows) {
      if (typeof row[x.value] !== "number" || typeof row[y.value] !== "number") continue;
      const key = by.value !== NOTHING ? String(row[by.value]) : y.value;
      groups.set(key, [...(groups.get(key) ?? []), [row[x.value], row[y.value]]]);
    }
    const shown = [...groups].slice(0, LINES_N);
    const tables = shown.map(([, points]) => (points.sort((a, b) => a[0] - b[0]), [points.map((point) => point[0]), points.map((point) => point[1])]));
    const data = tables.length ? uPlot.join(tables) : [[]];
    const points = marks.value === "points";
    drawn = chart({ title: `${y.value} by ${x.value}`, unit: groups.size > LINES_N ? `the first ${LINES_N} of ${groups.size} lines` : "", axis: x.value, data, height: 260,
      series: shown.map(([label], k) => ({ label, ...looks(k), points: points || undefined, scatter: points })) });
    fill(place, drawn.element);
  }

  draw();
  return { element, close: () => drawn?.close() };
}
