// The page: views by address, the token, and whether the server answers.

import { onReachable, part } from "./base/api.js";
import { fault, fill, h } from "./base/dom.js";
import { here, to } from "./base/link.js";
import { begin, leave } from "./base/session.js";

const VIEWS = {
  runs: ["Runs", () => import("./runs/view.js")],
  replay: ["Replay", () => import("./replay/view.js")],
  query: ["Query", () => import("./query/view.js")],
};
const content = document.getElementById("content");
const seen = { name: null, view: null };

async function show() {
  const { view, ...values } = here();
  const name = Object.hasOwn(VIEWS, view) ? view : "runs";
  for (const link of document.querySelectorAll("#views a"))
    link.toggleAttribute("aria-current", link.dataset.view === name);
  document.querySelectorAll("#views a[aria-current]").forEach((link) => link.setAttribute("aria-current", "page"));
  if (seen.name !== name) {
    seen.view?.close();
    Object.assign(seen, { name, view: null });
    const place = h("div", { class: `view ${name}` });
    fill(content, place);
    const { open } = await part(VIEWS[name][1]).catch(({ message }) => ({ open: (place) => missing(place, message) }));
    if (seen.name !== name) return; // somebody went on meanwhile
    document.title = `${VIEWS[name][0]} · T6-GPS`;
    seen.view = open(place);
  }
  seen.view?.update(values);
}

/** In the place of a view whose files did not come. */
function missing(place, sentence) {
  seen.name = null; // so that it is tried again
  fill(place, fault(sentence), h("button", { type: "button", class: "main", onclick: show }, "Try again"));
  return { update() {}, close() {} };
}

fill(document.getElementById("views"), Object.entries(VIEWS).map(([name, [title]]) => h("a", { href: to(name), "data-view": name }, title)));
document.getElementById("leave").addEventListener("click", leave);
onReachable((now) => fill(document.getElementById("connection"), now ? "" : "⚠ The server does not answer; asking again"));
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // the address is that of the view
  content.focus();
});
begin();
window.addEventListener("hashchange", show);
show();
