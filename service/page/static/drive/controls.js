// What somebody may ask of a drive by fields and buttons: everything that pointer and keys do, too.

import { field, fill, h } from "../base/dom.js";
import { MOST_N_S } from "./pointing.js";

const DIRECTIONS = [["↑", "away from you", [0, 1]], ["↓", "towards you", [0, -1]], ["←", "to the left", [-1, 0]], ["→", "to the right", [1, 0]]];

/** The controls; `ask(command)` is told what is asked, `push(direction, N s)` with a direction as one sees it. */
export function controls(ask, push, { look, follow, end }) {
  const pause = h("button", { type: "button", class: "main play", onclick: () => ask({ paused: !state.paused }) });
  const friction = slider("Friction", 0.05, 1.5, (value) => ask({ friction: value }));
  const terrain = slider("Terrain", 0, 1.5, (value) => ask({ terrain_difficulty: value }), "1 is the paper's ground");
  const x = place(), y = place();
  const strength = h("input", { type: "number", min: 5, max: MOST_N_S, step: 5, value: 60, required: true });
  const following = h("input", { type: "checkbox", checked: true, onchange: () => follow(following.checked) });
  const output = h("output");
  const state = { paused: false };
  const element = h("div", { class: "controls", role: "group", "aria-label": "Drive" },
    h("div", { class: "transport" }, pause, h("button", { type: "button", onclick: () => ask({ restart: true }) }, "Start again"), h("label", {}, following, "Follow"),
      h("button", { type: "button", onclick: look }, "Reset view"), h("button", { type: "button", onclick: end }, "End the drive"), output),
    h("div", { class: "row" }, friction.element, terrain.element,
      h("form", { class: "row", onsubmit: (event) => (event.preventDefault(), ask({ waypoint_m: [Number(x.value), Number(y.value)] })) }, field("Waypoint x (m)", x), field("y (m)", y), h("button", {}, "Head there")),
      h("div", { class: "row", role: "group", "aria-label": "Push" }, field("Push (N s)", strength), DIRECTIONS.map(([sign, words, direction]) => h("button", { type: "button", "aria-label": `push ${words}`, onclick: () => strength.reportValidity() && push(direction, Number(strength.value)) }, sign)))));

  function slider(title, min, max, changed, hint) {
    const value = h("output"), tell = (now) => fill(value, String(Number(now.toFixed(4))));
    const input = h("input", { type: "range", min, max, step: 0.01, "aria-label": title, oninput: () => tell(Number(input.value)), onchange: () => changed(Number(input.value)) });
    return { element: h("label", { class: "field", title: hint }, h("span", {}, title, " ", value), input), show: (now) => ((input.value = now), tell(now)) };
  }

  function place() {
    return h("input", { type: "number", step: "any", required: true });
  }

  return {
    element, state,
    strength: () => Number(strength.value),
    following: () => following.checked,
    /** What holds now, also where others have asked for it. */
    scene: (scene) => (friction.show(scene.friction), terrain.show(scene.terrain_difficulty)),
    frame(frame) {
      state.paused = frame.paused;
      fill(pause, frame.paused ? "▶ Go on" : "❚❚ Pause");
      fill(output, `${frame.time_s.toFixed(1)} s`);
    },
    waypoint([now_x, now_y]) {
      if (element.contains(document.activeElement) && [x, y].includes(document.activeElement)) return;
      x.value = now_x.toFixed(2);
      y.value = now_y.toFixed(2);
    },
  };
}
