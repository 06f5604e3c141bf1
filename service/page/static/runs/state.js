// How a run is, in a word and a sign.

const SIGNS = {
  RUNNING: ["▶", "good"], DEGRADED: ["◐", "warn"], PAUSED: ["⏸", "calm"], STOPPING: ["◌", "warn"], STOPPED: ["■", "calm"],
  DONE: ["✓", "good"], FAILED: ["✕", "bad"], "at work": ["▶", "good"], done: ["✓", "calm"], unfinished: ["■", "calm"], damaged: ["✕", "bad"],
};

/** The state of a run in the list: what can be said of it without looking into it. */
export function standing(run) {
  if (run.fault) return "damaged";
  if (run.at_work) return "at work";
  return run.done >= run.planned ? "done" : "unfinished";
}

export function sign(state) {
  return SIGNS[state]?.[0] ?? "?";
}

export function tone(state) {
  return SIGNS[state]?.[1] ?? "calm";
}
