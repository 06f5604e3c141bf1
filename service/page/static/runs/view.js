// The runs: their list beside one of them, or beside the curves of several.

import { empty, fill, h } from "../base/dom.js";
import { here, note, to } from "../base/link.js";
import { compare } from "./compare.js";
import { list } from "./list.js";
import { run } from "./run.js";
import { startDialog } from "./start.js";

export function open(place) {
  const left = new AbortController();
  const detail = h("div", { class: "detail" });
  let shown = { key: "", view: null };
  const runs = list({
    signal: left.signal,
    start: () => startDialog((name) => (location.hash = to("runs", { run: name }), runs.look())),
    changed: (values) => {
      note(values);
      update(here());
    },
    told: (found) => shown.view?.listed?.(found),
  });
  fill(place, runs.element, detail);

  function update({ view, ...values }) {
    runs.update(values);
    const compared = (values.compare ?? "").split(",").filter(Boolean);
    const key = values.run ? `run ${values.run}` : compared.length ? `compare ${compared}` : "nothing";
    place.toggleAttribute("data-detail", key !== "nothing");
    if (key === shown.key) return shown.view?.update?.(values);
    shown.view?.close();
    shown = { key, view: null };
    if (values.run) shown.view = run(values.run);
    else if (compared.length) shown.view = compare(compared);
    fill(detail, key === "nothing"
      ? empty("Choose a run to see how it is. Tick several to compare their curves; those that differ in the seed alone are averaged.")
      : [h("a", { class: "back", href: to("runs", { ...values, run: "", compare: values.run ? values.compare : "" }) }, "← all runs"), shown.view.element]);
    shown.view?.update?.(values);
  }

  return { update, close: () => (left.abort(), shown.view?.close()) };
}
