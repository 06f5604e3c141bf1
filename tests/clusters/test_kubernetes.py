"""Laws of jobs on a stand-in for Kubernetes and KubeRay, spoken to by the real kubectl.

A run has the same bytes whatever happens to its job, what cannot be is refused in one sentence, and nothing is left.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import kuberay_cluster
import pytest
import run_digest
import tiny_run
import yaml
from command import t6gps
from kube_api import kubeconfig
from kuberay_cluster import Cluster
from pods_of_processes import PROGRAMS

from t6gps.service import config as configuration
from t6gps.service.launch import folder as folders
from t6gps.service.launch import job as records
from t6gps.service.launch.fetch import FolderSource
from t6gps.service.launch.target import K8s, Kind
from t6gps.service.launch.targets.kubernetes import manifests
from t6gps.service.steering import requests
from t6gps.storage import catalog
from t6gps.storage.catalog import Run

pytestmark = pytest.mark.skipif(
    any(shutil.which(program) is None for program in PROGRAMS) or os.geteuid() != 0,
    reason=f"pods of processes need root and the programs {', '.join(PROGRAMS)}",
)
LONG = [*tiny_run.settings(), *tiny_run.VALUED, "--set=run.iterations=8"]
ENDLESS = [*tiny_run.settings(), "--set=run.iterations=2000"]
TARGET = """
[k8s]
image = "t6gps"
claim = "runs"
head_cpus = 1
head_memory_gb = 2
cpus_per_pod = 1
memory_gb_per_pod = 2
pods = 2
retries = 1
"""
SOON_S = 300.0
Wait = Callable[[Callable[[], bool], float], None]


@dataclass(frozen=True)
class Desk:
    """Where somebody submits from: a cluster, its claim, and a root for what is submitted."""

    cluster: Cluster
    claim: Path
    root: Path

    def state(self, run: str) -> dict[str, str]:
        return json.loads(t6gps("status", run, "--json", "--root", self.root).stdout)["job"]

    def learned(self, run: str) -> bool:
        """True when a run has a checkpoint."""
        assert self.cluster.fault is None, self.cluster.fault
        folder = self.claim / run / "checkpoints"
        return folder.is_dir() and any(folder.iterdir())

    def ray_job(self, run: str) -> dict[str, str | int]:
        """What KubeRay says of a run's job."""
        return self.cluster.store.get("rayjobs", number(run))["status"]


def number(run: str) -> str:
    return next(job.native_id for job in records.jobs() if job.run == run)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    folder = Path(tempfile.mkdtemp(prefix="t6gps-"))
    try:
        with kuberay_cluster.started(folder) as cluster:
            cluster.claim("runs")
            yield cluster
    finally:
        shutil.rmtree(folder)


