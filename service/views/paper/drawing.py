"""The figures of the paper for a run: one file or two for each, PNG and, where it is lines, SVG."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
from matplotlib.figure import Figure

from t6gps.service.views import run_figures
from t6gps.service.views.paper.costs import costs
from t6gps.service.views.paper.footprints import footprints
from t6gps.service.views.paper.material import Material
from t6gps.service.views.paper.models import models
from t6gps.service.views.paper.segments import trajectory
from t6gps.service.views.paper.snapshots import snapshots
from t6gps.service.views.paper.speeds import speeds
from t6gps.service.views.paper.stretch import Stretch, stretch, track
from t6gps.service.views.paper.topology import topology
from t6gps.storage.errors import ConfigError
from t6gps.workers.pictures.scene import Sizes

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Drawn:
    """Files that were written, and figures that were left out, with the reason."""

    files: list[Path]
    left_out: dict[str, str]


def draw(material: Material, folder: Path, progress: Progress) -> Drawn:
    """Write all figures into `folder`, which is made when missing; each file appears whole or not at all.

    ConfigError where the folder cannot be written.
    """
    files = list[Path]()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for done, (name, figure) in enumerate(FIGURES.items()):
            if name in lacking(material):
                continue
            drawn = figure(material)
            suffixes = (".png",) if name == "snapshots" else (".png", ".svg")
            files += [run_figures.save(drawn, folder / f"{name}{suffix}") for suffix in suffixes]
            progress(done + 1, len(FIGURES))
    except OSError as error:
        raise ConfigError(
            f"cannot write {folder}: {error.strerror}; choose a folder that you may write with --out"
        ) from error
    return Drawn(files, lacking(material))


def lacking(material: Material) -> dict[str, str]:
    """Figures that have nothing to show, by their names, and why."""
    if material.models.num_rows:
        return {}
    return {"models": f"run {material.run} keeps no local models, which runs before version 6 of the tables do not"}


def _stretch(material: Material) -> Stretch:
    return stretch(material.shown.frames, level=material.terrain is None)


def _title(material: Material, shown: Stretch) -> str:
    """Names the episode, and says what the robot does in the stretch that is shown."""
    path = track(material.shown.frames)
    way_m = np.hypot(*(path[shown.last] - path[shown.first]))
    way = f"{way_m:.2f} m far" if material.terrain is None else f"{shown.gain_m:.2f} m up"
    return f"{material.title}: {way} in {(shown.last - shown.first) / 10:.0f} s"


def _ground_track(material: Material) -> Figure:
    shown = material.episodes.filter(pc.field("episode_id") == material.shown.episode_id)
    return run_figures.ground_track(material.shown.frames, shown, material.config)


def _snapshots(material: Material) -> Figure:
    shown, config = _stretch(material), material.config
    sizes = Sizes(config.robot.bar_radius_m, config.task.waypoint_radius_m, config.robot.attachment_span_m)
    return snapshots(material.shown.frames, material.terrain, shown, sizes, _title(material, shown))


def _footprints(material: Material) -> Figure:
    shown, radius_m = _stretch(material), material.config.robot.bar_radius_m
    return footprints(material.shown.frames, material.terrain, shown, radius_m, _title(material, shown))


def _trajectory(material: Material) -> Figure:
    return trajectory(material, _stretch(material))


FIGURES: dict[str, Callable[[Material], Figure]] = {
    "costs": costs,
    "speeds": speeds,
    "ground_track": _ground_track,
    "snapshots": _snapshots,
    "footprints": _footprints,
    "segments": _trajectory,
    "models": models,
    "topology": topology,
}
"""Files of each name."""
