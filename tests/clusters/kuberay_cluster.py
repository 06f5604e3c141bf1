"""A stand-in for a Kubernetes cluster with KubeRay, on this machine: `with started(folder) as cluster`.

Real kubectl speaks to `kube_api`; pods are processes (`pods_of_processes`). What KubeRay does is done here in the same
steps and with the same commands: a RayCluster's pods, the submitter beside the head, retries, suspension, deletion.
"""

from __future__ import annotations

import itertools
import json
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from kube_api import Store, kubeconfig, serving
from pods_of_processes import Container, Network, Pod, network, volume

TICK_S, ASK_S = 0.1, 1.0
DASHBOARD = "http://127.0.0.1:8265"
HEALTHY = (
    f"""python -c "import urllib.request; r=urllib.request.urlopen('{DASHBOARD}/api/gcs_healthz', timeout=10); """
    """exit(0 if b'success' in r.read() else 1)" """
)
ASKED = """exec 3<> /dev/tcp/127.0.0.1/8265
printf 'GET /api/jobs/t6gps HTTP/1.0\\r\\nAuthorization: Bearer %s\\r\\n\\r\\n' "$RAY_AUTH_TOKEN" >&3
timeout 5 cat <&3"""
"""KubeRay asks without a program of Python, whose start takes as long as ten questions."""
TERMINAL = ("SUCCEEDED", "FAILED", "STOPPED")


