// The sign above a robot in three dimensions, of one size from near and far.

import * as THREE from "../vendor/three/three.module.min.js";
import { sign } from "./flat.js";

const WIDTH_PX = 128, HEIGHT_PX = 64, SIGN_PX = 52, SIZE = 0.06;

/** A sign with a frame of a colour. `show(text)` says what it says. */
export function label(shade) {
  const canvas = Object.assign(document.createElement("canvas"), { width: WIDTH_PX, height: HEIGHT_PX }), pen = canvas.getContext("2d");
  const map = new THREE.CanvasTexture(canvas);
  map.colorSpace = THREE.SRGBColorSpace;
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, sizeAttenuation: false, depthTest: false, fog: false }));
  sprite.scale.set((SIZE * WIDTH_PX) / HEIGHT_PX, SIZE, 1);
  sprite.renderOrder = 8;
  let shown = null;
  return { sprite, show(text) {
    if (text === shown) return;
    shown = text;
    pen.clearRect(0, 0, WIDTH_PX, HEIGHT_PX);
    sign(pen, text, WIDTH_PX / 2, HEIGHT_PX / 2, SIGN_PX, shade);
    map.needsUpdate = true;
  } };
}
