"""The studies as declarations: which arms are compared, at which size, and which figures show the answer.

An arm is a preset with overrides; each is trained with the same seeds. `conduct` runs them.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from t6gps.storage.errors import ConfigError


class Scale(StrEnum):
    """Sizes of a study."""

    QUICK = "quick"
    PAPER = "paper"


class Baseline(StrEnum):
    """What may stand in the place of T6-GPS (`baselines`)."""

    FLOP = "flop"
    PERIODIC = "periodic"
    PPO = "ppo"


class Rival(StrEnum):
    """What else may stand there, on rough ground (`rivals`); the name of a learner ends with what it commands."""

    GAIT = "gait"
    CPG = "cpg"
    CMA_ES = "cma-es"
    PPO_ABSOLUTE = "ppo-absolute"
    PPO_RATES = "ppo-rates"
    SAC_ABSOLUTE = "sac-absolute"
    SAC_RATES = "sac-rates"
    TQC_ABSOLUTE = "tqc-absolute"
    TQC_RATES = "tqc-rates"
    CROSSQ_ABSOLUTE = "crossq-absolute"
    CROSSQ_RATES = "crossq-rates"


BY_HAND = (Baseline.FLOP, Rival.GAIT)
"""These learn nothing."""


@dataclass(frozen=True)
class Arm:
    """One of the things compared.

    label, panel   in figures: arms of one panel are drawn together and told apart by their label
    baseline       what stands in the place of T6-GPS, if anything
    sizes          further overrides at one scale, after those of the study
    """

    label: str
    panel: str
    preset: str
    overrides: tuple[str, ...] = ()
    baseline: Baseline | Rival | None = None
    sizes: Mapping[Scale, tuple[str, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Study:
    """Arms and what is asked of them.

    paper_arms   further arms, which learn nothing from fewer steps than the paper's
    quick        overrides that, with `quick_seeds`, end the study within half an hour on two cores
    figures      names of figures in `arm_figures.FIGURES`, beside the evaluation and the learning curves
    conditions   worlds (overrides by name) in which each policy is evaluated beside its own
    policies_of  the study whose runs it evaluates, None if it trains its own
    """

    question: str
    arms: Mapping[str, Arm]
    quick: tuple[str, ...]
    quick_seeds: int
    figures: tuple[str, ...] = ()
    conditions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    policies_of: str | None = None
    paper_arms: Mapping[str, Arm] = field(default_factory=dict)

    def arms_at(self, scale: Scale) -> dict[str, Arm]:
        """All arms of a scale."""
        return {**self.arms, **(self.paper_arms if scale is Scale.PAPER else {})}


PAPER = ("run.episodes=300", "run.steps=250", "run.iterations=5")
"""Sizes of the paper (Sec. IV-A, V-B): N = 300, T = 250, 5 iterations."""
PAPER_SEEDS = 3
PAPER_COST = ("task.target_speed_m_per_s=0.8", "learner.kl_weight=0.02")
PAPER_NETWORK = ("learner.hidden_layers=[256, 256, 256]",)
PAPER_OBSERVATION = ("learner.observation=sensors",)
NO_VALUE = (
    *("learner.value_from=0", "learner.rounds=1", "learner.models_share=0"),
    *("learner.replay_iterations=1", "learner.epochs=8", "run.iterations=5", "exploration.noise_correlation=0.6"),
)
"""The backward pass throughout, replay, epochs and noise as by default, and the paper's number of iterations, where a
preset has an action value."""
AS_IN_THE_PAPER = (*PAPER_COST, *PAPER_NETWORK, *PAPER_OBSERVATION, *NO_VALUE, "exploration.quiet_share=0")
"""Cost, network, observation, exploration and iterations of the paper (Sec. IV-A, IV-C), under which its claims are
checked, and replay.

