"""Settings of the C-step and the S-step; defaults and their grounds are in docs/algorithm.md."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field, model_validator

from t6gps.storage.settings import Settings


class Localization(StrEnum):
    """How samples are grouped for local models.

    SEGMENTS   by segment class and aligned step (T6-GPS, Sec. III-A and III-B)
    TIME       by start, direction and time step, in world axes (standard GPS, Algorithm 1); needs task.directions
    KIND, NONE, CLUSTERS   without segments: by kind and exit, not at all, by k-means (`localization`)
    """

    SEGMENTS = "segments"
    TIME = "time"
    KIND = "kind"
    NONE = "none"
    CLUSTERS = "clusters"


class ModeSearch(StrEnum):
    """How the modes of a class step are found: RANSAC (Sec. III-E), or a Gaussian mixture of as many components."""

    RANSAC = "ransac"
    GAUSSIAN = "gaussian"


Observation = Literal["sensors", "shape"]
ReducedState = Literal["com", "lower-nodes", "nodes", "nodes+vels", "nodes+cables"]
LayerWidth = Annotated[int, Field(ge=1, le=4096)]
HiddenLayers = Annotated[tuple[LayerWidth, ...], Field(strict=False, min_length=1, max_length=8)]


class ActionValueSettings(Settings):
    """The learned action value Q, and how actions climb it (docs/algorithm.md, "Action value")."""

    remembered_iterations: int = Field(3, ge=1, le=20, description="iterations whose transitions are learned from")
    improved_iterations: int = Field(
        1, ge=1, le=20, description="iterations whose rows its models, improved actions and pairs are of"
    )
    discount: float = Field(0.95, ge=0.0, lt=1.0, description="gamma, per control step of 0.1 s")
    hidden_layers: HiddenLayers = Field((128, 128), description="tanh units per hidden layer of Q")
    critics: int = Field(1, ge=1, le=8, description="networks whose mean is Q")
    batch: int = Field(256, ge=1, le=100_000, description="transitions per gradient step")
    steps: int = Field(600, ge=1, le=1_000_000, description="gradient steps per iteration")
    first_steps: int = Field(1800, ge=1, le=1_000_000, description="gradient steps of the first iteration")
    learning_rate: float = Field(1e-3, gt=0.0, le=1.0, description="step of AdamW")
    weight_decay: float = Field(0.01, ge=0.0, le=1.0, description="share of the weights that AdamW takes off, per rate")
    target_rate: float = Field(0.005, gt=0.0, le=1.0, description="share by which the target follows Q, per step")
    own_heading_share: float = Field(
        0.5, ge=0.0, le=1.0, description="share of transitions learned from with their own waypoint's direction"
    )
    step_weight: float = Field(
        0.3, gt=0.0, le=100.0, description="w: larger ones trust Q farther from the policy (m s)"
    )
    reach_noise: float = Field(
        0.0,
        ge=0.0,
        le=10.0,
        description="exploration while it leads, about what winches reach (reaches of a step); 0: as before",
    )
    ascents: int = Field(4, ge=1, le=1000, description="steps of gradient ascent to u*")
    ascent_rate: float = Field(0.5, gt=0.0, le=1.0, description="share of the way that a step of ascent takes")


class LearnerSettings(Settings):
    """How trajectories become local models (III-A to III-E), improved actions (III-F) and a policy (II-A)."""

    reduced_state: ReducedState = Field("nodes", description="what the surrogate models predict (Sec. IV-C)")
    localization: Localization = Field(Localization.SEGMENTS, description="how samples are grouped for local models")
    longest_segment_steps: int = Field(20, ge=2, le=1000, description="longer stays on a triangle are cut (steps)")
    smallest_class_segments: int = Field(40, ge=1, description="rarer classes share models (segments)")
    modes: int = Field(4, ge=1, le=16, description="most modes per class and time step")
    mode_search: ModeSearch = Field(ModeSearch.RANSAC, description="how modes are found")
    residual_threshold: float = Field(0.35, gt=0.0, le=10.0, description="outliers lie beyond (standard deviations)")
    prior_samples: float = Field(500.0, ge=0.0, le=1e6, description="weight of the pooled model, n0 (samples)")
    ridge: float = Field(1e-3, gt=0.0, le=1.0, description="ridge relative to the variance of a regressor")
    horizon_steps: int = Field(10, ge=1, le=1000, description="length of a sub-trajectory (steps)")
    kl_weight: float = Field(0.05, gt=0.0, le=100.0, description="weight of the KL term, c (m2/s2)")
    deviation_from: Literal["recorded", "fitted"] = Field(
        "recorded", description="the KL term is centred on the recorded policy mean or on the fitted p(x)"
    )
    observation: Observation = Field(
        "shape", description="what the policy sees: the sensors of the paper (Sec. IV-C), or the nodes as well"
    )
    hidden_layers: HiddenLayers = Field((128, 128, 128), description="tanh units per hidden layer")
    epochs: int = Field(8, ge=1, le=1000, description="passes over the pairs per S-step")
    batch: int = Field(512, ge=1, le=100_000, description="pairs per gradient step")
    learning_rate: float = Field(1e-3, gt=0.0, le=1.0, description="initial step of Adam, decays to zero")
    replay_iterations: int = Field(1, ge=0, le=10, description="earlier iterations whose pairs are used again")
    value_from: int = Field(
        0, ge=0, le=10_000, description="iteration from which a learned action value improves the actions; 0: never"
    )
    action_value: ActionValueSettings = ActionValueSettings()
    rounds: int = Field(
        1, ge=1, le=20, description="rounds of the action value, improved actions and S-step in an iteration it leads"
    )
    models_share: float = Field(
        0.0, ge=0.0, le=1.0, description="share of the slope from the backward pass, the action value at its end"
    )
    models_horizon_steps: int = Field(
        3, ge=1, le=100, description="steps of that pass: the mean over all lengths up to it"
    )

    def leads(self, iteration: int) -> bool:
        """True where the action value improves the actions of an iteration."""
        return 0 < self.value_from <= iteration

    def explores_within_reach(self, iteration: int) -> bool:
        """True where noise departs from what the winches reach of a command in the episodes of an iteration."""
        return self.leads(iteration) and self.action_value.reach_noise > 0

    @model_validator(mode="after")
    def _led_by_a_value(self) -> "LearnerSettings":
        if (self.models_share or self.rounds > 1) and not self.value_from:
            raise ValueError(
                "models_share and rounds need an action value; set value_from to 1 or later, or models_share to 0 and "
                "rounds to 1"
            )
        if self.models_share and self.reduced_state != "nodes":
            raise ValueError(
                "models_share needs reduced_state = nodes, to which it adds the rest lengths, found "
                f"{self.reduced_state}; set models_share to 0 for another"
            )
        return self

    @model_validator(mode="after")
    def _improves_what_it_remembers(self) -> "LearnerSettings":
        of_value = self.action_value
        if of_value.improved_iterations > of_value.remembered_iterations:
            raise ValueError(
                f"action_value.improved_iterations = {of_value.improved_iterations} is more than "
                f"remembered_iterations = {of_value.remembered_iterations}; remember as many"
            )
        if self.value_from and of_value.improved_iterations > 1 and self.replay_iterations:
            raise ValueError(
                f"action_value.improved_iterations = {of_value.improved_iterations} makes new pairs of earlier rows, "
                f"and replay_iterations = {self.replay_iterations} would add their old ones; set it to 0"
            )
        return self

    @model_validator(mode="after")
    def _value_in_canonical_frames(self) -> "LearnerSettings":
        if self.value_from and self.localization is Localization.TIME:
            raise ValueError("value_from must be 0 with localization = time, whose actions are in world axes")
        return self
