// One run: how it is, its curves, its pool, what happened, its classes and its episodes.

import { Refusal, get, repeatedly, run as path } from "../base/api.js";
import { fault, fill, h } from "../base/dom.js";
import { follow } from "../base/follow.js";
import { note } from "../base/link.js";
import { classes } from "./classes.js";
import { learning } from "./learning.js";
import { episodes } from "./episodes.js";
import { events } from "./events.js";
import { pool } from "./pool.js";
import { sign, standing, tone } from "./state.js";
import { steering } from "./steering.js";

const STATUS_MS = 1000;
const PARTS = { pool: "Pool", events: "Events", classes: "Classes and modes", episodes: "Episodes" };
const ENDED = new Set(["DONE", "FAILED", "STOPPED"]);

export function run(name) {
  const left = new AbortController();
  const state = h("span", { class: "state" });
  const reason = h("p", { class: "reason" });
  const said = h("div");
  const steer = steering(name, (status) => status && show(status));
  const curves = learning((iteration) => (pick(iteration), choose("episodes")));
  const parts = { pool: pool(), events: events((kind) => note({ kind })), classes: classes(name, pick, left.signal), episodes: episodes(name, pick, left.signal) };
  const tabs = h("div", { class: "tabs", role: "tablist", "aria-label": "About this run" });
  const panel = h("div", { class: "panel", role: "tabpanel", id: "part", tabindex: "0" });
  const element = h("section", { "aria-label": `Run ${name}` }, h("div", { class: "title" }, h("h1", {}, name), state), reason, said, steer.element, curves.element, tabs, panel);
  let part = null, status = null, listed = null, looked = false;

  for (const [key, title] of Object.entries(PARTS))
    tabs.append(h("button", { type: "button", role: "tab", id: `tab-${key}`, "aria-controls": "part", onclick: () => choose(key), onkeydown: arrows }, title));

  function arrows(event) {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const keys = Object.keys(PARTS);
    choose(keys[(keys.indexOf(part) + step + keys.length) % keys.length]);
    document.getElementById(`tab-${part}`).focus();
  }

  /** Look at an iteration, null for the newest. */
  function pick(iteration) {
    note({ iteration });
    for (const part of [parts.classes, parts.episodes]) part.choose(iteration);
  }

  function choose(key) {
    note({ part: key === "pool" ? "" : key });
    open(key);
  }

  function open(key) {
    if (key === part) return;
    part = key;
    for (const tab of tabs.children) {
      const is = tab.id === `tab-${key}`;
      tab.setAttribute("aria-selected", String(is));
      tab.tabIndex = is ? 0 : -1;
    }
    panel.setAttribute("aria-labelledby", `tab-${key}`);
    fill(panel, parts[key].element);
    parts[key].opened?.();
  }

  function show(now) {
    status = now;
    state.className = `state ${tone(now.state)}`;
    fill(state, `${sign(now.state)} ${now.state}`);
    fill(reason, [now.reason, now.phase && !ENDED.has(now.state) ? `now ${now.phase}` : ""].filter(Boolean).join(" · "));
    parts.pool.show(now);
    steer.show(now, listed);
  }

  function happened(kind, data) {
    if (kind === "status") show(data);
    else if (kind === "pool") parts.events.add(data);
    else if (kind === "iteration") {
      curves.add(data);
      parts.classes.iteration(data.iteration);
      parts.episodes.iteration(data.iteration);
    }
  }

  async function look() {
    if (listed && !listed.at_work && (status ? ENDED.has(status.state) : looked)) return; // nothing changes
    looked = true;
    try {
      show(await get(`${path(name)}/status`, left.signal));
    } catch (error) {
      if (!left.signal.aborted && error instanceof Refusal && error.status !== 404 && !status) parts.pool.none(error.message);
    }
  }

  follow(`${path(name)}/events`, happened, left.signal).catch((error) => {
    if (!left.signal.aborted) fill(said, fault(`${error.message}. What is shown is the last that was known.`));
  });
  repeatedly(STATUS_MS, look, left.signal);
  return {
    element,
    update(values) {
      open(Object.hasOwn(PARTS, values.part ?? "") ? values.part : "pool");
      for (const part of [parts.classes, parts.episodes]) part.choose(/^\d+$/.test(values.iteration) ? Number(values.iteration) : null);
      parts.events.choose(values.kind ?? "");
    },
    listed(runs) {
      listed = runs.find((one) => one.name === name) ?? null;
      if (!listed) fill(said, fault(`Run ${name} has gone from this root. What is shown is the last that was known.`));
      else if (listed.fault) fill(said, fault(listed.fault));
      if (listed && !status) {
        const word = standing(listed);
        state.className = `state ${tone(word)}`;
        fill(state, `${sign(word)} ${word}`);
      }
      steer.show(status, listed);
    },
    close: () => (left.abort(), curves.close()),
  };
}