The KL term weighs as much beside the gradient of the cost as it does by default.
"""
FAST = ("fast", "winch 0.70 m/s", "robot.winch_speed_m_per_s=0.7")
SLOW = ("slow", "winch 0.30 m/s", "robot.winch_speed_m_per_s=0.3")
SHRUNK = ("", "", "learner.prior_samples=500")
PLAIN = ("plain", ", no shrinkage", "learner.prior_samples=0")


def _arms(levels: Mapping[str, tuple[str, ...]], *priors: tuple[str, str, str]) -> dict[str, Arm]:
    """Every level (label -> overrides) at both winch speeds and with each of `priors`, on rough ground."""
    return {
        "-".join(filter(None, (label.replace("+", "-").replace(" ", "-"), winch, prior))): Arm(
            label, panel + title, "rough", (*AS_IN_THE_PAPER, *overrides, speed, shrinkage)
        )
        for prior, title, shrinkage in priors
        for winch, panel, speed in (FAST, SLOW)
        for label, overrides in levels.items()
    }


ROUGH_SIZES = {Scale.QUICK: ("run.iterations=10",), Scale.PAPER: ("run.iterations=15", "run.episodes=100")}
"""At the paper's scale its 375,000 steps, divided as in the preset."""
ROUGH = Arm("T6-GPS", "rough ground", "rough", sizes=ROUGH_SIZES)
"""The headline run."""

RIVALS_EVALUATION = "run.evaluation_episodes=80"
RIVALS_SIZE = ("run.iterations=15", "run.episodes=100", RIVALS_EVALUATION)
STATES = ("com", "lower-nodes", "nodes", "nodes+vels", "nodes+cables")
REDUCED_STATES = {state: (f"learner.reduced_state={state}",) for state in STATES}
HORIZONS = {f"{steps} steps": (f"learner.horizon_steps={steps}",) for steps in (5, 10, 15, 20)}

FROM_REST = ("task.directions=36", "run.steps=16")
STANDARD_GPS = (
    *NO_VALUE,
    *FROM_REST,
    "run.iterations=10",
    "run.evaluation_episodes=36",
    "learner.localization=time",
    "learner.horizon_steps=16",
    "learner.smallest_class_segments=1",
)
"""Algorithm 1 with the paper's J = 36 directions, T = 16 steps and 10 iterations."""
STANDARD_SIZES = {Scale.QUICK: ("run.episodes=360",), Scale.PAPER: ("run.episodes=1800",)}
"""N: 10 samples of each direction, and the paper's 50."""

LOCALIZATIONS = {
    "segments": (),
    "by kind alone": ("learner.localization=kind",),
    "one model": ("learner.localization=none", "learner.modes=1"),
    "k-means": ("learner.localization=clusters",),
    "gaussian mixtures": ("learner.mode_search=gaussian",),
    "no shrinkage": ("learner.prior_samples=0",),
    "fitted deviation": ("learner.deviation_from=fitted",),
    "no replay": ("learner.replay_iterations=0",),
}
"""T6-GPS as it is, the alternatives that the paper names, and the departures of docs/algorithm.md undone one by one."""

BEYOND = {
    "default": ("v* = 2 m/s", ()),
    "v08": ("v* = 0.8 m/s", PAPER_COST),
    "v40": ("v* = 4 m/s", ("task.target_speed_m_per_s=4", "learner.kl_weight=0.1")),
    "256-units": ("256 units", PAPER_NETWORK),
    "sensors": ("sensors alone", PAPER_OBSERVATION),
    "quiet": ("a quarter quiet", ("exploration.quiet_share=0.25",)),
}
"""The default; other target speeds of the cost; the paper's network; its observation; episodes with less noise."""

