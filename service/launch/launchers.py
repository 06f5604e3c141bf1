"""Which launcher serves which kind of target."""

from __future__ import annotations

from t6gps.service.launch import target as targets
from t6gps.service.launch.job import Job
from t6gps.service.launch.launcher import Launcher
from t6gps.service.launch.target import K8s, Ray, Slurm, Target
from t6gps.service.launch.targets.kubernetes.launcher import KubernetesLauncher
from t6gps.service.launch.targets.local import LocalLauncher
from t6gps.service.launch.targets.slurm import SlurmLauncher


def of(target: Target) -> Launcher:
    """The launcher of a target."""
    if isinstance(target, Slurm):
        return SlurmLauncher(target)
    if isinstance(target, Ray):
        from t6gps.service.launch.targets.ray_jobs import RayLauncher  # it loads Ray

        return RayLauncher(target)
    return KubernetesLauncher(target) if isinstance(target, K8s) else LocalLauncher()


def serving(job: Job) -> Launcher:
    """The launcher that serves a job. ConfigError for a kind that this version does not know."""
    return of(targets.parse(job.kind, job.target, f"the record of job {job.name}"))
