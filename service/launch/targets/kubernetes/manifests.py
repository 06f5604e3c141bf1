"""From a job and a target to objects of Kubernetes; pure functions.

A job is a RayJob of KubeRay with a Ray cluster of its own, whose head runs no workers; a ConfigMap holds what it needs,
and a NetworkPolicy lets only its own pods reach each other. All have the job's name.
"""

from __future__ import annotations

import base64
import hashlib
import math
import re
from importlib import metadata, resources
from pathlib import Path

import yaml

from t6gps.service import config as configuration
from t6gps.service.config import Config
from t6gps.service.launch.folder import PUBLISH
from t6gps.service.launch.target import K8s
from t6gps.service.launch.targets.kubernetes import pods
from t6gps.service.launch.targets.kubernetes.pods import JOB, ROOT, Manifest, Size
from t6gps.storage.errors import ConfigError, TerrainError

NAME_LENGTH_N = 41
"""KubeRay allows 47 characters for a RayJob; names of its pods and services are longer."""
CONFIGMAP_MOST_BYTES = 900_000
"""Kubernetes allows one MiB for all of it, ground in base64 included."""
LABEL = "t6gps/job"
GROUP = "workers"
RAY_JOB = "t6gps"
"""The job's number in its Ray cluster, where it is the only one."""
OPERATOR = {"app.kubernetes.io/name": "kuberay-operator"}
DNS_PORT, DASHBOARD_PORT = 53, 8265


def name(run: str, target: K8s) -> str:
    """The name of all objects of a run's job on a claim: the same each time, short, small letters, digits and '-'."""
    digest = hashlib.sha256(f"{target.claim}/{run}".encode()).hexdigest()[:8]
    readable = re.sub(r"[^a-z0-9]+", "-", run.lower()).strip("-")
    return f"{f't6gps-{readable}'[: NAME_LENGTH_N - 9].rstrip('-')}-{digest}"


def labels(instance: str) -> dict[str, str]:
    """What all objects of a job have in common, its pods included."""
    return {LABEL: instance}


def job(config: Config, run: str, target: K8s, publish: str | None = None) -> list[Manifest]:
    """The objects of a job, the RayJob last. ConfigError for a run that does not fit, TerrainError for its ground.

    publish   root in an object store that gets a copy of the run; ConfigError where the target has no keys for it
    """
    instance = name(run, target)
    if publish is not None and target.store_secret is None:
        raise ConfigError(
            "--publish needs the keys of the object store in the cluster, and k8s.store_secret names none; make a "
            "Secret with AWS_ACCESS_KEY_ID and so on, and name it in the file of targets"
        )
    port = None if publish is None else target.store_port
    return [
        _config_map(config, run, instance, publish),
        _network_policy(instance, port),
        _ray_job(config, run, instance, target, publish is not None),
    ]


def cluster(instance: str, pods_n: int, target: K8s) -> list[Manifest]:
    """A Ray cluster that several runs share, until somebody deletes it; they come to it as Ray jobs."""
    spec = _cluster_spec(instance, pods_n, target, [], [])
    ray_cluster: Manifest = {
        "apiVersion": "ray.io/v1", "kind": "RayCluster", "metadata": _metadata(instance), "spec": spec,
    }  # fmt: skip
    return [_network_policy(instance), ray_cluster]


def reader(instance: str, target: K8s) -> Manifest:
    """A pod that sees the claim, for a while: it serves those who read what a job has left there."""
    container: Manifest = {"name": "reader", "command": ["sleep", "3600"], "resources": Size(1, 1).resources()}
    spec = pods.spec(target, container, [], claim_read_only=True)
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": _metadata(instance),
        "spec": {**spec, "restartPolicy": "Never", "activeDeadlineSeconds": 3600},
    }


def to_yaml(manifests: list[Manifest]) -> str:
    """Objects as a file that kubectl takes."""
    return yaml.dump_all(manifests, Dumper=_Written, sort_keys=False, width=120)


def pods_for(workers: int, cpus_per_worker: float, target: K8s) -> int:
    """Pods that hold so many workers. ConfigError where they are more than the target allows."""
    each_n = int(target.cpus_per_pod / cpus_per_worker + 1e-6)
    if workers > target.pods * each_n:
        raise ConfigError(
            f"{workers} workers of run.cpus_per_worker = {cpus_per_worker:g} do not fit on k8s.pods = {target.pods} "
            f"with k8s.cpus_per_pod = {target.cpus_per_pod}; allowed: {target.pods * each_n}; lower the number of "
            "workers, or allow more in the file of targets and submit again"
        )
    return math.ceil(workers / each_n) if each_n else 0


class _Written(yaml.SafeDumper):
    """Writes texts of several lines as such, and nothing as a reference to something above."""

    def ignore_aliases(self, data: object) -> bool:
        return True


_Written.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None),
)


def _metadata(instance: str) -> Manifest:
    return {"name": instance, "labels": labels(instance)}


