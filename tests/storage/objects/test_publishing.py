"""Laws of copying runs into an object store: whole at any moment, never over another, never where commits are lost."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import object_stores
import obstore
import pytest
import synthetic
from damages import flip
from run_digest import digests

from t6gps.service.api import asking
from t6gps.service.config import load
from t6gps.service.training import copying, origin, verification
from t6gps.storage import catalog, checkpoint, tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import checkpoints
from t6gps.storage.errors import DataError, RunError, StoreError, StoreUnreachableError
from t6gps.storage.objects import place, publishing
from t6gps.storage.objects.place import ObjectPath
from t6gps.storage.spool import Spool
from t6gps.storage.sql.query import query
from t6gps.workers.ground import ground


def quiet(done: int, total: int) -> None:
    assert done <= total


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of two iterations that no test changes."""
    return synthetic.made(tmp_path_factory.mktemp("here"), 2)


def test_a_run_comes_back_from_a_store_with_the_same_bytes(run: Run, objects: ObjectPath, tmp_path: Path) -> None:
    there = copying.copy(run, objects, "far", quiet)
    assert verification.verify(there) == []
    back = copying.copy(there, tmp_path, "back", quiet)
    assert digests(back.path) == digests(run.path)
    assert place.below(back.path / "tables") == place.below(run.path / "tables")


@pytest.mark.slow
def test_readers_see_a_sound_run_at_any_moment_of_its_copying(run: Run, objects: ObjectPath) -> None:
    seen, there = list[int](), Run(objects / run.name)

    def look(done: int, total: int) -> None:
        if done % 3 == 1 or done == total:
            assert verification.verify(there) == []
            seen.append(tables.committed_iterations(there))

    publishing.publish(run.path, objects / run.name, progress=look)
    assert seen == sorted(seen)
    assert {0, 1, 2} == set(seen)


class CutOff(Exception):
    """Stands for the end of a process."""


@pytest.mark.parametrize("after_n", [1, 5, 13])
def test_a_copy_that_was_cut_off_is_continued(run: Run, objects: ObjectPath, after_n: int) -> None:
    name = f"cut-{after_n}"

    def cut(done: int, total: int) -> None:
        if done == after_n:
            raise CutOff

    with pytest.raises(CutOff):
        publishing.publish(run.path, objects / name, progress=cut)
    copying.copy(run, objects, name, quiet)
    assert digests(objects / name) == digests(run.path)


def test_checkpoints_that_the_run_has_removed_go(objects: ObjectPath, tmp_path: Path) -> None:
    run = synthetic.made(tmp_path, 2)
    for iteration in (1, 4):
        publishing.publish(run.path, objects / run.name)
        checkpoint.save(run.checkpoints, iteration + 2, {}, {"weights": np.ones(iteration)})
        checkpoint.save(run.checkpoints, iteration + 3, {}, {"weights": np.ones(iteration)})
    publishing.publish(run.path, objects / run.name)
    copies = objects / run.name / "checkpoints"
    assert copies.below() == place.below(run.checkpoints)
    assert checkpoint.load(copies / "iteration-000007")[0] == 7


def test_what_the_run_has_removed_goes_and_what_belongs_to_others_stays(objects: ObjectPath, tmp_path: Path) -> None:
    run, copied = synthetic.made(tmp_path, 1), objects / "rolling"
    for episode in synthetic.episodes(1):
        Spool(run.spool, 1).append(episode)
    bundle = run.path / "bundles" / "episode-000000000003.json"
    bundle.parent.mkdir()
    bundle.write_text("{}")
    publishing.publish(run.path, copied)
    obstore.put(copied.client(), (copied / "notes.txt").key, b"mine")
    assert any(file.startswith("spool/") for file in copied.below())
    synthetic.commit(run, 1)
    Spool(run.spool, 1).clear()
    bundle.unlink()
    publishing.publish(run.path, copied, publishing.AT_WORK)
    assert not [file for file in copied.below() if file.startswith(("spool/", "bundles/"))]
    assert tables.committed_iterations(Run(copied)) == 2
    assert (copied / "notes.txt").read_bytes() == b"mine"


