"""The commands, the Python and the C of docs/policies.md work; its node of ROS 2 finds what it imports of ours."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command import t6gps
from tiny_run import Trained

from t6gps.service.policies import files
from t6gps.service.policies.driver import START, Measurement
from t6gps.storage import catalog

PAGE = (Path(__file__).parents[2] / "docs" / "policies.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.M | re.S)


@pytest.fixture(scope="module")
def folder(tiny: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the page's commands have written a policy in each format."""
    folder = tmp_path_factory.mktemp("page")
    catalog.copy(tiny.run, folder / "runs", "flat-quick")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        t6gps("policy", "export", "flat-quick", "--format", "onnx", "--out", "policy.onnx")
        for line in blocks("console")[0].splitlines():
            command = shlex.split(line, comments=True)[1:]
            if "--version" in command:
                command[command.index("--version") + 1] = "3"
            if "run" in command:
                command += ["--set", "run.steps=3", "--episodes", "2"]
            t6gps(*(argument.replace(".mp4", ".png") for argument in command))
    return folder


def test_the_commands_and_the_python_of_the_page_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert {"flat-quick-3.onnx", "policy.pt", "policy.h", "first.png"} <= {file.name for file in folder.iterdir()}
    monkeypatch.chdir(folder)
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(compile(block, "policies.md", "exec"), names)


def test_the_c_of_the_page_compiles_and_commands_the_cables(folder: Path) -> None:
    (source,) = blocks("c")
    (folder / "robot.c").write_text(source)
    (build,) = re.findall(r"^    (gcc .*)$", PAGE, re.M)
    subprocess.run([*shlex.split(build), "-Wall", "-Wextra", "-Werror"], cwd=folder, check=True)
    driver = files.opened(folder / "policy.h")
    nodes = np.random.default_rng(0).uniform(-1, 1, (12, 3))
    given = Measurement(nodes, np.zeros(3), np.zeros((6, 3)), np.full(24, 1.1), np.array([3.0, 0.0]))
    wanted, _ = driver.decide(given, START)
    text = " ".join(f"{value!r}" for value in nodes.ravel().tolist())
    done = subprocess.run(["./robot"], input=text, cwd=folder, capture_output=True, text=True, check=True)
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [pair for pair, _ in lines] == [f"{a}-{b}" for a, b in driver.description.cables]
    assert np.allclose([float(value) for _, value in lines], wanted, rtol=0, atol=1e-9)


def test_topics_of_the_node_are_those_of_the_table_and_names_that_ros_2_takes() -> None:
    (node,) = blocks("py")
    kinds = re.findall(r"\w+", " ".join(re.findall(r"^from \w+\.msg import (.*)$", node, re.M)))
    names: dict[str, object] = dict.fromkeys(kinds)
    exec("\n".join(line for line in node.splitlines() if re.match(r"(TOPICS|BARS) = ", line)), names)
    published = re.findall(r'create_publisher\(\w+, "([^"]+)"', node)
    topics = [*names["TOPICS"], *names["BARS"], *published]  # type: ignore[misc]
    written = re.findall(r"`(/\w[\w/]*)`", "".join(re.findall(r"^\| (`/[^|]*)\|", PAGE, re.M)))
    assert {*written} == {*topics} - {f"/bar_{bar}" for bar in range(1, 5)}, "the table has the first and the last bar"
    assert len({*topics}) == 5 + 6
    for topic in topics:  # rmw_validate_full_topic_name, and the rules for names that an application gives
        assert re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", topic), topic
        assert "__" not in topic, topic
        assert len(topic) <= 247, topic


def test_the_node_of_the_page_is_python_and_names_what_there_is() -> None:
    (node,) = blocks("py")
    compile(node, "policies.md", "exec")
    ours = [line for line in node.splitlines() if line.startswith("from t6gps")]
    assert len(ours) == 3
    exec("\n".join(ours), {})
