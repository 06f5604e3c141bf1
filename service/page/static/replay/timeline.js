// An episode on a line: stays on triangles, speed, where it was stuck, waypoints, and the moment that is shown.

import { colour } from "../base/curves.js";
import { h } from "../base/dom.js";
import { TRIANGLES } from "../base/format.js";

const HEIGHT = 44, BAND = 16, STUCK = 5;

/** A line for an episode; `length_s` is how long the line lasts, `scrub(time_s)` is told where somebody points. */
export function timeline(episode, letter, length_s, scrub) {
  const canvas = h("canvas", { role: "img", "aria-label": inWords(episode), height: HEIGHT });
  const element = h("div", { class: "line" }, h("b", {}, letter), canvas);
  let picture = null, time_s = 0, held = false;

  const point = (event) => scrub(Math.min(Math.max((event.offsetX / canvas.clientWidth) * length_s, 0), length_s));
  canvas.addEventListener("pointerdown", (event) => ((held = true), canvas.setPointerCapture(event.pointerId), point(event)));
  canvas.addEventListener("pointermove", (event) => held && point(event));
  canvas.addEventListener("pointerup", () => (held = false));
  canvas.addEventListener("mousemove", (event) => {
    const row = Math.round((event.offsetX / canvas.clientWidth) * length_s / step());
    canvas.title = episode.segments.find((span) => row < span.stop)?.name ?? "";
  });
  const step = () => (episode.time_s.length > 1 ? episode.time_s[1] - episode.time_s[0] : 1);
  const observer = new ResizeObserver(() => ((picture = null), draw()));
  observer.observe(canvas);
  const restyle = () => ((picture = null), draw());
  window.addEventListener("themechange", restyle);

  function draw() {
    const width = Math.round(canvas.clientWidth * devicePixelRatio), height = Math.round(HEIGHT * devicePixelRatio);
    if (!width) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const pen = canvas.getContext("2d");
    if (!picture) {
      picture = new OffscreenCanvas(width, height);
      paint(picture.getContext("2d"), width, height, devicePixelRatio);
    }
    pen.clearRect(0, 0, width, height);
    pen.drawImage(picture, 0, 0);
    const x = (time_s / length_s) * width;
    pen.fillStyle = colour("text");
    pen.fillRect(Math.round(x) - 1, 0, 2 * devicePixelRatio, height);
  }

  function paint(pen, width, height, ratio) {
    const at = (row) => (episode.time_s[Math.min(row, episode.time_s.length - 1)] / length_s) * width;
    const shades = [colour("delta"), colour("lambda")], band = BAND * ratio, top = STUCK * ratio;
    pen.font = `${11 * ratio}px system-ui`;
    pen.textBaseline = "middle";
    for (const span of episode.segments) {
      const left = at(span.start), right = at(span.stop);
      pen.fillStyle = shades[span.kind];
      const low = span.kind ? top + 4 * ratio : top; // kinds differ in height as well as in colour
      pen.fillRect(left, low, Math.max(1, right - left - ratio), band - (low - top));
      if (right - left > 16 * ratio) {
        pen.fillStyle = colour("on-accent");
        pen.fillText(TRIANGLES[span.kind], left + 4 * ratio, top + band / 2 + 2 * ratio);
      }
    }
    pen.fillStyle = colour("bad");
    for (const [start, stop] of episode.stuck) pen.fillRect(at(start), 0, Math.max(2 * ratio, at(stop) - at(start)), STUCK * ratio - ratio);
    const bottom = height - 2 * ratio, room = height - top - band - 4 * ratio;
    const most = Math.max(0.1, ...episode.forward_speed_m_per_s.map(Math.abs));
    pen.strokeStyle = colour("faint-text");
    pen.lineWidth = ratio;
    pen.beginPath();
    episode.forward_speed_m_per_s.forEach((speed, row) => pen[row ? "lineTo" : "moveTo"](at(row), bottom - (Math.max(0, speed) / most) * room));
    pen.stroke();
    pen.fillStyle = colour("text");
    for (const mark of episode.waypoints.slice(1)) {
      const x = at(mark.start);
      pen.beginPath();
      pen.moveTo(x - 4 * ratio, height);
      pen.lineTo(x + 4 * ratio, height);
      pen.lineTo(x, height - 7 * ratio);
      pen.fill();
    }
  }

  return {
    element,
    show: (now_s) => ((time_s = now_s), draw()),
    close() {
      observer.disconnect();
      window.removeEventListener("themechange", restyle);
    },
  };
}

function inWords(episode) {
  const stuck = episode.stuck.reduce((sum, [start, stop]) => sum + stop - start, 0);
  return `Time line of episode ${episode.episode}: ${episode.segments.length} stays on triangles, ${stuck} steps stuck, ${episode.waypoints.length - 1} changes of the waypoint`;
}
