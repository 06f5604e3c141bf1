"""Laws of driving, in a browser: what is clicked, dragged and typed acts on the robot that is seen."""

from __future__ import annotations

from collections.abc import Callable
from urllib.parse import parse_qs, urlsplit

import no_webgl
import pytest
from axe_playwright_python.sync_playwright import Axe
from loopback import Server
from playwright.sync_api import Page, expect

from t6gps.service.remote.messages import Scope

Opened = Callable[..., Page]


def place(page: Page) -> list[float]:
    """Where robot A is (m)."""
    text = page.get_by_role("region", name="Robots").locator("tbody tr").first.locator("td").nth(1).inner_text()
    return [float(part.replace("\u2212", "-")) for part in text.split(", ")]


def raced(visit: Opened, page: Page) -> None:
    """Let tiny-1 race in a drive that is seen again, which ends the one before, and let a second tab steer, too."""
    page.reload()
    page.locator(".drive .entrants input").fill("tiny-1")
    with page.expect_request(lambda asked: asked.method == "DELETE"):
        page.get_by_role("button", name="Race with its newest policy").click()
    expect(page.get_by_role("region", name="Robots").locator("tbody tr")).to_have_count(2)
    page.wait_for_url("**tiny-1**")
    drive = page.url
    second = visit(drive.partition("/#")[2].join(["#", ""]), Scope.OPERATE)
    expect(second.get_by_role("region", name="Robots").locator("tbody tr")).to_have_count(2)
    slider = second.get_by_role("slider", name="Terrain")
    slider.fill("0.8")
    expect(page.get_by_text("Somebody else with this token has changed terrain difficulty")).to_be_visible()
    expect(page.get_by_role("slider", name="Terrain")).to_have_value("0.8")
    friction = second.get_by_role("slider", name="Friction")
    friction.fill("0.42")
    expect(page.get_by_role("slider", name="Friction")).to_have_value("0.42")
    second.route("**/v1/drives/*", lambda route: route.fulfill(status=422, json={"error": "not so much"}))
    friction.fill("0.9")
    expect(second.get_by_text("not so much")).to_be_visible()
    expect(friction).to_have_value("0.42")
    second.unroute("**/v1/drives/*")
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        found = Axe().run(page, options={"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]})
        told = [f"{v['id']}: {n['html']}" for v in found.response["violations"] for n in v["nodes"]]
        assert not told
    second.get_by_role("button", name="End the drive").click()
    expect(page.get_by_role("alert")).to_contain_text("has ended this drive")
    expect(page.get_by_role("button", name="Drive again")).to_be_visible()


@pytest.mark.parametrize("script", ["", no_webgl.SCRIPT], ids=["webgl", "flat"])
def test_a_policy_is_driven_by_clicks_drags_and_keys_and_raced(visit: Opened, served: Server, script: str) -> None:
    page = visit("#/replay?run=tiny-0&episode=4", Scope.OPERATE, script)
    page.route("**/drive/solid.js", lambda route: route.abort())
    page.get_by_role("button", name="Drive it yourself").click()
    if not script:
        expect(page.get_by_role("alert")).to_contain_text("this part of the page could not be read")
        page.unroute("**/drive/solid.js")
        page.get_by_role("button", name="Try again").click()
    canvas = page.locator(".drive .stage canvas")
    expect(canvas).to_be_visible()
    clock = page.locator(".drive .controls > .transport > output")
    page.wait_for_function("clock => Number(clock.textContent.split(' ')[0]) > 0.5", arg=clock.element_handle())
    box = canvas.bounding_box()
    assert box is not None
    canvas.click(position={"x": 0.85 * box["width"], "y": 0.7 * box["height"]})
    page.wait_for_url("**waypoint=**")
    clicked = [
        float(value) for value in parse_qs(urlsplit(page.url).fragment.partition("?")[2])["waypoint"][0].split(",")
    ]
    page.wait_for_function(
        "([x, y]) => { const [a, b] = document.querySelectorAll('.controls form input');"
        " return Math.hypot(a.value - x, b.value - y) < 0.01; }",
        arg=clicked,
    )
    page.get_by_role("button", name="Pause").click()
    expect(page.get_by_role("button", name="Go on")).to_be_visible()
    page.locator(".drive .stage").focus()
    page.keyboard.press("ArrowUp")
    page.wait_for_function(
        "([x, y]) => { const [a, b] = document.querySelectorAll('.controls form input');"
        " return Math.abs(Math.hypot(a.value - x, b.value - y) - 0.5) < 0.03; }",
        arg=clicked,
    )
    page.get_by_role("button", name="Go on").click()
    start = place(page)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + box["height"] / 2, steps=5)
    with page.expect_request(lambda asked: asked.method == "POST" and '"push"' in (asked.post_data or "")):
        page.mouse.up()
    page.wait_for_function(
        "([x, y]) => { const [a, b] = document.querySelector('.entrants tbody td:nth-child(3)').textContent"
        ".replaceAll('\u2212', '-').split(', '); return Math.hypot(a - x, b - y) > 0.5; }",
        arg=start,
    )
    if script:
        page.get_by_role("button", name="End the drive").click()
        expect(page.get_by_role("button", name="▶ Play")).to_be_visible()
        return
    raced(visit, page)


def test_who_may_only_read_is_refused_in_place_and_the_replay_stays(visit: Opened) -> None:
    page = visit("#/replay?run=tiny-0&episode=4", Scope.READ)
    page.route("**/drive/view.js", lambda route: route.abort())
    page.get_by_role("button", name="Drive it yourself").click()
    expect(page.get_by_role("alert")).to_contain_text("this part of the page could not be read")
    expect(page.locator(".tag")).to_contain_text("tiny-0 episode 4")
    page.unroute("**/drive/view.js")
    page.get_by_role("button", name="Try again").click()
    expect(page.get_by_role("alert")).to_contain_text("this needs operate")
    page.get_by_role("button", name="Back to the replay").click()
    expect(page.locator(".tag")).to_contain_text("tiny-0 episode 4")
