"""Laws of `t6gps figures`: it draws, from noise-free episodes of the paper's length, which it makes once."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyarrow.compute as pc
import pytest
from command import Done, t6gps
from PIL import Image
from tiny_run import Trained

from t6gps.service.cli.data.figures import EPISODES_N, STEPS_N
from t6gps.service.views.paper import drawing
from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run


@pytest.fixture(scope="module")
def drawn(tiny: Trained, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path, Done]:
    """A run that had no episode long enough, the folder of its figures, and what the command said."""
    root = tmp_path_factory.mktemp("figures")
    run, out = catalog.copy(tiny.run, root, "tiny"), root / "new" / "pictures"
    return run, out, t6gps("figures", "tiny", "--root", root, "--out", out)


def test_every_figure_is_a_picture_with_something_in_it(drawn: tuple[Run, Path, Done]) -> None:
    _, out, done = drawn
    printed = [Path(line) for line in done.stdout.decode().split()]
    assert sorted(printed) == sorted(out.iterdir())
    assert {path.stem for path in printed} == drawing.FIGURES.keys()
    for path in printed:
        if path.suffix == ".png":
            picture = np.asarray(Image.open(path).convert("L"))
            assert picture.shape[1] >= 600 and (picture < 128).mean() > 0.002, path
        else:
            assert ElementTree.parse(path).getroot().tag.endswith("svg"), path


def test_the_episodes_are_made_once_and_kept(drawn: tuple[Run, Path, Done]) -> None:
    run, _, done = drawn
    assert "are made now" in done.stderr
    refused = t6gps("figures", "tiny", "--root", run.path.parent, "--out", run.config_path, code=2)
    assert "made" not in refused.stderr
    row = tables.read(run, "evaluations").to_pylist()[-1]
    episodes = tables.read(run, "evaluation_episodes", filter=pc.field("evaluation_id") == 1)
    assert (row["evaluation_id"], row["purpose"], row["episodes"]) == (1, "eval", EPISODES_N)
    assert episodes["steps"].to_pylist() == [STEPS_N] * EPISODES_N
    assert episodes["noise_std_m"].to_pylist() == [0.0] * EPISODES_N


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--evaluation", "7"], ["keeps no evaluation 7", "kept: 0"]),
        (["--evaluation", "0", "--episode", "9"], ["no episode 9", "0 .. 1"]),
    ],
)
def test_a_refusal_writes_nothing(tiny: Trained, tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    root = tiny.run.path.parent
    done = t6gps("figures", "tiny", *arguments, "--root", root, "--out", tmp_path / "out", code=2)
    assert done.stderr.startswith("error: ")
    assert all(word in done.stderr for word in words), done.stderr
    assert not list(tmp_path.iterdir())


def test_a_run_without_an_iteration_has_nothing_to_draw(tiny: Trained, tmp_path: Path) -> None:
    catalog.create(tmp_path, "new", tiny.config.to_json())
    done = t6gps("figures", "new", "--root", tmp_path, code=2)
    assert done.stderr == "error: run new has no iteration to draw yet; let it finish one\n"
