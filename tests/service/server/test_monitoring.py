"""Laws of `/metrics` over HTTP: who may ask, the text format, and that Prometheus itself understands it."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
import yaml
from loopback import Server

from t6gps.service.remote.messages import Scope

PROMETHEUS = shutil.which("prometheus")
SHIPPED = Path(__file__).parents[3] / "deploy" / "prometheus"


def test_metrics_are_told_in_the_text_format_to_who_may_read(server: Server) -> None:
    with server.http(Scope.READ) as http:
        answer = http.get("/metrics")
    assert answer.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
    assert 't6gps_iterations_total{run="walk"} 2.0' in answer.text
    assert "process_resident_memory_bytes" in answer.text
    with server.http() as http:
        assert http.get("/metrics").status_code == 401


@contextmanager
def scraping(server: Server, folder: Path) -> Iterator[str]:
    """A Prometheus with the shipped configuration and rules, led to a server on this machine; its address."""
    assert PROMETHEUS is not None
    shutil.copytree(SHIPPED, folder)
    (folder / "token").write_text(server.tokens[Scope.READ] + "\n")
    config = yaml.safe_load((folder / "prometheus.yml").read_text())
    config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
    job = config["scrape_configs"][0]
    del job["tls_config"]
    job |= {"scheme": "http", "static_configs": [{"targets": [server.url.removeprefix("http://")]}]}
    (folder / "prometheus.yml").write_text(yaml.safe_dump(config))
    options = {"config.file": folder / "prometheus.yml", "storage.tsdb.path": folder / "data"}
    options |= {"web.listen-address": "127.0.0.1:0"}
    command = [PROMETHEUS, *(f"--{name}={value}" for name, value in options.items())]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        said = ""
        for line in process.stderr:
            said += line
            if found := re.search(r'msg="Listening on" address=(\S+)', line):
                yield f"http://{found[1]}"
                return
        raise AssertionError(said)
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.skipif(PROMETHEUS is None, reason="no prometheus here: it is in Debian's package prometheus")
def test_prometheus_scrapes_a_server_with_the_shipped_configuration_and_evaluates_its_rules(
    server: Server, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    def ask(path: str, **parameters: str) -> dict:
        return prometheus.get(f"/api/v1/{path}", params=parameters).json()["data"]

    def newest(query: str) -> str | None:
        """Of the newest scrape; None where that has not come, or has taken too long."""
        found = ask("query", query=query)["result"]
        return found[0]["value"][1] if found else None

    with scraping(server, tmp_path / "prometheus") as url, httpx.Client(base_url=url, trust_env=False) as prometheus:
        wait_until(lambda: newest('t6gps_iterations_total{run="walk"}') == "2", 240)
        rules = [rule for group in ask("rules")["groups"] for rule in group["rules"]]
        assert len(rules) > 5
        wait_until(lambda: {r["health"] for g in ask("rules")["groups"] for r in g["rules"]} == {"ok"}, 240)
        wait_until(lambda: newest('up{job="t6gps"}') == "1", 240)
