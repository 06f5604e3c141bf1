"""Gaits that need no learned policy: one made by hand, and periodic ones for an evolution strategy to choose from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.episode.rollout import Controller
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.robot.symmetry import CABLES_FROM
from t6gps.workers.robot.topology import CABLES, CABLES_N

Array = NDArray[np.float64]

FLOP_PERIOD_STEPS = 16
"""0.8 s to lean and 0.8 s to let go."""

LEAN = 0.8
"""Change of a rest length per metre of its cable ahead of the centre of mass."""

LEAN_WITH_HEIGHT = 0.8
"""The same per metre of its height."""

WAVE_PARAMETERS_N = 2 * CABLES_N + 1
"""Two amplitudes of each cable, and the frequency."""

SLOWEST_HZ = 0.2
"""Five seconds: the time that a waypoint has."""

FASTEST_HZ = 1.5
"""Winches do not follow faster waves: at 0.35 m/s they move 0.23 m in a period of this one."""

WAVE_SCALE_M = 0.3
"""Amplitude that a parameter of 1 stands for."""


def flop(nominal_m: float) -> Controller:
    """Lean towards the waypoint until the robot flops over, then let go; 0.8 s each (as by hand in Chen et al. 2017).

    Leaning shortens the cables ahead of the centre of mass, more so the higher they are, and lengthens those behind it.
    """

    def control(episode: RunningEpisode, step: int) -> Array:
        if step % FLOP_PERIOD_STEPS >= FLOP_PERIOD_STEPS // 2:
            return np.full(CABLES_N, nominal_m)
        nodes = episode.state.nodes() - episode.state.com
        middle = nodes[CABLES].mean(axis=1)
        ahead = middle[:, :2] @ np.array(episode.target)
        return _canonical(nominal_m - (LEAN + LEAN_WITH_HEIGHT * middle[:, 2]) * ahead, episode)

    return control


def waves(nominal_m: float, parameters: Array) -> Controller:
    """Each cable follows its own sinusoid of one common frequency, whatever happens: an open-loop gait.

    parameters [49]: amplitudes of cosine and sine of each cable over 0.3 m, and the frequency, squashed into
    0.2 .. 1.5 Hz.
    """
    cosine, sine = WAVE_SCALE_M * parameters[:-1].reshape(2, CABLES_N)
    frequency_hz = SLOWEST_HZ + (FASTEST_HZ - SLOWEST_HZ) / (1 + np.exp(-parameters[-1]))

    def control(episode: RunningEpisode, step: int) -> Array:
        phase = 2 * np.pi * frequency_hz * step / 10
        return _canonical(nominal_m + cosine * np.cos(phase) + sine * np.sin(phase), episode)

    return control


def _canonical(command: NDArray[np.float64], episode: RunningEpisode) -> NDArray[np.float64]:
    """Commands [24] of the cables in world labels, relabelled for the present frame."""
    return command[CABLES_FROM[episode.frame.element]]
