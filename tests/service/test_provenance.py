"""Laws of provenance: it names what made a file, so that the file can be made again."""

from __future__ import annotations

import platform
from datetime import UTC, datetime, timedelta
from importlib import metadata

from t6gps.service.provenance import provenance, versions


def test_provenance_is_of_this_process_and_of_now() -> None:
    origin = provenance()
    assert origin.commit and origin.cores >= 1
    age = datetime.now(UTC) - datetime.fromisoformat(origin.date)
    assert timedelta(0) <= age < timedelta(minutes=1)
    assert origin.versions == versions()


def test_versions_name_what_the_data_of_an_episode_depend_on() -> None:
    assert versions()["pybullet"] == metadata.version("pybullet")
    assert versions()["python"] == platform.python_version()