def test_a_torn_checkpoint_is_not_copied_and_one_that_was_is_replaced(objects: ObjectPath, tmp_path: Path) -> None:
    run, copied = synthetic.made(tmp_path, 2), objects / "rolling"
    newest = run.checkpoints / "iteration-000002"
    flip(newest / "arrays.npz", 40)
    publishing.publish(run.path, copied)
    assert list(checkpoint.kept(copied / "checkpoints")) == [1]
    checkpoint.save(run.checkpoints, 2, {"ledger": {}}, {"weights": np.zeros(9)})
    publishing.publish(run.path, copied)
    checkpoint.save(run.checkpoints, 2, {"ledger": {}}, {"weights": np.ones(9)})
    publishing.publish(run.path, copied)
    assert checkpoint.load(copied / "checkpoints" / newest.name)[2]["weights"].tolist() == [1.0] * 9
    copies = copied / "checkpoints" / newest.name
    obstore.put(copies.client(), (copies / "arrays.npz").key, b"torn")
    publishing.publish(run.path, copied)
    assert verification.verify(Run(copied)) == []


def test_a_copy_of_a_run_without_a_sound_checkpoint_says_so(objects: ObjectPath, tmp_path: Path) -> None:
    run, copied = synthetic.made(tmp_path, 2), objects / "rolling"
    for state in checkpoint.kept(run.checkpoints).values():
        flip(state / "arrays.npz", 40)
    publishing.publish(run.path, copied)
    found, there = verification.verify(run), verification.verify(Run(copied))
    assert {fault.place for fault in found} == {fault.place for fault in there} != set()


def test_checkpoints_of_logs_stay_and_the_copy_is_read_by_its_commits(objects: ObjectPath, tmp_path: Path) -> None:
    run, copied = synthetic.made(tmp_path, checkpoints.EVERY_N), objects / "rolling"
    assert checkpoints.kept(run.tables / "frames" / "_delta_log")
    publishing.publish(run.path, copied)
    assert not [file for file in copied.below() if file.endswith(checkpoints.ENDING)]
    assert tables.committed_iterations(Run(copied)) == checkpoints.EVERY_N
    assert verification.verify(Run(copied)) == []


def test_a_run_in_a_store_has_its_ground(objects: ObjectPath, tmp_path: Path) -> None:
    np.save(tmp_path / "hills.npy", np.linspace(0, 1, 81 * 81).reshape(81, 81))
    config = load("flat-quick", [f'terrain.file="{tmp_path / "hills.npy"}"'])
    run = origin.create(config, tmp_path, "hills")
    publishing.publish(run.path, objects / "hills")
    here, there = (origin.configured(each, ["run.steps=40"]) for each in (run, Run(objects / "hills")))
    assert there.terrain.file == f"{objects}/hills/ground/hills.npy"
    grounds = [ground.ground(each.terrain, 0, 0.0) for each in (here, there)]
    assert all(each is not None for each in grounds)
    np.testing.assert_array_equal(*(each.heights for each in grounds if each is not None))


def test_what_is_there_is_not_sent_again(run: Run, objects: ObjectPath) -> None:
    counts = []
    for _ in range(2):
        publishing.publish(run.path, objects / run.name, progress=lambda done, total: counts.append(total))
    assert counts[0] > 20
    assert counts[-1] == 0


def test_another_run_of_the_name_is_left_as_it_is(run: Run, objects: ObjectPath, tmp_path: Path) -> None:
    copying.copy(run, objects, "taken", quiet)
    before = digests(objects / "taken")
    other = synthetic.made(tmp_path, 1)
    with pytest.raises(RunError, match="holds another run of that name; choose another name or prefix"):
        copying.copy(other, objects, "taken", quiet)
    with pytest.raises(RunError, match="another run"):
        publishing.check_same(other.path, objects / "taken")
    assert digests(objects / "taken") == before


def test_a_run_that_went_on_elsewhere_is_refused(objects: ObjectPath, tmp_path: Path) -> None:
    first = synthetic.made(tmp_path, 1)
    second = catalog.copy(first, tmp_path, "second")
    synthetic.commit(first, 1)
    copying.copy(first, objects, "both", quiet)
    with pytest.raises(RunError, match="has more of the run than"):
        copying.copy(second, objects, "both", quiet)
    synthetic.commit(second, 1)  # at another time, which its log says
    with pytest.raises(RunError, match="another run"):
        copying.copy(second, objects, "both", quiet)
    assert verification.verify(Run(objects / "both")) == []


