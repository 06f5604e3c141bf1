"""Laws of the package: what an installed wheel holds is what the repository holds."""

import os
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
SETUPTOOLS = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from the files that git tracks or would track, without network."""
    folder = tmp_path_factory.mktemp("wheel")
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=REPOSITORY, capture_output=True, check=True).stdout.decode().split("\0"):
        source = REPOSITORY / name
        if name and source.is_file():
            copy = folder / "source" / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(source.read_bytes())
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    done = subprocess.run([*build, str(folder / "source")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(folder.glob("*.whl"))


def folder_of(package: str) -> Path:
    """Where a package lies in the repository."""
    mapped = SETUPTOOLS["package-dir"]
    if package in mapped:
        return REPOSITORY / mapped[package]
    parent, _, name = package.rpartition(".")
    return folder_of(parent) / name


def test_every_folder_with_modules_is_listed_as_a_package() -> None:
    rooms = SETUPTOOLS["package-dir"].values()
    folders = {path.parent for room in rooms for path in (REPOSITORY / room).rglob("*.py")}
    assert {folder_of(package) for package in SETUPTOOLS["packages"]} == folders


def test_the_package_has_a_room_for_each_folder_and_its_own_modules_lie_in_deploy() -> None:
    mapped = dict(SETUPTOOLS["package-dir"])
    assert mapped.pop("t6gps") == "deploy/t6gps"
    assert mapped == {f"t6gps.{room}": room for room in mapped.values()}


@pytest.mark.slow
def test_the_wheel_holds_every_module_preset_script_and_the_plugin(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for package in SETUPTOOLS["packages"]:
        for module in folder_of(package).glob("*.py"):
            assert f"{package.replace('.', '/')}/{module.name}" in names
    for preset in (REPOSITORY / "deploy" / "presets").glob("*.toml"):
        assert f"t6gps/deploy/presets/{preset.name}" in names
    shipped = ("launch/train.sh", "ray/cluster.yaml", "slurm/train.sbatch", "k8s/start.sh", "grafana/t6gps.json")
    for script in (*shipped, "prometheus/prometheus.yml", "prometheus/alerts.yml"):
        assert f"t6gps/deploy/{script}" in names
    assert "t6gps/service/policies/policy.h" in names
    for module in SETUPTOOLS["ext-modules"]:
        assert f"{module['name'].replace('.', '/')}{sysconfig.get_config_var('EXT_SUFFIX')}" in names
    assert all(name.startswith(("t6gps/", "t6gps-")) for name in names)


@pytest.mark.slow
def test_the_wheel_is_typed_compiled_modules_included(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assert "t6gps/py.typed" in names
    for room in ("storage", "workers", "learner", "service"):
        assert f"t6gps/{room}/py.typed" in names
        for stub in (REPOSITORY / room).rglob("*.pyi"):
            assert f"t6gps/{stub.relative_to(REPOSITORY)}" in names
    for module in SETUPTOOLS["ext-modules"]:
        stub_name = f"{module['name'].replace('.', '/')}.pyi"
        is_imported = b"PyInit_" in b"".join((REPOSITORY / source).read_bytes() for source in module["sources"])
        assert (stub_name in names) == is_imported


@pytest.mark.slow
def test_an_installed_wheel_runs_without_the_repository(wheel: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    # Without site (-S) the editable installation of this environment is not found; its dependencies still are.
    dependencies = [entry for entry in sys.path if Path(entry).name == "site-packages"]
    path = os.pathsep.join([str(tmp_path / "site"), *dependencies])
    arguments = ["--root", str(tmp_path / "runs"), "--serial", "--set=run.episodes=2", "--set=run.iterations=1"]
    done = subprocess.run(
        [sys.executable, "-S", "-m", "t6gps", "train", "flat-quick", *arguments, "--set=run.steps=20"],
        env={**os.environ, "PYTHONPATH": path},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Noise-free policy" in done.stdout
