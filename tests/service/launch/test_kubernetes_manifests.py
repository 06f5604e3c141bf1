"""Laws of what `submit --to k8s` makes: valid for Kubernetes and KubeRay, safe, named by its run, large enough."""

from __future__ import annotations

import base64
import copy
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import k8s_samples
import kube_api
import numpy as np
import pytest
import yaml
from command import t6gps

from t6gps.service import config as configuration
from t6gps.service.launch.target import K8s
from t6gps.service.launch.targets.kubernetes import claim, manifests
from t6gps.storage.errors import ConfigError, TerrainError

TARGET = K8s(image="t6gps", claim="runs", service_account="trainer", image_pull_policy="Always", pods=4, cpus_per_pod=3)
PLURALS = {kind: plural for plural, (_, kind) in kube_api.KINDS.items()}


def job(*overrides: str) -> list[Any]:
    return manifests.job(configuration.load("flat-quick", overrides), "flat", TARGET)


def ray_spec(manifest: Any) -> Any:
    return manifest["spec"].get("rayClusterSpec", manifest["spec"])


def every() -> list[Any]:
    return [*job(), *manifests.cluster("t6gps-shared", 2, TARGET), manifests.reader("t6gps-reader", TARGET)]


def pod_specs() -> Iterator[Any]:
    """The specification of each pod that would be."""
    for manifest in every():
        if manifest["kind"].startswith("Ray"):
            spec = ray_spec(manifest)
            yield from (group["template"]["spec"] for group in (spec["headGroupSpec"], *spec["workerGroupSpecs"]))
        elif manifest["kind"] == "Pod":
            yield manifest["spec"]


@pytest.mark.parametrize("manifest", every(), ids=lambda manifest: manifest["kind"])
def test_kubernetes_takes_every_object(manifest: Any) -> None:
    kube_api.check(PLURALS[manifest["kind"]], manifest)


def published() -> list[Any]:
    target = TARGET.model_copy(update={"store_secret": "lab-keys", "store_port": 8333})
    return manifests.job(configuration.load("flat-quick"), "flat", target, "s3://lab/runs")


@pytest.mark.parametrize("manifest", published(), ids=lambda manifest: manifest["kind"])
def test_kubernetes_takes_every_object_of_a_job_that_publishes(manifest: Any) -> None:
    kube_api.check(PLURALS[manifest["kind"]], manifest)


def test_the_head_alone_has_the_keys_of_the_store_and_a_job_without_them_is_refused() -> None:
    config_map, policy, ray_job = published()
    assert config_map["data"]["publish"] == "s3://lab/runs\n"
    assert policy["spec"]["egress"][-1] == {"ports": [{"protocol": "TCP", "port": 8333}]}
    spec = ray_spec(ray_job)
    (head,), (worker,) = (
        group["template"]["spec"]["containers"] for group in (spec["headGroupSpec"], *spec["workerGroupSpecs"])
    )
    assert head["envFrom"] == [{"secretRef": {"name": "lab-keys"}}]
    assert "envFrom" not in worker
    assert len(job()[1]["spec"]["egress"]) == len(policy["spec"]["egress"]) - 1
    with pytest.raises(ConfigError, match=r"k8s\.store_secret names none; make a Secret"):
        manifests.job(configuration.load("flat-quick"), "flat", TARGET, "s3://lab/runs")


PLANTED = [
    ("RayJob", lambda spec: spec["rayClusterSpec"]["headGroupSpec"]["template"]["spec"]["containers"][0].pop("name")),
    ("RayJob", lambda spec: spec["rayClusterSpec"]["workerGroupSpecs"][0]["template"]["spec"].update(hostNetwrok=True)),
    ("NetworkPolicy", lambda spec: spec.update(policyType=["Ingress"])),
    ("NetworkPolicy", lambda spec: spec["ingress"][1]["ports"][0].update(port=[8265])),
    ("Pod", lambda spec: spec["securityContext"].update(runAsNonroot=True)),
]
PLANTED_FOR_KUBERAY = [
    ("RayJob", lambda spec: spec.update(backofLimit=3)),
    ("RayJob", lambda spec: spec.update(backoffLimit="3")),
    ("RayJob", lambda spec: spec["rayClusterSpec"]["authOptions"].update(mode="secret")),
    ("RayCluster", lambda spec: spec["workerGroupSpecs"][0].update(replica=2)),
    ("RayCluster", lambda spec: spec["headGroupSpec"].update(rayStartParams={"num-cpus": 0})),
]


