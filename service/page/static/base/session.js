// The token: typed once, kept for this tab alone, asked for again when it is refused.

import { keepToken, tokensFrom, tried } from "./api.js";
import { field, fill, h } from "./dom.js";

let asking = null;

/** Ask for tokens from now on, whenever one is needed. Whatever is seen stays there meanwhile. */
export function begin() {
  tokensFrom((reason) => (asking ??= asked(reason).finally(() => (asking = null))));
}

/** Ask for another token, and begin anew with it. Until there is one, the old one holds. */
export function leave() {
  asking ??= asked("", true).finally(() => (asking = null));
  asking.then((another) => another && location.reload());
}

/** Whether there is another token; only who may `cancel` goes on without. */
function asked(reason, cancel = false) {
  return new Promise((done) => {
    const input = h("input", { type: "password", name: "token", required: true, autocomplete: "off", spellcheck: "false" });
    const said = h("p", { class: "fault", role: "alert" }, reason);
    const send = h("button", { class: "main" }, "Open");
    const form = h("form", { method: "dialog" },
      h("h2", { id: "token-title" }, "A token, please"),
      h("p", {}, "Whoever runs this server makes one with ", h("code", {}, "t6gps token create"), ". It stays in this tab."),
      field("Token", input), said, h("div", { class: "actions" }, cancel && h("button", { type: "button", onclick: () => end(false) }, "Cancel"), send));
    const dialog = h("dialog", { "aria-labelledby": "token-title" }, form);
    said.hidden = !reason;
    let over = false;
    dialog.addEventListener("cancel", (event) => cancel || event.preventDefault());
    dialog.addEventListener("close", () => over || (cancel ? end(false) : dialog.showModal())); // a second Escape closes it all the same
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      send.disabled = true;
      const token = input.value.trim(), refused = await tried(token);
      send.disabled = false;
      if (refused) {
        said.hidden = false;
        fill(said, refused);
        return;
      }
      keepToken(token);
      end(true);
    });
    function end(another) {
      over = true;
      dialog.close();
      dialog.remove();
      done(another);
    }

    document.body.append(dialog);
    dialog.showModal();
  });
}
