"""Laws of the page's files: they come from this server alone, need no token, and are what their licences say."""

from __future__ import annotations

import hashlib
import re
from html.parser import HTMLParser
from pathlib import Path

import httpx
import pytest
from loopback import listening

from t6gps.service.page import files
from t6gps.service.server import app

BYTES_MOST_N = 1_500_000
VENDOR = files.FOLDER / "vendor"
SERVED = sorted(path for path in files.FOLDER.rglob("*") if path.is_file() and path.suffix != ".md")
OWN = [path for path in SERVED if not path.is_relative_to(VENDOR)]
FOREIGN = re.compile(r"(?:https?:)?//[a-z0-9-]+\.[a-z]", re.IGNORECASE)
ROW = re.compile(r"^\| `([\w./]+)` \|.*\| `([0-9a-f]{64})` \|$", re.MULTILINE)
IMPORT = re.compile(r"""(?:from|import\()\s*"([^"]+)\"""")


def test_every_file_is_served_without_a_token_and_forbids_what_is_not_of_the_page(tmp_path: Path) -> None:
    with listening(app.create(tmp_path)) as url, httpx.Client(base_url=url, trust_env=False) as http:
        for path in ["/", *(f"/page/{path.relative_to(files.FOLDER).as_posix()}" for path in SERVED)]:
            answer = http.get(path)
            assert answer.status_code == 200, path
            policy = answer.headers["Content-Security-Policy"]
            assert "default-src 'none'" in policy
            assert "unsafe" not in policy
            assert "://" not in policy
            assert answer.headers["X-Content-Type-Options"] == "nosniff"
        style = http.get("/page/style.css")
        assert style.headers["Content-Type"].startswith("text/css")
        again = http.get("/page/style.css", headers={"If-None-Match": style.headers["ETag"]})
        assert (again.status_code, again.content) == (304, b"")
        for path in ("/page/", "/page/none.js", "/page/../files.py", "/page/%2e%2e/files.py", "/page/vendor/README.md"):
            assert http.get(path).status_code in (401, 404), path


def test_all_of_it_is_small() -> None:
    assert sum(path.stat().st_size for path in SERVED) <= BYTES_MOST_N


def test_libraries_are_those_that_are_named_with_their_licences() -> None:
    named = dict(ROW.findall((VENDOR / "README.md").read_text()))
    there = {path.relative_to(VENDOR).as_posix(): path for path in VENDOR.rglob("*") if path.suffix != ".md"}
    digests = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in there.items() if path.is_file()}
    assert digests == named
    assert {Path(name).parent for name in named} == {Path(name).parent for name in named if name.endswith("LICENSE")}


@pytest.mark.parametrize("path", OWN, ids=lambda path: path.name)
def test_a_file_names_no_other_server_and_no_file_that_is_not_there(path: Path) -> None:
    text = path.read_text().replace("http://www.w3.org/2000/svg", "")
    assert not FOREIGN.findall(text)
    for name in IMPORT.findall(text) if path.suffix == ".js" else ():
        assert (path.parent / name).resolve() in SERVED, name


def test_the_page_has_no_script_and_no_style_within() -> None:
    found: list[str] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            names = {name for name, _ in attrs}
            found.extend(name for name in names if name == "style" or name.startswith("on"))
            if tag == "style" or (tag == "script" and "src" not in names):
                found.append(tag)

    Reader().feed((files.FOLDER / "index.html").read_text())
    assert not found
