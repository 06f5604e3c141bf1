// The token: typed once, kept for this tab alone, asked for again when it is refused.

import { forgetToken, keepToken, tokensFrom, tried } from "./api.js";
import { field, fill, h } from "./dom.js";

let asking = null;

/** Ask for tokens from now on, whenever one is needed. Whatever is seen stays there meanwhile. */
export function begin() {
  tokensFrom((reason) => (asking ??= asked(reason).finally(() => (asking = null))));
}

/** Forget the token, and ask for another one. */
export function leave() {
  forgetToken();
  asking ??= asked("").finally(() => (asking = null));
  asking.then(() => location.reload());
}

function asked(reason) {
  return new Promise((done) => {
    const input = h("input", { type: "password", name: "token", required: true, autocomplete: "off", spellcheck: "false" });
    const said = h("p", { class: "fault", role: "alert" }, reason);
    const send = h("button", { class: "main" }, "Open");
    const form = h("form", { method: "dialog" },
      h("h2", { id: "token-title" }, "A token, please"),
      h("p", {}, "Whoever runs this server makes one with ", h("code", {}, "t6gps token create"), ". It stays in this tab."),
      field("Token", input), said, h("div", { class: "actions" }, send));
    const dialog = h("dialog", { "aria-labelledby": "token-title" }, form);
    said.hidden = !reason;
    dialog.addEventListener("cancel", (event) => event.preventDefault());
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      send.disabled = true;
      const refused = await tried(input.value.trim());
      send.disabled = false;
      if (refused) {
        said.hidden = false;
        fill(said, refused);
        return;
      }
      keepToken(input.value.trim());
      dialog.close();
      dialog.remove();
      done();
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}
