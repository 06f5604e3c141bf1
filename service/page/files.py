"""The page's files as routes: `/`, and everything else below `/page/`.

They are the same for everybody and say nothing of any run, so that they need no token; what the page asks for does.
The browser is told to load nothing from elsewhere, and to run no script that is not a file of the page.
"""

from __future__ import annotations

from http import HTTPStatus
from pathlib import Path
from types import MappingProxyType

from fastapi import APIRouter, HTTPException
from fastapi.responses import FileResponse, Response

FOLDER = Path(__file__).parent / "static"
PREFIX = "/page/"
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


def routes() -> APIRouter:
    """The routes of the page."""
    router = APIRouter(include_in_schema=False)
    files = {path.relative_to(FOLDER).as_posix(): path for path in FOLDER.rglob("*") if path.suffix in MEDIA}

    @router.get("/")
    def page() -> Response:
        """The page."""
        return _answer(files["index.html"])

    @router.get(PREFIX + "{name:path}")
    def file(name: str) -> Response:
        """One of its files."""
        if name not in files or not files[name].is_file():
            raise HTTPException(HTTPStatus.NOT_FOUND, f"the page has no file {name[:100]!r}; open / instead")
        return _answer(files[name])

    return router


def _answer(path: Path) -> Response:
    return FileResponse(path, media_type=MEDIA[path.suffix], headers=dict(HEADERS))