@dataclass
class Cluster:
    """A cluster that is up: its objects, its pods, and the folder of its claims."""

    folder: Path
    store: Store
    net: Network
    ending: threading.Event = field(default_factory=threading.Event)
    pods: dict[str, Pod] = field(default_factory=dict)
    tokens: dict[str, str] = field(default_factory=dict)
    names: Iterator[int] = field(default_factory=lambda: itertools.count(1))
    answers: dict[str, dict[str, str]] = field(default_factory=dict)
    asked_s: float = 0.0
    fault: BaseException | None = None

    @property
    def kubeconfig(self) -> Path:
        return self.folder / "kubeconfig"

    @property
    def claims(self) -> Path:
        return self.folder / "claims"

    def claim(self, name: str, mode: str = "ReadWriteMany") -> Path:
        """Make a claim; the folder that it is."""
        path = self.claims / name
        path.mkdir(parents=True)
        spec = {"accessModes": [mode], "resources": {"requests": {"storage": "1Gi"}}}
        self.store.create("persistentvolumeclaims", {
            "apiVersion": "v1", "kind": "PersistentVolumeClaim", "metadata": {"name": name}, "spec": spec,
        })  # fmt: skip
        return path

    def head(self, instance: str) -> Pod | None:
        """The head of a job's Ray cluster."""
        found = (pod for _, pod in self.heads() if _labels(pod).get("t6gps/job") == instance)
        return next(found, None)

    def heads(self) -> list[tuple[str, Pod]]:
        """The heads of Ray clusters, by the names of these."""
        with self.store.lock:
            labels = ((_labels(pod), pod) for pod in self.pods.values())
            return [(known["ray.io/cluster"], pod) for known, pod in labels if known["ray.io/node-type"] == "head"]

    def container(self, pod: str, name: str) -> Container | None:
        found = self.pods.get(pod)
        return None if found is None else found.containers.get(name)

    def work(self) -> None:
        """Do what the objects ask for, until the end."""
        while not self.ending.wait(TICK_S):
            try:
                self.step()
            except BaseException as error:
                self.fault = error
                raise

    def step(self) -> None:
        if time.monotonic() > self.asked_s + ASK_S:  # a call into a pod takes a while, and others want the lock
            self.answers, self.asked_s = {head: ask(pod) for head, pod in self.heads()}, time.monotonic()
        with self.store.lock:
            for manifest in self.store.of("pods"):
                self.tend_pod(manifest)
            for job in self.store.of("rayjobs"):
                self.tend_job(job)
            for ray_cluster in self.store.of("rayclusters"):
                self.tend_ray_cluster(ray_cluster)

    def tend_pod(self, manifest: dict[str, Any]) -> None:
        """Start a pod that was made by a user, and say how each is."""
        name = manifest["metadata"]["name"]
        if name not in self.pods:
            self.pods[name] = pod = self.net.pod(manifest)
            container = manifest["spec"]["containers"][0]
            pod.start(container, container["command"], self.volumes(pod))
        manifest["status"] = {"phase": self.pods[name].phase}

    def volumes(self, pod: Pod) -> dict[str, Path]:
        maps = {entry["metadata"]["name"]: entry for entry in self.store.of("configmaps")}
        return {entry["name"]: volume(entry, pod, self.claims, maps) for entry in pod.manifest["spec"]["volumes"]}

    def removed(self, plural: str, found: dict[str, Any]) -> None:
        """End what belongs to an object that somebody has deleted."""
        name = found["metadata"]["name"]
        if plural == "pods":
            pod = self.pods.pop(name, None)
            if pod is not None:
                self.net.remove(pod)
        elif plural == "rayclusters":
            for pod in self.pods_of(name):
                self.store.delete("pods", pod.manifest["metadata"]["name"])
        elif plural == "rayjobs" and found.get("status", {}).get("rayClusterName"):
            self.end_ray_cluster(found["status"])

    def end_ray_cluster(self, status: dict[str, Any]) -> None:
        if ("rayclusters", status["rayClusterName"]) in self.store.objects:
            self.store.delete("rayclusters", status["rayClusterName"])

    def pods_of(self, ray_cluster: str) -> list[Pod]:
        return [pod for pod in self.pods.values() if _labels(pod).get("ray.io/cluster") == ray_cluster]

    def tend_job(self, job: dict[str, Any]) -> None:
        """One step of KubeRay's state machine of a RayJob, in SidecarMode."""
        spec, status = job["spec"], job.setdefault("status", {"jobDeploymentStatus": "", "failed": 0})
        assert spec["submissionMode"] == "SidecarMode"
        match status["jobDeploymentStatus"]:
            case "":
                name = f"{job['metadata']['name']}-{secrets.token_hex(3)[:5]}"
                status |= {"jobId": spec["jobId"], "rayClusterName": name, "jobDeploymentStatus": "Initializing"}
                status |= {"jobStatus": ""}
                self.store.create("rayclusters", {
                    "apiVersion": "ray.io/v1", "kind": "RayCluster", "spec": spec["rayClusterSpec"],
                    "metadata": {"name": name, "annotations": {"entrypoint": spec["entrypoint"], "id": spec["jobId"]}},
                })  # fmt: skip
            case "Initializing" | "Running" if spec.get("suspend"):
                status["jobDeploymentStatus"] = "Suspending"
            case "Initializing":
                if self.store.get("rayclusters", status["rayClusterName"]).get("status") == {"state": "ready"}:
                    status["jobDeploymentStatus"] = "Running"
            case "Running":
                self.follow(status)
                if status["jobDeploymentStatus"] == "Failed":
                    status["failed"] += 1
                    if status["failed"] <= spec["backoffLimit"]:
                        status["jobDeploymentStatus"] = "Retrying"
            case "Suspending" | "Retrying" as word:
                self.end_ray_cluster(status)
                status["jobDeploymentStatus"] = "Suspended" if word == "Suspending" else ""
            case "Complete" | "Failed":
                assert spec["shutdownAfterJobFinishes"]
                self.end_ray_cluster(status)

    def follow(self, status: dict[str, Any]) -> None:
        """See whether the job of a RayJob that runs has ended."""
        head = dict(self.heads()).get(status["rayClusterName"])
        if head is None or head.phase != "Running":
            status |= {"jobDeploymentStatus": "Failed", "reason": "AppFailed", "message": "Ray head pod not found."}
            return
        submitter = head.containers["ray-job-submitter"].process.poll()
        status |= self.answers.get(status["rayClusterName"], {})
        if submitter:
            status["jobDeploymentStatus"] = "Failed"
            if status["jobStatus"] != "FAILED":
                message = f"Ray head pod container ray-job-submitter terminated with exit code {submitter}"
                status |= {"reason": "SubmissionFailed", "message": message}
        elif submitter == 0 and status["jobStatus"] in TERMINAL:
            status["jobDeploymentStatus"] = "Complete"

    def tend_ray_cluster(self, ray_cluster: dict[str, Any]) -> None:
        """Have the pods that a RayCluster asks for. A head that died does not come back: its job is started anew."""
        name, spec = ray_cluster["metadata"]["name"], ray_cluster["spec"]
        group, there = spec["workerGroupSpecs"][0], self.pods_of(name)
        heads = [pod for pod in there if _labels(pod)["ray.io/node-type"] == "head"]
        if name not in self.tokens:
            self.tokens[name] = secrets.token_hex(32)
            assert spec["authOptions"] == {"mode": "token"}
            heads = [self.start_ray(ray_cluster, spec["headGroupSpec"], "head", f"{name}-head", None)]
        if not heads:
            return
        workers = [pod for pod in there if pod not in heads]
        for pod in workers[group["replicas"] :] + [pod for pod in workers if pod.phase == "Failed"]:
            self.store.delete("pods", pod.manifest["metadata"]["name"])
        for _ in range(group["replicas"] - len(workers)):
            self.start_ray(ray_cluster, group, "worker", f"{name}-workers-worker-{next(self.names)}", heads[0].address)
        running = [pod for pod in self.pods_of(name) if pod.phase == "Running"]
        ray_cluster["status"] = {"state": "ready" if len(running) == group["replicas"] + 1 else ""}

    def start_ray(
        self, ray_cluster: dict[str, Any], group: dict[str, Any], node: str, name: str, address: str | None
    ) -> Pod:
        """Start a pod with Ray, and beside the head the submitter."""
        cluster_name, template = ray_cluster["metadata"]["name"], json.loads(json.dumps(group["template"]))
        labels = {"ray.io/cluster": cluster_name, "ray.io/node-type": node, **template["metadata"]["labels"]}
        manifest = self.store.create("pods", {
            "apiVersion": "v1", "kind": "Pod", "metadata": {"name": name, "labels": labels}, "spec": template["spec"],
        })  # fmt: skip
        self.pods[name] = pod = self.net.pod(manifest)
        given = {"block": "true", "dashboard-agent-listen-port": "52365", "metrics-export-port": "8080"}
        given |= {"dashboard-host": "0.0.0.0"} if address is None else {"address": f"{address}:6379"}
        options = " ".join(
            f"--{key}" if value == "true" else f"--{key}={value}"
            for key, value in {**given, **group["rayStartParams"]}.items()
        )
        begin = "ray start --head" if address is None else f"{_until_open(address)}; ray start"
        secret = [
            {"name": "RAY_AUTH_MODE", "value": "token"},
            {"name": "RAY_AUTH_TOKEN", "value": self.tokens[cluster_name]},
        ]
        volumes, container = self.volumes(pod), manifest["spec"]["containers"][0]
        joined = [{"name": "RAY_ADDRESS", "value": f"{address or '127.0.0.1'}:6379"}]
        container = {**container, "env": [*container["env"], *secret, *joined]}
        pod.start(container, ["bash", "-c", f"ulimit -n 65536; {begin} {options}"], volumes)
        annotations = ray_cluster["metadata"].get("annotations")
        if address is None and annotations is not None:
            options = f"--address {DASHBOARD} --submission-id {annotations['id']}"
            submit = f"ray job submit {options} -- {annotations['entrypoint']}"
            wait = f"until {HEALTHY} > /dev/null 2>&1; do sleep 1; done"
            env = [{"name": "PYTHONUNBUFFERED", "value": "1"}, *secret]
            pod.start({"name": "ray-job-submitter", "env": env}, ["bash", "-ce", f"{wait}; {submit}"], {})
        return pod


