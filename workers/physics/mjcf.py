"""The robot as a MuJoCo model (MJCF), for engines and viewers that read that format. Needs no MuJoCo itself.

The bars are six free capsules with the inertia of physics/bullet_world.py. A cable is a tendon between two sites with
an actuator that pulls as a spring and a damper do:

    force      clip(k (u + r0 - l) - c l', -T_max, 0)
    u, r0, l   control (m), nominal rest length, length of the tendon

so that a control of 0 is the nominal rest length. That is the law of workers/physics/cables.py but for the limits of
the damping, which matter to cables that are nearly slack. Six more actuators, whose controls stay 0, brake the
spin of the bars about their axes.
"""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree

import numpy as np

from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.engine import GRAVITY_M_PER_S2
from t6gps.workers.robot.neutral import neutral_state, nominal_rest_length
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS, BARS_N, CABLES
from t6gps.workers.settings import RobotSettings

START_CLEARANCE_M = 0.1
"""Height of the lowest node's centre line above the highest ground below the initial state (m)."""

GROUND_DEPTH_M = 2.0
"""Thickness of rough ground below its lowest point (m)."""

_BAR_COLOR = "0.25 0.25 0.3 1"
_CABLE_COLOR = "0.75 0.2 0.15 1"
_GROUND_COLOR = "0.8 0.78 0.72 1"


def to_mjcf(robot: RobotSettings, terrain: Terrain | None = None) -> str:
    """MJCF text of the robot in its neutral state over a ground, None being the plane z = 0."""
    root = ElementTree.Element("mujoco", model="t6gps")
    step_s = robot.physics_step_s
    _add(root, "option", timestep=step_s, gravity=(0, 0, -GRAVITY_M_PER_S2), cone="elliptic", impratio=100)
    # The stiffest contacts that MuJoCo accepts at this step; of two geometries' frictions MuJoCo takes the larger.
    contact = {"solref": (2 * step_s, 1), "solimp": (0.95, 0.99, 0.001), "friction": (robot.friction, 0, 0)}
    _add(_add(root, "default"), "geom", condim=3, **contact)
    _add_ground(root, terrain)
    world = _find(root, "worldbody")
    _add_bars(world, robot, BAR_LENGTH_M / 2 + START_CLEARANCE_M + _highest_below_start_m(terrain))
    _add_cables(root, robot)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_ground(root: ElementTree.Element, terrain: Terrain | None) -> None:
    if terrain is not None:
        # Rows of equal y, the largest y first. MuJoCo divides a cell along the same diagonal as Terrain.
        rows, low = terrain.heights.T[::-1], terrain.heights.min()
        size = (terrain.half_size_m, terrain.half_size_m, np.ptp(rows) or 1.0, GROUND_DEPTH_M)
        asset = _add(root, "asset")
        _add(asset, "hfield", name="ground", nrow=len(rows), ncol=len(rows), size=size, elevation=rows.ravel())
    world = _add(root, "worldbody")
    _add(world, "light", pos=(0, 0, 20), dir=(0.2, 0.3, -1), directional="true")
    if terrain is None:
        _add(world, "geom", name="ground", type="plane", size=(20, 20, 1), rgba=_GROUND_COLOR)
    else:
        _add(world, "geom", name="ground", type="hfield", hfield="ground", pos=(0, 0, low), rgba=_GROUND_COLOR)


def _highest_below_start_m(terrain: Terrain | None) -> float:
    if terrain is None:
        return 0.0
    x, y = np.meshgrid(*[np.linspace(-BAR_LENGTH_M / 2, BAR_LENGTH_M / 2, 25)] * 2)
    return float(terrain.height(x, y).max())


def _add_bars(world: ElementTree.Element, robot: RobotSettings, height_m: float) -> None:
    state = neutral_state(robot, height_m)
    transverse_inertia = robot.bar_mass_kg * BAR_LENGTH_M**2 / 12
    inertia = (transverse_inertia, transverse_inertia, robot.axial_inertia_kg_m2)
    for bar, (first, second) in enumerate(BARS):
        x, y, z, w = state.bar_orientations[bar]
        body = _add(world, "body", name=f"bar_{bar}", pos=state.bar_positions[bar], quat=(w, x, y, z))
        _add(body, "freejoint", name=f"bar_{bar}")
        _add(body, "inertial", pos=(0, 0, 0), mass=robot.bar_mass_kg, diaginertia=inertia)
        _add(body, "geom", type="capsule", size=(robot.bar_radius_m, BAR_LENGTH_M / 2), rgba=_BAR_COLOR)
        _add(body, "site", name=f"bar_{bar}")
        _add(body, "site", name=f"node_{first}", pos=(0, 0, robot.attachment_span_m / 2))
        _add(body, "site", name=f"node_{second}", pos=(0, 0, -robot.attachment_span_m / 2))


def _add_cables(root: ElementTree.Element, robot: RobotSettings) -> None:
    tendons, actuators = _add(root, "tendon"), _add(root, "actuator")
    nominal_m, stiffness = nominal_rest_length(robot), robot.cable_stiffness_n_per_m
    for cable, nodes in enumerate(CABLES):
        name = f"cable_{cable}"
        tendon = _add(tendons, "spatial", name=name, width=0.008, rgba=_CABLE_COLOR)
        for node in nodes:
            _add(tendon, "site", site=f"node_{node}")
        _add(
            actuators,
            "general",
            name=name,
            tendon=name,
            biastype="affine",
            gainprm=stiffness,
            biasprm=(stiffness * nominal_m, -stiffness, -robot.cable_damping_n_s_per_m),
            ctrlrange=(robot.shortest_command_m - nominal_m, robot.longest_command_m - nominal_m),
            forcerange=(-robot.cable_max_tension_n, 0),
        )
    for bar in range(BARS_N):
        name = f"bar_{bar}"
        _add(actuators, "velocity", name=name, site=name, gear=(0, 0, 0, 0, 0, 1), kv=robot.axial_damping_n_m_s)


def _find(root: ElementTree.Element, tag: str) -> ElementTree.Element:
    (element,) = root.iter(tag)
    return element


def _add(parent: ElementTree.Element, tag: str, **attributes: str | float | Iterable[float]) -> ElementTree.Element:
    texts = {key: value if isinstance(value, str) else _text(value) for key, value in attributes.items()}
    return ElementTree.SubElement(parent, tag, texts)


def _text(value: float | Iterable[float]) -> str:
    return " ".join(repr(float(number)).removesuffix(".0") for number in np.atleast_1d(np.asarray(value, dtype=float)))
