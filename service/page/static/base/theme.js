// Light or dark, as chosen here or else as the system has it, before anything is painted: a plain script, since modules
// run after the first paint.
(() => {
  const root = document.documentElement, system = matchMedia("(prefers-color-scheme: dark)");
  const show = () => {
    root.dataset.theme = localStorage.getItem("t6gps-theme") ?? (system.matches ? "dark" : "light");
    window.dispatchEvent(new Event("themechange"));
  };
  show();
  system.addEventListener("change", show);
  document.addEventListener("click", ({ target }) => {
    if (target.id !== "theme") return;
    localStorage.setItem("t6gps-theme", root.dataset.theme === "dark" ? "light" : "dark");
    show();
  });
})();
