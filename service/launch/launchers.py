"""Which launcher serves which kind of target."""

from __future__ import annotations

from t6gps.service.launch import target as targets
from t6gps.service.launch.job import Job
from t6gps.service.launch.launcher import Launcher
from t6gps.service.launch.local import LocalLauncher
from t6gps.service.launch.slurm import SlurmLauncher
from t6gps.service.launch.target import Ray, Slurm, Target


def of(target: Target) -> Launcher:
    """The launcher of a target."""
    if isinstance(target, Slurm):
        return SlurmLauncher(target)
    if isinstance(target, Ray):
        from t6gps.service.launch.ray_jobs import RayLauncher  # it loads Ray

        return RayLauncher(target)
    return LocalLauncher()


def serving(job: Job) -> Launcher:
    """The launcher that serves a job. ConfigError for a kind that this version does not know."""
    return of(targets.parse(job.kind, job.target, f"the record of job {job.name}"))
