// The learning curves of a run, as its iterations come.

import { chart } from "../base/curves.js";
import { h } from "../base/dom.js";

const error = (mean, deviation) => [
  { label: `${mean} + error`, column: (row) => (row[deviation] === null ? null : row[mean] + row[deviation]), hidden: true, under: 2 },
  { label: `${mean} − error`, column: (row) => (row[deviation] === null ? null : row[mean] - row[deviation]), hidden: true },
];
const CHARTS = [
  ["Cost", "m²/s², ± standard error", [{ label: "cost", column: (row) => row.cost, stroke: "curve-1" }, ...error("cost", "cost_standard_error")]],
  ["Forward speed", "m/s, ± standard error", [{ label: "speed", column: (row) => row.forward_speed_m_per_s, stroke: "curve-2" }, ...error("forward_speed_m_per_s", "forward_speed_standard_error")]],
  ["Stuck", "share of steps", [{ label: "by speed", column: (row) => row.stuck_share, stroke: "curve-3" }, { label: "by distance", column: (row) => row.stuck_share_by_distance, stroke: "curve-4", dash: [6, 4] }]],
  ["Promised and realised change of cost", "m²/s²", [{ label: "promised", column: (_, before) => before?.predicted_cost_change, stroke: "curve-5", dash: [6, 4] }, { label: "realised", column: (row) => row.realised_cost_change, stroke: "curve-1" }]],
];

/** The curves; `chosen(iteration)` is told of a point that somebody clicks. */
export function learning(chosen) {
  const rows = [];
  const charts = CHARTS.map(([title, unit, series]) => chart({
    title, unit, data: [[], ...series.map(() => [])], chosen: (k) => rows[k] && chosen(rows[k].iteration),
    series: series.map((one) => ({ stroke: series[0].stroke, ...one })),
  }));
  const element = h("div", { class: "charts" }, charts.map((one) => one.element));
  let waits = 0;

  function draw() {
    waits = 0;
    const axis = rows.map((row) => row.iteration);
    CHARTS.forEach(([, , series], k) => charts[k].show([axis, ...series.map((one) => rows.map((row, n) => one.column(row, rows[n - 1]) ?? null))]));
  }

  return {
    element,
    add(row) {
      if (rows.length && row.iteration <= rows.at(-1).iteration) return;
      rows.push(row);
      waits ||= requestAnimationFrame(draw); // many may come at once
    },
    close: () => (cancelAnimationFrame(waits), charts.forEach((one) => one.close())),
  };
}
