// A drive from above, for browsers that draw nothing in three dimensions: the same as `solid`.

import { colour } from "../base/curves.js";
import { above, body, circle, hills, line, words } from "../replay/flat.js";
import { NODES_N, moment, nodesAt, pointAt } from "../replay/motion.js";
import { LETTERS, SHADES, evened } from "./live.js";

const VIEW_M = 9, GRAB_M = 1.1, ARROW_M_PER_N_S = 0.015;

/** A stage in an element for the robots of a drive. */
export function plain(place, robots) {
  const canvas = document.createElement("canvas");
  place.prepend(canvas);
  const nodes = robots.map(() => new Float64Array(3 * NODES_N));
  let centre = null, following = true, stale = true, points = [], pulled = null, time_s = 0;
  const view_m = robots.length > 1 ? 1.6 * VIEW_M : VIEW_M;
  const restyle = () => (stale = true), observer = new ResizeObserver(restyle);
  observer.observe(place);
  window.addEventListener("themechange", restyle);
  const scale = () => Math.min(place.clientWidth, place.clientHeight) / view_m;
  const placeAt = (x, y) => [centre[0] + (x - place.clientWidth / 2) / scale(), centre[1] - (y - place.clientHeight / 2) / scale()];

  function show(now_s) {
    time_s = now_s;
    points = robots.map((one, k) => {
      const at = moment(one, time_s);
      nodesAt(one, at, nodes[k]);
      return pointAt(one.time_s.map((_, row) => one.com_m.slice(3 * row, 3 * row + 3)), at);
    });
    if (following || !centre) centre = [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
    stale = true;
  }

  function render() {
    if (!stale || !centre) return;
    stale = false;
    const width = (canvas.width = place.clientWidth * devicePixelRatio), height = (canvas.height = place.clientHeight * devicePixelRatio);
    const pen = canvas.getContext("2d"), size = scale() * devicePixelRatio;
    const x = (value) => width / 2 + (value - centre[0]) * size, y = (value) => height / 2 - (value - centre[1]) * size;
    pen.fillStyle = colour("plane");
    pen.fillRect(0, 0, width, height);
    hills(pen, robots[0], x, y, size);
    robots.forEach((one, k) => {
      line(pen, evened(one.trail).map(([px, py]) => [x(px), y(py)]), colour(k ? SHADES[k] : "cap"), 3);
      circle(pen, one.mark, one.waypoint_radius_m, colour(k ? SHADES[k] : "cap"), x, y, size);
      body(pen, one, nodes[k], moment(one, time_s).row, colour(SHADES[k]), x, y, size);
    });
    robots.forEach((one, k) => above(pen, words(one, moment(one, time_s).row, robots.length > 1 && LETTERS[k]), nodes[k], colour(SHADES[k]), x, y));
    if (pulled) {
      const [px, py] = points[pulled.k], tip = [0, 1].map((axis) => [px, py][axis] + ARROW_M_PER_N_S * pulled.impulse[axis]);
      line(pen, [[x(px), y(py)], [x(tip[0]), y(tip[1])]], colour("bad"), 5);
      pen.fillStyle = colour("bad");
      pen.beginPath();
      pen.arc(x(tip[0]), y(tip[1]), 7, 0, 7);
      pen.fill();
    }
  }

  return {
    show, render, canvas, look: () => show(time_s),
    follow: (whether) => (following = whether),
    groundAt: placeAt,
    robotAt(x, y) {
      const [px, py] = placeAt(x, y), far = points.map((point) => Math.hypot(point[0] - px, point[1] - py)), nearest = far.indexOf(Math.min(...far));
      return far[nearest] < GRAB_M ? nearest : null;
    },
    beside: placeAt,
    ahead: () => [0, 1],
    hold() {},
    arrow: (k, impulse) => ((pulled = impulse ? { k, impulse } : null), (stale = true)),
    close() {
      observer.disconnect();
      window.removeEventListener("themechange", restyle);
      canvas.remove();
    },
  };
}
