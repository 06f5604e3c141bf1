"""Laws of datasets for other programs: bit for bit, numbered anew, whole or not at all, in bounded memory."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from minari import MinariDataset

from t6gps.storage import catalog, schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import iterations
from t6gps.storage.errors import ConfigError, DataError
from t6gps.storage.exports import dataset, lerobot, selection
from t6gps.storage.exports.card import Asked
from t6gps.storage.exports.dataset import FORMATS
from t6gps.storage.exports.selection import Source
from t6gps.storage.records import Episode, Learned

pytestmark = pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")  # numbers of every size
ASKED = Asked("*", "cost > 0", "CC-BY-4.0", "t6gps 1.2.3")
CHOSEN = {"walk-0": [0, 2, 100], "walk-1": [1, 101, 102]}
"""Episodes that leave, of runs with two iterations of three."""
NAME = "walks-v0"


@pytest.fixture(scope="module")
def runs(
    tmp_path_factory: pytest.TempPathFactory,
    make_episode: Callable[..., Episode],
    learn: Callable[..., Learned],
) -> list[Run]:
    """Runs with episodes of different lengths; no test changes them."""
    root, made = tmp_path_factory.mktemp("runs"), []
    for seed, name in enumerate(CHOSEN):
        run = catalog.create(root, name, "{}")
        for number in range(2):
            rng = np.random.default_rng([seed, number])
            episodes = [make_episode(100 * number + i, number, steps=3 + i, rng=rng) for i in range(3)]
            iterations.commit(run, number, iter(episodes), learn(number))
        made.append(run)
    return made


@pytest.fixture(scope="module")
def sources(runs: list[Run]) -> list[Source]:
    return [selection.source(run, CHOSEN[run.name], {"run": run.name}, {"run.seed": run.name}) for run in runs]


def written(form: str, sources: list[Source], out: Path) -> Path:
    return dataset.write(FORMATS[form], out / NAME, ASKED, sources, lambda done, total: None).path


def originals(sources: list[Source]) -> list[Episode]:
    """The episodes as the tables have them, in the order in which they leave."""
    runs = {source.run.name: source.run for source in sources}
    return [tables.episode(runs[name], number) for name, numbers in CHOSEN.items() for number in numbers]


def floats(table: pa.Table, name: str) -> np.ndarray:
    """A column as an array whose bits are those of the column."""
    column = table.column(name).combine_chunks()
    if not pa.types.is_list(column.type):
        return column.to_numpy(zero_copy_only=False)
    return column.flatten().to_numpy().reshape(len(column) - column.null_count, -1)


def same_bits(found: np.ndarray, expected: np.ndarray) -> bool:
    return found.dtype == expected.dtype and found.shape == expected.shape and found.tobytes() == expected.tobytes()


def of_transitions(table: pa.Table, observation: str, action: str, reward: str, episodes: list[Episode]) -> None:
    """Rows are the transitions of episodes, one after the other, bit for bit."""
    frames = [episode.frames for episode in episodes]
    assert same_bits(floats(table, observation), np.concatenate([floats(f, "observation")[:-1] for f in frames]))
    assert same_bits(floats(table, action), np.concatenate([floats(f, "action") for f in frames]))
    assert same_bits(floats(table, reward), np.concatenate([-floats(f, "cost")[1:] for f in frames]))


def times(episode: Episode) -> np.ndarray:
    return floats(episode.frames, "time_s")[:-1].astype(np.float32)


def ends(episodes: list[Episode]) -> list[bool]:
    return [step == episode.frames.num_rows - 2 for episode in episodes for step in range(episode.frames.num_rows - 1)]


def test_parquet_has_every_column_of_every_frame(
    sources: list[Source], tmp_path: Path, bits: Callable[[pa.Table], list[list[bytes]]]
) -> None:
    out, episodes = written("parquet", sources, tmp_path), originals(sources)
    found = pq.read_table(out / "frames")
    frames = pa.concat_tables([episode.frames for episode in episodes])
    assert bits(found.select(frames.column_names)) == bits(frames)
    lengths = [episode.frames.num_rows for episode in episodes]
    assert found.column("episode_index").to_pylist() == np.repeat(np.arange(6), lengths).tolist()
    assert (
        found.column("run").to_pylist()
        == np.repeat(["walk-0", "walk-1"], [sum(lengths[:3]), sum(lengths[3:])]).tolist()
    )
    assert all(found.schema.field(field.name).metadata == field.metadata for field in schema.FRAMES)
    assert found.schema.metadata == schema.FRAMES.metadata


def test_lerobot_has_the_transitions_and_says_where_each_episode_lies(sources: list[Source], tmp_path: Path) -> None:
    out, episodes = written("lerobot", sources, tmp_path), originals(sources)
    rows = pq.read_table(out / "data" / "chunk-000" / "file-000.parquet")
    of_transitions(rows, "observation.state", "action", "next.reward", episodes)
    assert rows.column("next.done").to_pylist() == rows.column("next.truncated").to_pylist() == ends(episodes)
    assert rows.column("index").to_pylist() == list(range(rows.num_rows))
    for row in pq.read_table(out / "meta" / "episodes").to_pylist():
        part = rows.slice(row["dataset_from_index"], row["length"])
        assert row["dataset_to_index"] - row["dataset_from_index"] == row["length"] == part.num_rows
        assert set(part.column("episode_index").to_pylist()) == {row["episode_index"]}
        assert part.column("frame_index").to_pylist() == list(range(row["length"]))
        assert same_bits(floats(part, "timestamp"), times(episodes[row["episode_index"]]))
        assert CHOSEN[row["run"]][row["episode_index"] % 3] == row["episode_id"]
    info = json.loads((out / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (6, rows.num_rows, 10)
    assert {name: len(feature["names"] or [0]) for name, feature in info["features"].items()} == {
        name: feature["shape"][0] for name, feature in info["features"].items()
    }


def test_lerobot_begins_a_new_file_after_so_many_bytes(sources: list[Source], tmp_path: Path) -> None:
    one = written("lerobot", sources, tmp_path)
    folder = tmp_path / "small"
    folder.mkdir()
    lerobot.write(folder, NAME, selection.episodes(sources), file_bytes_n=4000)
    files = sorted((folder / "data").rglob("*.parquet"))
    assert len(files) > 2
    assert pa.concat_tables(map(pq.read_table, files)).equals(pq.read_table(one / "data"))
    known = sorted((folder / "meta" / "episodes").rglob("*.parquet"))
    assert len({pq.read_schema(file) for file in known}) == 1
    assert pq.read_schema(known[0]).field("waypoints_reached").type == pa.int32()
    for row in pq.read_table(folder / "meta" / "episodes").to_pylist():
        place = {key: row[f"data/{key}"] for key in ("chunk_index", "file_index")}
        info = json.loads((folder / "meta" / "info.json").read_text())
        file = pq.read_table(folder / info["data_path"].format(**place))
        assert row["episode_index"] in file.column("episode_index").to_pylist()


def test_rllib_has_the_transitions_with_the_last_state(sources: list[Source], tmp_path: Path) -> None:
    out, episodes = written("rllib", sources, tmp_path), originals(sources)
    rows = pa.concat_tables(pq.read_table(out / "data" / f"{name}.parquet") for name in CHOSEN)
    of_transitions(rows, "obs", "actions", "rewards", episodes)
    after = np.concatenate([floats(episode.frames, "observation")[1:] for episode in episodes])
    assert same_bits(floats(rows, "new_obs"), after)
    assert rows.column("truncateds").to_pylist() == ends(episodes)
    assert not any(rows.column("terminateds").to_pylist())
    assert list(dict.fromkeys(rows.column("eps_id").to_pylist())) == [
        f"{name}/{number}" for name, numbers in CHOSEN.items() for number in numbers
    ]


def test_minari_opens_every_state_bit_for_bit(sources: list[Source], tmp_path: Path) -> None:
    found = MinariDataset(written("minari", sources, tmp_path) / "data")
    episodes = originals(sources)
    assert (found.total_episodes, found.total_steps) == (6, len(ends(episodes)))
    for one, episode, known in zip(found, episodes, found.storage.get_episode_metadata(range(6)), strict=True):
        assert same_bits(one.observations, floats(episode.frames, "observation"))
        assert same_bits(one.actions, floats(episode.frames, "action"))
        assert same_bits(one.rewards, -floats(episode.frames, "cost")[1:])
        assert same_bits(one.infos["com_x_m"], floats(episode.frames, "com_x_m"))
        assert one.truncations.tolist() == ends([episode])
        assert not one.terminations.any()
        assert known["seed"] == episode.summary.column("seed")[0].as_py()
    assert [known["run"] for known in found.storage.get_episode_metadata(range(6))] == 3 * ["walk-0"] + 3 * ["walk-1"]


def test_minari_wants_a_name_with_a_version(sources: list[Source], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"NAME-v0.*'walks'"):
        dataset.write(FORMATS["minari"], tmp_path / "walks", ASKED, sources, lambda done, total: None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", FORMATS)
def test_every_dataset_says_where_its_episodes_come_from(form: str, sources: list[Source], tmp_path: Path) -> None:
    out = written(form, sources, tmp_path)
    rows = pq.read_table(out / "episodes.parquet")
    assert rows.column("episode_index").to_pylist() == list(range(6))
    assert rows.select(schema.EPISODES.names).equals(
        pa.concat_tables([episode.summary for episode in originals(sources)])
    )
    assert {path.name for path in (out / "provenance").iterdir()} == set(CHOSEN)
    assert (out / "provenance" / "walk-0" / "config.json").read_text() == "{}"
    card = (out / "README.md").read_text()
    facts = yaml.safe_load(card.split("---\n")[1])
    assert (facts["license"], facts["pretty_name"]) == ("cc-by-4.0", NAME)
    assert all(list(out.glob(config["data_files"])) for config in facts.get("configs", []))
    named = [*FORMATS[form].columns.names, *FORMATS[form].losses, *CHOSEN, "cost > 0", "t6gps 1.2.3", "run.seed"]
    assert not [words for words in named if words not in card]
    assert json.loads((out / FORMATS[form].statistics).read_text()).keys() <= set(FORMATS[form].columns.names)


@pytest.mark.parametrize("form", FORMATS)
def test_the_same_episodes_give_the_same_bytes(form: str, sources: list[Source], tmp_path: Path) -> None:
    def digests(folder: Path) -> dict[str, str]:
        files = [path for path in folder.rglob("*") if path.is_file()]
        return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}

    (tmp_path / "again").mkdir()
    assert digests(written(form, sources, tmp_path)) == digests(written(form, sources, tmp_path / "again"))


@pytest.mark.parametrize("form", FORMATS)
def test_a_dataset_is_written_whole_or_not_at_all(
    form: str, sources: list[Source], tmp_path: Path, full_disk: Callable[[], AbstractContextManager[None]]
) -> None:
    def stop(done: int, total: int) -> None:
        assert total == 6
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dataset.write(FORMATS[form], tmp_path / NAME, ASKED, sources, stop)
    with full_disk(), pytest.raises(ConfigError, match=f"cannot write {tmp_path / NAME}"):
        written(form, sources, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("make", [Path.mkdir, Path.touch, lambda path: path.symlink_to("nowhere")])
def test_what_exists_is_left_as_it_is(make: Callable[[Path], None], sources: list[Source], tmp_path: Path) -> None:
    make(tmp_path / NAME)
    with pytest.raises(ConfigError, match="exists already"):
        written("parquet", sources, tmp_path)
    with pytest.raises(ConfigError, match="cannot write"):
        written("parquet", sources, tmp_path / "absent")
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


def without_rows(frames: pa.Table) -> pa.Table:
    return frames.slice(0, 8)


def of_version_3(frames: pa.Table) -> pa.Table:
    short = pa.array(
        [row[: schema.SENSORS_N] for row in frames.column("observation").to_pylist()], pa.list_(pa.float32())
    )
    older = frames.set_column(frames.schema.get_field_index("observation"), "observation", short)
    return older.replace_schema_metadata({"t6gps_schema_version": "3"})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (without_rows, r"damaged.*episode 2: its 6 frames are not there"),
        (of_version_3, r"episode 0: .* observation must hold 83 numbers; it is of version 3 .*leave its run out"),
    ],
)
def test_frames_that_cannot_leave_are_refused_by_run_and_episode(
    change: Callable[[pa.Table], pa.Table], words: str, runs: list[Run], tmp_path: Path
) -> None:
    run = catalog.copy(runs[0], tmp_path / "runs", "damaged")
    file = run.tables / "frames" / "iteration-000000.parquet"
    size_n = file.stat().st_size
    pq.write_table(change(pq.read_table(file)), file)
    log = next((run.tables / "frames" / "_delta_log").glob("*1.json"))
    log.write_text(log.read_text().replace(f'"size":{size_n}', f'"size":{file.stat().st_size}'))
    with pytest.raises(DataError, match=words):
        written("parquet", [selection.source(run, [0, 2, 100], {"run": run.name}, {})], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_no_more_than_a_few_row_groups_are_in_memory(
    tmp_path: Path, make_episode: Callable[..., Episode], learn: Callable[..., Learned]
) -> None:
    run = catalog.create(tmp_path / "runs", "long", "{}")
    iterations.commit(run, 0, (make_episode(number, 0, steps=20) for number in range(80)), learn(0))
    source = selection.source(run, [number for number in range(80) if number != 7], {}, {})
    held, most_n, all_n = pa.total_allocated_bytes(), 0, 0
    for numbered in selection.episodes([source]):
        all_n += numbered.episode.frames.nbytes
        most_n = max(most_n, pa.total_allocated_bytes() - held)
    assert most_n < all_n / 3
