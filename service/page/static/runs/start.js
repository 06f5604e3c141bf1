// A dialog that starts a run from a preset.

import { get, post } from "../base/api.js";
import { fault, field, fill, h, select } from "../base/dom.js";

export async function startDialog(started) {
  const presets = h("div"), said = h("div", { role: "alert" });
  const name = h("input", { type: "text", name: "name", pattern: "[A-Za-z0-9][A-Za-z0-9._\\-]*", maxlength: 64, placeholder: "as the preset" });
  const settings = h("textarea", { rows: 5, name: "settings", spellcheck: "false", placeholder: "run.iterations = 20\nrun.seed = 3" });
  const send = h("button", { class: "main" }, "Start");
  const form = h("form", {}, h("h2", { id: "start-title" }, "Start a run"), presets,
    field("Name", name), field("Settings", settings, "one a line, as dotted.key = value"), said,
    h("div", { class: "actions" }, h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"), send));
  const dialog = h("dialog", { "aria-labelledby": "start-title", onclose: () => dialog.remove() }, form);
  document.body.append(dialog);
  dialog.showModal();
  const chosen = await known().catch((error) => (fill(said, fault(error.message)), []));
  const preset = select(chosen, { name: "preset", value: "flat-quick" });
  fill(presets, field("Preset", preset));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    send.disabled = true;
    try {
      const request = { preset: preset.value, settings: parsed(settings.value), ...(name.value ? { name: name.value } : {}) };
      const answer = await post("/v1/runs", request);
      dialog.close();
      started(answer.name);
    } catch (error) {
      fill(said, fault(error.message)); // what was typed stays
    }
    send.disabled = false;
  });
}

/** The presets that the server's own document names. */
async function known() {
  const document_ = await get("/openapi.json");
  return document_.components.schemas.StartRequest.properties.preset.anyOf.find((kind) => kind.enum).enum;
}

/** Settings by dotted keys; a value that is no JSON is a text. */
export function parsed(text) {
  const found = {};
  text.split("\n").map((line) => line.trim()).filter((line) => line && !line.startsWith("#")).forEach((line) => {
    const at = line.indexOf("=");
    if (at < 0) throw new Error(`“${line}” sets nothing; write dotted.key = value.`);
    const value = line.slice(at + 1).trim();
    try {
      found[line.slice(0, at).trim()] = JSON.parse(value);
    } catch {
      found[line.slice(0, at).trim()] = value;
    }
  });
  return found;
}
