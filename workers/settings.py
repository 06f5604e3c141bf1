"""Settings of the robot, its ground and its task. Defaults are SUPERball v2 with the paper's scenario."""

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from t6gps.storage.settings import Settings

STEEPEST_DIFFICULTY = 1.5
"""Slopes of 48 deg on average, heights over a range of 2.3 m."""

LEAST_FRICTION, LARGEST_FRICTION = 0.05, 1.5
"""Wet ice, and rubber on a dry road."""

HALF_DIAMETER_M = 1.084492969087398
"""Distance of a node from the centre in the neutral shape. The paper's waypoints "are half the diameter of the vehicle"
(Sec. IV-A), which may also mean their diameter: the radius would then be half of this."""


def _none_for(old: float | str) -> BeforeValidator:
    """Reads `old` as None: it says so where TOML has no null, and in configurations of older runs."""
    return BeforeValidator(lambda value: None if type(value) is type(old) and value == old else value)


FilePath = Annotated[str | None, _none_for("")]
Doubt = Literal["extent", "range", "step", "flat"]
"""What is doubtful about a ground's file (`workers.ground.sense`, docs/physics.md)."""

Directions = Annotated[Annotated[int, Field(ge=1, le=360)] | None, _none_for(0)]
StallTension = Annotated[Annotated[float, Field(ge=100.0, le=20000.0)] | None, _none_for(0), _none_for(0.0)]
Cable = Annotated[int, Field(ge=0, le=23)]


class RobotSettings(Settings):
    """Physical parameters of the robot and of its simulation (SI units; sources in docs/physics.md)."""

    bar_mass_kg: float = Field(6.0, ge=1.0, le=20.0, description="mass of one bar (kg)")
    bar_radius_m: float = Field(0.05, ge=0.01, le=0.1, description="collision radius of a bar (m)")
    axial_inertia_kg_m2: float = Field(0.06, ge=0.01, le=1.0, description="inertia of a bar about its axis")
    axial_damping_n_m_s: float = Field(0.3, ge=0.0, le=5.0, description="torque against spin about the axis per rad/s")
    attachment_span_m: float = Field(
        1.94, ge=1.2, le=1.94, description="from where cables attach at one end of a bar to where at the other (m)"
    )
    cable_stiffness_n_per_m: float = Field(2000.0, ge=500.0, le=5000.0, description="cable stiffness (N/m)")
    cable_damping_n_s_per_m: float = Field(50.0, ge=0.0, le=500.0, description="damping, clipped at the elastic force")
    cable_max_tension_n: float = Field(1500.0, ge=200.0, le=10000.0, description="largest tension (N)")
    pretension_n: float = Field(200.0, ge=50.0, le=1000.0, description="tension at the neutral shape (N)")
    winch_speed_m_per_s: float = Field(0.35, ge=0.01, le=2.0, description="largest rate of change of a rest length")
    winch_stall_n: StallTension = Field(
        None, description="tension that stops a winch, which hauls the slower the nearer it is (N); none: same speed"
    )
    dead_winch: Cable | None = Field(None, description="cable whose winch never moves, 0 .. 23")
    shortest_command_m: float = Field(0.5, ge=0.4, le=1.2, description="lower end of commanded rest lengths (m)")
    longest_command_m: float = Field(1.5, ge=0.8, le=1.6, description="upper end of commanded rest lengths (m)")
    friction: float = Field(
        1.0, ge=LEAST_FRICTION, le=LARGEST_FRICTION, description="effective coefficient between bars and ground"
    )
    physics_step_s: float = Field(0.004, ge=0.0005, le=0.01, description="physics step; divides the control step (s)")

    @model_validator(mode="after")
    def _ordered_commands(self) -> "RobotSettings":
        if self.shortest_command_m >= self.longest_command_m:
            raise ValueError("shortest_command_m must be below longest_command_m")
        return self


