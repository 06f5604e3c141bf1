"""The manifests in deploy/k8s, made anew by `python tests/clusters/k8s_samples.py`; a test says that they are these."""

from __future__ import annotations

from pathlib import Path

from t6gps.service import config as configuration
from t6gps.service.launch import target as targets
from t6gps.service.launch.target import K8s, Kind
from t6gps.service.launch.targets.kubernetes import manifests

FOLDER = Path(__file__).parents[2] / "deploy" / "k8s"


def samples() -> dict[str, str]:
    """The text of each sample by its file's name."""
    target = targets.read(Kind.K8S, FOLDER / "targets.toml")
    assert isinstance(target, K8s)
    config = configuration.load("rough", ["run.workers=32"])
    return {
        "rayjob.yaml": "# t6gps submit rough --to k8s --target targets.toml --workers 32 --dry-run\n"
        + manifests.to_yaml(manifests.job(config, "rough", target)),
        "raycluster.yaml": "# A Ray cluster that several runs share; docs/launch.md says how they come to it.\n"
        + manifests.to_yaml(manifests.cluster("t6gps-shared", 8, target)),
    }


if __name__ == "__main__":
    for name, text in samples().items():
        (FOLDER / name).write_text(text)
