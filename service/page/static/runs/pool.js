// The pool of a run: its workers, who waits for whom, and what became of episodes and processes.

import { empty, fill, h, table } from "../base/dom.js";
import { duration } from "../base/format.js";
import { number } from "../base/format.js";

const MOST_WORKERS_N = 100;

export function pool() {
  const element = h("div", {}, empty("This run has had no workers yet."));

  function show(status) {
    const { workers, waits, episodes = {}, processes = {} } = status;
    fill(element,
      h("dl", { class: "facts" },
        fact("ready", `${status.ready ?? 0} of ${status.wanted ?? 0} workers`), fact("backlog", `${status.backlog ?? 0} episodes`),
        fact("with a worker", number(status.leases ?? 0)), fact("back, not durable", number(status.arrived ?? 0)),
        fact("newest episode", status.durable_for_s === null || status.durable_for_s === undefined ? "none yet" : `${duration(status.durable_for_s)} ago`),
        ...Object.entries(episodes).map(([key, count]) => fact(`episodes ${key}`, number(count))),
        ...Object.entries(processes).filter(([, count]) => count).map(([key, count]) => fact(`workers ${key}`, number(count)))),
      h("h2", {}, "Who waits for whom"),
      waits.length ? h("ul", { class: "waits" }, waits.map((wait) => h("li", {}, wait.what, " ", h("b", {}, duration(wait.for_s))))) : empty("Nobody waits."),
      h("h2", {}, "Workers"),
      workers.length ? table("Workers", [
        ["slot", (worker) => number(worker.slot), "number"], ["does", (worker) => h("span", { class: `phase ${worker.phase}` }, worker.phase)],
        ["for", (worker) => duration(worker.for_s), "number"], ["episodes", (worker) => worker.episodes.join(", ") || "–"],
        ["started", (worker) => number(worker.incarnation + 1), "number", "how many processes this slot has had"], ["process", (worker) => (worker.pid === null ? "–" : `${worker.pid} on ${worker.node}`)],
      ], workers.slice(0, MOST_WORKERS_N)) : empty("No worker is there."),
      workers.length > MOST_WORKERS_N && empty(`${workers.length - MOST_WORKERS_N} more workers are not shown.`),
      status.quarantined?.length > 0 && h("p", {}, `Quarantined episodes, which are not tried any more: ${status.quarantined.join(", ")}.`));
  }

  return { element, show, none: (sentence) => fill(element, empty(sentence)) };
}

function fact(name, value) {
  return h("div", {}, h("dt", {}, name), h("dd", {}, value));
}