def ask(head: Pod) -> dict[str, str]:
    """How the job of a Ray cluster is, as its dashboard says; empty where it does not answer yet."""
    if head.phase != "Running":
        return {}
    said, _ = head.containers["ray"].call(["bash", "-ec", ASKED]).communicate()
    head_of_answer, _, body = said.partition(b"\r\n\r\n")
    if b" 200 " not in head_of_answer.partition(b"\r\n")[0]:
        return {}
    known = json.loads(body)
    return {"jobStatus": known["status"], "message": known["message"]}


def _labels(pod: Pod) -> dict[str, str]:
    return {"ray.io/node-type": "", **pod.manifest["metadata"].get("labels", {})}


def _until_open(address: str) -> str:
    """What the init container of KubeRay waits for: the head answers."""
    return f"until (exec 3<>/dev/tcp/{address}/6379) 2> /dev/null; do sleep 0.2; done"


@contextmanager
def started(folder: Path, without: tuple[str, ...] = ()) -> Iterator[Cluster]:
    """A cluster whose KubeRay does not know the fields `without`; all that it has started ends with it."""
    store = Store(without=without)
    with network(folder) as net, serving(store) as address:
        cluster = Cluster(folder, store, net)
        store.deleted, store.container = cluster.removed, cluster.container
        cluster.kubeconfig.write_text(yaml.safe_dump(kubeconfig(address)))
        thread = threading.Thread(target=cluster.work)
        thread.start()
        try:
            yield cluster
        finally:
            cluster.ending.set()
            thread.join()
            assert cluster.fault is None, cluster.fault
