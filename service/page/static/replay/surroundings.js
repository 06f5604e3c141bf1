// What stands still in a scene: ground, light, track and waypoints.

import * as THREE from "../vendor/three/three.module.min.js";
import { colour } from "../base/curves.js";
import { heightOf } from "./motion.js";

const REACH_M = 6, TRACK_M = 0.05, RING_M = 0.05, POLE_M = 1, LIFT_M = 0.012;
const LOW = "#6f8f6a", HIGH = "#d9c9a0";

/** The facets of an episode's ground, or a plane with a line each metre. */
export function ground(episode) {
  const group = new THREE.Group();
  const { vertices, lines, shades } = episode.ground ? facets(episode.ground) : plane(episode);
  const surface = new THREE.BufferGeometry();
  surface.setAttribute("position", new THREE.Float32BufferAttribute(vertices, 3));
  surface.setAttribute("color", new THREE.Float32BufferAttribute(shades, 3));
  surface.computeVertexNormals();
  const mesh = new THREE.Mesh(surface, new THREE.MeshLambertMaterial({ vertexColors: true, flatShading: true }));
  mesh.receiveShadow = true;
  const grid = new THREE.BufferGeometry();
  grid.setAttribute("position", new THREE.Float32BufferAttribute(lines, 3));
  group.add(mesh, new THREE.LineSegments(grid, new THREE.LineBasicMaterial({ color: 0x000000, transparent: true, opacity: 0.16 })));
  return group;
}

function facets({ x_m, y_m, cell_m, rows, columns, heights_m }) {
  const vertices = [], lines = [], shades = [];
  const low = heights_m.reduce((a, b) => Math.min(a, b)), range = heights_m.reduce((a, b) => Math.max(a, b)) - low || 1;
  const from = new THREE.Color(LOW), to = new THREE.Color(HIGH), mixed = new THREE.Color();
  const point = (i, j, lift = 0) => [x_m + i * cell_m, y_m + j * cell_m, heights_m[i * columns + j] + lift];
  const corner = (i, j) => {
    vertices.push(...point(i, j));
    mixed.lerpColors(from, to, Math.min(1, (heights_m[i * columns + j] - low) / Math.min(range, 2)));
    shades.push(mixed.r, mixed.g, mixed.b);
  };
  for (let i = 0; i < rows - 1; i += 1)
    for (let j = 0; j < columns - 1; j += 1) {
      for (const [di, dj] of [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]) corner(i + di, j + dj);
      lines.push(...point(i, j, 0.004), ...point(i + 1, j, 0.004), ...point(i, j, 0.004), ...point(i, j + 1, 0.004));
    }
  return { vertices, lines, shades };
}

function plane(episode) {
  const [left, right] = bounds(episode, 0), [near, far] = bounds(episode, 1);
  const shade = new THREE.Color(colour("plane")), vertices = [], lines = [], shades = [];
  for (const [x, y] of [[left, near], [right, near], [right, far], [left, near], [right, far], [left, far]]) {
    vertices.push(x, y, 0);
    shades.push(shade.r, shade.g, shade.b);
  }
  for (let x = left; x <= right; x += 1) lines.push(x, near, 0.003, x, far, 0.003);
  for (let y = near; y <= far; y += 1) lines.push(left, y, 0.003, right, y, 0.003);
  return { vertices, lines, shades };
}

function bounds(episode, axis) {
  let low = Infinity, high = -Infinity;
  for (let k = axis; k < episode.com_m.length; k += 3) (low = Math.min(low, episode.com_m[k])), (high = Math.max(high, episode.com_m[k]));
  for (const mark of episode.waypoints) {
    const value = axis ? mark.y_m : mark.x_m;
    if (value > low - 2 * REACH_M && value < high + 2 * REACH_M) (low = Math.min(low, value)), (high = Math.max(high, value));
  }
  return [Math.floor(low - REACH_M), Math.ceil(high + REACH_M)];
}

/** A band of a width along a horizontal path [[x, y], ...] laid on the ground; `upTo(k)` shows its first k points. */
export function band(path, height, width_m, material) {
  const vertices = [];
  path.forEach(([x, y], k) => {
    const [ax, ay] = path[Math.max(0, k - 1)], [bx, by] = path[Math.min(path.length - 1, k + 1)];
    const length = Math.hypot(bx - ax, by - ay) || 1, nx = (-(by - ay) / length) * (width_m / 2), ny = ((bx - ax) / length) * (width_m / 2);
    for (const side of [1, -1]) vertices.push(x + side * nx, y + side * ny, height(x + side * nx, y + side * ny) + LIFT_M);
  });
  const index = [];
  for (let k = 0; k + 1 < path.length; k += 1) index.push(2 * k, 2 * k + 1, 2 * k + 2, 2 * k + 1, 2 * k + 3, 2 * k + 2);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(vertices, 3));
  geometry.setIndex(index);
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  return { mesh, upTo: (k) => geometry.setDrawRange(0, 6 * k) };
}

/** The track of an episode: all of it faint, and what lies behind the robot strong. */
export function track(episode, shade) {
  const height = heightOf(episode.ground), path = [];
  for (let k = 0; k < episode.com_m.length; k += 3) path.push([episode.com_m[k], episode.com_m[k + 1]]);
  const whole = band(path, height, TRACK_M, flat(shade, 0.3)), past = band(path, height, 1.6 * TRACK_M, flat(shade, 0.95));
  past.mesh.position.z = 0.004;
  const group = new THREE.Group();
  group.add(whole.mesh, past.mesh);
  return { group, upTo: past.upTo };
}

/** The waypoint: the circle in which it is reached, and a pole; `to(mark)` moves it. */
export function waypoint(episode, shade) {
  const group = new THREE.Group(), height = heightOf(episode.ground);
  let shown = null;
  return { group, to(mark) {
    if (mark === shown) return;
    shown = mark;
    dispose(group);
    const circle = Array.from({ length: 65 }, (_, k) => [mark.x_m + episode.waypoint_radius_m * Math.cos((k * Math.PI) / 32), mark.y_m + episode.waypoint_radius_m * Math.sin((k * Math.PI) / 32)]);
    const foot = height(mark.x_m, mark.y_m);
    const pole = new THREE.Mesh(new THREE.CylinderGeometry(0.018, 0.018, POLE_M, 8).rotateX(Math.PI / 2), flat(shade, 1));
    pole.position.set(mark.x_m, mark.y_m, foot + POLE_M / 2);
    const ball = new THREE.Mesh(new THREE.SphereGeometry(0.09, 16, 12), flat(shade, 1));
    ball.position.set(mark.x_m, mark.y_m, foot + POLE_M);
    group.add(band(circle, height, RING_M, flat(shade, 0.9)).mesh, pole, ball);
  } };
}

function flat(shade, opacity) {
  return new THREE.MeshBasicMaterial({ color: shade, transparent: opacity < 1, opacity, side: THREE.DoubleSide });
}

/** Forget what a group holds, in the graphics card too. */
export function dispose(group) {
  group.traverse((part) => {
    part.geometry?.dispose();
    part.material?.map?.dispose();
    part.material?.dispose();
  });
  group.clear();
}
