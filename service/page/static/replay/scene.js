// Episodes on one ground in three dimensions, with a camera that somebody turns and that follows them.

import * as THREE from "../vendor/three/three.module.min.js";
import { OrbitControls } from "../vendor/three/OrbitControls.js";
import { colour } from "../base/curves.js";
import { moment, pointAt, smoothed, waypointAt } from "./motion.js";
import { robot } from "./robot.js";
import { dispose, ground, track, waypoint } from "./surroundings.js";

const DISTANCE_M = 6.5, ELEVATION = 0.5, TURN = 0.6, SHARPEST = 2;
const SUN = new THREE.Vector3(-0.5, -0.35, 0.85).normalize();


/** A scene in an element. Episodes share one ground; the k-th has bars in the colour `bar-a` or `bar-b`. */
export function scene(place, episodes, letters) {
  const canvas = document.createElement("canvas");
  place.prepend(canvas);
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  renderer.shadowMap.enabled = true;
  renderer.setPixelRatio(Math.min(devicePixelRatio, SHARPEST));
  const world = new THREE.Scene(), camera = new THREE.PerspectiveCamera(40, 1, 0.05, 200);
  camera.up.set(0, 0, 1);
  const controls = new OrbitControls(camera, canvas);
  Object.assign(controls, { minDistance: 1, maxDistance: 60, maxPolarAngle: Math.PI / 2 - 0.02, zoomSpeed: 0.8 });
  const paths = episodes.map(smoothed);
  const centre = new THREE.Vector3(), before = new THREE.Vector3();
  const sun = light(world, episodes.length);
  let parts = [], time_s = 0, following = true, stale = true;
  controls.addEventListener("change", () => (stale = true));

  function build() {
    parts.forEach((part) => part.groups.forEach((group) => (dispose(group), world.remove(group))));
    world.background = new THREE.Color(colour("sky"));
    world.fog = new THREE.Fog(world.background, 25, 60);
    parts = episodes.map((episode, k) => {
      const shade = colour(letters[k] === "B" ? "bar-b" : "cap");
      const body = robot(episode, colour(letters[k] === "B" ? "bar-b" : "bar-a")), way = track(episode, shade), mark = waypoint(episode, shade), below = ground(episode);
      const groups = [body.group, way.group, mark.group, below];
      world.add(...groups);
      return { episode, body, way, mark, groups };
    });
    show(time_s);
  }

  function show(now_s) {
    time_s = now_s;
    before.copy(centre);
    centre.set(0, 0, 0);
    for (const [k, { episode, body, way, mark }] of parts.entries()) {
      const at = moment(episode, time_s);
      body.show(at);
      way.upTo(at.row);
      mark.to(waypointAt(episode, at.row));
      centre.add(new THREE.Vector3(...pointAt(paths[k], at)));
    }
    centre.divideScalar(parts.length);
    sun.position.copy(centre).addScaledVector(SUN, 20);
    sun.target.position.copy(centre);
    if (following) carry();
    stale = true;
  }

  function carry() {
    const way = before.subVectors(centre, controls.target);
    controls.target.add(way);
    camera.position.add(way);
    controls.update();
  }

  function look() {
    const first = episodes[0], mark = waypointAt(first, 0);
    const angle = Math.atan2(mark.y_m - first.com_m[1], mark.x_m - first.com_m[0]) + TURN;
    const far_m = DISTANCE_M * (episodes.length > 1 ? 1.5 : 1);
    controls.target.copy(centre);
    camera.position.copy(centre).add(new THREE.Vector3(-Math.cos(angle) * Math.cos(ELEVATION), -Math.sin(angle) * Math.cos(ELEVATION), Math.sin(ELEVATION)).multiplyScalar(far_m));
    controls.update();
    stale = true;
  }

  const observer = new ResizeObserver(() => {
    const { clientWidth: width, clientHeight: height } = place;
    if (!width || !height) return;
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    stale = true;
  });
  observer.observe(place);
  window.addEventListener("themechange", build);
  build();
  look();
  return {
    show, look,
    follow: (whether) => ((following = whether), whether && carry()),
    render() {
      if (!stale) return;
      stale = false;
      renderer.render(world, camera);
    },
    nodes: (k) => parts[k].body.nodes(),
    close() {
      observer.disconnect();
      window.removeEventListener("themechange", build);
      controls.dispose();
      dispose(world);
      renderer.dispose();
      renderer.forceContextLoss();
      canvas.remove();
    },
  };
}

function light(world, episodes_n) {
  world.add(new THREE.HemisphereLight(0xffffff, 0x8a7f70, 1.7));
  const sun = new THREE.DirectionalLight(0xffffff, 1.9);
  const reach_m = episodes_n > 1 ? 12 : 4;
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  Object.assign(sun.shadow.camera, { left: -reach_m, right: reach_m, top: reach_m, bottom: -reach_m, near: 1, far: 40 });
  sun.shadow.bias = -0.0008;
  world.add(sun, sun.target);
  return sun;
}
