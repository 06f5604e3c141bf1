"""From a configuration to jobs that are submitted and recorded, or to one error and nothing."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from t6gps.service import config as configuration
from t6gps.service.config import Config
from t6gps.service.launch import folder as folders
from t6gps.service.launch import job as records
from t6gps.service.launch import launchers
from t6gps.service.launch.folder import Folder, Planned
from t6gps.service.launch.job import ENDED, Job
from t6gps.service.launch.launcher import Launcher
from t6gps.service.launch.target import Kind, Target
from t6gps.service.training import session
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError


def plan(
    source: str,
    overrides: Sequence[str],
    root: Path,
    name: str | None,
    seeds: int | None,
    resume: bool,
    publish: str | None = None,
) -> list[Planned]:
    """The jobs that train a configuration: one, or RUN-seed0, RUN-seed1, ... with these training seeds.

    Without a name a run has the source's, with a number where that is taken. ConfigError and TerrainError for what
    cannot be trained; RunError for a name that is taken, for a job to resume that has not ended, and for one that has
    another configuration.

    publish   root in an object store that gets a copy of each run, s3://BUCKET/PREFIX
    """
    stem = Path(source).stem if name is None else name
    if seeds is None:
        chosen = folders.first_free(root, stem) if name is None and not resume else stem
        each = {chosen: configuration.load(source, overrides)}
    else:
        each = {
            f"{stem}-seed{seed}": configuration.load(source, [*overrides, f"run.seed={seed}"]) for seed in range(seeds)
        }
    planned = [Planned(config, folders.of(root, run), publish) for run, config in each.items()]
    folders.check_ground(planned[0].config)
    for job in planned:
        _check_free(job, resume)
    return planned


def continuing(run: Run, config: Config) -> Planned:
    """The job that trains what is missing of a run, and publishes it where the job before did.

    RunError where somebody trains it already.
    """
    folder = folders.of(run.path.parent, run.name)
    _check_ended(folder)
    return Planned(config, folder, folder.publish)


def submit(launcher: Launcher, kind: Kind, target: Target, source: str, planned: Sequence[Planned]) -> list[Job]:
    """Submit jobs to a target that was checked, and record them. Where that fails, nothing is left of them."""
    records.make_state_folder()
    each = [job.folder for job in planned]
    with ExitStack() as stack:
        for job in planned:
            stack.enter_context(folders.prepared(job))
        numbers = launcher.submit(planned)
        submitted: list[Job] = []
        try:
            for folder, number in zip(each, numbers, strict=True):
                submitted.append(records.new(kind, number, folder, source, target))
        except BaseException:
            for folder, number in zip(each, numbers, strict=True):
                launcher.cancel(records.record(folder.run, kind, number, folder, source, target))
            records.forget(submitted)
            raise
    return submitted


def _check_free(planned: Planned, resume: bool) -> None:
    """RunError where a run or a job is in the way of another, or cannot be resumed."""
    folder = planned.folder
    obstacle = folders.taken(folder)
    if obstacle is None:
        return
    if not resume:
        raise RunError(f"{obstacle} exists already; choose another name with --run, or add --resume")
    _check_ended(folder)
    remedy = "repeat the run's settings, or choose another name with --run"
    if catalog.exists(folder.root, folder.run):
        session.check_unchanged(catalog.open_run(folder.root, folder.run), planned.config, remedy)


def _check_ended(folder: Folder) -> None:
    """RunError where a run is being trained, or waits to be."""
    if catalog.exists(folder.root, folder.run):
        process = catalog.process_of(catalog.open_run(folder.root, folder.run))
        if process is not None:
            raise RunError(f"run {folder.run} is in use by process {process}; wait for it to end, or stop it")
    job = records.find(folder.root, folder.run)
    if job is None:
        return
    state, detail = launchers.serving(job).state(job)
    if state not in ENDED:
        raise RunError(
            f"job {job.name} is {state} ({detail}); wait for it to end, or end it with t6gps stop {job.name}"
        )
