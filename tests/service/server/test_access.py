"""Laws of who may ask what: tokens, scopes, expiry, names, origins, sizes, rates, and the audit of changes."""

from __future__ import annotations

import hmac
import json
import stat
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest
from loopback import Server

from t6gps.service.remote.messages import Scope, TokenRequest
from t6gps.service.server import app, tokens
from t6gps.service.server.guard import OPEN, Limits
from t6gps.service.server.rates import Rates
from t6gps.storage.errors import ServerError

NOW = datetime(2026, 1, 1, tzinfo=UTC)
NEEDS = {
    ("GET", "/metrics"): Scope.READ,
    ("GET", "/v1/runs"): Scope.READ,
    ("GET", "/v1/runs/{name}/status"): Scope.READ,
    ("GET", "/v1/runs/{name}/metrics"): Scope.READ,
    ("GET", "/v1/runs/{name}/evaluation"): Scope.READ,
    ("GET", "/v1/runs/{name}/figures"): Scope.READ,
    ("GET", "/v1/runs/{name}/figures/{figure}"): Scope.READ,
    ("GET", "/v1/runs/{name}/policies"): Scope.READ,
    ("GET", "/v1/runs/{name}/policies/{version}"): Scope.READ,
    ("POST", "/v1/query"): Scope.READ,
    ("GET", "/v1/runs/{name}/events"): Scope.READ,
    ("GET", "/v1/runs/{name}/standing"): Scope.READ,
    ("GET", "/v1/runs/{name}/logs"): Scope.READ,
    ("GET", "/v1/runs/{name}/history"): Scope.READ,
    ("GET", "/v1/runs/{name}/episodes/{number}"): Scope.READ,
    ("GET", "/v1/runs/{name}/replay"): Scope.READ,
    ("GET", "/v1/runs/{name}/files"): Scope.READ,
    ("GET", "/v1/runs/{name}/file"): Scope.READ,
    ("GET", "/v1/jobs"): Scope.READ,
    ("POST", "/v1/runs"): Scope.OPERATE,
    ("POST", "/v1/runs/{name}/scale"): Scope.OPERATE,
    ("POST", "/v1/runs/{name}/pause"): Scope.OPERATE,
    ("POST", "/v1/runs/{name}/unpause"): Scope.OPERATE,
    ("POST", "/v1/runs/{name}/resume"): Scope.OPERATE,
    ("POST", "/v1/runs/{name}/stop"): Scope.OPERATE,
    ("POST", "/v1/drives"): Scope.OPERATE,
    ("POST", "/v1/drives/{drive}"): Scope.OPERATE,
    ("DELETE", "/v1/drives/{drive}"): Scope.OPERATE,
    ("GET", "/v1/drives/{drive}/frames"): Scope.READ,
    ("GET", "/v1/tokens"): Scope.ADMIN,
    ("POST", "/v1/tokens"): Scope.ADMIN,
    ("DELETE", "/v1/tokens/{token}"): Scope.ADMIN,
    ("GET", "/v1/audit"): Scope.ADMIN,
}
"""The scope of every route that the server has."""
REFUSED = (401, 403)


def status_of(http: httpx.Client, method: str, path: str) -> int:
    """The status of a request for a run that does not exist, so that nothing changes."""
    with http.stream(
        method, path.format(name="none", figure="none.png", version=0, number=0, token="none", drive="none")
    ) as answer:
        return answer.status_code


def test_every_route_stands_in_the_table_of_scopes(tmp_path: Path) -> None:
    document = app.create(tmp_path).openapi()["paths"]
    routes = {(method.upper(), path) for path, methods in document.items() for method in methods}
    assert routes == NEEDS.keys() | {("GET", path) for path in OPEN if path in document}


def test_a_scope_opens_its_routes_and_those_of_lower_scopes_alone(server: Server) -> None:
    for scope in (None, *Scope):
        with server.http(scope) as http:
            for (method, path), needed in NEEDS.items():
                allowed = scope is not None and scope.includes(needed)
                status = status_of(http, method, path)
                assert (status not in REFUSED) == allowed, (scope, method, path, status)
                assert allowed or status == (401 if scope is None else 403)
            assert http.get("/v1/health").status_code == 200


