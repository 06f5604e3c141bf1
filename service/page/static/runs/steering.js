// What somebody may ask of a run: workers, a pause, an end, and to go on.

import { post, run as path } from "../base/api.js";
import { fill, h } from "../base/dom.js";

const ALIVE = new Set(["RUNNING", "DEGRADED", "PAUSED", "STOPPING"]);
const SURE_MS = 5000;

/** Buttons for a run. `done(status)` is told how it is after a request, where the server says so. */
export function steering(name, done) {
  const count = h("input", { type: "number", min: 0, step: 1, value: 1, "aria-label": "workers", oninput: () => (typed = true) });
  const said = h("p", { class: "said", role: "status" });
  const scale = button("Scale", () => ["scale", { workers: Number(count.value) }]);
  const pause = button("Pause", () => ["pause", {}]);
  const unpause = button("Unpause", () => ["unpause", {}]);
  const resume = button("Resume", () => ["resume", undefined]);
  const stop = button("Stop", () => ["stop", {}]);
  const element = h("div", { class: "steering", role: "group", "aria-label": `Steer ${name}` },
    h("span", { class: "scale" }, h("label", {}, "Workers ", count), scale), pause, unpause, resume, stop, said);
  let typed = false, busy = false, state = null, sure = 0;

  function button(title, asked) {
    return h("button", { type: "button", onclick: () => ask(title, ...asked()) }, title);
  }

  async function ask(title, what, body) {
    if (what === "stop" && !sure) {
      sure = setTimeout(() => ((sure = 0), fill(stop, "Stop")), SURE_MS);
      fill(stop, "Really stop?");
      return;
    }
    clearTimeout(sure);
    sure = 0;
    fill(stop, "Stop");
    busy = true;
    enable();
    tell(`${title}: asked, and waiting until it is so …`, "calm");
    try {
      const answer = await post(`${path(name)}/${what}`, body);
      typed = false;
      if (answer.state) done(answer);
      tell(answer.sentence ?? (answer.job ? `Job ${answer.job} trains it.` : `${title}: done.`), "good");
    } catch (error) {
      tell(error.message, "bad"); // what was typed stays
    }
    busy = false;
    enable();
  }

  function tell(sentence, tone) {
    said.className = `said ${tone}`;
    fill(said, tone === "bad" ? `✕ ${sentence}` : sentence);
  }

  function enable() {
    const alive = ALIVE.has(state);
    for (const one of [scale, count, stop]) one.disabled = busy || !alive;
    pause.hidden = state === "PAUSED";
    unpause.hidden = !pause.hidden;
    pause.disabled = unpause.disabled = busy || !alive;
    resume.disabled = busy || alive;
  }

  enable();
  return { element, show(status, listed) {
    const working = listed?.at_work !== false;
    state = status && (working || !ALIVE.has(status.state)) ? status.state : null;
    if (status?.most) count.max = status.most;
    if (status && !typed && document.activeElement !== count) count.value = status.wanted ?? 1;
    resume.hidden = state === "DONE" || ALIVE.has(state) || (!state && listed && listed.done >= listed.planned);
    element.hidden = resume.hidden && !ALIVE.has(state);
    if (!busy) enable();
  } };
}