def test_of_two_that_publish_one_run_as_it_went_on_one_is_refused(objects: ObjectPath, tmp_path: Path) -> None:
    first = synthetic.made(tmp_path, 1)
    second = catalog.copy(first, tmp_path, "second")
    for run in (first, second):
        synthetic.commit(run, 1)

    def refused(run: Run) -> bool:
        try:
            publishing.publish(run.path, objects / "both")
        except RunError:
            return True
        return False

    with ThreadPoolExecutor(2) as threads:
        assert sorted(threads.map(refused, (first, second))) == [False, True]
    assert verification.verify(Run(objects / "both")) == []
    assert tables.committed_iterations(Run(objects / "both")) == 2


def test_a_file_that_another_writer_left_without_its_log_entry_is_not_taken_for_ours(
    run: Run, objects: ObjectPath
) -> None:
    file = "tables/iterations/iteration-000001.parquet"
    copy, content = objects / "mixed" / file, (run.path / file).read_bytes()
    obstore.put(copy.client(), copy.key, bytes(len(content)))
    with pytest.raises(RunError, match=r"iteration-000001.parquet is of another run"):
        publishing.publish(run.path, objects / "mixed")


def test_a_store_that_ignores_if_none_match_is_refused(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with object_stores.rclone(tmp_path) as store:
        for name, value in store.environment.items():
            monkeypatch.setenv(name, value)
        root = place.whole(Path(f"s3://{object_stores.BUCKET}/runs"))
        with pytest.raises(StoreError, match=r"ignores If-None-Match.*publish to a store that refuses it"):
            copying.copy(run, root, "rolling", quiet)
        assert root.parent.below() == {".ready": len(object_stores.READY)}, "nothing was left there"


def test_a_run_that_does_not_come_whole_is_not_kept(run: Run, objects: ObjectPath, tmp_path: Path) -> None:
    there = copying.copy(run, objects, "torn", quiet)
    obstore.delete(objects.client(), (objects / "torn/tables/frames/iteration-000001.parquet").key)
    with pytest.raises(RunError, match=r"does not come whole from s3://.*frames/iteration-000001.parquet"):
        copying.copy(there, tmp_path, "torn", quiet)
    assert not list(tmp_path.iterdir())
    with pytest.raises(DataError, match=r"table frames in s3://.* iteration-000001.parquet"):
        tables.read(there, "frames")


@pytest.mark.slow
def test_a_store_that_goes_away_is_no_damage_of_the_run(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(run.path, tmp_path / "rolling")
    with object_stores.seaweed(tmp_path) as store:
        for name, value in store.environment.items():
            monkeypatch.setenv(name, value)
        there = copying.copy(run, place.whole(Path(f"s3://{object_stores.BUCKET}")), "rolling", quiet)
        assert tables.read(there, "frames").num_rows > 0
        store.kill()
        for ask in (lambda: tables.read(there, "frames"), lambda: verification.verify(there)):
            with pytest.raises(StoreUnreachableError, match=r"does not answer.*see AWS_ENDPOINT_URL and the network"):
                ask()


@pytest.mark.parametrize("table", ["_delta_log/00000000000000000001.json", "iteration-000000.parquet"])
def test_an_internal_error_for_one_object_is_no_damage_of_the_run(
    run: Run, objects: ObjectPath, seaweed: object_stores.Store, monkeypatch: pytest.MonkeyPatch, table: str
) -> None:
    there = copying.copy(run, objects, "rolling", quiet)
    with object_stores.failing(seaweed, f"frames/{table}") as address:
        monkeypatch.setenv("AWS_ENDPOINT_URL", address)
        for ask in (lambda: tables.read(there, "frames"), lambda: verification.verify(there)):
            with pytest.raises(StoreUnreachableError, match=r"does not answer.*(InternalError|500).*then repeat"):
                ask()
        with pytest.raises(StoreUnreachableError, match=r"does not answer"):
            query(asking.of_run(there, "SELECT sum(com_x_m) FROM frames", {}))
        assert tables.read(there, "episodes").num_rows > 0
