// Which policies drive: the first is that of the shown episode, others race with it.

import { get, run as path } from "../base/api.js";
import { field, fill, h, select } from "../base/dom.js";
import { KINDS, TRIANGLES, number } from "../base/format.js";
import { LETTERS, SHADES } from "./live.js";

export const MOST_N = 4;

/** Policies as the address has them: RUN:VERSION, several with commas; no run has either sign in its name. */
export const written = (entries) => entries.map(({ run, version }) => `${run}:${version}`).join(",");
export const read = (text) => text.split(",").filter(Boolean).slice(0, MOST_N).map((one) => {
  const [run, version] = one.split(":");
  return { run, version: Number(version) };
});

/** The version that acted in an episode, or the nearest that its run keeps. */
export async function acting({ run, summary }, signal) {
  const kept = await versions(run, signal);
  return kept.reduce((best, one) => (Math.abs(one - summary.policy_version) < Math.abs(best - summary.policy_version) ? one : best), kept[0]);
}

/** The versions that a run keeps. An error where there is none. */
export async function versions(run, signal) {
  const kept = await get(`${path(run)}/policies`, signal);
  if (!kept.length) throw new Error(`Run ${run} has no policy yet. Wait until its first iteration is finished.`);
  return kept;
}

/** A list of them with what each does; `changed(entries)` is told what somebody chooses, `failed(sentence)` why not. */
export function entrants(changed, failed, names) {
  const body = h("tbody"), told = [];
  const name = h("input", { type: "text", list: names, size: 14, autocomplete: "off", spellcheck: "false", required: true });
  const adding = h("form", { class: "row", onsubmit: add }, field("Run", name), h("button", {}, "Race with its newest policy"));
  const element = h("section", { class: "entrants" },
    h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Robots" }, h("table", {}, h("caption", { class: "hidden" }, "Robots"),
      h("thead", {}, h("tr", {}, ["Robot", "Policy", "Place (m)", "Speed over 3 s", "To the waypoint", "Triangle", ""].map((title) => h("th", { scope: "col" }, title)))), body)), adding);
  let entries = [];

  async function add(event) {
    event.preventDefault();
    try {
      const kept = await versions(name.value.trim());
      changed([...entries, { run: name.value.trim(), version: kept.at(-1) }]);
      name.value = "";
    } catch (error) {
      failed(error.message);
    }
  }

  function row({ run, version }, k) {
    const choice = select([version], { value: version, "aria-label": `version of robot ${LETTERS[k]}`, onchange: () => changed(entries.with(k, { run, version: Number(choice.value) })) });
    versions(run).then((kept) => {
      fill(choice, kept.map((one) => h("option", { value: String(one) }, one)));
      choice.value = String(version);
    }).catch((error) => failed(error.message));
    const [place, speed, way, triangle] = (told[k] = [h("td"), h("td"), h("td"), h("td")]);
    const leave = k > 0 && h("button", { type: "button", "aria-label": `leave robot ${LETTERS[k]} out`, onclick: () => changed(entries.toSpliced(k, 1)) }, "✕");
    return h("tr", {}, h("th", { scope: "row" }, h("i", { class: `robot-${SHADES[k]}` }), ` ${LETTERS[k]}`), h("td", {}, `${run} version `, choice), place, speed, way, triangle, h("td", {}, leave));
  }

  return {
    element,
    show(next) {
      entries = next;
      told.length = 0;
      fill(body, entries.map(row));
      adding.hidden = entries.length >= MOST_N;
    },
    tell(robots) {
      robots.forEach(({ now }, k) => {
        if (!told[k] || !now) return;
        const [place, speed, way, triangle] = told[k];
        fill(place, now.com_m.slice(0, 2).map((value) => value.toFixed(2).replace("-", "−")).join(", "));
        fill(triangle, `${TRIANGLES[now.kind]} ${KINDS[now.kind]}`);
        fill(speed, `${number(now.speed_m_per_s)} m/s`);
        fill(way, now.ended_by ? `⚠ ended: ${now.ended_by}` : now.reached_after_s === null ? `${now.distance_m.toFixed(1)} m` : `✓ reached after ${now.reached_after_s.toFixed(1)} s`);
      });
    },
  };
}
