"""Pods as every job here has them: not root, nothing writable but its volumes, and as much as they ask for.

/runs          the root, on the claim
/job           what was submitted, on the head
/tmp, HOME     a pod's own, gone with it
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from t6gps.service.launch.target import K8s

Manifest: TypeAlias = dict[str, object]
"""An object of Kubernetes, or a part of one, as YAML has it."""

ROOT, JOB, HOME = "/runs", "/job", "/home/t6gps"
USER = 1000
"""The user of the image; files on the claim are this user's and group's."""
RAY_CONTAINER = "ray"
ENVIRONMENT = {
    "HOME": HOME,
    # As for a Ray of one's own: workers of normal priority, processes that fit models wait for the next iteration.
    "RAY_worker_niceness": "0",
    "RAY_idle_worker_killing_time_threshold_ms": "300000",
}


@dataclass(frozen=True)
class Size:
    """What a container asks for, and may use at most: CPUs, and memory in GiB."""

    cpus: int
    memory_gb: int

    def resources(self) -> Manifest:
        amount = {"cpu": str(self.cpus), "memory": f"{self.memory_gb}Gi"}
        return {"requests": amount, "limits": amount}


def spec(target: K8s, container: Manifest, volumes: list[Manifest], claim_read_only: bool) -> Manifest:
    """A pod's specification with one container, which gets the claim, /tmp and a home besides its own mounts."""
    mounts = [
        {"name": "claim", "mountPath": ROOT, "readOnly": claim_read_only},
        {"name": "tmp", "mountPath": "/tmp"},
        {"name": "home", "mountPath": HOME},
    ]
    own = container.get("volumeMounts", [])
    assert isinstance(own, list)
    pull = {} if target.image_pull_policy is None else {"imagePullPolicy": target.image_pull_policy}
    account = {} if target.service_account is None else {"serviceAccountName": target.service_account}
    return {
        **account,
        "automountServiceAccountToken": False,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": USER,
            "runAsGroup": USER,
            "fsGroup": USER,
            "fsGroupChangePolicy": "OnRootMismatch",
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [
            {
                **container,
                "image": target.image,
                **pull,
                "securityContext": {
                    "allowPrivilegeEscalation": False,
                    "readOnlyRootFilesystem": True,
                    "capabilities": {"drop": ["ALL"]},
                },
                "volumeMounts": [*mounts, *own],
            }
        ],
        "volumes": [
            {"name": "claim", "persistentVolumeClaim": {"claimName": target.claim}},
            {"name": "tmp", "emptyDir": {}},
            {"name": "home", "emptyDir": {}},
            *volumes,
        ],
    }


def ray_container(size: Size, mounts: list[Manifest]) -> Manifest:
    """The container that Ray runs in; KubeRay adds the command."""
    return {
        "name": RAY_CONTAINER,
        "env": [{"name": name, "value": value} for name, value in ENVIRONMENT.items()],
        "resources": size.resources(),
        "volumeMounts": mounts,
    }
