"""A browser, and a server of a root with finished runs, which all tests of the page share."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from datetime import UTC, datetime

import pytest
from loopback import PATIENT, Server, listening
from playwright.sync_api import Browser, Page, expect, sync_playwright
from tiny_run import Trained

from t6gps.service.remote.messages import Scope, TokenRequest
from t6gps.service.server import app, tokens
from t6gps.storage import catalog

CHROMIUM = shutil.which("chromium")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: it is in Debian's package chromium")
KEPT = "t6gps-token"
PATIENCE_MS = 180_000
SMALL = {"width": 1000, "height": 640}
"""Of the window: the processor draws it."""
Opened = Callable[..., Page]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a browser where there is none."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(needs_chromium)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Chromium without a window, which draws in three dimensions by the processor.

    While it is open, Playwright's event loop runs in the main thread, where other modules start loops of their own.
    """
    with sync_playwright() as driver:
        arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=arguments)
        expect.set_options(timeout=PATIENCE_MS)
        yield opened
        opened.close()


@pytest.fixture(scope="session")
def served(tiny: Trained, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server of the runs tiny-0 and tiny-1, which are alike, and `watched`, which tests change and remove."""
    root = tmp_path_factory.mktemp("page") / "runs"
    for name in ("tiny-0", "tiny-1", "watched"):
        shutil.copytree(tiny.run.path, root / name)
    now = datetime.now(UTC)
    requests = {scope: TokenRequest(name=scope.value, scope=scope, days=1.0) for scope in Scope}
    texts = {scope: tokens.issue(root, asked, now).token for scope, asked in requests.items()}
    server = Server("", catalog.open_run(root, "watched"), texts)
    application = app.create(root, start=server.launch, now=server.now, limits=PATIENT)
    with listening(application) as server.url:
        yield server


@pytest.fixture
def visit(browser: Browser, served: Server) -> Iterator[Opened]:
    """visit("#/query", scope, **options) opens the page in a tab of its own; nothing may go wrong in it unsaid."""
    wrong: list[str] = []
    contexts = []

    def opened(address: str = "", scope: Scope | None = Scope.OPERATE, script: str = "", **options: object) -> Page:
        context = browser.new_context(**{"viewport": SMALL, **options})  # type: ignore[arg-type]
        contexts.append(context)
        if scope is not None:
            context.add_init_script(
                f"sessionStorage.getItem('{KEPT}') ?? sessionStorage.setItem('{KEPT}', '{served.tokens[scope]}')"
            )
        if script:
            context.add_init_script(script)
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda said: wrong.append(said.text) if "Content Security Policy" in said.text else None)
        page.on(
            "request",
            lambda asked: None if asked.url.startswith(("http://127.0.0.1:", "blob:")) else wrong.append(asked.url),
        )
        page.goto(f"{served.url}/{address}")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert not wrong
