// An episode in time: which rows are shown at a moment, and what lies where then.

export const NODES_N = 12;
const SMOOTH_S = 0.8;

/** Where a time lies between rows: row, the next one, and the share of the way. */
export function moment(episode, time_s) {
  const times = episode.time_s, last = times.length - 1;
  if (time_s <= times[0]) return { row: 0, next: Math.min(1, last), share: 0 };
  if (time_s >= times[last]) return { row: last, next: last, share: 0 };
  let low = 0, high = last;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time_s + 1e-9) low = middle;
    else high = middle;
  }
  return { row: low, next: high, share: Math.max(0, (time_s - times[low]) / (times[high] - times[low])) };
}

/** Write the nodes at a moment into `out` [12 * 3]. */
export function nodesAt(episode, { row, next, share }, out) {
  const width = 3 * NODES_N, nodes = episode.nodes_m;
  for (let k = 0; k < width; k += 1) out[k] = nodes[width * row + k] + share * (nodes[width * next + k] - nodes[width * row + k]);
  return out;
}

/** The path of the centre of mass without its rocking, for a camera [T + 1][3]. */
export function smoothed(episode) {
  const { time_s, com_m } = episode, step_s = time_s.length > 1 ? time_s[1] - time_s[0] : 1;
  const reach = Math.ceil((3 * SMOOTH_S) / step_s);
  return time_s.map((_, row) => {
    const sum = [0, 0, 0];
    let weights = 0;
    for (let k = Math.max(0, row - reach); k <= Math.min(time_s.length - 1, row + reach); k += 1) {
      const weight = Math.exp(-0.5 * (((k - row) * step_s) / SMOOTH_S) ** 2);
      weights += weight;
      for (let axis = 0; axis < 3; axis += 1) sum[axis] += weight * com_m[3 * k + axis];
    }
    return sum.map((value) => value / weights);
  });
}

/** The point at a moment of a path of rows. */
export function pointAt(path, { row, next, share }) {
  return path[row].map((value, axis) => value + share * (path[next][axis] - value));
}

/** The waypoint that is active in a row. */
export function waypointAt(episode, row) {
  return episode.waypoints.findLast((mark) => mark.start <= row) ?? episode.waypoints[0];
}

/** The segment of a row. */
export function segmentAt(episode, row) {
  return episode.segments.find((span) => row < span.stop);
}

export function isStuck(episode, row) {
  return episode.stuck.some(([start, stop]) => row >= start && row < stop);
}

/** Height of the ground (m) at a place, as its triangles have it; beyond what is known, that of the side. */
export function heightOf(ground) {
  if (!ground) return () => 0;
  const { x_m, y_m, cell_m, rows, columns, heights_m } = ground;
  return (x, y) => {
    const u = Math.min(Math.max((x - x_m) / cell_m, 0), rows - 1), v = Math.min(Math.max((y - y_m) / cell_m, 0), columns - 1);
    const i = Math.min(Math.floor(u), rows - 2), j = Math.min(Math.floor(v), columns - 2);
    const a = u - i, b = v - j, at = (di, dj) => heights_m[(i + di) * columns + j + dj];
    const corner = at(0, 0), far = at(1, 1);
    return a >= b ? corner + a * (at(1, 0) - corner) + b * (far - at(1, 0)) : corner + b * (at(0, 1) - corner) + a * (far - at(0, 1));
  };
}

/** Red, green and blue (0 .. 1) of a share from 0 to 1: the colours of Turbo. */
export function turbo(share) {
  const x = Math.min(Math.max(share, 0), 1);
  const rgb = [
    0.1357 + x * (4.5974 - x * (42.3277 - x * (130.5887 - x * (150.5666 - x * 58.1375)))),
    0.0914 + x * (2.1856 + x * (4.8052 - x * (14.0195 - x * (4.2109 + x * 2.7747)))),
    0.1067 + x * (12.5925 - x * (60.1097 - x * (109.0745 - x * (88.5066 - x * 26.8183)))),
  ];
  return rgb.map((value) => Math.min(Math.max(value, 0), 1));
}
