// One SELECT over runs: completion of names, the rows, a plot of them, and the whole result as a file.

import { exactly, query, rows } from "../base/api.js";
import { empty, fault, field, fill, h, table } from "../base/dom.js";
import { number } from "../base/format.js";
import { here, to } from "../base/link.js";
import { completion } from "./completion.js";
import { plot } from "./plot.js";

const ROWS_N = 5000, SHOWN_N = 200;
const FORMS = ["csv", "parquet", "json", "arrow"];
const WARNINGS = "T6GPS-Warnings";
const FIRST = `SELECT run, iteration, cost, forward_speed_m_per_s
FROM iterations ORDER BY run, iteration`;

export function open(place) {
  const left = new AbortController();
  const runs = h("input", { type: "text", value: "*", spellcheck: "false", autocomplete: "off" });
  const sql = h("textarea", { class: "sql", spellcheck: "false", rows: 6, autocomplete: "off", autocapitalize: "off", onkeydown: (event) => {
    if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) (event.preventDefault(), choose());
  } });
  const known = rows("*", "SELECT table_name, column_name, type, unit, meaning FROM columns", {}, left.signal).catch(() => null); // said below, when somebody asks
  const list = completion(sql, known);
  const ask = h("button", { type: "button", class: "main", onclick: choose }, "Ask");
  const downloads = FORMS.map((form) => h("button", { type: "button", onclick: () => download(form) }, form));
  const said = h("div", { role: "status" }), result = h("div"), drawing = h("div");
  const columns = h("details", {}, h("summary", {}, "Tables and columns"), h("div"));
  let asked = "", latest = 0, drawn = null;
  fill(place, h("h1", { class: "hidden" }, "Query"),
    h("div", { class: "ask" }, field("Runs", runs, "a name, or a pattern such as rough-*"), h("div", { class: "sqlbox" }, field("SQL", sql, "one SELECT; Ctrl+Enter asks, Escape closes the list of names"), list.element)),
    h("div", { class: "row" }, ask, h("span", { class: "count" }, "Download the whole result:"), downloads), said, drawing, result, columns);
  place.querySelector(".sqlbox .field").style.display = "flex";
  columns.addEventListener("toggle", async () => {
    const found = await known;
    fill(columns.lastChild, found ? table("Tables and columns", [["table", (row) => row.table_name], ["column", (row) => row.column_name], ["unit", (row) => row.unit], ["meaning", (row) => row.meaning]], found) : empty("They can be had when there is a run."));
  }, { once: true });

  function choose() {
    list.close();
    const { x, y, by, marks } = here();
    const next = to("query", { runs: runs.value, sql: sql.value, x, y, by, marks });
    asked = "";
    if (location.hash === next) answer();
    else location.hash = next;
  }

  function bare() {
    return sql.value.trim().replace(/;\s*$/, "");
  }

  async function answer() {
    const number_ = (latest += 1);
    asked = `${runs.value} ${sql.value}`;
    fill(said, empty("Asked …"));
    ask.disabled = true;
    try {
      const found = await query(runs.value.trim(), `SELECT * FROM (\n${bare()}\n) LIMIT ${ROWS_N + 1}`, { signal: left.signal });
      const warnings = JSON.parse(found.headers.get(WARNINGS) ?? "[]");
      const lines = exactly(await found.text());
      if (number_ === latest) show(lines, warnings);
    } catch (error) {
      if (!left.signal.aborted && number_ === latest) fill(said, fault(error.message)); // the last result stays below
    }
    ask.disabled = false;
  }

  function show(found, warnings) {
    const cut = found.length > ROWS_N;
    const shown = cut ? found.slice(0, ROWS_N) : found;
    fill(said, warnings.map(fault), h("p", { class: "count" }, cut ? `More than ${ROWS_N} rows; the first ${ROWS_N} are here, a file has all.` : `${found.length} row${found.length === 1 ? "" : "s"}`));
    drawn?.close();
    drawn = plot(shown, here());
    fill(drawing, drawn.element);
    if (!found.length) return fill(result, empty("No row answers this."));
    const names = Object.keys(found[0]), leads = names.includes("episode_id");
    const cells = names.map((name) => [name, (row) => text(row[name]), shown.some((row) => typeof row[name] === "number") ? "number" : null]);
    if (leads) cells.unshift(["replay", (row) => replay(row)]);
    const more = h("button", { type: "button", onclick: () => fill(result, table("Result", cells, shown)) }, `Show all ${shown.length}`);
    fill(result, table("Result", cells, shown.slice(0, SHOWN_N)), shown.length > SHOWN_N && more);
  }

  function replay(row) {
    const name = row.run ?? (/[*?[]/.test(runs.value) ? null : runs.value.trim());
    if (!name) return "–";
    return h("a", { href: to("replay", { run: name, episode: row.episode_id, evaluation: row.evaluation_id, step: row.step }), "aria-label": `replay episode ${row.episode_id} of ${name}` }, "▶ replay");
  }

  async function download(form) {
    fill(said, empty(`The result is made as ${form} …`));
    try {
      const found = await (await query(runs.value.trim(), bare(), { form, signal: left.signal })).blob();
      const address = URL.createObjectURL(found);
      h("a", { href: address, download: `query.${form}` }).click();
      setTimeout(() => URL.revokeObjectURL(address), 60_000);
      fill(said, h("p", { class: "count" }, `query.${form}, ${Math.ceil(found.size / 1024)} kB`));
    } catch (error) {
      if (!left.signal.aborted) fill(said, fault(error.message));
    }
  }

  return {
    update(values) {
      runs.value = values.runs ?? "*";
      sql.value = values.sql ?? FIRST;
      if (values.sql !== undefined && asked !== `${runs.value} ${sql.value}`) answer();
    },
    close: () => (left.abort(), drawn?.close()),
  };
}

function text(value) {
  if (typeof value === "number") return number(value, 6);
  if (value === null || value === undefined) return "–";
  if (typeof value === "object") return JSON.stringify(value).slice(0, 120);
  return String(value);
}
