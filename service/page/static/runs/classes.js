// Segment classes of an iteration, with the modes of their models.

import { rows } from "../base/api.js";
import { empty, fault, field, fill, h, table } from "../base/dom.js";
import { className, number } from "../base/format.js";

const SOON_MS = 200;
const SQL = "SELECT * FROM classes WHERE iteration = $iteration ORDER BY segments DESC, kind, entry_edge, exit_edge";

/** The list; `picked(iteration)` is told which iteration somebody wants to see, null for the newest. */
export function classes(name, picked, signal) {
  const which = h("input", { type: "number", min: 0, step: 1, onchange: () => picked(which.value === "" ? null : Number(which.value)) });
  const body = h("div", {}, empty("No iteration is committed yet."));
  const element = h("div", {}, field("Iteration", which), body);
  let newest = null, pinned = null, seen = false, waits = 0;

  async function look() {
    waits = 0;
    if (which.value === "") return;
    try {
      const found = await rows(name, SQL, { iteration: Number(which.value) }, signal);
      const most = Math.max(1, ...found.map((row) => row.modes ?? 0));
      fill(body, found.length ? table("Segment classes", [
        ["class", (row) => className(row) + (row.truncated ? " (first part)" : "")], ["models", (row) => (row.pooled ? "pooled" : "own")], ["segments", (row) => number(row.segments), "number"],
        ["steps", (row) => number(row.rows), "number"], ["aligned", (row) => number(row.time_steps), "number", "time steps of the class"],
        ["modes", (row) => h("span", { class: "bar" }, h("meter", { min: 0, max: most, value: row.modes ?? 0, "aria-label": "modes" }), number(row.modes)), "number"],
        ["residual", (row) => number(row.residual), "number", "in standard deviations"], ["cost", (row) => number(row.cost), "number"], ["promised", (row) => number(row.predicted_cost_change), "number", "predicted change of cost per step"],
      ], found) : empty("This iteration has no class, or is not there."));
    } catch (error) {
      if (!signal.aborted) fill(body, fault(error.message));
    }
  }

  return {
    element,
    opened: () => ((seen = true), look()),
    choose(iteration) {
      if (iteration === pinned) return;
      pinned = iteration;
      which.value = pinned ?? newest ?? "";
      if (seen) look();
    },
    iteration(committed) {
      newest = committed;
      which.max = newest;
      if (pinned !== null) return;
      which.value = newest;
      if (seen && element.isConnected) waits ||= setTimeout(look, SOON_MS); // many iterations may come at once
    },
  };
}
