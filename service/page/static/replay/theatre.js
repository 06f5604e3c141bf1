// What every scene in three dimensions has: a canvas, light, and a camera that somebody turns and that follows.

import * as THREE from "../vendor/three/three.module.min.js";
import { OrbitControls } from "../vendor/three/OrbitControls.js";
import { colour } from "../base/curves.js";
import { dispose } from "./surroundings.js";

const DISTANCE_M = 6.5, ELEVATION = 0.5, TURN = 0.6, SHARPEST = 2;
const SUN = new THREE.Vector3(-0.5, -0.35, 0.85).normalize();

/** An empty scene in an element. `build()` is told when colours are others; several robots need a wide one. */
export function theatre(place, wide, build) {
  const canvas = document.createElement("canvas");
  place.prepend(canvas);
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  renderer.shadowMap.enabled = true;
  renderer.setPixelRatio(Math.min(devicePixelRatio, SHARPEST));
  const world = new THREE.Scene(), camera = new THREE.PerspectiveCamera(40, 1, 0.05, 200);
  camera.up.set(0, 0, 1);
  const controls = new OrbitControls(camera, canvas);
  Object.assign(controls, { minDistance: 1, maxDistance: 60, maxPolarAngle: Math.PI / 2 - 0.02, zoomSpeed: 0.8 });
  const sun = light(world, wide ? 12 : 4), centre = new THREE.Vector3();
  let following = true, stale = true;
  controls.addEventListener("change", () => (stale = true));

  /** Let a point [x, y, z] be the middle of what is seen. */
  function centreOn(point) {
    centre.set(...point);
    sun.position.copy(centre).addScaledVector(SUN, 20);
    sun.target.position.copy(centre);
    if (following) carry();
    stale = true;
  }

  function carry() {
    const way = new THREE.Vector3().subVectors(centre, controls.target);
    controls.target.add(way);
    camera.position.add(way);
    controls.update();
  }

  /** Look at the middle from behind somebody who heads for a mark. */
  function look(from, mark) {
    const angle = Math.atan2(mark.y_m - from[1], mark.x_m - from[0]) + TURN, far_m = DISTANCE_M * (wide ? 1.5 : 1);
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

  function restyle() {
    world.background = new THREE.Color(colour("sky"));
    world.fog = new THREE.Fog(world.background, 25, 60);
    build();
    stale = true;
  }
  window.addEventListener("themechange", restyle);

  return {
    canvas, world, camera, controls, centreOn, look, restyle,
    follow: (whether) => ((following = whether), whether && carry()),
    render() {
      if (!stale) return;
      stale = false;
      renderer.render(world, camera);
    },
    close() {
      observer.disconnect();
      window.removeEventListener("themechange", restyle);
      controls.dispose();
      dispose(world);
      renderer.dispose();
      renderer.forceContextLoss();
      canvas.remove();
    },
  };
}

function light(world, reach_m) {
  world.add(new THREE.HemisphereLight(0xffffff, 0x8a7f70, 1.7));
  const sun = new THREE.DirectionalLight(0xffffff, 1.9);
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  Object.assign(sun.shadow.camera, { left: -reach_m, right: reach_m, top: reach_m, bottom: -reach_m, near: 1, far: 40 });
  sun.shadow.bias = -0.0008;
  world.add(sun, sun.target);
  return sun;
}
