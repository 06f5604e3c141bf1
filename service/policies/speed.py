"""How long a decision takes: in each format, beside what the run's own workers do between two control steps."""

from __future__ import annotations

import ctypes
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.execution.wiring import new_learner
from t6gps.service.policies import c_header, files
from t6gps.service.policies.driver import START, Driver, Measurement, measured
from t6gps.service.policies.files import Format
from t6gps.storage.records import PolicySnapshot
from t6gps.workers.episode import policy as acting
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.physics.observer import observe, steer, survey
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame, enter
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.worker import RolloutWorker

PRESET = "flat"
ROUNDS = 9
SOURCE = """#include "{}"
void decide_all(const t6gps_measurement *m, int n, double *c) {{
    t6gps_state state = T6GPS_START;
    for (int i = 0; i < n; i++) t6gps_decide(m + i, &state, c + 24 * i);
}}
"""
"""A loop in C, as a robot has it."""
NOTES = ("microseconds a decision, median of rounds over an episode; the network of the preset flat",)

Seen = list[tuple[RobotState, tuple[float, float]]]


def policy() -> dict[str, float]:
    """Microseconds of a decision: of a run's workers, and of each format."""
    config = configuration.load(PRESET)
    snapshot = new_learner(config).policy()
    seen = _episode(config, snapshot)
    given = [measured(*each) for each in seen]
    with tempfile.TemporaryDirectory(prefix="t6gps-") as folder:
        written = {
            form: files.write(form, Path(folder, f"policy{kind.suffix}"), PRESET, config, None, snapshot)
            for form, kind in files.FORMS.items()
        }
        contenders = {
            "run": lambda: _of_run(config, snapshot, seen),
            "c": _in_c(written[Format.C], given),
            **{form.value: _by(files.opened(written[form]), given) for form in (Format.ONNX, Format.TORCHSCRIPT)},
        }
        rounds = [{name: _took_s(work) for name, work in contenders.items()} for _ in range(ROUNDS)]
    us = {name: 1e6 * median(each[name] for each in rounds) / len(seen) for name in contenders}
    return {f"{name}_us": value for name, value in us.items()} | {"c_over_run": us["c"] / us["run"]}


def _took_s(work: Callable[[], object]) -> float:
    begin_s = time.process_time()  # other work on the machine does not count
    work()
    return time.process_time() - begin_s


def _episode(config: Config, snapshot: PolicySnapshot) -> Seen:
    """States and waypoints of an episode of training, so that the robot moves."""
    seen: Seen = []
    act = acting.ready(snapshot)

    def control(episode: RunningEpisode, _: int) -> NDArray[np.float64]:
        seen.append((episode.state, episode.waypoint))
        return act(episode.observation)

    worker = RolloutWorker(config.rollout)
    worker.drive(seeding.training_plans(config, 0)[0], control, snapshot.version, snapshot.offset_m)
    worker.close()
    return seen


def _of_run(config: Config, snapshot: PolicySnapshot, seen: Seen) -> None:
    """What a worker computes between two control steps."""
    act, still, robot = acting.ready(snapshot), np.zeros(CABLES_N), config.robot
    frame: SupportFrame | None = None
    for state, waypoint in seen:
        face, x, y, _ = survey(state)
        if frame is None or face != frame.face:
            frame = enter(face, frame, state)
        way = np.array([waypoint[0] - x, waypoint[1] - y])
        target = way / np.hypot(*way)
        _, observation = observe(state, frame, (target[0], target[1]), snapshot.offset_m)
        steer(act(observation), still, frame.element, robot.shortest_command_m, robot.longest_command_m)


def _in_c(file: Path, given: list[Measurement]) -> Callable[[], object]:
    decide_all = c_header.compiled(file, SOURCE, "decide_all")
    values = np.concatenate([part.ravel() for each in given for part in vars(each).values()])
    commands = np.empty((len(given), CABLES_N))
    pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (values, commands)]
    return lambda: decide_all(pointers[0], len(given), pointers[1])


def _by(driver: Driver, given: list[Measurement]) -> Callable[[], object]:
    def decide_all() -> None:
        state = START
        for each in given:
            _, state = driver.decide(each, state)

    return decide_all
