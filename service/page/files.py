"""The page's files as routes: `/`, and everything else below `/page/`.

They are the same for everybody and say nothing of any run, so that they need no token; what the page asks for does.
The browser is told to load nothing from elsewhere, and to run no script that is not a file of the page.
"""

from __future__ import annotations

import hashlib
from http import HTTPStatus
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, NamedTuple

from fastapi import APIRouter, Header, HTTPException
from fastapi.responses import Response

FOLDER = Path(__file__).parent / "static"
PREFIX = "/page/"
Known = Annotated[str | None, Header()]
MEDIA = MappingProxyType(
    {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml", "": "text/plain"}
)
"""Kinds of the files that are served."""
HEADERS = MappingProxyType(
    {
        "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-cache",  # ask whether there is a newer one; a server may be of another version tomorrow
    }
)


def is_of_page(path: str) -> bool:
    """True for paths of the page."""
    return path == "/" or path.startswith(PREFIX)


class _File(NamedTuple):
    """A file, read once, so that all of them are of one version."""

    content: bytes
    kind: str
    tag: str


def routes() -> APIRouter:
    """The routes of the page."""
    router = APIRouter(include_in_schema=False)
    files = {path.relative_to(FOLDER).as_posix(): _read(path) for path in FOLDER.rglob("*") if _is_served(path)}

    @router.get("/")
    def page(if_none_match: Known = None) -> Response:
        """The page."""
        return _answer(files["index.html"], if_none_match)

    @router.get(PREFIX + "{name:path}")
    def file(name: str, if_none_match: Known = None) -> Response:
        """One of its files."""
        if name not in files:
            raise HTTPException(HTTPStatus.NOT_FOUND, f"the page has no file {name[:100]!r}; open / instead")
        return _answer(files[name], if_none_match)

    return router


def _is_served(path: Path) -> bool:
    return path.is_file() and path.suffix in MEDIA


def _read(path: Path) -> _File:
    content = path.read_bytes()
    return _File(content, MEDIA[path.suffix], f'"{hashlib.sha256(content).hexdigest()[:32]}"')


def _answer(file: _File, known: str | None) -> Response:
    """A file, or only that it is what the browser has already."""
    headers = {**HEADERS, "ETag": file.tag}
    if known == file.tag:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    return Response(file.content, media_type=file.kind, headers=headers)
