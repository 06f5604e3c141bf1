// Which episode is looked at, and which one beside it.

import { field, h } from "../base/dom.js";

/** Fields for an episode; `changed({run, episode, evaluation})` is told what somebody chooses. */
export function picker(title, changed, runs) {
  const run = h("input", { type: "text", list: runs.id, size: 14, autocomplete: "off", spellcheck: "false", onchange: tell });
  const episode = h("input", { type: "number", min: 0, step: 1, onchange: tell });
  const evaluation = h("input", { type: "number", min: 0, step: 1, placeholder: "none", onchange: tell });
  const next = (by) => h("button", { type: "button", "aria-label": by > 0 ? `next episode of ${title}` : `episode before that of ${title}`, onclick: () => ((episode.value = Math.max(0, Number(episode.value || 0) + by)), tell()) }, by > 0 ? "›" : "‹");
  const element = h("fieldset", { class: "picker" }, h("legend", {}, title), field("Run", run), field("Episode", episode), next(-1), next(1), field("Evaluation", evaluation));

  function tell() {
    changed({ run: run.value.trim(), episode: episode.value, evaluation: evaluation.value });
  }

  return { element, show(values) {
    run.value = values.run ?? "";
    episode.value = values.episode ?? "";
    evaluation.value = values.evaluation ?? "";
  } };
}
