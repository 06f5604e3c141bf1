"""Domain randomisation: a robot of its own for each episode, drawn around the configured one."""

from __future__ import annotations

import numpy as np

from t6gps.workers.settings import RandomisationSettings, RobotSettings


def draw(
    robot: RobotSettings, randomisation: RandomisationSettings, rng: np.random.Generator
) -> tuple[RobotSettings, int]:
    """The robot of an episode and its control delay (control steps).

    Mass, stiffness, friction and winch speed are the configured ones times a factor uniform between 1 - spread and
    1 + spread; the delay is uniform in 0 .. largest_delay_steps. Without randomisation the robot itself comes back.
    The pretension stays, so a stiffer cable is longer at rest.
    """
    spreads = {
        "bar_mass_kg": randomisation.mass_spread,
        "cable_stiffness_n_per_m": randomisation.stiffness_spread,
        "friction": randomisation.friction_spread,
        "winch_speed_m_per_s": randomisation.winch_speed_spread,
    }
    factors = 1 + rng.uniform(-1, 1, len(spreads)) * list(spreads.values())
    drawn = {
        name: float(getattr(robot, name) * factor)
        for (name, spread), factor in zip(spreads.items(), factors, strict=True)
        if spread > 0
    }
    delay = int(rng.integers(randomisation.largest_delay_steps, endpoint=True))
    return robot.model_copy(update=drawn), delay