def planted(kind: str, change: Any) -> None:
    """See that an object is refused once a mistake was made in it."""
    manifest = copy.deepcopy(next(manifest for manifest in every() if manifest["kind"] == kind))
    change(manifest["spec"])
    with pytest.raises(kube_api.Refused):
        kube_api.check(PLURALS[kind], manifest)


@pytest.mark.parametrize(("kind", "change"), PLANTED)
def test_a_mistake_in_an_object_is_found(kind: str, change: Any) -> None:
    planted(kind, change)


@pytest.mark.skipif(kube_api.ray_schema("rayjobs") is None, reason="T6GPS_KUBERAY_SCHEMAS names no folder of schemas")
@pytest.mark.parametrize(("kind", "change"), PLANTED_FOR_KUBERAY)
def test_a_mistake_in_an_object_of_kuberay_is_found(kind: str, change: Any) -> None:
    planted(kind, change)


def test_kubectl_reads_every_object_as_it_was_written() -> None:
    """Without a cluster: kubectl knows no schemas then, but it knows YAML as Kubernetes does."""
    if shutil.which("kubectl") is None:
        pytest.skip("there is no kubectl")
    core = [manifest for manifest in every() if not manifest["kind"].startswith("Ray")]
    assert yaml.safe_load_all(manifests.to_yaml(core))
    for manifest in core:
        call = ["kubectl", "label", "--local", "-f", "-", "a=b", "--output=json"]
        done = subprocess.run(call, input=manifests.to_yaml([manifest]), capture_output=True, text=True, check=True)
        assert yaml.safe_load(done.stdout)["spec" if "spec" in manifest else "data"] == manifest.get(
            "spec", manifest.get("data")
        )


def test_pods_are_nobody_write_nowhere_and_ask_for_what_they_may_use() -> None:
    for spec in pod_specs():
        assert spec["securityContext"] | {"runAsNonRoot": True, "runAsUser": 1000} == spec["securityContext"]
        assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert spec["automountServiceAccountToken"] is False
        assert spec["serviceAccountName"] == "trainer"
        (container,) = spec["containers"]
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
        }  # fmt: skip
        assert container["resources"]["requests"] == container["resources"]["limits"]
        assert {mount["name"] for mount in container["volumeMounts"]} == {entry["name"] for entry in spec["volumes"]}


def test_only_the_head_and_its_job_write_to_the_claim() -> None:
    claims = [
        mount["readOnly"]
        for spec in pod_specs()
        for mount in spec["containers"][0]["volumeMounts"]
        if mount["mountPath"] == "/runs"
    ]
    assert claims == [False, True, False, True, True]


