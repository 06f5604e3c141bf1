// Light or dark, before anything is painted. A plain script, since modules run after the first paint.
(() => {
  const chosen = localStorage.getItem("t6gps-theme");
  if (chosen) document.documentElement.dataset.theme = chosen;
})();
