// The replay of an episode, and of a second one beside it.

import { Refusal, get, part, repeatedly, run as path } from "../base/api.js";
import { empty, fault, fill, h, select, table } from "../base/dom.js";
import { number } from "../base/format.js";
import { here, note, to } from "../base/link.js";
import { clock } from "./clock.js";
import { flat } from "./flat.js";
import { isStuck, moment, segmentAt } from "./motion.js";
import { picker } from "./pickers.js";
import { timeline } from "./timeline.js";

const NEWEST_MS = 3000, REST_MS = 200;
const NO_DRIVE = { drive: "", policies: "", friction: "", terrain: "", waypoint: "" };
const RATES = ["0.25", "0.5", "1", "2", "4", "8"];

export function open(place) {
  const left = new AbortController();
  const names = h("datalist", { id: "replay-runs" });
  const first = picker("A", (chosen) => go({ ...NO_DRIVE, ...chosen, newest: "", step: "" }), names);
  const second = picker("B, beside it", ({ run, episode, evaluation }) => go({ run2: run, episode2: episode, evaluation2: evaluation }), names);
  const beside = h("button", { type: "button", onclick: () => (second.element.hidden ? go({ run2: wanted.run, episode2: Number(wanted.episode || 0) + 1 }) : go({ run2: "", episode2: "", evaluation2: "" })) });
  const newest = h("button", { type: "button", onclick: () => go(wanted.newest ? { newest: "", episode: loaded[0]?.episode } : { newest: 1, episode: "", evaluation: "" }) }, "Newest, as they come");
  const wheel = h("button", { type: "button", class: "main", onclick: () => go({ drive: "new", newest: "", episode: loaded[0].episode, run2: "", episode2: "", evaluation2: "" }) }, "Drive it yourself");
  const said = h("div"), cockpit = h("div", { class: "drive" }), stages = h("div", { class: "stages" }), lines = h("div", { class: "lines" }), numbers = h("div");
  const play = h("button", { type: "button", class: "main play", onclick: () => time.play(!time.state.playing) });
  const scrub = h("input", { type: "range", class: "scrub", min: 0, max: 0, step: 1, value: 0, "aria-label": "Step", oninput: () => (time.play(false), time.set(Number(scrub.value) * step_s())) });
  const rate = select(RATES.map((value) => [value, `${value} ×`]), { value: "1", onchange: () => (note({ rate: rate.value === "1" ? "" : rate.value }), (time.state.rate = Number(rate.value))) });
  const follow = h("input", { type: "checkbox", checked: true, onchange: () => (note({ follow: follow.checked ? "" : "no" }), views.forEach((one) => one.view.follow(follow.checked))) });
  const output = h("output");
  const details = h("details", { ontoggle: () => (told = -1) }, h("summary", {}, "Numbers at this step"), numbers);
  const transport = h("div", { class: "transport", role: "group", "aria-label": "Replay" }, play, button("Step back", -1), button("Step on", 1), h("label", {}, "Speed", rate), h("label", {}, follow, "Follow"),
    h("button", { type: "button", onclick: () => views.forEach((one) => one.view.look()) }, "Reset view"), output);
  let wanted = {}, drive = null, loaded = [], views = [], rows = [], told = -1, asked = 0, rests = 0;
  const time = clock(shown, (playing) => {
    fill(play, playing ? "❚❚ Pause" : "▶ Play");
    clearTimeout(rests);
    if (playing || !loaded.length) return;
    time.set(step() * step_s()); // what stands is a stored row
    rests = setTimeout(() => note({ step: step() || "" }), REST_MS); // where somebody has come to rest
  });
  const step = () => Math.floor(time.state.time_s / step_s() + 1e-6);
  const step_s = () => (loaded[0]?.time_s.length > 1 ? loaded[0].time_s[1] : 0.1);
  time.play(false);
  fill(place, h("h1", { class: "hidden" }, "Replay"), names, h("div", { class: "pickers" }, first.element, second.element, beside, newest, wheel), said, stages, lines, scrub, transport, details, cockpit);
  wheel.hidden = true; // before there is an episode
  document.addEventListener("keydown", keys);
  get("/v1/runs", left.signal).then((runs) => fill(names, runs.map((run) => h("option", { value: run.name })))).catch(() => {}); // names are a convenience; the fields take any

  function button(title, by) {
    return h("button", { type: "button", onclick: () => by_steps(by) }, title);
  }

  function by_steps(by) {
    time.play(false);
    time.set((Math.round(time.state.time_s / step_s()) + by) * step_s());
  }

  function keys(event) {
    if (drive || !loaded.length || event.defaultPrevented || event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.target.closest("input:not([type=range], [type=checkbox]), select, textarea, .scroll") || document.querySelector("dialog[open]")) return;
    const by = { ArrowLeft: -1, ArrowRight: 1, Home: -1e9, End: 1e9 }[event.key];
    if (by) by_steps(by * (event.shiftKey ? 10 : 1));
    else if (event.key === " " && !event.target.closest("button, summary, input")) time.play(!time.state.playing);
    else return;
    event.preventDefault();
  }

  function go(values) {
    const { view, ...before } = here();
    location.hash = to("replay", { ...before, ...values });
  }

  async function update(values) {
    const before = wanted;
    wanted = values;
    first.show(values);
    second.show({ run: values.run2, episode: values.episode2, evaluation: values.evaluation2 });
    second.element.hidden = !values.run2;
    fill(beside, values.run2 ? "One alone" : "Another one beside it");
    newest.setAttribute("aria-pressed", String(Boolean(values.newest)));
    rate.value = RATES.includes(values.rate) ? values.rate : "1";
    time.state.rate = Number(rate.value);
    follow.checked = values.follow !== "no";
    if (["run", "episode", "evaluation", "run2", "episode2", "evaluation2", "newest"].some((key) => values[key] !== before[key])) await load(false);
    else if (values.step !== undefined && loaded.length) time.set(wantedStep() * step_s());
    await driven(values);
  }

  /** Show a drive in the place of the replay, where the address says so. */
  async function driven(values) {
    const whether = Boolean(values.drive) && loaded.length > 0;
    const driving = whether && (await part(() => import("../drive/view.js")).catch(({ message }) => undriven(message)));
    if (wanted !== values || left.signal.aborted) return;
    for (const element of [said, stages, lines, scrub, transport, details]) element.hidden = Boolean(driving);
    wheel.hidden = whether || !loaded.length;
    if (drive && (!driving || drive.episode !== loaded[0])) drive.view.close(), (drive = null);
    if (!driving) return;
    time.play(false);
    drive ??= { episode: loaded[0], view: driving.open(cockpit, loaded[0], () => go(NO_DRIVE)) };
    drive.view.update(values);
  }

  /** The replay stays, with a sentence why nobody can drive, and both ways from here. */
  function undriven(sentence) {
    fill(said, fault(sentence), h("button", { type: "button", class: "main", onclick: () => (fill(said), driven(wanted)) }, "Try again"), " ",
      h("button", { type: "button", onclick: () => (fill(said), go(NO_DRIVE)) }, "Back to the replay"));
  }

  async function load(playing) {
    const number_ = (asked += 1);
    clearTimeout(rests);
    if (!wanted.run) return fill(stages, empty("Choose a run and an episode. Links of episodes lead here, also from queries and curves."));
    fill(said, loaded.length ? null : empty("Reading the episode …"));
    try {
      const found = [await replay(wanted.run, wanted.newest ? "" : (wanted.episode ?? 0), wanted.evaluation)];
      if (wanted.run2) found.push(await replay(wanted.run2, wanted.episode2 ?? 0, wanted.evaluation2));
      const solid = await three();
      if (number_ !== asked || left.signal.aborted) return;
      fill(said);
      build(found, solid);
      time.state.length_s = Math.max(...found.map((episode) => episode.time_s.at(-1)));
      time.set(playing ? 0 : wantedStep() * step_s());
      time.play(playing);
    } catch (error) {
      if (left.signal.aborted || number_ !== asked) return;
      fill(said, fault(error.message), !(error instanceof Refusal) && h("button", { type: "button", class: "main", onclick: async () => (await load(false), driven(wanted)) }, "Try again"));
    }
  }

  const wantedStep = () => (Number.isFinite(Number(wanted.step)) ? Number(wanted.step) : 0);

  function replay(name, episode, evaluation) {
    const query = new URLSearchParams(Object.entries({ episode, evaluation }).filter(([, value]) => value !== undefined && value !== ""));
    return get(`${path(name)}/replay?${query}`, left.signal);
  }

  function build(found, solid) {
    views.forEach((one) => one.view.close());
    rows.forEach((line) => line.close());
    loaded = found;
    const letters = ["A", "B"], groups = [];
    found.forEach((episode, k) => {
      const group = groups.find((one) => one.ground === episode.ground_id);
      if (group) group.indices.push(k);
      else groups.push({ ground: episode.ground_id, indices: [k] });
    });
    views = groups.map(({ indices }) => {
      const tags = indices.map((k) => h("div", { class: letters[k] === "B" ? "second" : null }));
      const stage = h("div", { class: "stage", tabindex: "0", role: "group", "aria-label": "Scene: drag to turn, pinch or scroll to come nearer; arrows step, space plays" }, h("div", { class: "tag" }, tags), legend(found[indices[0]], solid));
      return { indices, tags, stage };
    });
    fill(stages, views.map((one) => one.stage));
    for (const one of views) {
      const args = [one.stage, one.indices.map((k) => found[k]), one.indices.map((k) => letters[k])];
      one.view = solid ? solid.scene(...args) : flat(...args);
      one.view.follow(follow.checked);
    }
    if (!solid) fill(said, empty("This browser draws nothing in three dimensions (WebGL), so that the robot is seen from above."));
    if (groups.length > 1) fill(said, empty("A and B walk on different ground, so that each has a view of its own."));
    const length_s = Math.max(...found.map((episode) => episode.time_s.at(-1)));
    rows = found.map((episode, k) => timeline(episode, letters[k], length_s, (time_s) => (time.play(false), time.set(time_s))));
    fill(lines, rows.map((line) => line.element));
    scrub.max = Math.round(length_s / step_s());
    told = -1;
  }

  function shown(time_s) {
    if (!views.length) return;
    for (const { view } of views) {
      if (time_s !== shown.before || told < 0) view.show(time_s);
      view.render();
    }
    if (time_s !== shown.before || told < 0) rows.forEach((line) => line.show(time_s));
    shown.before = time_s;
    if (step() !== told) tell(step(), time_s);
  }

  function tell(step, time_s) {
    told = step;
    const row_s = (step * step_s()).toFixed(1);
    scrub.value = step;
    scrub.setAttribute("aria-valuetext", `step ${step}, ${row_s} s`);
    fill(output, `step ${step} · ${row_s} s`);
    for (const { indices, tags } of views) indices.forEach((k, n) => fill(tags[n], words(loaded[k], k, time_s)));
    if (details.open) fill(numbers, views.flatMap(({ view, indices }) => indices.map((k, n) => positions(loaded[k], view.nodes(n)))));
  }

  function words(episode, k, time_s) {
    const { row } = moment(episode, time_s);
    return [h("b", {}, `${"AB"[k]} · ${episode.run} ${episode.evaluation === null ? "" : `evaluation ${episode.evaluation}, `}episode ${episode.episode}`), h("br"),
      `${number(episode.forward_speed_m_per_s[row])} m/s · cost ${number(episode.cost[row])}`, h("br"), segmentAt(episode, row).name, isStuck(episode, row) ? " · ⚠ stuck" : ""];
  }

  repeatedly(NEWEST_MS, async () => {
    if (!wanted.newest || time.state.playing || !loaded.length) return;
    const found = await replay(wanted.run, "", undefined).catch(() => null); // the next look says what is wrong, if it stays so
    if (found && (found.episode !== loaded[0].episode || found.run !== loaded[0].run)) await load(true);
  }, left.signal);

  return { update, close() {
    left.abort();
    document.removeEventListener("keydown", keys);
    clearTimeout(rests);
    drive?.view.close();
    time.close();
    views.forEach((one) => one.view.close());
    rows.forEach((line) => line.close());
  } };
}

/** The drawing in three dimensions, null where the browser cannot. */
async function three() {
  if (document.createElement("canvas").getContext("webgl2") === null) return null;
  return part(() => import("./scene.js"));
}

function legend(episode, solid) {
  return h("div", { class: "legend" }, solid && h("span", {}, "tension 0 ", h("i"), ` ${number(episode.brightest_n)} N, thicker as tighter`), h("span", {}, "sign above a robot: its triangle, Δ blue, Λ orange"), h("span", {}, "circle: waypoint"));
}

function positions(episode, nodes) {
  return table(`Nodes of episode ${episode.episode} of ${episode.run}`, [
    [`node of ${episode.run} ${episode.episode}`, (row) => row[0]], ...["x", "y", "z"].map((axis, k) => [`${axis} (m)`, (row) => row[1][k].toFixed(4), "number"]),
  ], nodes.map((point, node) => [node, point]));
}
