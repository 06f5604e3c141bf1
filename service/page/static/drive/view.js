// Somebody drives the policy of an episode: the server simulates, frames come as a stream, commands go back.

import { Refusal, answered, part, post } from "../base/api.js";
import { empty, fault, fill, h } from "../base/dom.js";
import { follow } from "../base/follow.js";
import { note } from "../base/link.js";
import { controls } from "./controls.js";
import { acting, entrants, read, written } from "./entries.js";
import { pacer, robots, take } from "./live.js";
import { plain } from "./plain.js";
import { pointing } from "./pointing.js";

const TOLD_MS = 250, STEP_M = 0.5;
const KEYS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };
const OWN = "t6gps-drive"; // the drive that this tab has begun, also before it was read again
const rounded = (value) => Math.round(100 * value) / 100;
const me = crypto.randomUUID().slice(0, 8);

/** A drive in an element, of the policy that acted in an episode and on its ground. `leave` leads back to the replay. */
export function open(place, episode, leave) {
  const left = new AbortController(), stages = h("div", { class: "stages" }), said = h("div", { role: "status" });
  const racers = entrants((next) => begin({ ...wanted, policies: written(next) }), (sentence) => fill(said, fault(sentence)), "replay-runs");
  const panel = controls(ask, push, { look: () => stage?.look(), follow: (whether) => stage?.follow(whether), end });
  const again = () => h("button", { type: "button", class: "main", onclick: () => begin(wanted) }, "Drive again");
  const help = h("details", {}, h("summary", {}, "By mouse, touch and keys"), h("ul", {},
    h("li", {}, "A click on the ground sets the waypoint. A drag from a robot pushes it. A drag elsewhere turns the view."),
    h("li", {}, "With the scene in focus, arrows move the waypoint by half a metre, as one sees it. Shift and an arrow push robot A."),
    h("li", {}, "Space pauses, and Home starts again.")));
  let wanted = {}, drive = null, watching = null, found = [], ground = null, raised = null, stage = null, pace = null, frame_n = 0, begun_n = 0, told_ms = 0, drawn_s = null;
  fill(place, h("p", { class: "count" }, `Seed and ground of episode ${episode.episode} of ${episode.run}. `, h("button", { type: "button", class: "quiet", onclick: leave }, "Back to the replay")), said, stages, panel.element, racers.element, help);
  frame_n = requestAnimationFrame(tick);

  async function begin(values) {
    const mine = (begun_n += 1), before = drive, overtaken = () => mine !== begun_n || left.signal.aborted;
    forget();
    drive = null;
    fill(said, empty("Starting the simulator …"));
    try {
      if (before && before === sessionStorage.getItem(OWN)) await ended(before);
      const entries = values.policies ? read(values.policies) : [{ run: episode.run, version: await acting(episode, left.signal) }];
      if (overtaken()) return;
      wanted = { ...values, policies: written(entries) };
      racers.show(entries);
      const other = (value) => (value === undefined ? null : Number.isFinite(Number(value)) ? Number(value) : value); // the server says what is wrong with it
      const { id } = await post("/v1/drives", { entries, episode: episode.episode, evaluation: episode.evaluation, friction: other(values.friction), terrain_difficulty: other(values.terrain) });
      if (overtaken()) return void (await ended(id));
      drive = id;
      sessionStorage.setItem(OWN, id);
      noted({ drive: id });
      look(values.waypoint);
    } catch (error) {
      if (!overtaken()) fill(said, fault(error.message), again());
    }
  }

  /** See nothing more of what was seen. */
  function forget() {
    watching?.abort();
    stage?.close();
    stage = raised = ground = null;
    found = [];
  }

  /** Let the address say it, so that it begins such a drive where this one has ended. */
  function noted(values) {
    Object.assign(wanted, values);
    const { policies, friction, terrain, waypoint } = wanted;
    note({ drive, policies, friction, terrain, waypoint });
  }

  async function look(waypoint) {
    const mine = (watching = new AbortController()), end = () => mine.abort();
    left.signal.addEventListener("abort", end, { once: true });
    try {
      await follow(`/v1/drives/${drive}/frames`, (kind, data) => {
        if (mine.signal.aborted) return;
        if (kind === "scene") scene(data), waypoint && (ask({ waypoint_m: waypoint.split(",").map(Number) }), (waypoint = null));
        else if (kind === "frame") frame(data);
        else if (kind === "steered") steered(data);
        else if (kind === "end") mine.abort(), over(data);
      }, mine.signal);
    } catch (error) {
      if (mine.signal.aborted) return;
      if (error instanceof Refusal && error.status === 404 && !found.length) begin(wanted); // the address is of one that has ended
      else over(error.message);
    } finally {
      left.signal.removeEventListener("abort", end);
    }
  }

  async function scene(data) {
    const before = ground;
    ground = data;
    panel.scene(data);
    if (before?.terrain_difficulty === data.terrain_difficulty) return; // what was changed is not to be seen
    stage?.close();
    stage = raised = null;
    found = robots(data);
    pace = pacer();
    racers.show(data.robots.map(({ run, version }) => ({ run, version })));
    const mine = found, drawing = await three().catch(({ message }) => ({ message }));
    if (mine !== found || left.signal.aborted) return;
    if (drawing?.message) return unread(data, drawing.message);
    const solid = drawing?.solid;
    const place = h("div", { class: "stage", tabindex: "0", role: "group", "aria-label": "Scene: click the ground for a waypoint, drag a robot to push it; arrows move the waypoint, with shift they push", onkeydown: keys },
      h("div", { class: "legend" }, h("span", {}, "click: waypoint"), h("span", {}, "drag a robot: push"), h("span", {}, "sign above a robot: its triangle, Δ blue, Λ orange")));
    fill(stages, place);
    fill(said, solid ? null : empty("This browser draws nothing in three dimensions (WebGL), so that the robot is seen from above."));
    raised = () => (solid ?? plain)(place, mine);
    if (mine.every((one) => one.now)) raise(); // its first frame has come meanwhile, and a pause brings no other
  }

  /** The drawing could not be had; a scene that comes later tries it again, too. */
  function unread(data, sentence) {
    ground = null;
    fill(said, fault(sentence), h("button", { type: "button", class: "main", onclick: () => scene(data) }, "Try again"), " ", h("button", { type: "button", onclick: leave }, "Back to the replay"));
  }

  function frame(data) {
    take(found, data);
    panel.frame(data);
    if (performance.now() - told_ms > TOLD_MS || data.paused) {
      told_ms = performance.now();
      racers.tell(found);
      panel.waypoint(data.robots[0].waypoint_m);
    }
    if (!stage && raised) raise();
  }

  /** Draw, from the first frame of a scene on. */
  function raise() {
    stage = raised();
    stage.follow(panel.following());
    stage.show(pace(found, performance.now()));
    stage.look();
    pointing(stage, { waypoint: (at) => ask({ waypoint_m: at.map(rounded) }), push: pushed, aimed: (n_s) => fill(said, n_s === null ? null : empty(`Push of ${n_s.toFixed(0)} N s`)) });
  }

  function tick(now_ms) {
    frame_n = requestAnimationFrame(tick);
    if (!stage) return;
    const time_s = pace(found, now_ms);
    if (time_s !== drawn_s) stage.show((drawn_s = time_s));
    stage.render();
  }

  function steered(command) {
    const { by, ...changes } = command;
    if ("friction" in changes) wanted.friction = changes.friction;
    if ("terrain_difficulty" in changes) wanted.terrain = changes.terrain_difficulty;
    if ("waypoint_m" in changes) wanted.waypoint = changes.waypoint_m.join(",");
    noted({});
    if (by !== me) fill(said, empty(`Somebody else with this token has changed ${Object.keys(changes).join(", ").replaceAll("_", " ")}. The last one who asks counts.`));
  }

  async function ask(command) {
    if (!drive) return fill(said, fault("This drive has ended."), again());
    try {
      await answered(`/v1/drives/${drive}`, { method: "POST", body: { by: me, ...command } });
    } catch (error) {
      fill(said, fault(error.message));
      if (ground) panel.scene(ground); // what was refused does not hold
    }
  }

  const pushed = (robot, [x, y]) => ask({ push: { robot, impulse_n_s: [x, y, 0] } });

  /** A direction as one sees it, in the world. */
  function seen([right, away]) {
    const [x, y] = stage?.ahead() ?? [0, 1];
    return [away * x + right * y, away * y - right * x];
  }

  function push(direction, n_s) {
    pushed(0, seen(direction).map((value) => value * n_s));
  }

  function keys(event) {
    const direction = KEYS[event.key];
    if (direction && event.shiftKey) push(direction, panel.strength());
    else if (direction && found[0]?.now) ask({ waypoint_m: seen(direction).map((value, axis) => rounded(found[0].now.waypoint_m[axis] + STEP_M * value)) });
    else if (event.key === " ") ask({ paused: !panel.state.paused });
    else if (event.key === "Home") ask({ restart: true });
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  function over(sentence) {
    drive = null;
    fill(said, fault(sentence), again());
  }

  async function ended(id) {
    await answered(`/v1/drives/${id}`, { method: "DELETE" }).catch((error) => {
      if (error.status !== 404) throw error; // it has ended by itself
    });
  }

  async function end() {
    const mine = drive;
    if (mine) await ended(mine).catch((error) => fill(said, fault(error.message)));
    leave();
  }

  return {
    update(values) {
      wanted = { policies: values.policies, friction: values.friction, terrain: values.terrain, waypoint: values.waypoint };
      if (drive && values.drive === drive) return;
      if (values.drive === "new") begin(wanted);
      else forget(), (drive = values.drive), look();
    },
    close() {
      left.abort();
      cancelAnimationFrame(frame_n);
      stage?.close();
      fill(place);
    },
  };
}

/** The drawing in three dimensions, null where the browser cannot. */
async function three() {
  if (document.createElement("canvas").getContext("webgl2") === null) return null;
  return part(() => import("./solid.js"));
}