@pytest.fixture
def desk(cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    """A desk whose jobs end with the test."""
    (tmp_path / "targets.toml").write_text(TARGET)
    monkeypatch.setenv("T6GPS_TARGET", str(tmp_path / "targets.toml"))
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path / "state"))
    monkeypatch.setenv("KUBECONFIG", str(cluster.kubeconfig))
    monkeypatch.setenv("KUBECACHEDIR", str(tmp_path / "kubectl"))
    yield Desk(cluster, cluster.claims / "runs", tmp_path / "desk")
    for plural in ("rayjobs", "configmaps", "networkpolicies"):
        for found in cluster.store.of(plural):
            cluster.store.delete(plural, found["metadata"]["name"])
    assert not cluster.pods


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Digests of the run of LONG, trained in one process."""
    root = tmp_path_factory.mktemp("expected")
    t6gps("train", "flat-quick", "--run", "serial", "--serial", "--root", root, *LONG)
    return run_digest.digests(root / "serial")


@pytest.mark.slow
@pytest.mark.ray
def test_a_job_outlives_its_head_and_comes_home_with_the_same_bytes(
    desk: Desk, expected: dict[str, str], tmp_path: Path, wait_until: Wait
) -> None:
    root = ["--root", desk.root]
    t6gps("submit", "flat-quick", "--to", "k8s", "--run", "long", "--workers", "1", *LONG, *root)
    wait_until(lambda: desk.learned("long"), SOON_S)
    requests.pause(catalog.open_run(desk.claim, "long"), SOON_S)  # so that it does not end meanwhile
    status = json.loads(t6gps("status", "long", "--json", *root).stdout)
    assert (status["job"]["state"], status["state"]) == ("running", "PAUSED")
    head = desk.cluster.head(number("long"))
    assert head is not None
    head.kill()
    log = t6gps("logs", "-f", "long", *root).stdout.decode()
    assert "iteration 7" in log
    assert desk.state("long")["state"] == "done"
    assert desk.ray_job("long")["failed"] == 1
    home = t6gps("fetch", "long", "--to", tmp_path / "home", *root).stdout.decode().strip()
    assert run_digest.digests(Path(home)) == expected
    assert not desk.cluster.pods


@pytest.mark.slow
@pytest.mark.ray
def test_a_job_scales_with_its_pods_and_one_that_is_stopped_is_not_retried(desk: Desk, wait_until: Wait) -> None:
    submit = [
        "submit",
        "flat-quick",
        "--to",
        "k8s",
        "--run",
        "stopped",
        "--workers",
        "1",
        *ENDLESS,
        "--root",
        desk.root,
    ]
    t6gps(*submit)
    wait_until(lambda: desk.learned("stopped"), SOON_S)
    assert len(desk.cluster.pods) == 2
    scaled = t6gps("scale", "stopped", "2", "--deadline", str(SOON_S), "--root", desk.root).stdout.decode()
    assert scaled.startswith("run stopped has 2 workers")
    assert len(desk.cluster.pods) == 3
    refused = t6gps(*submit, "--resume", code=2).stderr
    assert "job stopped is running" in " ".join(refused.split())
    assert "stop it, or wait for it to end" in " ".join(
        t6gps("fetch", "stopped", "--root", desk.root, code=2).stderr.split()
    )
    assert "job stopped is stopped" in t6gps("stop", "stopped", "--root", desk.root).stdout.decode()
    assert desk.ray_job("stopped")["jobStatus"] == "STOPPED"
    assert desk.ray_job("stopped")["failed"] == 0
    assert "everything sampled so far is kept" in t6gps("logs", "stopped", "--root", desk.root).stdout.decode()
    t6gps(*submit, "--resume")
    shutil.rmtree(desk.root / ".jobs")  # the record of the job is elsewhere
    refused = t6gps(*submit, code=2).stderr
    assert "end it with t6gps stop stopped" in " ".join(refused.split())
    assert "job stopped is stopped" in t6gps("stop", "stopped", "--root", desk.root).stdout.decode()
    assert desk.state("stopped")["detail"] == "its RayJob is suspended"
    assert not desk.cluster.pods


def ended(desk: Desk, run: str, exit_code: str) -> Run:
    """A run on the claim whose job has ended and whose RayJob somebody has removed."""
    made = catalog.create(desk.claim, run, "{}")
    (made.tables / "a part").write_bytes(bytes(range(256)) * 40)
    (made.tables / "large").write_bytes(bytes(range(251)) * 4000)
    folder = desk.claim / ".jobs" / run
    folder.mkdir(parents=True)
    (folder / "exit_code").write_text(exit_code)
    (folder / "log").write_text("what it said\n")
    target = K8s(image="t6gps", claim="runs")
    records.make_state_folder()
    records.new(Kind.K8S, manifests.name(run, target), folders.of(desk.root, run), "flat-quick", target)
    return made


@pytest.mark.parametrize(
    ("exit_code", "state"), [("0", "done"), ("130", "stopped"), ("2", "failed"), ("", "failed")], ids=str
)
def test_a_job_whose_rayjob_was_removed_ended_as_its_script_wrote(desk: Desk, exit_code: str, state: str) -> None:
    ended(desk, f"removed-{exit_code}", exit_code)
    known = {row["run"]: row for row in json.loads(t6gps("jobs", "--json").stdout)}[f"removed-{exit_code}"]
    assert (known["state"], "was removed" in known["detail"]) == (state, True)
    assert not desk.cluster.pods


@pytest.mark.slow
def test_a_run_on_a_claim_comes_home_and_a_copy_that_was_cut_off_goes_on(desk: Desk, tmp_path: Path) -> None:
    run = ended(desk, "cut", "0")
    begun = tmp_path / "home" / ".fetched" / "cut" / "tables"
    begun.mkdir(parents=True)
    for name in ("a part", "large"):
        (begun / name).write_bytes((run.tables / name).read_bytes()[:1000])
    t6gps("fetch", "cut", "--root", desk.root, "--to", tmp_path / "home")
    assert FolderSource(catalog.open_run(tmp_path / "home", "cut")).files() == FolderSource(run).files()
    assert t6gps("logs", "cut", "--root", desk.root).stdout == b"what it said\n"
    with catalog.locked(run):
        said = t6gps("fetch", "cut", "--root", desk.root, "--to", tmp_path / "other", code=2).stderr
    assert "run cut is in use" in " ".join(said.split())
    assert not desk.cluster.pods


def closed_port(folder: Path) -> None:
    (folder / "kubeconfig").write_text(yaml.safe_dump(kubeconfig("http://127.0.0.1:1")))
    os.environ["KUBECONFIG"] = str(folder / "kubeconfig")


def target(line: str) -> Callable[[Path], None]:
    return lambda folder: (folder / "targets.toml").write_text(TARGET + line + "\n") and None


def without(line: str) -> Callable[[Path], None]:
    return lambda folder: (folder / "targets.toml").write_text(TARGET.replace(line, "")) and None


def no_kubectl(folder: Path) -> None:
    os.environ["PATH"] = str(folder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (no_kubectl, ["no program kubectl", "install it"]),
        (closed_port, ["refused", "see that the cluster is up"]),
        (target("context = 'elsewhere'"), ["elsewhere", "does not exist", "correct k8s.context"]),
        (target("namespace = 'elsewhere'"), ["k8s.claim = runs in namespace elsewhere", "correct the file of targets"]),
        (without('claim = "runs"'), ["k8s.claim: Field required"]),
        (without('image = "t6gps"'), ["k8s.image: Field required"]),
        (target("namespace = 'No_name'"), ["k8s.namespace", "No_name"]),
        (target("image_pull_policy = 'Sometimes'"), ["k8s.image_pull_policy", "Always"]),
    ],
)
def test_a_cluster_that_cannot_be_used_gives_one_error_and_nothing_is_left(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Path], None], words: list[str]
) -> None:
    monkeypatch.setenv("PATH", os.environ["PATH"])  # so that it comes back
    change(tmp_path)
    refused(desk, words)


@pytest.mark.parametrize(
    ("claim", "mode", "words"),
    [
        ("elsewhere", None, ["k8s.claim = elsewhere", "is not there", "make that PersistentVolumeClaim"]),
        ("single", "ReadWriteOnce", ["k8s.claim = single", "not shared", "allowed: ReadWriteMany"]),
    ],
)
def test_a_claim_that_cannot_hold_a_root_is_refused(
    desk: Desk, tmp_path: Path, claim: str, mode: str | None, words: list[str]
) -> None:
    if mode is not None:
        desk.cluster.claim(claim, mode)
    (tmp_path / "targets.toml").write_text(TARGET.replace('"runs"', f'"{claim}"'))
    refused(desk, words)


def test_more_workers_than_fit_are_refused(desk: Desk) -> None:
    refused(desk, ["3 workers", "k8s.pods = 2", "k8s.cpus_per_pod = 1", "allowed: 2"], "--workers", "3")


def test_an_earlier_kuberay_is_refused(desk: Desk) -> None:
    desk.cluster.store.without = ("authOptions",)
    try:
        refused(desk, ["unknown field", "authOptions", "KubeRay 1.6 or later"])
    finally:
        desk.cluster.store.without = ()


def test_a_name_that_another_has_taken_is_refused_and_stays_theirs(desk: Desk) -> None:
    objects = manifests.job(configuration.load("flat-quick"), "refused", K8s(image="t6gps", claim="runs"))
    desk.cluster.store.create("networkpolicies", objects[1])
    said = t6gps("submit", "flat-quick", "--to", "k8s", "--run", "refused", "--root", desk.root, code=2).stderr
    assert "choose another name with --run" in " ".join(said.split())
    assert [found["metadata"]["uid"] for found in desk.cluster.store.of("networkpolicies")]
    assert not desk.cluster.store.of("configmaps")
    assert not records.jobs()


def test_a_manifest_edited_into_nonsense_is_refused_by_the_cluster(desk: Desk, tmp_path: Path) -> None:
    """What `--dry-run` prints may be edited and given to kubectl."""
    objects = manifests.job(configuration.load("flat-quick"), "edited", K8s(image="t6gps", claim="runs"))
    text = manifests.to_yaml(objects)
    for old, new in (("mountPath: /runs", "mountpath: /runs"), ("policyTypes:", "policytypes:")):
        edited = tmp_path / "edited.yaml"
        edited.write_text(text.replace(old, new))
        done = subprocess.run(
            ["kubectl", "create", "--dry-run=server", "-f", str(edited)], capture_output=True, text=True, check=False
        )
        assert done.returncode != 0
        assert old.split(":")[0].lower() in done.stderr.lower()


def refused(desk: Desk, words: list[str], *options: str) -> None:
    """See that a job is refused with these words, and that nothing is left of it."""
    submit = ["submit", "flat-quick", "--to", "k8s", "--run", "refused", "--root", desk.root, *options]
    said = " ".join(t6gps(*submit, code=2).stderr.split())
    assert all(word in said for word in words), said
    assert not any(desk.cluster.store.of(plural) for plural in ("configmaps", "networkpolicies", "rayjobs", "pods"))
    assert not (desk.root / ".jobs" / "refused").exists()
    assert not records.jobs()
