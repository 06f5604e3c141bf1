"""The figures of the paper for a run: one file or two for each, PNG and, where it is lines, SVG."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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
from t6gps.service.views.paper.stretch import Stretch, stretch
from t6gps.service.views.paper.topology import topology
from t6gps.storage.errors import ConfigError
from t6gps.workers.pictures.scene import Sizes

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Drawn:
    """Files that were written, and why a figure was left out."""

    files: list[Path]
    left_out: list[str]


def draw(material: Material, folder: Path, progress: Progress) -> Drawn:
    """Write all figures into `folder`, which is made when missing; each file appears whole or not at all.

    ConfigError where the folder cannot be written.
    """
    files, left_out = list[Path](), list[str]()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for done, (name, figure) in enumerate(FIGURES.items()):
            if name == "models" and not material.models.num_rows:
                left_out.append(
                    f"left out: {name}, since run {material.run} keeps no local models; those that the backward pass "
                    "leads keep them, from version 6 of the tables on"
                )
                continue
            drawn = figure(material)
            suffixes = (".png",) if name == "snapshots" else (".png", ".svg")
            files += [run_figures.save(drawn, folder / f"{name}{suffix}") for suffix in suffixes]
            progress(done + 1, len(FIGURES))
    except OSError as error:
        raise ConfigError(
            f"cannot write {folder}: {error.strerror}; choose a folder that you may write with --out"
        ) from error
    return Drawn(files, left_out)


def _stretch(material: Material) -> Stretch:
    return stretch(material.shown.frames, level=material.terrain is None)


def _stretch_title(material: Material, shown: Stretch) -> str:
    return f"{material.title}: {shown.gain_m:+.2f} m in {(shown.last - shown.first) / 10:.0f} s"


def _ground_track(material: Material) -> Figure:
    shown = material.episodes.filter(pc.field("episode_id") == material.shown.episode_id)
    return run_figures.ground_track(material.shown.frames, shown, material.config)


def _snapshots(material: Material) -> Figure:
    shown, config = _stretch(material), material.config
    sizes = Sizes(config.robot.bar_radius_m, config.task.waypoint_radius_m)
    title = _stretch_title(material, shown)
    return snapshots(material.shown.frames, material.terrain, shown, sizes, title)


def _footprints(material: Material) -> Figure:
    shown, title = _stretch(material), _stretch_title(material, _stretch(material))
    return footprints(material.shown.frames, material.terrain, shown, material.config.robot.bar_radius_m, title)


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
