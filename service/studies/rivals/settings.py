"""Settings of the rivals, in one place; docs/lab-notes.md lists what was tried for each ("Rivals")."""

from __future__ import annotations

from dataclasses import dataclass

MARKS = (10_000, 25_000, 75_000, 125_000)
"""Control steps of a training after which a rival is evaluated, beside the last; off-policy learners take about as long
for the second as T6-GPS takes for 375,000."""


@dataclass(frozen=True, kw_only=True)
class OffPolicy:
    """Settings of SAC, TQC and CrossQ, which have as many updates and the same memory, that of all steps.

    discount              per control step of 0.1 s
    learning_rate         of actor, critics and entropy weight
    actor, critics        units of the hidden layers
    first_entropy_weight  the library's 1.0 swamps a reward of 0.1 m/s
    first_steps           control steps at random before the first update
    steps_per_update      control steps for each update of a batch
    """

    learning_rate: float
    actor: tuple[int, ...] = (256, 256)
    critics: tuple[int, ...] = (256, 256)
    discount: float = 0.9
    first_entropy_weight: float = 0.005
    first_steps: int = 1000
    steps_per_update: int = 4
    batch: int = 256


SAC = TQC = OffPolicy(learning_rate=1e-3)
CROSSQ = OffPolicy(learning_rate=1e-3)


@dataclass(frozen=True, kw_only=True)
class OnPolicy:
    """Settings of PPO; `rollout` control steps are sampled for each improvement, and divide every mark."""

    discount: float = 0.95
    learning_rate: float = 3e-4
    layers: tuple[int, ...] = (128, 128, 128)
    first_log_deviation: float = -1.0
    rollout: int = 2500
    batch: int = 250


PPO = OnPolicy()

EVOLUTION_STEPS = 100
"""Length of the episodes by which evolution judges: 10 s, two or three waypoints."""
PATTERN_SPREAD = 0.2
REFLEX_SPREAD = 0.3
"""First standard deviation of CMA-ES, in units of the parameters."""
