// A drive in three dimensions: robots on their ground, and what lies under a pointer.

import * as THREE from "../vendor/three/three.module.min.js";
import { colour } from "../base/curves.js";
import { heightOf, moment } from "../replay/motion.js";
import { robot } from "../replay/robot.js";
import { band, dispose, ground, waypoint } from "../replay/surroundings.js";
import { theatre } from "../replay/theatre.js";
import { LETTERS, SHADES, evened } from "./live.js";

const PLANE_M = 24, TRAIL_M = 0.05, SOFT = 0.04, NEAR_PX = 22, INSIDE = 0.8, ARROW_M_PER_N_S = 0.015;

/** A stage in an element for the robots of a drive. */
export function solid(place, robots) {
  let parts = [], floor = null, time_s = 0, centre = null, arrow = null;
  const stage = theatre(place, robots.length > 1, build), height = heightOf(robots[0].ground);
  const ray = new THREE.Raycaster(), pointer = new THREE.Vector2(), hit = new THREE.Vector3(), plane = new THREE.Plane();

  function build() {
    parts.forEach(({ groups }) => groups.forEach(forget));
    if (floor) forget(floor);
    floor = ground({ ground: robots[0].ground, com_m: [-PLANE_M, -PLANE_M, 0, PLANE_M, PLANE_M, 0], waypoints: [] });
    stage.world.add(floor);
    parts = robots.map((one, k) => {
      const body = robot(one, colour(SHADES[k]), robots.length > 1 && LETTERS[k]), mark = waypoint(one, colour(k ? SHADES[k] : "cap")), way = new THREE.Group(), groups = [body.group, mark.group, way];
      stage.world.add(...groups);
      return { one, body, mark, way, groups, trail_n: 0 };
    });
    if (centre) show(time_s);
  }

  function forget(group) {
    dispose(group);
    stage.world.remove(group);
  }

  function show(now_s) {
    time_s = now_s;
    const sum = [0, 0, 0];
    parts.forEach((part, k) => {
      const at = moment(part.one, time_s);
      part.body.show(at);
      part.mark.to(part.one.mark);
      trail(part, k);
      part.body.group.children.at(-1).position.toArray().forEach((value, axis) => (sum[axis] += value / parts.length));
    });
    centre = centre && Math.hypot(...centre.map((value, axis) => value - sum[axis])) < 3 ? centre.map((value, axis) => value + SOFT * (sum[axis] - value)) : sum;
    if (!robots[0].ground) floor.position.set(Math.round(centre[0]), Math.round(centre[1]), 0);
    stage.centreOn(centre);
  }

  function trail(part, k) {
    const newest = part.one.trail.at(-1);
    if (newest === part.newest || part.one.trail.length < 2) return;
    part.newest = newest;
    dispose(part.way);
    part.way.add(band(evened(part.one.trail), height, TRAIL_M, new THREE.MeshBasicMaterial({ color: colour(k ? SHADES[k] : "cap"), side: THREE.DoubleSide, transparent: true, opacity: 0.8 })).mesh);
  }

  function aim(x, y) {
    pointer.set((2 * x) / place.clientWidth - 1, 1 - (2 * y) / place.clientHeight);
    ray.setFromCamera(pointer, stage.camera);
  }

  const com = (k) => parts[k].body.group.children.at(-1).position;

  stage.restyle();
  return {
    show, canvas: stage.canvas, follow: stage.follow, render: stage.render, close: stage.close,
    look: () => stage.look(robots[0].com_m, robots[0].mark),
    /** The place on the ground under a pointer, null for the sky. */
    groundAt(x, y) {
      aim(x, y);
      const found = ray.intersectObject(floor.children[0])[0]?.point;
      return found ? [found.x, found.y] : null;
    },
    /** The number of the robot under a pointer, or nearly so, null where there is none: of those the nearest. */
    robotAt(x, y) {
      const seen = (point) => {
        hit.fromArray(point).project(stage.camera);
        return [((hit.x + 1) / 2) * place.clientWidth, ((1 - hit.y) / 2) * place.clientHeight];
      };
      const far = parts.map(({ body }, k) => {
        const middle = seen(com(k).toArray()), size_px = Math.max(...body.nodes().map((node) => distance(seen(node), middle)));
        return distance([x, y], middle) / Math.max(INSIDE * size_px, NEAR_PX);
      });
      const nearest = far.indexOf(Math.min(...far));
      return far[nearest] < 1 ? nearest : null;
    },
    /** The place under a pointer at the height of a robot. */
    beside(x, y, k) {
      aim(x, y);
      plane.set(new THREE.Vector3(0, 0, 1), -com(k).z);
      return ray.ray.intersectPlane(plane, hit) ? [hit.x, hit.y] : null;
    },
    /** The horizontal direction away from who looks. */
    ahead() {
      stage.camera.getWorldDirection(hit);
      const length = Math.hypot(hit.x, hit.y) || 1;
      return [hit.x / length, hit.y / length];
    },
    /** While somebody pulls, the camera stays. */
    hold: (whether) => (stage.controls.enabled = !whether),
    /** Show an impulse [x, y] on a robot, null for none. */
    arrow(k, impulse) {
      if (arrow) forget(arrow);
      arrow = null;
      const length = impulse ? ARROW_M_PER_N_S * Math.hypot(...impulse) : 0;
      if (length > 0.02) stage.world.add((arrow = pull(com(k), impulse, length)));
      stage.centreOn(centre);
    },
  };
}

/** An arrow from a point in a horizontal direction, seen through everything. */
function pull(from, [x, y], length_m) {
  const group = new THREE.Group(), material = new THREE.MeshBasicMaterial({ color: colour("bad"), depthTest: false, transparent: true });
  const shaft = new THREE.Mesh(new THREE.CylinderGeometry(0.035, 0.035, length_m, 12), material), tip = new THREE.Mesh(new THREE.ConeGeometry(0.12, 0.3, 16), material);
  shaft.position.y = length_m / 2;
  tip.position.y = length_m;
  group.add(shaft, tip);
  group.renderOrder = shaft.renderOrder = tip.renderOrder = 9;
  group.position.copy(from);
  group.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), new THREE.Vector3(x, y, 0).normalize());
  return group;
}

const distance = ([ax, ay], [bx, by]) => Math.hypot(ax - bx, ay - by);
