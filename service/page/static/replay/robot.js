// A robot in a scene: bars, their ends, cables by tension, the triangle that it stands on, and its sign.

import * as THREE from "../vendor/three/three.module.min.js";
import { colour } from "../base/curves.js";
import { words } from "./flat.js";
import { label } from "./label.js";
import { NODES_N, nodesAt, segmentAt, turbo } from "./motion.js";

const BALL_PER_BAR = 1.25, SLACK_M = 0.004, TIGHT_M = 0.016, CABLES_N = 24, ABOVE_M = 1.15;

/** The robot of an episode; where there are several, each has a letter. `show(moment)` moves it; `nodes()` says where the balls at its nodes are drawn. */
export function robot(episode, barColour, letter) {
  const group = new THREE.Group();
  const rod = new THREE.CylinderGeometry(1, 1, 1, 14).rotateX(Math.PI / 2);
  const solid = (shade) => new THREE.MeshLambertMaterial({ color: shade });
  const bars = new THREE.InstancedMesh(rod, solid(barColour), episode.bars.length);
  const cables = new THREE.InstancedMesh(rod, new THREE.MeshBasicMaterial(), episode.cables.length);
  const balls = new THREE.InstancedMesh(new THREE.SphereGeometry(1, 18, 12), solid(colour("cap")), NODES_N);
  const corners = new THREE.BufferGeometry();
  corners.setAttribute("position", new THREE.Float32BufferAttribute(new Float32Array(9), 3));
  const triangle = new THREE.Mesh(corners, new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.7, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: -2, polygonOffsetUnits: -2 }));
  const com = new THREE.Mesh(new THREE.SphereGeometry(0.05, 16, 12), solid(colour("cap")));
  const above = label(barColour);
  for (const part of [bars, cables, balls, triangle]) part.frustumCulled = false;
  bars.castShadow = balls.castShadow = cables.castShadow = true;
  group.add(bars, cables, balls, triangle, above.sprite, com);
  const kinds = ["delta", "lambda"].map((name) => new THREE.Color(colour(name)));
  const nodes = new Float64Array(3 * NODES_N), ends = new Float64Array(3 * NODES_N), a = new THREE.Vector3(), b = new THREE.Vector3();
  const middle = new THREE.Vector3(), turn = new THREE.Quaternion(), size = new THREE.Vector3(), matrix = new THREE.Matrix4();
  const upright = new THREE.Vector3(0, 0, 1), shade = new THREE.Color();

  function place(mesh, k, points, [first, second], radius_m) {
    a.fromArray(points, 3 * first);
    b.fromArray(points, 3 * second);
    middle.addVectors(a, b).multiplyScalar(0.5);
    b.sub(a);
    const length = b.length() || 1e-6;
    turn.setFromUnitVectors(upright, b.divideScalar(length));
    mesh.setMatrixAt(k, matrix.compose(middle, turn, size.set(radius_m, radius_m, length)));
  }

  function show(moment) {
    nodesAt(episode, moment, nodes);
    episode.bars.forEach((pair, k) => place(bars, k, nodes, pair, episode.bar_radius_m));
    for (const [from, to] of episode.bars)
      for (let axis = 0; axis < 3; axis += 1) {
        const left = nodes[3 * from + axis], right = nodes[3 * to + axis], inset = (right - left) * (1 - episode.attached_share) / 2;
        ends[3 * from + axis] = left + inset;
        ends[3 * to + axis] = right - inset;
      }
    episode.cables.forEach((pair, k) => {
      const tension = episode.tensions_n[CABLES_N * moment.row + k] / episode.brightest_n;
      place(cables, k, ends, pair, SLACK_M + (TIGHT_M - SLACK_M) * Math.min(1, tension));
      cables.setColorAt(k, shade.setRGB(...turbo(tension), THREE.SRGBColorSpace));
    });
    const radius_m = BALL_PER_BAR * episode.bar_radius_m;
    for (let k = 0; k < NODES_N; k += 1)
      balls.setMatrixAt(k, matrix.makeScale(radius_m, radius_m, radius_m).setPosition(nodes[3 * k], nodes[3 * k + 1], nodes[3 * k + 2]));
    for (const mesh of [bars, cables, balls]) mesh.instanceMatrix.needsUpdate = true;
    cables.instanceColor.needsUpdate = true;
    const face = episode.faces[episode.face[moment.row]], position = corners.attributes.position;
    face.forEach((node, k) => position.setXYZ(k, nodes[3 * node], nodes[3 * node + 1], nodes[3 * node + 2]));
    position.needsUpdate = true;
    triangle.material.color.copy(kinds[segmentAt(episode, moment.row).kind]);
    const at = (axis) => episode.com_m[3 * moment.row + axis] + moment.share * (episode.com_m[3 * moment.next + axis] - episode.com_m[3 * moment.row + axis]);
    com.position.set(at(0), at(1), at(2));
    above.sprite.position.set(at(0), at(1), at(2) + ABOVE_M);
    above.show(words(episode, moment.row, letter));
  }

  return { group, show, nodes: () => Array.from({ length: NODES_N }, (_, k) => {
    balls.getMatrixAt(k, matrix);
    return matrix.elements.slice(12, 15);
  }) };
}