def test_the_head_runs_no_workers_and_the_others_hold_all_of_them() -> None:
    *_, ray_job = job("run.workers=7", "run.cpus_per_worker=1.5")
    spec = ray_spec(ray_job)
    (group,) = spec["workerGroupSpecs"]
    assert spec["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"
    assert group["replicas"] == 4
    assert (
        group["rayStartParams"]["num-cpus"] == group["template"]["spec"]["containers"][0]["resources"]["limits"]["cpu"]
    )
    *_, scaling = job("run.workers_min=1", "run.workers_max=9")
    assert ray_spec(scaling)["workerGroupSpecs"][0]["replicas"] == 3


@pytest.mark.parametrize("overrides", [["run.workers=13"], ["run.workers_max=13"], ["run.cpus_per_worker=4.0"]])
def test_more_workers_than_the_target_allows_are_refused(overrides: list[str]) -> None:
    with pytest.raises(ConfigError, match=r"do not fit on k8s.pods = 4 with k8s.cpus_per_pod = 3; allowed: (12|0)"):
        job(*overrides)


def test_strangers_reach_nothing_of_a_job() -> None:
    _, policy, ray_job = job()
    spec = policy["spec"]
    labels = spec["podSelector"]["matchLabels"]
    groups = (ray_spec(ray_job)["headGroupSpec"], *ray_spec(ray_job)["workerGroupSpecs"])
    assert all(group["template"]["metadata"]["labels"] == labels for group in groups)
    assert spec["policyTypes"] == ["Ingress", "Egress"]
    own, operator = spec["ingress"]
    assert own == {"from": [{"podSelector": {"matchLabels": labels}}]}
    assert operator["ports"] == [{"protocol": "TCP", "port": 8265}]
    assert ray_spec(ray_job)["authOptions"] == {"mode": "token"}


def test_no_secret_is_written_into_what_is_submitted() -> None:
    assert not re.search("auth_token|RAY_AUTH_TOKEN", manifests.to_yaml(every()))


@pytest.mark.parametrize("run", ["a", "Flat_quick.1", "x" * 64, "7", "-".join("abc"), "A" * 63 + "b"])
def test_objects_are_named_by_the_run_as_kuberay_allows(run: str) -> None:
    named = manifests.name(run, TARGET)
    assert re.fullmatch(r"[a-z]([-a-z0-9]*[a-z0-9])?", named)
    assert len(named) <= manifests.NAME_LENGTH_N
    assert named == manifests.name(run, TARGET)


def test_runs_and_claims_that_differ_have_other_names() -> None:
    other = TARGET.model_copy(update={"claim": "others"})
    names = [manifests.name(run, target) for run in ("a.b", "a-b", "A-b") for target in (TARGET, other)]
    assert len(set(names)) == len(names)


def test_a_ground_travels_with_the_job_and_a_large_one_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "my hill.npy"
    np.save(source, np.linspace(0, 1, 81 * 81).reshape(81, 81))
    config_map = job(f"terrain.file={source}")[0]
    assert base64.b64decode(config_map["binaryData"]["ground.npy"]) == source.read_bytes()
    assert 'terrain.file = "/runs/.jobs/flat/ground/ground.npy"' in config_map["data"]["config.toml"]
    np.save(source, np.zeros((400, 400)))
    with pytest.raises(TerrainError, match="1280128 bytes; Kubernetes takes a ground of at most 675000"):
        job(f"terrain.file={source}")
    source.unlink()
    with pytest.raises(TerrainError, match=r"cannot read ground from .*my hill.npy: No such file"):
        job(f"terrain.file={source}")


WAITS = [
    ({"containerStatuses": [{"state": {"waiting": {"reason": "ImagePullBackOff", "message": "no such image"}}}]},
     "ImagePullBackOff no such image"),
    ({"conditions": [{"type": "PodScheduled", "status": "False", "reason": "Unschedulable", "message": "0/3 nodes"}]},
     "Unschedulable 0/3 nodes"),
    ({"containerStatuses": [{"state": {"running": {}}}]}, ""),
    ({}, ""),
]  # fmt: skip


@pytest.mark.parametrize(("status", "words"), WAITS)
def test_a_pod_that_waits_is_quoted(status: Any, words: str) -> None:
    assert claim.reason({"status": status}) == words


def test_a_dry_run_prints_what_kubectl_takes_and_does_nothing(tmp_path: Path) -> None:
    options = ["--to", "k8s", "--target", k8s_samples.FOLDER / "targets.toml", "--root", tmp_path, "--seeds", "2"]
    printed = t6gps("submit", "flat-quick", "--dry-run", *options).stdout.decode()
    objects = list(yaml.safe_load_all(printed[printed.index("apiVersion") :]))
    assert [found["kind"] for found in objects] == ["ConfigMap", "NetworkPolicy", "RayJob"] * 2
    assert "run.seed = 1\n" in objects[3]["data"]["config.toml"]
    assert not list(tmp_path.iterdir())


def test_the_samples_are_what_is_made_of_their_target() -> None:
    for name, text in k8s_samples.samples().items():
        assert (k8s_samples.FOLDER / name).read_text() == text, "run python tests/clusters/k8s_samples.py"
