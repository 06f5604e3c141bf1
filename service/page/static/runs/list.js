// The runs of the root: which there are, which of them are looked at, and which are compared.

import { get, repeatedly } from "../base/api.js";
import { fault, field, fill, h, select } from "../base/dom.js";
import { number } from "../base/format.js";
import { to } from "../base/link.js";
import { sign, standing, tone } from "./state.js";

const EVERY_MS = 3000;
const ORDERS = {
  name: ["name", (a, b) => a.name.localeCompare(b.name, undefined, { numeric: true })],
  cost: ["lowest cost", (a, b) => (a.cost ?? Infinity) - (b.cost ?? Infinity)],
  speed: ["fastest", (a, b) => (b.forward_speed_m_per_s ?? -Infinity) - (a.forward_speed_m_per_s ?? -Infinity)],
};
const STATES = [["", "all"], "at work", "unfinished", "done", "damaged"];

/** The list. `changed({filter, state, order, compare})` is told what somebody chooses; `told(runs)` what there is. */
export function list({ changed, told, start, signal }) {
  const filter = h("input", { type: "search", placeholder: "part of a name", oninput: () => choose({ filter: filter.value }) });
  const states = select(STATES, { onchange: () => choose({ state: states.value }) });
  const orders = select(Object.entries(ORDERS).map(([key, [text]]) => [key, text]), { onchange: () => choose({ order: orders.value }) });
  const body = h("tbody");
  const count = h("p", { class: "count", role: "status" });
  const said = h("div");
  const element = h("section", { class: "list", "aria-label": "Runs" },
    h("div", { class: "filters" }, field("Find", filter), field("State", states), field("Order", orders),
      h("button", { type: "button", class: "main", onclick: start }, "Start a run")),
    count, said,
    h("div", { class: "scroll rows", tabindex: "0", role: "region", "aria-label": "List of runs" },
      h("table", {}, h("caption", { class: "hidden" }, "Runs of this root"),
        h("thead", {}, h("tr", {}, ["", "run", "iterations", "cost", "m/s", "state"].map((title, k) =>
          h("th", { scope: "col", class: k > 1 && k < 5 ? "number" : null }, title || h("span", { class: "hidden" }, "compare"))))), body)));
  const known = new Map();
  const chosen = { filter: "", state: "", order: "name", compare: new Set(), run: null };
  let runs = null;

  function choose(values) {
    Object.assign(chosen, values);
    draw();
    changed({ filter: chosen.filter, state: chosen.state, order: chosen.order === "name" ? "" : chosen.order, compare: [...chosen.compare].join(",") });
  }

  function draw() {
    if (!runs) return;
    const text = chosen.filter.toLowerCase();
    const shown = runs.filter((run) => run.name.toLowerCase().includes(text) && (!chosen.state || standing(run) === chosen.state));
    shown.sort(ORDERS[chosen.order][1]);
    const wanted = shown.map((run) => row(run));
    const same = wanted.length === body.children.length && wanted.every((line, k) => line === body.children[k]);
    if (!same) fill(body, wanted); // only then: whoever has the focus in it keeps it
    fill(count, runs.length === 0 ? "No run yet. Start one, or train with ‘t6gps train’ in this root." : shown.length === runs.length ? `${runs.length} run${runs.length === 1 ? "" : "s"}` : `${shown.length} of ${runs.length} runs`,
      chosen.compare.size > 0 && h("span", {}, ` · ${chosen.compare.size} compared `, h("button", { type: "button", class: "quiet", onclick: () => choose({ compare: new Set() }) }, "Clear")));
  }

  function row(run) {
    const line = known.get(run.name) ?? made(run.name);
    known.set(run.name, line);
    line.show(run);
    return line.element;
  }

  function made(name) {
    const box = h("input", { type: "checkbox", "aria-label": `compare ${name}`, onchange: () => {
      chosen.compare[box.checked ? "add" : "delete"](name);
      choose({});
    } });
    const link = h("a", { href: "#" }, name);
    const bar = h("progress", { max: 1, value: 0, "aria-label": `iterations of ${name}` });
    const cells = { done: h("span"), cost: h("td", { class: "number" }), speed: h("td", { class: "number" }), state: h("span") };
    const element = h("tr", {}, h("td", { class: "box" }, box), h("td", {}, link), h("td", { class: "number progress" }, bar, cells.done), cells.cost, cells.speed, h("td", {}, cells.state));
    let last = "";
    return { element, show(run) {
      const state = standing(run);
      const now = JSON.stringify([run, chosen.compare.has(name), chosen.run === name, chosen.filter, chosen.state, chosen.order, [...chosen.compare]]);
      if (now === last) return;
      last = now;
      box.checked = chosen.compare.has(name);
      link.href = to("runs", { run: name, filter: chosen.filter, state: chosen.state, order: chosen.order === "name" ? "" : chosen.order, compare: [...chosen.compare].join(",") });
      link.title = run.fault ?? "";
      element.toggleAttribute("data-chosen", chosen.run === name);
      link.toggleAttribute("aria-current", chosen.run === name);
      bar.max = run.planned || 1;
      bar.value = run.done ?? 0;
      fill(cells.done, run.planned ? `${run.done}/${run.planned}` : "–");
      fill(cells.cost, number(run.cost));
      fill(cells.speed, number(run.forward_speed_m_per_s));
      cells.state.className = `state ${tone(state)}`;
      fill(cells.state, `${sign(state)} ${state}`);
    } };
  }

  async function look() {
    try {
      runs = await get("/v1/runs", signal);
      fill(said);
      for (const name of known.keys()) if (!runs.some((run) => run.name === name)) known.delete(name);
      draw();
      told(runs);
    } catch (error) {
      if (signal.aborted) return;
      if (error.status) fill(said, fault(error.message));
    }
  }

  repeatedly(EVERY_MS, look, signal);
  return { element, look, update(values) {
    Object.assign(chosen, { filter: values.filter ?? "", state: STATES.includes(values.state) ? values.state : "", order: Object.hasOwn(ORDERS, values.order ?? "") ? values.order : "name", run: values.run ?? null, compare: new Set((values.compare ?? "").split(",").filter(Boolean)) });
    filter.value = chosen.filter;
    states.value = chosen.state;
    orders.value = chosen.order;
    draw();
  } };
}
