// Robots of a drive as they come: the newest rows of each, in the form of an episode.

const KEPT_N = 12, TRAIL_N = 300, EVEN_N = 8, BEHIND_S = 0.15;
export const LETTERS = "ABCD", SHADES = ["bar-a", "bar-b", "curve-2", "curve-4"];

/** Robots of a scene, without a row yet. */
export function robots(scene) {
  const { bars, cables, faces, ground, waypoint_radius_m } = scene;
  return scene.robots.map((one) => ({ ...one, bars, cables, faces, ground, waypoint_radius_m, time_s: [], com_m: [], nodes_m: [], tensions_n: [], face: [], kinds: [], segments: [], trail: [], mark: null, now: null }));
}

/** Add a frame; rows of before a new start are forgotten. */
export function take(found, frame) {
  frame.robots.forEach((now, k) => {
    const one = found[k];
    if (one.time_s.length && frame.time_s < one.time_s.at(-1)) Object.assign(one, { time_s: [], com_m: [], nodes_m: [], tensions_n: [], face: [], kinds: [], trail: [] });
    if (one.time_s.at(-1) === frame.time_s) drop(one, one.time_s.length - 1, 1); // time stands, and something was changed
    one.time_s.push(frame.time_s);
    one.com_m.push(...now.com_m);
    one.nodes_m.push(...now.nodes_m);
    one.tensions_n.push(...now.tensions_n);
    one.face.push(now.face);
    one.kinds.push(now.kind);
    if (one.time_s.length > KEPT_N) drop(one, 0, 1);
    one.segments = one.kinds.map((kind, row) => ({ start: row, stop: row + 1, kind }));
    one.trail.push(now.com_m.slice(0, 2));
    if (one.trail.length > TRAIL_N) one.trail.shift();
    const [x_m, y_m] = now.waypoint_m;
    if (one.mark?.x_m !== x_m || one.mark?.y_m !== y_m) one.mark = { x_m, y_m };
    one.now = now;
  });
}

function drop(one, row, n) {
  for (const [name, width] of [["time_s", 1], ["com_m", 3], ["nodes_m", 36], ["tensions_n", 24], ["face", 1], ["kinds", 1]]) one[name].splice(row * width, n * width);
}

/** A trail without the robot's rocking: the mean of neighbours. */
export function evened(trail) {
  return trail.map((_, k) => {
    const near = trail.slice(Math.max(0, k - EVEN_N), k + EVEN_N + 1);
    return [0, 1].map((axis) => near.reduce((sum, point) => sum + point[axis], 0) / near.length);
  });
}

/** A clock that stays a little behind the newest row, so that the next one is there before it is needed. */
export function pacer() {
  let time_s = 0, before_ms = 0;
  return (found, now_ms) => {
    const rows = found[0].time_s, wanted_s = rows.at(-1) - BEHIND_S, passed_s = Math.min(now_ms - before_ms, 250) / 1000;
    before_ms = now_ms;
    time_s += passed_s * Math.min(Math.max(1 + 2 * (wanted_s - time_s), 0), 2);
    time_s = Math.min(Math.max(time_s, rows[0]), rows.at(-1));
    return time_s;
  };
}
