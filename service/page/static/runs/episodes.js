// The episodes of an iteration, those of evaluations, and where the robot was stuck: each leads into the replay.

import { rows } from "../base/api.js";
import { empty, fault, field, fill, h, table } from "../base/dom.js";
import { duration, number, share } from "../base/format.js";
import { to } from "../base/link.js";

const SOON_MS = 200;
const MOST_N = 500;
const EPISODES = `SELECT * FROM episodes WHERE iteration = $iteration ORDER BY episode_id LIMIT ${MOST_N + 1}`;
const STUCK = "SELECT episode_id, step, time_s, duration_s, ground_slope_deg FROM stuck WHERE iteration = $iteration ORDER BY duration_s DESC LIMIT 50";
const EVALUATED = `SELECT e.*, v.purpose FROM evaluation_episodes e JOIN evaluations v USING (run, evaluation_id) ORDER BY evaluation_id DESC, episode_id LIMIT ${MOST_N + 1}`;

/** The lists; `picked(iteration)` is told which iteration somebody wants to see, null for the newest. */
export function episodes(name, picked, signal) {
  const which = h("input", { type: "number", min: 0, step: 1, onchange: () => picked(which.value === "" ? null : Number(which.value)) });
  const parts = ["", "", ""].map(() => h("div"));
  const first = empty("No iteration is committed yet.");
  const element = h("div", {}, h("div", { class: "row" }, field("Iteration", which), h("a", { href: to("replay", { run: name, newest: 1 }) }, "Watch the newest episode as it comes")), first, parts);
  let pinned = null, newest = null, opened = false, seen = -1, waits = 0;

  async function look() {
    waits = 0;
    if (which.value === "" || !element.isConnected) return;
    const iteration = Number(which.value), before = seen;
    seen = iteration;
    first.hidden = true;
    if (before !== iteration) parts.forEach((part, k) => fill(part, k === 0 && empty(`Reading iteration ${iteration} …`)));
    await part(0, iteration, EPISODES, { iteration }, (found) => [h("h2", {}, `Episodes of iteration ${iteration}`), found.length ? of(found, "Episodes") : empty("This iteration has no episode, or is not there.")]);
    await part(1, iteration, STUCK, { iteration }, (found) => [h("h2", {}, "Where the robot was stuck longest"), found.length ? stuckTable(found) : empty("Nowhere in this iteration.")]);
    await part(2, iteration, EVALUATED, {}, (found) => [h("h2", {}, "Episodes of evaluations, the newest first"), found.length ? of(found, "Episodes of evaluations") : empty("No evaluation is kept yet.")]);
  }

  async function part(k, iteration, sql, parameters, shown) {
    if (iteration !== seen || signal.aborted) return;
    try {
      const found = await rows(name, sql, parameters, signal);
      if (iteration === seen) fill(parts[k], shown(found));
    } catch (error) {
      if (!signal.aborted) fill(parts[k], fault(error.message));
    }
  }

  function of(found, caption) {
    const evaluation = (row) => row.evaluation_id ?? null;
    const cut = found.length > MOST_N && h("p", { class: "count" }, `There are more than ${MOST_N}; the first ${MOST_N} are here. A `, h("a", { href: to("query", { runs: name, sql: "SELECT * FROM " + (found[0].purpose ? "evaluation_episodes" : `episodes WHERE iteration = ${seen}`) }) }, "query"), " has all.");
    return [cut, table(caption, [
      ...(found[0].purpose ? [["evaluation", (row) => `${row.evaluation_id}: ${row.purpose}`]] : []),
      ["episode", (row) => h("a", { href: to("replay", { run: name, episode: row.episode_id, evaluation: evaluation(row) }), "aria-label": `replay episode ${row.episode_id}` }, number(row.episode_id)), "number"],
      ["cost", (row) => number(row.cost), "number"], ["m/s", (row) => number(row.forward_speed_m_per_s), "number"], ["stuck", (row) => share(row.stuck_share), "number"],
      ["waypoints", (row) => number(row.waypoints_reached), "number"], ["path (m)", (row) => number(row.path_length_m), "number"], ["steps", (row) => number(row.steps), "number"], ["ended", (row) => row.ended_by],
    ], found.slice(0, MOST_N))];
  }

  function stuckTable(found) {
    return table("Where the robot was stuck", [
      ["episode", (row) => h("a", { href: to("replay", { run: name, episode: row.episode_id, step: row.step }), "aria-label": `replay episode ${row.episode_id} from step ${row.step}` }, `${row.episode_id} at ${row.time_s.toFixed(1)} s`)],
      ["for", (row) => duration(row.duration_s), "number"], ["slope (°)", (row) => number(row.ground_slope_deg), "number"],
    ], found);
  }

  return {
    element,
    opened: () => ((opened = true), look()),
    choose(iteration) {
      if (iteration === pinned) return;
      pinned = iteration;
      which.value = pinned ?? newest ?? "";
      if (opened) look();
    },
    iteration(committed) {
      newest = committed;
      which.max = newest;
      if (pinned !== null) return;
      which.value = newest;
      if (opened) waits ||= setTimeout(look, SOON_MS); // many iterations may come at once
    },
  };
}