CHANGED_WORLDS = {
    "flat": ("terrain.difficulty=0",),
    "half-rough": ("terrain.difficulty=0.5",),
    "steeper": ("terrain.difficulty=1.25",),
    "steepest": ("terrain.difficulty=1.5",),
    "incline-10": ("terrain.difficulty=0", "terrain.tilt_deg=10"),
    "incline-18": ("terrain.difficulty=0", "terrain.tilt_deg=18"),
    "incline-26": ("terrain.difficulty=0", "terrain.tilt_deg=26"),
    "rough-incline-10": ("terrain.tilt_deg=10",),
    "friction-0.5": ("robot.friction=0.5",),
    "friction-0.75": ("robot.friction=0.75",),
    "waypoint-0.54": ("task.waypoint_radius_m=0.54",),
    "friction-0.5-waypoint-0.54": ("robot.friction=0.5", "task.waypoint_radius_m=0.54"),
    "mass-4": ("robot.bar_mass_kg=4",),
    "mass-8": ("robot.bar_mass_kg=8",),
    "stiffness-1500": ("robot.cable_stiffness_n_per_m=1500",),
    "stiffness-4000": ("robot.cable_stiffness_n_per_m=4000",),
    "winch-0.35": ("robot.winch_speed_m_per_s=0.35",),
    "winch-1.0": ("robot.winch_speed_m_per_s=1.0",),
    "sensor-noise-0.1": ("randomisation.sensor_noise=0.1",),
    "sensor-noise-0.3": ("randomisation.sensor_noise=0.3",),
    "delay-0-to-2": ("randomisation.largest_delay_steps=2",),
    "all-spread-20": tuple(
        f"randomisation.{key}_spread=0.2" for key in ("mass", "stiffness", "friction", "winch_speed")
    ),
}
"""Grounds and robots of `transfer`; the paper names 26 deg as the steepest incline climbed before it, and 18 deg."""

