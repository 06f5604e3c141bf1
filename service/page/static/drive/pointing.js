// Clicks and drags on a stage: a click on the ground is a waypoint, a drag from a robot a push.

const CLICK_PX = 6, N_S_PER_M = 60, LEAST_N_S = 3;
export const MOST_N_S = 200;

/** Tell `waypoint([x, y])` and `push(robot, [x, y])` (m, N s), and `aimed(N s)` while somebody pulls. */
export function pointing(stage, { waypoint, push, aimed }) {
  const { canvas } = stage;
  let held = null;

  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };

  function down(event) {
    if (!event.isPrimary || event.button) return drop();
    const [x, y] = at(event), robot = stage.robotAt(x, y);
    held = { x, y, robot, from: robot === null ? null : stage.beside(x, y, robot), far_px: 0, impulse: [0, 0] };
    if (robot === null) return;
    stage.hold(true);
    canvas.setPointerCapture(event.pointerId);
  }

  function move(event) {
    if (!held || !event.isPrimary) return;
    const [x, y] = at(event);
    held.far_px = Math.max(held.far_px, Math.hypot(x - held.x, y - held.y));
    const to = held.robot === null ? null : stage.beside(x, y, held.robot);
    if (!to || !held.from) return;
    held.impulse = bounded([0, 1].map((axis) => N_S_PER_M * (to[axis] - held.from[axis])));
    stage.arrow(held.robot, held.impulse);
    aimed(Math.hypot(...held.impulse));
  }

  function up(event) {
    if (!held || !event.isPrimary) return;
    const { robot, impulse, far_px, x, y } = held;
    drop();
    if (far_px < CLICK_PX) {
      const place = stage.groundAt(x, y);
      if (place) waypoint(place);
    } else if (robot !== null && Math.hypot(...impulse) > LEAST_N_S) push(robot, impulse);
  }

  function drop() {
    if (held && held.robot !== null) stage.arrow(held.robot, null), stage.hold(false), aimed(null);
    held = null;
  }

  canvas.addEventListener("pointerdown", down, { capture: true }); // before the camera turns
  canvas.addEventListener("pointermove", move);
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", drop);
}

/** An impulse of at most MOST_N_S. */
export function bounded(impulse) {
  const share = Math.min(1, MOST_N_S / (Math.hypot(...impulse) || 1));
  return impulse.map((value) => value * share);
}
