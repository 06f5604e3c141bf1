// Curves over a common axis: uPlot in the page's colours, told in words for those who do not see it.

import { h } from "./dom.js";
import { number } from "./format.js";

const DASHES = [[], [8, 4], [2, 3], [12, 4, 2, 4], [5, 2]];

/** A colour of the page by its name in style.css. */
export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Colour and dash of the k-th of several curves, which differ in both. */
export function looks(k) {
  return { stroke: `curve-${(k % 6) + 1}`, dash: DASHES[k % DASHES.length] };
}

/**
 * A chart. `series` are {label, stroke, dash, width, points, band: [lower, upper]}: names of colours, never colours;
 * bands are columns of `data` that are drawn as an area. `chosen(k)` is told which point of the axis was clicked.
 */
export function chart({ title, unit, axis = "iteration", series, data, chosen = null, height = 190 }) {
  const place = h("div", { class: "plot" });
  const words = h("figcaption", {}, title, " ", h("small", {}, unit));
  const element = h("figure", { class: "chart", role: "group", "aria-label": title }, words, place);
  const shown = { plot: null, data, series };
  const draw = () => {
    const width = Math.floor(place.clientWidth);
    if (!width) return;
    const zoom = zoomed();
    shown.plot?.destroy();
    shown.plot = new uPlot(options(width, height, axis, shown.series, chosen), shown.data, place);
    if (zoom) shown.plot.setScale("x", zoom);
    place.querySelector("canvas").setAttribute("role", "img");
    describe();
  };
  /** The part of the axis that somebody chose to see, null where all of it is seen. */
  const zoomed = () => {
    const { min, max } = shown.plot?.scales.x ?? {}, xs = shown.plot?.data[0] ?? [];
    return xs.length > 1 && (min > xs[0] || max < xs.at(-1)) ? { min, max } : null;
  };
  const replace = (next) => {
    const zoom = zoomed();
    shown.plot.setData(next, !zoom);
    if (zoom) shown.plot.setScale("x", zoom);
  };
  const describe = () => place.querySelector("canvas")?.setAttribute("aria-label", inWords(title, unit, shown.series, shown.data));
  const observer = new ResizeObserver(() => {
    const width = Math.floor(place.clientWidth);
    if (!shown.plot) draw();
    else if (width && width !== shown.plot.width) shown.plot.setSize({ width, height });
  });
  observer.observe(place);
  window.addEventListener("themechange", draw);
  return {
    element,
    show(next, nextSeries = shown.series) {
      const same = nextSeries.length === shown.series.length && nextSeries.every((one, k) => one.label === shown.series[k].label);
      Object.assign(shown, { data: next, series: nextSeries });
      if (shown.plot && same) replace(next), describe();
      else draw();
    },
    close() {
      observer.disconnect();
      window.removeEventListener("themechange", draw);
      shown.plot?.destroy();
    },
  };
}

function options(width, height, axis, series, chosen) {
  const line = { stroke: colour("faint-text"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line"), width: 1, size: 4 }, font: "11px system-ui" };
  const drawn = series.map((one) => ({
    label: one.label,
    show: one.show ?? true,
    stroke: one.hidden ? "transparent" : colour(one.stroke),
    width: one.hidden ? 0 : (one.width ?? 2),
    dash: one.dash,
    fill: undefined,
    spanGaps: true,
    points: { show: one.points ?? undefined, size: 5 },
    paths: one.scatter ? () => null : undefined,
    value: (_, value) => number(value, 4),
    class: one.hidden ? "hidden-series" : undefined,
  }));
  const bands = series.flatMap((one, k) => (one.under === undefined ? [] : [{ series: [k + 1, one.under + 1], fill: colour(one.stroke) + "30" }]));
  return {
    width,
    height,
    cursor: { y: false, points: { size: 7 }, drag: { x: true, y: false, setScale: true } },
    legend: { live: true, markers: { dash: (_, k) => (series[k - 1]?.dash?.length ? "dashed" : "solid") } },
    scales: { x: { time: false } },
    axes: [{ ...line, size: 28, gap: 2, incrs: axis === "iteration" ? [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000] : undefined }, { ...line, size: 48, gap: 2, values: (_, ticks, __, ___, step) => ticks.map((tick) => tick.toFixed(decimals(step)).replace("-", "−")) }],
    series: [{ label: axis, value: (_, value) => number(value, 5) }, ...drawn],
    bands,
    hooks: {
      init: [(plot) => {
        plot.root.querySelectorAll(".u-series").forEach((row, k) => row.classList.toggle("hidden", k > 0 && Boolean(series[k - 1].hidden)));
        if (chosen) plot.over.addEventListener("click", () => plot.cursor.idx !== null && chosen(plot.cursor.idx));
      }],
    },
  };
}

function decimals(step) {
  for (let n = 0; n < 6; n += 1) if (Math.abs(step * 10 ** n - Math.round(step * 10 ** n)) < 1e-6) return n;
  return 6;
}

function inWords(title, unit, series, data) {
  const told = series.flatMap((one, k) => {
    if (one.hidden) return [];
    const values = (data[k + 1] ?? []).filter((value) => value !== null && value !== undefined);
    return values.length ? [`${one.label}: ${number(values[0])} at first, ${number(values.at(-1))} at last, ${values.length} points`] : [`${one.label}: none yet`];
  });
  return `${title} (${unit}). ${told.join(". ")}`;
}