def test_an_expired_or_revoked_token_opens_nothing(server: Server) -> None:
    with server.http(Scope.READ) as http, server.client(Scope.ADMIN) as admin:
        assert http.get("/v1/runs").status_code == 200
        admin.admin.revoke_token("read")
        assert http.get("/v1/runs").status_code == 401
    server.later = timedelta(days=2)
    with server.http(Scope.ADMIN) as http:
        answer = http.get("/v1/runs")
    assert answer.status_code == 401
    assert "expired" in answer.json()["error"]
    assert answer.headers["WWW-Authenticate"] == "Bearer"


def test_tokens_are_kept_as_hashes_for_their_owner_alone(tmp_path: Path) -> None:
    issued = tokens.issue(tmp_path, TokenRequest(name="a", scope=Scope.READ, days=1.0), NOW)
    secret = issued.token.rpartition("_")[2]
    kept = [path for path in (tmp_path / ".server").rglob("*") if path.is_file()]
    assert all(secret.encode() not in path.read_bytes() for path in kept)
    assert stat.S_IMODE((tmp_path / ".server" / "tokens.json").stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / ".server").stat().st_mode) == 0o700
    assert tokens.Verifier(tmp_path).verify(issued.token, NOW).name == "a"


def test_tokens_that_others_may_read_are_refused(tmp_path: Path) -> None:
    issued = tokens.issue(tmp_path, TokenRequest(name="a", scope=Scope.READ, days=1.0), NOW)
    (tmp_path / ".server" / "tokens.json").chmod(0o644)
    with pytest.raises(ServerError, match="chmod 600"):
        tokens.Verifier(tmp_path).verify(issued.token, NOW)


@pytest.mark.parametrize(
    "damage", [lambda t: t[:-1], lambda t: t + "a", lambda t: t[:-1] + "!", lambda t: "", str.upper]
)
def test_another_text_is_no_token(tmp_path: Path, damage: Callable[[str], str]) -> None:
    issued = tokens.issue(tmp_path, TokenRequest(name="a", scope=Scope.READ, days=1.0), NOW)
    with pytest.raises(ServerError, match="not known"):
        tokens.Verifier(tmp_path).verify(damage(issued.token), NOW)


def test_known_and_unknown_tokens_are_compared_in_constant_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    issued = tokens.issue(tmp_path, TokenRequest(name="a", scope=Scope.READ, days=1.0), NOW)
    compared: list[int] = []
    original = hmac.compare_digest
    monkeypatch.setattr(hmac, "compare_digest", lambda a, b: compared.append(len(a)) or original(a, b))
    verifier = tokens.Verifier(tmp_path)
    verifier.verify(issued.token, NOW)
    for text in (issued.token.replace(issued.token[6:22], "0" * 16), issued.token[:-1] + "A", "nothing"):
        if text != issued.token:
            with pytest.raises(ServerError):
                verifier.verify(text, NOW)
    assert len(set(compared)) == 1
    assert len(compared) >= 3


def test_a_name_has_one_token_until_it_expires(tmp_path: Path) -> None:
    request = TokenRequest(name="a", scope=Scope.READ, days=1.0)
    first = tokens.issue(tmp_path, request, NOW)
    with pytest.raises(ServerError, match="already"):
        tokens.issue(tmp_path, request, NOW)
    second = tokens.issue(tmp_path, request, NOW + timedelta(days=1))
    assert second.token != first.token
    assert len(tokens.listed(tmp_path)) == 1
    with pytest.raises(ServerError, match="tokens: a"):
        tokens.revoke(tmp_path, "b")


def test_tokens_that_cannot_be_read_open_nothing_and_the_answer_does_not_say_where_they_are(server: Server) -> None:
    path = server.root / ".server" / "tokens.json"
    path.write_text("{")
    with server.http(Scope.ADMIN) as http:
        answer = http.get("/v1/runs")
    assert answer.status_code == 503
    assert str(path) not in answer.text


