"""Laws of `t6gps serve`: where it listens, how it ends, and what one error says when it cannot."""

from __future__ import annotations

import os
import re
import select
import signal
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from command import t6gps
from loopback import Server

from t6gps.service import config as configuration
from t6gps.service.remote.messages import Scope
from t6gps.service.server import patience
from t6gps.storage import catalog


@contextmanager
def serving(root: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The command in a process of its own, and its address."""
    command = [sys.executable, "-m", "t6gps", "serve", "--root", str(root), "--port", "0", *options]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stderr is not None
    try:
        ready, _, _ = select.select([process.stderr], [], [], 120)
        assert ready, "it says nothing"
        line = process.stderr.readline()
        found = re.search(r"at (https?://\S+)", line)
        assert found, line + process.stderr.read()
        yield process, found[1]
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_it_serves_without_a_run_and_ends_quietly_when_it_is_told_to(tmp_path: Path) -> None:
    token = t6gps("token", "create", "me", "--root", tmp_path).stdout.decode().strip()
    with serving(tmp_path) as (process, url):
        assert httpx.get(f"{url}/v1/health", trust_env=False).json().keys() == {"version"}
        headers = {"Authorization": f"Bearer {token}"}
        assert httpx.get(f"{url}/v1/runs", headers=headers, trust_env=False).json() == []
        t6gps("token", "revoke", "me", "--root", tmp_path)
        assert httpx.get(f"{url}/v1/runs", headers=headers, trust_env=False).status_code == 401
        os.kill(process.pid, signal.SIGTERM)
        _, last = process.communicate(timeout=240)
    assert process.returncode == 0
    assert "ended" in last
    assert "Traceback" not in last


@pytest.mark.slow
@pytest.mark.parametrize(
    "sent", [b"", b"GET /v1/health HT", b"GET /v1/health HTTP/1.1\r\nHost: localhost\r\n\r\nGET /"]
)
def test_a_connection_whose_request_does_not_come_is_closed(tmp_path: Path, sent: bytes) -> None:
    with serving(tmp_path) as (_, url):
        found = urlsplit(url)
        with socket.create_connection((found.hostname, found.port), timeout=patience.HEAD_S + 30) as silent:
            silent.sendall(sent)
            answered = b""
            while more := silent.recv(65536):
                answered += more
    assert (b"200 OK" in answered) == (b"Host" in sent)


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate for localhost, and its key."""
    cert, key = (tmp_path_factory.mktemp("tls") / name for name in ("cert.pem", "key.pem"))
    subject = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"]
    made = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", *subject]
    subprocess.run([*made, "-days", "2", "-keyout", str(key), "-out", str(cert)], check=True, capture_output=True)
    return cert, key


@pytest.mark.slow
def test_any_other_address_is_served_over_tls(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    cert, key = certificate
    options = ["--host", "0.0.0.0", "--name", "localhost", "--tls-cert", str(cert), "--tls-key", str(key)]
    with serving(tmp_path, *options) as (_, url):
        port = int(url.rpartition(":")[2])
        trusted = ssl.create_default_context(cafile=str(cert))
        with httpx.Client(verify=trusted, trust_env=False) as http:
            assert http.get(f"https://localhost:{port}/v1/health").status_code == 200
            assert http.get(f"https://127.0.0.1:{port}/v1/health").status_code == 400, "it has no such name"
        with pytest.raises(httpx.HTTPError):
            httpx.get(f"http://localhost:{port}/v1/health", trust_env=False)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--host", "0.0.0.0"], "--tls-cert"),
        (["--host", "::"], "--tls-cert"),
        (["--host", "203.0.113.1"], "--tls-cert"),
        (["--tls-cert", "cert.pem"], "both"),
        (["--tls-cert", "none.pem", "--tls-key", "none.pem"], "PEM"),
        (["--host", "no.such.name.invalid"], "--tls-cert"),
        (["--root", "runs%"], "'%'"),
    ],
)
def test_an_address_that_cannot_be_served_is_one_error_with_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert words in t6gps("serve", *options, code=2).stderr


