// Curves of several runs. Those that differ in the seed alone make one curve: their mean, in the range of all.

import { repeatedly, rows } from "../base/api.js";
import { chart, looks } from "../base/curves.js";
import { empty, fault, fill, h, table } from "../base/dom.js";
import { number } from "../base/format.js";

const EVERY_MS = 10_000;
const NO_SETTING = ["run", "study", "arm", "seed", "commit", "made_at", "schema_version"];
const NO_EFFECT = ["run_workers", "run_workers_min", "run_workers_max", "run_cpus_per_worker", "terrain_accept"]; // on data
const LEFT_OUT = [...NO_SETTING, ...NO_EFFECT, "run_seed"].map((name) => `'${name}'`).join(", ");
const ALIKE = `SELECT run, run_seed AS seed, hash(*COLUMNS(lambda c: c NOT IN (${LEFT_OUT}) AND NOT starts_with(c, 'evaluation_')))::VARCHAR AS alike
  FROM runs WHERE list_contains($names, run) ORDER BY run`;
const CURVES = `SELECT run, iteration, cost, forward_speed_m_per_s, stuck_share, stuck_share_by_distance FROM iterations
  WHERE list_contains($names, run) ORDER BY run, iteration`;
const SHOWN = [["cost", "Cost", "m²/s²"], ["forward_speed_m_per_s", "Forward speed", "m/s"], ["stuck_share", "Stuck by speed", "share of steps"], ["stuck_share_by_distance", "Stuck by distance", "share of steps"]];

export function compare(names) {
  const left = new AbortController();
  const charts = SHOWN.map(([, title, unit]) => chart({ title, unit, series: [], data: [[]], height: 240 }));
  const said = h("div", { role: "status" }, empty("Reading the curves …"));
  const who = h("div");
  const element = h("section", { "aria-label": "Comparison" }, h("h1", {}, `${names.length} runs compared`), said, h("div", { class: "charts" }, charts.map((one) => one.element)), who);

  async function look() {
    try {
      const pattern = names.length === 1 ? names[0] : "*";
      const alike = await rows(pattern, ALIKE, { names }, left.signal);
      const curves = await rows(pattern, CURVES, { names }, left.signal);
      const groups = grouped(alike);
      SHOWN.forEach(([column], k) => charts[k].show(...lines(groups, curves, column)));
      fill(who, table("Curves", [
        ["curve", (group) => group.label], ["seeds", (group) => group.runs.map((run) => run.seed).join(", "), "number"],
        ["runs", (group) => group.runs.map((run) => run.run).join(", ")], ["last cost", (group) => last(group, curves, "cost"), "number"],
        ["last speed (m/s)", (group) => last(group, curves, "forward_speed_m_per_s"), "number"],
      ], groups));
      const missing = names.filter((name) => !alike.some((run) => run.run === name));
      fill(said, missing.length > 0 && fault(`Not to be had: ${missing.join(", ")}. Such a run is damaged, or has gone; the list says which.`));
    } catch (error) {
      if (!left.signal.aborted) fill(said, fault(error.message));
    }
  }

  repeatedly(EVERY_MS, look, left.signal);
  return { element, close: () => (left.abort(), charts.forEach((one) => one.close())) };
}

/** Runs that are alike but for the seed, by what their names have in common. */
export function grouped(alike) {
  const groups = new Map();
  for (const run of alike) groups.set(run.alike, [...(groups.get(run.alike) ?? []), run]);
  return [...groups.values()].map((runs) => ({ runs, names: new Set(runs.map((run) => run.run)), label: common(runs) }));
}

function common(runs) {
  const names = runs.map((run) => run.run), seeds_n = new Set(runs.map((run) => run.seed)).size;
  if (names.length === 1) return names[0];
  const many = seeds_n === names.length ? `${seeds_n} seeds` : `${names.length} runs, ${seeds_n} seed${seeds_n === 1 ? "" : "s"}`;
  let n = 0;
  while (names.every((name) => n < name.length && name[n] === names[0][n])) n += 1;
  return `${names[0].slice(0, n).replace(/[-_.]?(seed)?[-_.]?$/, "") || names[0]} (${many})`;
}

function lines(groups, curves, column) {
  const most = curves.reduce((most, row) => Math.max(most, row.iteration + 1), 0);
  const axis = Array.from({ length: most }, (_, k) => k);
  const data = [axis], series = [];
  groups.forEach((group, k) => {
    const found = axis.map(() => []);
    for (const row of curves) if (group.names.has(row.run) && row[column] !== null) found[row.iteration].push(row[column]);
    const of = (statistic) => found.map((values) => (values.length ? statistic(values) : null));
    const style = looks(k);
    series.push({ label: group.label, ...style });
    data.push(of((values) => values.reduce((sum, value) => sum + value, 0) / values.length));
    if (group.runs.length > 1) {
      const upper = series.length;
      series.push({ label: `${group.label}: highest`, hidden: true, stroke: style.stroke, under: upper + 1 }, { label: `${group.label}: lowest`, hidden: true, stroke: style.stroke });
      data.push(of((values) => Math.max(...values)), of((values) => Math.min(...values)));
    }
  });
  return [data, series];
}

function last(group, curves, column) {
  const values = group.runs.map((run) => curves.filter((row) => row.run === run.run).at(-1)?.[column]).filter((value) => value !== undefined && value !== null);
  if (!values.length) return "–";
  const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
  return values.length === 1 ? number(mean) : `${number(mean)} (${number(Math.min(...values))} … ${number(Math.max(...values))})`;
}
