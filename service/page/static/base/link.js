// The address says what is seen: #/VIEW?name=value, so that a link brings another person to the same view.

/** The view of the address, and its values. */
export function here() {
  const [view, query] = location.hash.replace(/^#\/?/, "").split("?");
  return { ...Object.fromEntries(new URLSearchParams(query ?? "")), view: view || "runs" };
}

/** The address of a view with values; those that say nothing are left out. */
export function to(view, values = {}) {
  const said = Object.entries(values).filter(([, value]) => value !== null && value !== undefined && value !== "" && value !== false);
  const query = new URLSearchParams(said.map(([key, value]) => [key, String(value)])).toString();
  return `#/${view}${query ? `?${query}` : ""}`;
}

/** Go there, as by a link. */
export function go(view, values) {
  location.hash = to(view, values);
}

/** Let the address say what is seen now, without a step that "back" would undo. */
export function note(values) {
  const { view, ...before } = here();
  history.replaceState(null, "", to(view, { ...before, ...values }));
}
