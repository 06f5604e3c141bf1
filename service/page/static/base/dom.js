// Elements from plain values.

/** An element. Properties beginning with "on" listen; `css` sets properties of its style; null and false leave out. */
export function h(tag, props = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(props ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key === "css") for (const [name, text] of Object.entries(value)) element.style.setProperty(name, text);
    else if (key in DIRECT) element[key] = value;
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

const DIRECT = { value: 1, checked: 1, disabled: 1, textContent: 1 };

/** Put new children in the place of what an element holds. */
export function fill(element, ...children) {
  element.replaceChildren(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** A table with a caption for those who hear it. Columns: [title, cell(row), "number" or nothing, title in words]. */
export function table(caption, columns, rows) {
  const head = columns.map(([title, , kind, words]) => h("th", { scope: "col", class: kind, title: words }, title));
  const body = rows.map((row) => h("tr", {}, columns.map(([, cell, kind]) => h("td", { class: kind }, cell(row)))));
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
    h("table", {}, h("caption", { class: "hidden" }, caption), h("thead", {}, h("tr", {}, head)), h("tbody", {}, body)));
}

/** A sentence where something could not be had. */
export function fault(sentence) {
  return h("p", { class: "fault", role: "alert" }, sentence);
}

/** A sentence where there is nothing yet, with what to do. */
export function empty(...content) {
  return h("p", { class: "empty" }, ...content);
}

/** A field with its label. */
export function field(label, input, hint) {
  return h("label", { class: "field" }, h("span", {}, label), input, hint && h("small", {}, hint));
}

/** A choice of texts, or of [value, text]. */
export function select(options, props) {
  const found = options.map((option) => (Array.isArray(option) ? option : [option, option]));
  const element = h("select", props, found.map(([value, text]) => h("option", { value: String(value) }, text)));
  if (props?.value !== undefined) element.value = String(props.value);
  return element;
}
