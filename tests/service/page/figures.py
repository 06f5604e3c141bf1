"""How fast the page is, on an idle machine: `python tests/service/page/figures.py RUN [ROOT]` prints what
docs/figures/page.json holds.

first paint (ms)    the median of new tabs, each without a cache
size (kB)           all answers to the first tab
frames a second     of a replay that plays; script and main thread (ms) are the page's own share of a frame

A browser without a GPU draws three dimensions by the processor, which then bounds the frames.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import statistics
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from t6gps.service import provenance

SIZES = ({"width": 1000, "height": 640}, {"width": 1400, "height": 900})
TABS_N, PLAYED_S = 5, 5
COLUMNS = ("view", "first paint (ms)", "size (kB)", "frames a second", "script (ms)", "main thread (ms)")
FLAT = """
const context = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : context.call(this, kind, ...rest);
};
"""
FRAMES = """(ms) => new Promise((done) => {
  const begun = performance.now();
  let frames = 0;
  const tick = () => (frames++, performance.now() - begun < ms ? requestAnimationFrame(tick) : done(frames));
  requestAnimationFrame(tick);
})"""
PAINTED = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime"
TAKEN = """() => [...performance.getEntriesByType("resource"), ...performance.getEntriesByType("navigation")]
  .reduce((sum, one) => sum + one.transferSize, 0)"""


@contextmanager
def serving(root: Path) -> Iterator[tuple[str, str]]:
    """The address of a server of a root, and a token for it."""
    command = [sys.executable, "-m", "t6gps"]
    name = f"figures-{os.getpid()}"
    create = [*command, "token", "create", name, "--days", "1", "--root", str(root)]
    token = subprocess.run(create, check=True, capture_output=True, text=True).stdout.strip()
    serve = [*command, "serve", "--port", "0", "--root", str(root)]
    with subprocess.Popen(serve, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        found = re.search(r"http://\S+", process.stderr.readline())
        assert found is not None
        yield found[0].rstrip("/"), token
        process.terminate()
    subprocess.run([*command, "token", "revoke", name, "--root", str(root)], check=True, capture_output=True)


def opened(browser: Browser, address: str, token: str, size: dict[str, int], script: str = "") -> Page:
    """A new tab without a cache, when its view has come to rest."""
    context = browser.new_context(viewport=size)  # type: ignore[arg-type]
    context.add_init_script(f"sessionStorage.setItem('t6gps-token', '{token}');{script}")
    page = context.new_page()
    page.goto(address)
    page.wait_for_timeout(3000)
    return page


def painted(browser: Browser, address: str, token: str, size: dict[str, int]) -> list[float]:
    """First paint (ms) and size (kB) of a view."""
    times, taken = [], []
    for _ in range(TABS_N):
        page = opened(browser, address, token, size)
        times.append(page.evaluate(PAINTED))
        taken.append(page.evaluate(TAKEN))
        page.context.close()
    return [round(statistics.median(times)), round(taken[0] / 1000)]


def played(browser: Browser, address: str, token: str, size: dict[str, int], script: str) -> list[float]:
    """Frames a second of a replay that plays, script and main thread of each (ms)."""
    page = opened(browser, address, token, size, script)
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")

    def spent_s() -> list[float]:
        known = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
        return [known["ScriptDuration"], known["TaskDuration"]]

    if page.get_by_role("button", name="Play").count():
        page.get_by_role("button", name="Play").first.click()
    before = spent_s()
    frames = page.evaluate(FRAMES, 1000 * PLAYED_S)
    each = [round(1000 * (after - begun) / frames, 1) for begun, after in zip(before, spent_s(), strict=True)]
    page.context.close()
    return [round(frames / PLAYED_S, 1), *each]


def rows(browser: Browser, url: str, token: str, run: str) -> Iterator[list[str | float | None]]:
    """A row for each view and size of the window."""
    replay = f"#/replay?run={run}&episode=0"
    views = {"all runs": "#/runs", "a run": f"#/runs?run={run}", "replay": replay, "replay, 2D": replay}
    for size in SIZES:
        for title, address in views.items():
            flat, where = title.endswith("2D"), (f"{url}/{address}", token, size)
            opening = [None, None] if flat else painted(browser, *where)
            playing = played(browser, *where, FLAT if flat else "") if address == replay else [None] * 3
            yield [f"{title}, {size['width']} x {size['height']}", *opening, *playing]


def main(run: str, root: str = "runs") -> None:
    """Print the figures."""
    with serving(Path(root)) as (url, token), sync_playwright() as driver:
        arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=arguments)
        found = list(rows(browser, url, token, run))
        browser.close()
    origin = provenance.provenance()
    measured = {
        "command": f"python tests/service/page/figures.py {run}",
        "commit": origin.commit,
        "machine": f"{origin.cores} cores, no GPU",
        "date": date.today().isoformat(),
        "columns": [{"name": name} for name in COLUMNS],
        "rows": found,
    }
    print(json.dumps(measured, indent=2))


if __name__ == "__main__":
    main(*sys.argv[1:])