def _config_map(config: Config, run: str, instance: str, publish: str | None) -> Manifest:
    """What the head needs: configuration, ground, scripts, where to publish."""
    ground = config.terrain.file
    binary: dict[str, str] = {}
    if ground is not None:
        source = Path(ground)
        try:
            content = source.read_bytes()
        except OSError as error:
            raise TerrainError(f"cannot read ground from {source}: {error.strerror}; correct terrain.file") from None
        key = f"ground{source.suffix.lower()}"
        binary[key] = base64.b64encode(content).decode()
        if len(binary[key]) > CONFIGMAP_MOST_BYTES:
            raise TerrainError(
                f"{source} has {len(content)} bytes; Kubernetes takes a ground of at most "
                f"{CONFIGMAP_MOST_BYTES * 3 // 4} with a job; make it coarser or smaller"
            )
        config = configuration.with_ground(config, Path(ROOT) / ".jobs" / run / "ground" / key)
    scripts = {
        path.name: path.read_text(encoding="utf-8") for path in (_shipped("launch/train.sh"), _shipped("k8s/start.sh"))
    }
    return {
        "apiVersion": "v1",
        "kind": "ConfigMap",
        "metadata": _metadata(instance),
        "data": {
            "config.toml": config.to_toml(),
            **scripts,
            **({} if publish is None else {PUBLISH: f"{publish}\n"}),
        },
        **({"binaryData": binary} if binary else {}),
    }


def _shipped(path: str) -> Path:
    return Path(str(resources.files("t6gps.deploy") / path))


def _network_policy(instance: str, store_port: int | None = None) -> Manifest:
    """The job's pods reach each other and ask for names; KubeRay reaches their dashboard; nobody else does either.

    store_port   of an object store, anywhere, that they reach, too
    """
    own = {"podSelector": {"matchLabels": labels(instance)}}
    names = [{"protocol": protocol, "port": DNS_PORT} for protocol in ("UDP", "TCP")]
    operator = {"namespaceSelector": {}, "podSelector": {"matchLabels": OPERATOR}}
    return {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": _metadata(instance),
        "spec": {
            **own,
            "policyTypes": ["Ingress", "Egress"],
            "ingress": [
                {"from": [own]},
                {"from": [operator], "ports": [{"protocol": "TCP", "port": DASHBOARD_PORT}]},
            ],
            "egress": [
                {"to": [own]},
                {"to": [{"namespaceSelector": {}}], "ports": names},
                *([] if store_port is None else [{"ports": [{"protocol": "TCP", "port": store_port}]}]),
            ],
        },
    }


def _ray_job(config: Config, run: str, instance: str, target: K8s, published: bool) -> Manifest:
    workers_n = max(config.run.workers, *(config.run.autoscale or (0,)))
    pods_n = pods_for(workers_n, config.run.cpus_per_worker, target)
    mounts: list[Manifest] = [{"name": "job", "mountPath": JOB, "readOnly": True}]
    volumes: list[Manifest] = [{"name": "job", "configMap": {"name": instance}}]
    return {
        "apiVersion": "ray.io/v1",
        "kind": "RayJob",
        "metadata": _metadata(instance),
        "spec": {
            "submissionMode": "SidecarMode",
            "jobId": RAY_JOB,
            "entrypoint": f"bash {JOB}/start.sh {run}",
            "backoffLimit": target.retries,
            "shutdownAfterJobFinishes": True,
            "rayClusterSpec": _cluster_spec(instance, pods_n, target, mounts, volumes, published),
        },
    }


def _cluster_spec(
    instance: str,
    pods_n: int,
    target: K8s,
    mounts: list[Manifest],
    volumes: list[Manifest],
    published: bool = False,
) -> Manifest:
    """A Ray cluster whose processes know its token, with `mounts` of `volumes` on its head.

    published   the head has the keys of the object store
    """
    head, worker = Size(target.head_cpus, target.head_memory_gb), Size(target.cpus_per_pod, target.memory_gb_per_pod)
    keys = {"envFrom": [{"secretRef": {"name": target.store_secret}}]} if published else {}
    head_spec = pods.spec(target, {**pods.ray_container(head, mounts), **keys}, volumes, claim_read_only=False)
    return {
        "rayVersion": metadata.version("ray"),
        "authOptions": {"mode": "token"},
        "enableInTreeAutoscaling": False,
        "headGroupSpec": {
            "rayStartParams": {"num-cpus": "0", **_object_store(head)},
            "template": {
                "metadata": {"labels": labels(instance)}, "spec": {**head_spec, "restartPolicy": "Never"},
            },
        },
        "workerGroupSpecs": [
            {
                "groupName": GROUP,
                "replicas": pods_n,
                "minReplicas": 0,
                "maxReplicas": target.pods,
                "rayStartParams": {"num-cpus": str(worker.cpus), **_object_store(worker)},
                "template": {
                    "metadata": {"labels": labels(instance)},
                    "spec": pods.spec(target, pods.ray_container(worker, []), [], claim_read_only=True),
                },
            }
        ],
    }  # fmt: skip


def _object_store(size: Size) -> dict[str, str]:
    """A quarter of the container's memory for Ray's objects, which count as its memory."""
    return {"object-store-memory": str(size.memory_gb * (1 << 30) // 4)}