@pytest.mark.parametrize("host", ["evil.example", "", "127.0.0.1.evil.example", "[::2]:80"])
def test_another_name_than_the_servers_is_refused(server: Server, host: str) -> None:
    with server.http(Scope.READ) as http:
        assert http.get("/v1/health", headers={"Host": host}).status_code == 400
        assert http.get("/v1/runs", headers={"Host": "localhost:80"}).status_code == 200


def test_pages_of_other_servers_are_refused(server: Server) -> None:
    with server.http(Scope.READ) as http:
        assert http.get("/v1/runs", headers={"Origin": "https://evil.example"}).status_code == 403
        assert http.get("/v1/runs", headers={"Origin": "null"}).status_code == 403
        assert http.get("/v1/runs", headers={"Origin": server.url}).status_code == 200


def test_a_body_that_is_too_large_is_refused_whether_its_size_is_said_or_not(serve: Callable[..., Server]) -> None:
    server = serve(Limits(body_bytes_n=1000))
    with server.http(Scope.READ) as http:
        said = http.post("/v1/query", json={"runs": "walk", "sql": "-" * 2000})
        unsaid = http.post("/v1/query", content=(b" " * 300 for _ in range(10)))
        small = http.post("/v1/query", json={"runs": "walk", "sql": "SELECT 1"})
    assert (said.status_code, unsaid.status_code, small.status_code) == (413, 413, 200)


def test_who_asks_too_often_is_told_when_to_ask_again(serve: Callable[..., Server]) -> None:
    server = serve(Limits(requests=(0.001, 3), failures=(0.001, 2)))
    with server.http(Scope.READ) as http:
        statuses = [http.get("/v1/runs").status_code for _ in range(5)]
        assert statuses == [200, 200, 200, 429, 429]
        assert int(http.get("/v1/runs").headers["Retry-After"]) > 1
    with server.http() as http:
        assert [http.get("/v1/runs").status_code for _ in range(4)] == [401, 401, 429, 429]
    with server.http(Scope.OPERATE) as http:
        assert http.get("/v1/runs").status_code == 200, "others are not held up"


def test_a_bucket_fills_with_time_and_memory_is_bounded() -> None:
    rates = Rates(2.0, 3, most_n=10)
    assert [rates.take("a", 0.0) for _ in range(4)] == [0, 0, 0, 1]
    assert [rates.take("a", 0.5), rates.take("a", 0.5)] == [0, 1]
    for number in range(100):
        rates.take(f"other {number}", 0.6)
    assert rates.take("a", 0.6) == 0, "the oldest are forgotten"


def test_each_change_has_a_line_in_the_audit_made_or_refused_and_reading_has_none(server: Server) -> None:
    with (
        server.client(Scope.READ) as reader,
        server.client(Scope.OPERATE) as operator,
        server.client(Scope.ADMIN) as admin,
    ):
        reader.runs()
        reader.query("walk", "SELECT 1")
        operator.start("flat-quick", "new", {"run.iterations": 2})
        for refused in (lambda: reader.pause("walk"), lambda: operator.stop("walk"), lambda: operator.pause("none")):
            with pytest.raises(Exception, match=r"scope|not running|no run"):
                refused()
        issued = admin.admin.create_token("short", Scope.READ, 0.5)
        lines = admin.admin.audit()
    assert [(line.token, line.method, line.path, line.status) for line in lines] == [
        ("operate", "POST", "/v1/runs", 202),
        ("read", "POST", "/v1/runs/walk/pause", 403),
        ("operate", "POST", "/v1/runs/walk/stop", 409),
        ("operate", "POST", "/v1/runs/none/pause", 404),
        ("admin", "POST", "/v1/tokens", 201),
    ]
    assert lines[0].details["settings"] == {"run.iterations": 2}
    assert issued.token not in (server.root / ".server" / "audit.jsonl").read_text()


def test_nothing_changes_that_cannot_be_noted(server: Server) -> None:
    (server.root / ".server" / "audit.jsonl").mkdir()
    with server.http(Scope.OPERATE) as http:
        answer = http.post("/v1/runs", json={"preset": "flat-quick", "name": "new"})
    assert answer.status_code == 503
    assert not server.launched
    assert not (server.root / "new").exists()
    assert "Traceback" not in json.dumps(answer.json())
