// Names of tables and columns, offered while SQL is written.

import { fill, h } from "../base/dom.js";

const OFFERED_N = 12;
const WORDS = ["SELECT", "FROM", "WHERE", "GROUP BY", "ORDER BY", "LIMIT", "JOIN", "USING", "HAVING", "QUALIFY", "OVER", "PARTITION BY", "avg", "count", "max", "min", "sum", "arg_max", "arg_min", "corr", "median", "quantile_cont", "stddev_samp", "DISTINCT", "DESC"];

/** A list under a text field. `known` promises rows {table_name, column_name, unit, meaning}, or null. */
export function completion(input, known) {
  const element = h("ul", { class: "completion", role: "listbox", id: "names", "aria-label": "Names", hidden: true });
  let names = [], offered = [], at = 0;
  known.then((rows) => (names = rows ? named(rows) : []));
  input.setAttribute("aria-autocomplete", "list");
  input.setAttribute("aria-controls", "names");
  input.addEventListener("input", offer);
  input.addEventListener("blur", () => setTimeout(close, 150)); // a click into the list comes first
  input.addEventListener("keydown", (event) => {
    if (element.hidden) return;
    if (event.key === "ArrowDown" || event.key === "ArrowUp") show((at + (event.key === "ArrowDown" ? 1 : -1) + offered.length) % offered.length);
    else if ((event.key === "Enter" && !event.ctrlKey && !event.metaKey) || event.key === "Tab") take(offered[at]);
    else if (event.key === "Escape") close();
    else return;
    event.preventDefault();
  });

  function word() {
    return /[A-Za-z_][A-Za-z0-9_]*$/.exec(input.value.slice(0, input.selectionStart))?.[0] ?? "";
  }

  function offer() {
    const begun = word().toLowerCase();
    const near = mentioned(input.value);
    offered = begun.length < 2 ? [] : names.filter((one) => one.name.toLowerCase().includes(begun) && one.name.toLowerCase() !== begun)
      .sort((a, b) => rank(a, begun, near) - rank(b, begun, near) || a.name.localeCompare(b.name)).slice(0, OFFERED_N);
    if (!offered.length) return close();
    element.hidden = false;
    show(0);
  }

  function show(k) {
    at = k;
    fill(element, offered.map((one, n) => h("li", { role: "option", id: `name-${n}`, "aria-selected": String(n === at), onmousedown: (event) => (event.preventDefault(), take(one)) }, h("span", {}, one.name), h("small", {}, one.about))));
    input.setAttribute("aria-activedescendant", `name-${at}`);
    element.children[at].scrollIntoView({ block: "nearest" });
  }

  function take(one) {
    const end = input.selectionStart, begin = end - word().length;
    input.setRangeText(one.name, begin, end, "end");
    close();
  }

  function close() {
    element.hidden = true;
    input.removeAttribute("aria-activedescendant");
  }

  return { element, close };
}

function named(rows) {
  const columns = new Map();
  for (const row of rows) {
    const one = columns.get(row.column_name) ?? { name: row.column_name, tables: [], about: "" };
    one.tables.push(row.table_name);
    one.about ||= [row.unit === "1" || row.unit === "text" ? "" : row.unit, row.meaning].filter(Boolean).join(" · ");
    columns.set(row.column_name, one);
  }
  const tables = [...new Set(rows.map((row) => row.table_name))].map((name) => ({ name, tables: [name], about: "table" }));
  return [...tables, ...columns.values(), ...WORDS.map((name) => ({ name, tables: [], about: "" }))];
}

function mentioned(sql) {
  return new Set([...sql.matchAll(/\b(?:FROM|JOIN)\s+([a-z_]+)/gi)].map((found) => found[1].toLowerCase()));
}

/** Names that begin so, of tables that the SQL names, come first. */
function rank(one, begun, near) {
  return (one.name.toLowerCase().startsWith(begun) ? 0 : 2) + (near.size === 0 || one.tables.some((name) => near.has(name)) ? 0 : 1);
}
