"""Gaits with few parameters that feel the ground through the support triangle, for evolution to choose from."""

from __future__ import annotations

import numpy as np

from t6gps.service.studies.rivals.senses import Array
from t6gps.storage.schema import TARGET
from t6gps.workers.episode.gaits import FLOP_PERIOD_STEPS, LEAN, LEAN_WITH_HEIGHT
from t6gps.workers.episode.rollout import Controller
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.robot.symmetry import CABLES_FROM
from t6gps.workers.robot.topology import CABLES, CABLES_N

KINDS_N, GROUPS_N, HARMONICS_N = 2, 5, 3
PATTERN_N = KINDS_N * (GROUPS_N * HARMONICS_N + 1)
"""Parameters of `pattern`."""
REFLEX_INPUTS_N = 5
REFLEX_N = KINDS_N * REFLEX_INPUTS_N * CABLES_N
"""Parameters of `reflex`."""
REFLEX_SCALE_M = 0.3
"""Farthest from the nominal rest length."""
TRACK = slice(TARGET.stop, TARGET.stop + 2)
"""Where the direction of travel is in an observation."""


def pattern(nominal_m: float, parameters: Array) -> Controller:
    """A central pattern generator: one phase oscillator, begun anew whenever the support triangle changes.

        d phase / dt = 2 pi f[kind],                     phase = 0 on entering a triangle
        u[c] = nominal - sum_g m[g, c] (A[kind, g] . (1, cos phase, sin phase))

    m[g, c] are five groups of muscles, by where the middle of cable c is about the centre of mass: ahead, ahead times
    height, height, ahead squared, to the side squared (m, m2). The kind is that of the support triangle.

    parameters [32]: A [2, 5, 3], then f over that of the gait by hand as powers of two [2].
    """
    amplitudes = parameters[:-KINDS_N].reshape(KINDS_N, GROUPS_N, HARMONICS_N)
    turn_per_step = 2 * np.pi / FLOP_PERIOD_STEPS * 2 ** parameters[-KINDS_N:]
    phase, face = 0.0, -1

    def control(episode: RunningEpisode, step: int) -> Array:
        nonlocal phase, face
        frame = episode.frame
        phase = 0.0 if step == 0 or frame.face != face else phase + turn_per_step[frame.kind]
        face = frame.face
        pull = amplitudes[frame.kind] @ (1.0, np.cos(phase), np.sin(phase))
        wanted = nominal_m - _groups(episode) @ pull
        return wanted[CABLES_FROM[frame.element]]

    return control


def by_hand() -> Array:
    """Parameters [32] of `pattern` that come nearest to `gaits.flop`: the mean and first sine of its square wave."""
    amplitudes = np.zeros((KINDS_N, GROUPS_N, HARMONICS_N))
    amplitudes[:, 0], amplitudes[:, 1] = np.outer((LEAN, LEAN_WITH_HEIGHT), (0.5, 0.0, 2 / np.pi))
    return np.append(amplitudes, np.zeros(KINDS_N))


def _groups(episode: RunningEpisode) -> Array:
    """m [24, 5] of the cables in world labels."""
    x, y, z = ((episode.state.nodes() - episode.state.com)[CABLES].mean(axis=1)).T
    to_x, to_y = episode.target
    ahead, aside = x * to_x + y * to_y, y * to_x - x * to_y
    return np.stack([ahead, ahead * z, z, ahead**2, aside**2], axis=1)


def reflex(nominal_m: float, parameters: Array) -> Controller:
    """A linear policy for each kind of support triangle: u = nominal + 0.3 m tanh(M[kind] (1, target, track)).

    Target and track are the directions of the waypoint and of travel in the canonical observation, two entries each.

    parameters [240]: M [2, 24, 5].
    """
    matrices = parameters.reshape(KINDS_N, CABLES_N, REFLEX_INPUTS_N)

    def control(episode: RunningEpisode, _: int) -> Array:
        seen = episode.observation
        inputs = np.concatenate([[1.0], seen[TARGET], seen[TRACK]])
        wanted: Array = nominal_m + REFLEX_SCALE_M * np.tanh(matrices[episode.frame.kind] @ inputs)
        return wanted

    return control