class TerrainSettings(Settings):
    """Ground of an episode."""

    difficulty: float = Field(
        0.0, ge=0.0, le=STEEPEST_DIFFICULTY, description="0 flat, 1 the paper's 38 deg / 16 deg / 1.55 m"
    )
    tilt_deg: float = Field(0.0, ge=0.0, le=35.0, description="slope of the whole ground, rising towards +x (deg)")
    size_m: float = Field(40.0, ge=34.0, le=100.0, description="width of the ground; the plane has no end (m)")
    file: FilePath = Field(None, description="height map (.npy, .png) or surface (.stl, .obj) in place of random hills")
    png_range_m: float = Field(1.55, gt=0.0, le=20.0, description="height between black and white of a .png (m)")
    accept: tuple[Doubt, ...] = Field(
        (), strict=False, description="doubts about the file that are accepted: it is meant so"
    )


class TaskSettings(Settings):
    """Waypoints and cost (paper Sec. IV-A)."""

    waypoints: int = Field(5, ge=1, le=100, description="random waypoints of an episode, visited in a circle")
    nearest_waypoint_m: float = Field(2.0, gt=0.0, le=20.0, description="least distance between waypoints (m)")
    farthest_waypoint_m: float = Field(4.0, gt=0.0, le=20.0, description="largest distance between waypoints (m)")
    waypoint_radius_m: float = Field(
        HALF_DIAMETER_M, gt=0.0, le=10.0, description="a waypoint is reached within it; half the robot's diameter (m)"
    )
    waypoint_timeout_s: float = Field(5.0, gt=0.0, le=1000.0, description="the next waypoint comes after this time (s)")
    directions: Directions = Field(
        None, description="J: one rest state, episode i heads for direction i modulo J; none: random starts, waypoints"
    )
    target_speed_m_per_s: float = Field(2.0, gt=0.0, le=5.0, description="v* of the cost (m/s)")
    vertical_weight: float = Field(0.1, gt=0.0, le=1.0, description="weight of the vertical velocity in the cost")

    @model_validator(mode="after")
    def _ordered_distances(self) -> "TaskSettings":
        if self.nearest_waypoint_m > self.farthest_waypoint_m:
            raise ValueError("nearest_waypoint_m must not exceed farthest_waypoint_m")
        return self


class ExplorationSettings(Settings):
    """Exploration noise added to the policy's commands."""

    noise_std_m: float = Field(0.15, ge=0.0, le=1.0, description="standard deviation per cable (m)")
    noise_correlation: float = Field(0.6, ge=0.0, lt=1.0, description="first-order correlation from step to step")
    quiet_share: float = Field(0.0, ge=0.0, le=1.0, description="share of episodes with a fifth of the noise")


class RandomisationSettings(Settings):
    """Domain randomisation: how far robots of single episodes spread around the configured one, and how they sense."""

    mass_spread: float = Field(0.0, ge=0.0, le=0.5, description="relative spread of the bars' mass")
    stiffness_spread: float = Field(0.0, ge=0.0, le=0.5, description="relative spread of the cables' stiffness")
    friction_spread: float = Field(0.0, ge=0.0, le=0.5, description="relative spread of the friction")
    winch_speed_spread: float = Field(0.0, ge=0.0, le=0.5, description="relative spread of the winch speed")
    sensor_noise: float = Field(0.0, ge=0.0, le=1.0, description="noise on every reading (units of the observation)")
    sensor_bias: float = Field(
        0.0, ge=0.0, le=1.0, description="standard deviation of an error of each canonical reading in an episode (same)"
    )
    largest_delay_steps: int = Field(0, ge=0, le=10, description="largest delay of commands (control steps)")


class RolloutSettings(Settings):
    """Everything a worker needs to know before its first plan."""

    robot: RobotSettings = RobotSettings()
    terrain: TerrainSettings = TerrainSettings()
    task: TaskSettings = TaskSettings()
    exploration: ExplorationSettings = ExplorationSettings()
    randomisation: RandomisationSettings = RandomisationSettings()

    @model_validator(mode="after")
    def _rest_on_flat_ground(self) -> "RolloutSettings":
        ground = self.terrain
        rough = ground.difficulty > 0 or ground.tilt_deg > 0 or ground.file is not None
        if self.task.directions is not None and rough:
            raise ValueError(
                "task.directions starts from rest on flat ground: terrain.difficulty and tilt_deg must be 0"
            )
        return self