STUDIES = {
    "surrogate": Study(
        question="Which reduced state lets the surrogate models lower the cost (paper Sec. V-B, left figure)?",
        arms=_arms(REDUCED_STATES, SHRUNK),
        paper_arms=_arms(REDUCED_STATES, PLAIN),
        quick=("run.episodes=30",),
        quick_seeds=2,
    ),
    "modes": Study(
        question="What do several modes per class step change in cost and stuck states (paper Sec. V-B, right figure)?",
        arms=_arms({"4 modes": ("learner.modes=4",), "1 mode": ("learner.modes=1",)}, SHRUNK, PLAIN),
        quick=("run.episodes=40",),
        quick_seeds=2,
        figures=("speed_distribution", "modes_per_class"),
    ),
    "horizon": Study(
        question="How long must sub-trajectories be (paper Sec. V-B: 10 to 20 steps alike, 5 worse)?",
        arms=_arms(HORIZONS, SHRUNK),
        paper_arms=_arms(HORIZONS, PLAIN),
        quick=("run.episodes=40",),
        quick_seeds=2,
    ),
    "rough": Study(
        question="Does the controller cross the paper's rough ground, and how (Sec. V-B, V-C)?",
        arms={"nodes": ROUGH},
        quick=("run.episodes=40",),
        quick_seeds=3,
        figures=("ground_track", "footprints", "climb", "climbs", "any_axis", "grades"),
    ),
    "flat": Study(
        question=(
            "Any-axis motion on flat ground: how much data do T6-GPS and standard GPS need (paper Sec. V-A)? Standard "
            "GPS learns from one rest state, in 36 directions, for 16 steps."
        ),
        arms={
            "t6gps": Arm("T6-GPS", "flat ground", "flat", NO_VALUE, sizes={Scale.PAPER: ("run.episodes=100",)}),
            **{
                name: Arm(label, "flat ground", "flat", (*STANDARD_GPS, *overrides), sizes=STANDARD_SIZES)
                for name, label, overrides in (
                    ("standard", "standard GPS", ()),
                    ("standard-plain", "standard GPS, no shrinkage", ("learner.prior_samples=0",)),
                )
            },
        },
        quick=("run.episodes=60",),
        quick_seeds=3,
        figures=("conditions", "any_axis"),
        conditions={
            "from-rest": (*FROM_REST, "run.evaluation_episodes=36"),
            "any-start": ("task.directions=0", "run.steps=250", "run.evaluation_episodes=40"),
        },
    ),
    "localization": Study(
        question=(
            "What does each way of localising samples give and cost, and each departure from the paper (Sec. III)? "
            "The seconds of learning are in the table."
        ),
        arms={
            label.replace(" ", "-"): Arm(label, "winch 0.70 m/s", "rough", (*AS_IN_THE_PAPER, FAST[2], *overrides))
            for label, overrides in LOCALIZATIONS.items()
        },
        quick=("run.episodes=40",),
        quick_seeds=2,
    ),
    "beyond": Study(
        question=(
            "What do target speeds of the cost, a smaller network than the paper's, an observation of the shape and "
            "quiet episodes change?"
        ),
        arms={
            f"{name}-{ground}": Arm(label, f"{ground} ground", preset, (*NO_VALUE, *overrides))
            for ground, preset in (("flat", "flat"), ("rough", "rough-quick"))
            for name, (label, overrides) in BEYOND.items()
        },
        quick=("run.episodes=40",),
        quick_seeds=2,
    ),
    "value": Study(
        question="What does a learned action value add where the backward pass gains nothing more?",
        arms={
            "value": ROUGH,
            "backward-pass": Arm(
                "backward pass throughout", "rough ground", "rough", ("learner.value_from=0",), sizes=ROUGH_SIZES
            ),
            "flat-value": Arm(
                "T6-GPS",
                "flat ground",
                "flat-fast",
                sizes={Scale.PAPER: ("run.iterations=10", "run.episodes=50")},
            ),
            "flat-backward-pass": Arm(
                "backward pass throughout",
                "flat ground",
                "flat-fast",
                NO_VALUE,
                sizes={Scale.QUICK: ("run.episodes=80",), Scale.PAPER: ("run.episodes=100",)},
            ),
        },
        quick=("run.episodes=40",),
        quick_seeds=3,
    ),
    "baselines": Study(
        question=(
            "What do a gait by hand, an evolved open-loop gait and PPO reach with the same number of steps? An open "
            "loop cannot steer: the condition one-way, from rest along +x, is the one its gait was evolved for."
        ),
        arms={
            label.split()[0].lower(): Arm(label, "flat ground", "flat", NO_VALUE, baseline=baseline)
            for label, baseline in (
                ("T6-GPS", None),
                ("flop gait", Baseline.FLOP),
                ("periodic gait, evolved", Baseline.PERIODIC),
                ("PPO", Baseline.PPO),
            )
        },
        quick=("run.episodes=60",),
        quick_seeds=3,
        figures=("conditions",),
        conditions={"one-way": ("task.directions=1", "run.evaluation_episodes=2")},
    ),
    "rivals": Study(
        question=(
            "What do off-policy learners, PPO, a pattern generator and evolution reach on rough ground with the same "
            "steps, and in what time? Each rival is evaluated several times along one training."
        ),
        arms={
            "t6gps": Arm("T6-GPS", "rough ground", "rough", sizes={Scale.PAPER: RIVALS_SIZE}),
            **{
                rival.value: Arm(rival.value, "rough ground", "rough", baseline=rival, sizes={Scale.PAPER: RIVALS_SIZE})
                for rival in Rival
            },
        },
        paper_arms={
            f"t6gps-{steps}k": Arm(
                f"T6-GPS, {steps},000 steps",
                "rough ground",
                "rough",
                ("run.iterations=10", f"run.episodes={episodes}", RIVALS_EVALUATION),
            )
            for steps, episodes in ((75, 30), (125, 50))
        },
        quick=("run.episodes=4", "run.iterations=10", "run.evaluation_episodes=20"),
        quick_seeds=1,
        figures=("along_training",),
    ),
    "transfer": Study(
        question="What do policies of the rough ground do in worlds that they never saw?",
        arms={"nodes": ROUGH},
        quick=("run.episodes=40",),
        quick_seeds=3,
        figures=("conditions",),
        conditions=CHANGED_WORLDS,
        policies_of="rough",
    ),
}


def find(name: str) -> Study:
    """The study of that name. ConfigError for an unknown one."""
    if name not in STUDIES:
        close = difflib.get_close_matches(name, STUDIES, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise ConfigError(f"unknown study '{name}'{hint}; allowed: {', '.join(STUDIES)}")
    return STUDIES[name]