def test_a_port_in_use_is_one_error_with_its_remedy(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        refused = t6gps("serve", "--root", tmp_path, "--port", port, code=2).stderr
    assert port in refused
    assert "choose another --port" in refused


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["me", "--scope", "root"], "read"),
        (["me", "--days", "0"], "days"),
        (["me", "--days", "nan"], "days"),
        (["me", "--days", "1e9"], "366"),
        (["../me"], "name"),
    ],
)
def test_a_token_that_cannot_be_is_one_error(tmp_path: Path, options: list[str], words: str) -> None:
    assert words in t6gps("token", "create", *options, "--root", tmp_path, code=2).stderr
    assert not (tmp_path / ".server" / "tokens.json").exists()


def test_tokens_are_listed_without_their_secrets_and_revoked_by_name(tmp_path: Path) -> None:
    text = t6gps("token", "create", "me", "--scope", "admin", "--root", tmp_path).stdout.decode().strip()
    listed = t6gps("token", "list", "--json", "--root", tmp_path).stdout.decode()
    assert '"admin"' in listed
    assert text.rpartition("_")[2] not in listed
    t6gps("token", "revoke", "me", "--root", tmp_path)
    assert "no token 'me'" in t6gps("token", "revoke", "me", "--root", tmp_path, code=2).stderr


@pytest.mark.parametrize(
    ("url", "token", "words"),
    [
        ("http://gps.example.org:8686", "t", "in the clear"),
        ("ftp://127.0.0.1", "t", "no address of a server"),
        ("nonsense", "t", "no address of a server"),
        ("http://127.0.0.1:1", "t", "cannot be reached"),
        ("http://127.0.0.1:1", "", "T6GPS_TOKEN"),
        ("http://127.0.0.1:1", "a\nb", "T6GPS_TOKEN"),
    ],
)
def test_a_server_that_cannot_be_asked_is_one_error(
    monkeypatch: pytest.MonkeyPatch, url: str, token: str, words: str
) -> None:
    monkeypatch.setenv("T6GPS_TOKEN", token)
    assert words in t6gps("runs", "--server", url, code=2).stderr


def test_a_token_of_another_server_is_one_error(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("T6GPS_TOKEN", "t6gps_nothing")
    assert "t6gps token create" in t6gps("runs", "--server", server.url, code=2).stderr


def test_a_server_is_told_to_train_with_the_settings_of_the_command(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("T6GPS_TOKEN", server.tokens[Scope.OPERATE])
    settings = ["--set", "run.iterations=2", "--set=task.directions=36", "--workers", "3"]
    said = t6gps("train", "flat-quick", "--run", "far", *settings, "--server", server.url).stdout.decode()
    assert "far" in said
    config = configuration.kept(catalog.open_run(server.root, "far"))
    assert (config.run.iterations, config.run.workers, config.task.directions) == (2, 3, 36)
    t6gps("train", "flat-quick", "--run", "walk", "--resume", "--server", server.url)
    changed = ["train", "flat-quick", "--run", "walk", "--resume", "--set", "run.seed=9", "--server", server.url]
    assert "run.seed = 9 (the run has 0)" in t6gps(*changed, code=2).stderr
    assert server.launched == ["far", "walk"]
    mine = tmp_path / "mine.toml"
    mine.write_text(configuration.load("rough", ["run.seed=5"]).to_toml())
    t6gps("train", mine, "--set", "run.iterations=2", "--server", server.url)
    t6gps("train", mine, "--server", server.url)
    assert catalog.exists(server.root, "mine-2")
    sent = configuration.kept(catalog.open_run(server.root, "mine"))
    assert sent == configuration.load("rough", ["run.seed=5", "run.iterations=2"])
    for refused, words in ((["flat-quick", "--serial"], "--serial"), (["none.toml"], "cannot read")):
        assert words in t6gps("train", *refused, "--server", server.url, code=2).stderr
