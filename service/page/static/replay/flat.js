// Episodes from above, for browsers that draw nothing in three dimensions.

import { colour } from "../base/curves.js";
import { TRIANGLES } from "../base/format.js";
import { NODES_N, heightOf, moment, nodesAt, pointAt, segmentAt, smoothed, waypointAt } from "./motion.js";

const VIEW_M = 8, SIGN_PX = 20, ABOVE_M = 0.3;

/** The same as `scene`, on a plain canvas. */
export function flat(place, episodes, letters) {
  const canvas = document.createElement("canvas");
  place.prepend(canvas);
  const paths = episodes.map(smoothed), nodes = episodes.map(() => new Float64Array(3 * NODES_N));
  let time_s = 0, following = true, stale = true, centre = [0, 0], view_m = VIEW_M;
  const observer = new ResizeObserver(() => (stale = true));
  observer.observe(place);
  const restyle = () => (stale = true);
  window.addEventListener("themechange", restyle);

  function show(now_s) {
    time_s = now_s;
    const points = episodes.map((episode, k) => {
      const at = moment(episode, time_s);
      nodesAt(episode, at, nodes[k]);
      return pointAt(paths[k], at);
    });
    if (following) centre = [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
    view_m = episodes.length > 1 ? 2 * VIEW_M : VIEW_M;
    stale = true;
  }

  function render() {
    if (!stale) return;
    stale = false;
    const width = (canvas.width = place.clientWidth * devicePixelRatio), height = (canvas.height = place.clientHeight * devicePixelRatio);
    const pen = canvas.getContext("2d"), scale = Math.min(width, height) / view_m;
    const x = (value) => width / 2 + (value - centre[0]) * scale, y = (value) => height / 2 - (value - centre[1]) * scale;
    pen.fillStyle = colour("plane");
    pen.fillRect(0, 0, width, height);
    hills(pen, episodes[0], x, y, scale);
    const rows = episodes.map((episode) => moment(episode, time_s).row), shades = letters.map((letter) => colour(letter === "B" ? "bar-b" : "bar-a"));
    episodes.forEach((episode, k) => draw(pen, episode, nodes[k], rows[k], shades[k], x, y, scale));
    episodes.forEach((episode, k) => above(pen, words(episode, rows[k], episodes.length > 1 && letters[k]), nodes[k], shades[k], x, y));
  }

  show(0);
  return {
    show, render, look: () => show(time_s),
    follow: (whether) => (following = whether),
    nodes: (k) => Array.from({ length: NODES_N }, (_, node) => [...nodes[k].slice(3 * node, 3 * node + 3)]),
    close() {
      observer.disconnect();
      window.removeEventListener("themechange", restyle);
      canvas.remove();
    },
  };
}

/** The ground, lighter where it is higher. */
export function hills(pen, { ground }, x, y, scale) {
  if (!ground) return;
  const height = heightOf(ground), { cell_m } = ground;
  for (let i = 0; i < ground.rows - 1; i += 1)
    for (let j = 0; j < ground.columns - 1; j += 1) {
      const left = ground.x_m + i * cell_m, low = ground.y_m + j * cell_m;
      if (x(left + cell_m) < 0 || x(left) > pen.canvas.width || y(low) < 0 || y(low + cell_m) > pen.canvas.height) continue;
      const level = Math.min(Math.max(height(left + cell_m / 2, low + cell_m / 2) / 1.6 + 0.5, 0), 1);
      pen.fillStyle = `rgb(${Math.round(95 + 110 * level)} ${Math.round(125 + 70 * level)} ${Math.round(95 + 60 * level)})`;
      pen.fillRect(x(left), y(low + cell_m), cell_m * scale + 1, cell_m * scale + 1);
    }
}

function draw(pen, episode, nodes, row, shade, x, y, scale) {
  const track = [];
  for (let k = 0; k < episode.com_m.length; k += 3) track.push([x(episode.com_m[k]), y(episode.com_m[k + 1])]);
  line(pen, track, colour("edge"), 1);
  line(pen, track.slice(0, row + 1), colour("cap"), 3);
  circle(pen, waypointAt(episode, row), episode.waypoint_radius_m, colour("cap"), x, y, scale);
  body(pen, episode, nodes, row, shade, x, y, scale);
}

/** A line of points of the canvas. */
export function line(pen, points, style, width) {
  pen.strokeStyle = style;
  pen.lineWidth = width;
  pen.beginPath();
  points.forEach(([px, py], k) => pen[k ? "lineTo" : "moveTo"](px, py));
  pen.stroke();
}

/** The circle in which a waypoint is reached. */
export function circle(pen, mark, radius_m, style, x, y, scale) {
  pen.strokeStyle = style;
  pen.lineWidth = 3;
  pen.beginPath();
  pen.arc(x(mark.x_m), y(mark.y_m), radius_m * scale, 0, 7);
  pen.stroke();
}

/** A robot in a row: its triangle, cables and bars. */
export function body(pen, episode, nodes, row, shade, x, y, scale) {
  const node = (k) => [x(nodes[3 * k]), y(nodes[3 * k + 1])];
  pen.fillStyle = colour(["delta", "lambda"][segmentAt(episode, row).kind]);
  pen.beginPath();
  episode.faces[episode.face[row]].forEach((k, n) => pen[n ? "lineTo" : "moveTo"](...node(k)));
  pen.fill();
  for (const [a, b] of episode.cables) line(pen, [node(a), node(b)], colour("faint-text"), 1);
  for (const [a, b] of episode.bars) line(pen, [node(a), node(b)], shade, Math.max(2, 2 * episode.bar_radius_m * scale));
}

/** What tells a robot and its triangle apart without colours: its letter, where it has one, and Δ or Λ. */
export const words = (episode, row, letter) => [letter, TRIANGLES[segmentAt(episode, row).kind]].filter(Boolean).join(" ");

/** A sign above a robot. */
export function above(pen, text, nodes, shade, x, y) {
  const middle = nodes.reduce((sum, value, k) => sum + (k % 3 === 0 ? value / NODES_N : 0), 0), top = nodes.reduce((most, value, k) => (k % 3 === 1 ? Math.max(most, value) : most), -Infinity);
  sign(pen, text, x(middle), y(top + ABOVE_M), SIGN_PX * devicePixelRatio, shade);
}

/** A text in a frame of a colour around a point of the canvas, so high. */
export function sign(pen, text, x, y, height, shade) {
  pen.font = `600 ${0.7 * height}px system-ui`;
  const width = pen.measureText(text).width + 0.7 * height;
  Object.assign(pen, { fillStyle: colour("card"), strokeStyle: shade, lineWidth: height / 10, textAlign: "center", textBaseline: "middle" });
  pen.beginPath();
  pen.roundRect(x - width / 2, y - height / 2, width, height, height / 4);
  pen.fill();
  pen.stroke();
  pen.fillStyle = colour("text");
  pen.fillText(text, x, y);
}
