"""Laws of looking, in a browser: lists, curves, replay, queries and links show what is stored."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import no_webgl
import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from loopback import Server
from playwright.sync_api import Page, expect

from t6gps.service.remote.messages import Scope
from t6gps.storage import catalog, schema, tables
from t6gps.workers.robot.state import RobotState

Opened = Callable[..., Page]
PHONE = {"viewport": {"width": 390, "height": 800}, "has_touch": True, "is_mobile": True}
EPISODES = (
    "#/query?runs=tiny-*&sql=SELECT+run%2C+iteration%2C+episode_id%2C+cost+FROM+episodes+ORDER+BY+run%2C+episode_id"
)

WRITTEN = """
window.written = new Set();
for (const context of [CanvasRenderingContext2D, OffscreenCanvasRenderingContext2D]) {
  const write = context.prototype.fillText;
  context.prototype.fillText = function (text, ...rest) { written.add(text); return write.call(this, text, ...rest); };
}
"""
"""A script that keeps what is written on canvases."""


def nodes_of(server: Server, run: str, episode: int, step: int) -> np.ndarray:
    """Where the stored frame has the ends of the bars [12, 3] (m)."""
    frames = tables.episode(catalog.open_run(server.root, run), episode).frames.slice(step, 1)
    positions = np.asarray(schema.array(frames, "bar_positions"), float).reshape(6, 3)
    orientations = np.asarray(schema.array(frames, "bar_orientations"), float).reshape(6, 4)
    rest = np.zeros((6, 3))
    return RobotState.of(positions, orientations, rest, rest, np.zeros(24)).nodes()


def drawn(page: Page) -> np.ndarray:
    """Where the scene has them, by its numbers at this step."""
    rows = page.locator("details table tbody tr")
    expect(rows.first).to_be_visible()
    cells = [row.split("\t") for row in rows.all_inner_texts()]
    return np.array([[float(cell) for cell in row[1:]] for row in cells])


def test_a_pause_of_the_page_that_is_over_leaves_nothing_behind(visit: Opened) -> None:
    left_behind = visit("").evaluate(
        """async () => {
          const { pause } = await import("/page/base/api.js"), signal = new AbortController().signal;
          let listening = 0;
          const add = signal.addEventListener, remove = signal.removeEventListener;
          signal.addEventListener = (...all) => (listening++, add.apply(signal, all));
          signal.removeEventListener = (...all) => (listening--, remove.apply(signal, all));
          await pause(1, signal);
          return listening;
        }"""
    )
    assert left_behind == 0


def test_the_list_finds_runs_and_those_alike_make_one_curve(visit: Opened, served: Server) -> None:
    page = visit("", Scope.READ)
    rows = page.locator(".rows tbody tr")
    expect(rows).to_have_count(3)
    page.get_by_label("Find").fill("TINY")
    expect(rows).to_have_count(2)
    page.get_by_label("compare tiny-0").check()
    page.get_by_label("compare tiny-1").check()
    expect(page.get_by_role("heading", name="2 runs compared")).to_be_visible()
    expect(page.get_by_role("cell", name="tiny (2 runs, 1 seed)")).to_be_visible()
    last = tables.read(catalog.open_run(served.root, "tiny-0"), "iterations", ["cost"])["cost"].to_pylist()[-1]
    expect(page.get_by_role("img", name="tiny (2 runs, 1 seed): ")).to_have_count(4)
    expect(page.get_by_role("cell", name=f"{last:.2f}").first).to_be_visible()


@contextmanager
def changed_copy(server: Server, name: str, section: str, **settings: object) -> Iterator[None]:
    """A copy of tiny-0 that says of itself that it has other settings."""
    path = server.root / name
    shutil.copytree(server.root / "tiny-0", path)
    try:
        stored = catalog.open_run(server.root, name).config_path
        values = json.loads(stored.read_text())
        values[section] |= settings
        stored.write_text(json.dumps(values))
        yield
    finally:
        shutil.rmtree(path)


def test_only_runs_that_differ_in_the_seed_alone_are_averaged(visit: Opened, served: Server) -> None:
    other_seed = changed_copy(served, "tiny-2", "run", seed=2**53 + 1, workers=5, cpus_per_worker=0.5)
    with other_seed, changed_copy(served, "spread", "randomisation", mass_spread=0.3):
        page = visit("#/runs?compare=tiny-0,tiny-2,spread", Scope.READ)
        row = page.get_by_role("table", name="Curves").get_by_role("row")
        expect(row).to_have_count(3)
        expect(row.filter(has_text="spread")).to_contain_text("spread0spread")
        expect(row.filter(has_text="tiny")).to_contain_text(f"tiny (2 seeds)0, {2**53 + 1}")


def test_a_link_keeps_the_iteration_and_the_kind_of_events(visit: Opened) -> None:
    page = visit("#/runs?run=tiny-0&part=classes&iteration=0", Scope.READ)
    expect(page.get_by_role("spinbutton", name="Iteration")).to_have_value("0")
    expect(page.get_by_role("img", name="3 points").first).to_be_visible()
    page.locator(".chart .u-over").first.click()
    expect(page.get_by_role("heading", name="Episodes of iteration 1")).to_be_visible()
    page.wait_for_url("**part=episodes**iteration=1**")
    page.get_by_role("spinbutton", name="Iteration").fill("2")
    page.get_by_role("spinbutton", name="Iteration").press("Enter")
    page.wait_for_url("**iteration=2**")
    page.get_by_role("tab", name="Events").click()
    page.get_by_label("Kind").select_option("crash")
    page.wait_for_url("**kind=crash**")
    page.reload()
    expect(page.get_by_label("Kind")).to_have_value("crash")
    page.get_by_role("tab", name="Classes and modes").click()
    expect(page.get_by_role("spinbutton", name="Iteration")).to_have_value("2")


def test_an_address_that_says_nothing_shows_what_none_would(visit: Opened) -> None:
    page = visit("#/toString?order=toString&state=none", Scope.READ)
    expect(page.get_by_label("compare tiny-0")).to_be_visible()
    for address in ("#/runs?run=tiny-0&part=toString&iteration=x", "#/replay?run=tiny-0&step=abc&rate=xyz&view=runs"):
        page.goto(page.url.partition("#")[0] + address)
        if "part" in address:
            expect(page.get_by_role("tab", name="Pool")).to_have_attribute("aria-selected", "true")
    expect(page.locator("output")).to_have_text("step 0 · 0.0 s")
    expect(page.get_by_role("combobox", name="Speed")).to_have_value("1")


def test_a_long_list_of_episodes_says_that_it_is_not_whole(visit: Opened) -> None:
    page = visit("#/query", Scope.READ)
    row = {"episode_id": 0, "cost": 1.0, "ended_by": "completed"}
    page.route("**/v1/query", lambda route: route.fulfill(json=[row | {"episode_id": n} for n in range(501)]))
    page.goto(page.url.partition("#")[0] + "#/runs?run=tiny-0&part=episodes")
    expect(page.get_by_text("There are more than 500; the first 500 are here.").first).to_be_visible()
    expect(page.get_by_role("table", name="Episodes", exact=True).get_by_role("row")).to_have_count(501)


def test_a_chart_that_somebody_has_zoomed_stays_so_when_data_come(visit: Opened) -> None:
    ranges = visit("").evaluate(
        """async () => {
          const { chart } = await import("/page/base/curves.js"), real = uPlot, made = [], seen = [];
          const series = [{ label: "a", stroke: "curve-1" }];
          const frame = () => new Promise(requestAnimationFrame);
          window.uPlot = function (...all) { made.push(new real(...all)); return made.at(-1); };
          const one = chart({ title: "", unit: "", series, data: [[0, 1], [0, 1]] });
          document.body.prepend(one.element);
          while (!made.length) await frame();
          const range = async () => (await frame(), seen.push([made.at(-1).scales.x.min, made.at(-1).scales.x.max]));
          one.show([[0, 1, 2, 3], [0, 1, 2, 3]]);
          await range();
          made[0].setScale("x", { min: 1, max: 2 });
          await range();
          one.show([[0, 1, 2, 3, 4], [0, 1, 2, 3, 4]]);
          await range();
          window.dispatchEvent(new Event("themechange"));
          await range();
          return seen;
        }"""
    )
    assert ranges == [[0, 3], [1, 2], [1, 2], [1, 2]]


def test_a_link_to_a_run_shows_its_curves_classes_and_episodes(visit: Opened) -> None:
    page = visit("#/runs?run=tiny-0&part=classes", Scope.READ)
    expect(page.get_by_role("heading", name="tiny-0")).to_be_visible()
    expect(page.get_by_role("img", name="cost: ")).to_be_visible()
    expect(page.get_by_role("img", name="3 points").first).to_be_visible()
    expect(page.get_by_role("tabpanel").get_by_role("row").nth(1)).to_contain_text(" → ")
    page.get_by_role("tab", name="Classes and modes").press("ArrowRight")
    expect(page.get_by_role("tab", name="Episodes")).to_be_focused()
    page.get_by_label("replay episode 6", exact=True).click()
    expect(page.locator(".tag")).to_contain_text("tiny-0 episode 6")
    assert "run=tiny-0&episode=6" in page.url


@pytest.mark.parametrize("script", ["", no_webgl.SCRIPT], ids=["webgl", "flat"])
def test_the_robot_stands_where_the_stored_frame_has_it(visit: Opened, served: Server, script: str) -> None:
    page = visit("#/replay?run=tiny-0&episode=4&step=17", Scope.READ, script)
    expect(page.locator("output")).to_contain_text("step 17")
    page.keyboard.press("ArrowLeft")  # nothing has the focus
    page.wait_for_url("**step=16")
    page.keyboard.press("ArrowRight")
    page.get_by_text("Numbers at this step").click()
    expect(page.locator("output")).to_contain_text("step 17")
    np.testing.assert_allclose(drawn(page), nodes_of(served, "tiny-0", 4, 17), atol=1e-3)
    page.locator(".stage").press("Shift+ArrowRight")
    expect(page.locator("output")).to_contain_text("step 27")
    np.testing.assert_allclose(drawn(page), nodes_of(served, "tiny-0", 4, 27), atol=1e-3)
    expect(page.get_by_text("seen from above")).to_have_count(1 if script else 0)


@pytest.mark.parametrize("script", ["", no_webgl.SCRIPT], ids=["webgl", "flat"])
def test_robots_and_triangles_are_told_apart_by_letters(visit: Opened, script: str) -> None:
    page = visit("#/replay?run=tiny-0&episode=4&run2=tiny-0&episode2=5", Scope.READ, script + WRITTEN)
    for sign in ("/^A [ΔΛ]$/", "/^B [ΔΛ]$/"):
        page.wait_for_function(f"() => [...written].some((text) => {sign}.test(text))")


def test_two_episodes_on_one_ground_share_a_scene_and_a_clock_and_a_link_brings_them_back(visit: Opened) -> None:
    page = visit("#/replay?run=tiny-0&episode=4", Scope.READ)
    page.get_by_role("button", name="Another one beside it").click()
    expect(page.locator(".tag div")).to_have_count(2)
    expect(page.locator(".stage")).to_have_count(1)
    page.get_by_label("Step", exact=True).fill("12")
    page.get_by_role("button", name="Step on").click()
    page.get_by_role("button", name="Play").click()
    page.get_by_role("button", name="Pause").click()
    rests = page.locator("output").inner_text().split()[1]
    page.wait_for_url(f"**step={rests}*")
    again = visit(page.url.partition("/#")[2].join(["#", ""]), Scope.READ)
    expect(again.locator(".tag div")).to_have_count(2)
    expect(again.locator("output")).to_have_text(page.locator("output").inner_text())


def test_the_newest_episode_is_shown_and_an_unknown_one_is_said_in_place(visit: Opened) -> None:
    page = visit("#/replay?run=tiny-0&newest=1", Scope.READ)
    expect(page.locator(".tag")).to_contain_text("episode 8")
    page.get_by_label("Episode", exact=True).first.fill("999")
    page.get_by_label("Episode", exact=True).first.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("has no episode 999")
    expect(page.locator(".tag")).to_contain_text("episode 8")


def test_a_query_completes_names_is_downloaded_whole_and_leads_into_the_replay(visit: Opened, served: Server) -> None:
    page = visit(EPISODES, Scope.READ)
    expect(page.get_by_text("18 rows")).to_be_visible()
    expect(page.get_by_role("img", name="tiny-1: ")).to_be_visible()
    with page.expect_download() as download:
        page.get_by_role("button", name="csv").click()
    found = list(csv.DictReader(io.StringIO(Path(download.value.path()).read_text())))
    stored = tables.read(catalog.open_run(served.root, "tiny-1"), "episodes", ["episode_id", "cost"]).to_pylist()
    costs = {(row["run"], int(row["episode_id"])): float(row["cost"]) for row in found}
    assert costs == {(run, row["episode_id"]): row["cost"] for run in ("tiny-0", "tiny-1") for row in stored}
    sql = page.get_by_label("SQL")
    sql.fill("SELECT run, episode_id, step FROM frames WHERE forward_sp")
    sql.press("End")
    page.keyboard.type("e")
    expect(page.get_by_role("option").first).to_contain_text("forward_speed_m_per_s")
    page.keyboard.press("Tab")
    expect(sql).to_have_value("SELECT run, episode_id, step FROM frames WHERE forward_speed_m_per_s")
    sql.fill("SELECT run, episode_id, step FROM frames WHERE step = 21 AND episode_id = 5 AND run = 'tiny-1'")
    sql.press("Control+Enter")
    expect(page.get_by_text("1 row", exact=True)).to_be_visible()
    page.get_by_label("replay episode 5 of tiny-1").click()
    expect(page.locator(".tag")).to_contain_text("tiny-1 episode 5")
    expect(page.locator("output")).to_contain_text("step 21")


def test_a_plot_without_lines_for_each_is_kept_by_its_link_and_by_asking_again(visit: Opened) -> None:
    page = visit(EPISODES, Scope.READ)
    page.get_by_label("A line for each").select_option("nothing")
    page.get_by_label("Marks").select_option("points")
    with page.expect_request("**/v1/query"):
        page.get_by_role("button", name="Ask").click()
    page.get_by_label("SQL").fill(f"SELECT run, episode_id, cost, {2**53 + 1} AS wide FROM episodes LIMIT 3")
    page.get_by_role("button", name="Ask").click()
    expect(page.get_by_role("cell", name=str(2**53 + 1))).to_have_count(3)
    page.reload()
    expect(page.get_by_label("A line for each")).to_have_value("-")
    expect(page.get_by_label("Marks")).to_have_value("points")


def test_wrong_sql_is_said_in_place_and_the_last_result_stays(visit: Opened) -> None:
    page = visit(EPISODES, Scope.READ)
    expect(page.get_by_text("18 rows")).to_be_visible()
    page.get_by_label("SQL").fill("SELECT nothing FROM nowhere")
    page.get_by_role("button", name="Ask").click()
    expect(page.get_by_role("alert")).to_contain_text("nowhere")
    expect(page.get_by_role("table", name="Result")).to_be_visible()
    expect(page.get_by_label("SQL")).to_have_value("SELECT nothing FROM nowhere")


def test_hundreds_of_runs_and_iterations_are_shown_and_what_is_kept_is_bounded(visit: Opened) -> None:
    page = visit("", Scope.READ)
    one = {"planned": 500, "done": 500, "cost": 1.0, "forward_speed_m_per_s": 0.5, "fault": None, "at_work": False}
    runs = [{"name": f"run-{number}"} | one for number in range(500)]
    row = {"cost": 1.0, "cost_standard_error": 0.1, "forward_speed_m_per_s": 0.5, "forward_speed_standard_error": None}
    more = {
        "stuck_share": 0.1,
        "stuck_share_by_distance": None,
        "predicted_cost_change": -0.1,
        "realised_cost_change": None,
    }
    event = {"time": "2026-01-01T00:00:00Z", "event": "start", "phase": "sampling", "reason": "slot 0"}
    told = [
        f"event: iteration\nid: {n + 1}-0\ndata: {json.dumps({'iteration': n} | row | more)}\n\n" for n in range(500)
    ]
    told += [f"event: pool\nid: 500-{n + 1}\ndata: {json.dumps({'number': n} | event)}\n\n" for n in range(2000)]
    page.route("**/v1/runs", lambda route: route.fulfill(json=runs))
    page.route("**/events", lambda route: route.fulfill(body="".join(told), content_type="text/event-stream"))
    expect(page.locator(".rows tbody tr")).to_have_count(500)
    page.get_by_label("Find").fill("run-49")
    expect(page.locator(".rows tbody tr")).to_have_count(11)
    page.get_by_role("link", name="run-499").click()
    expect(page.get_by_role("img", name="cost: 1 at first, 1 at last, 500 points")).to_be_visible()
    page.get_by_role("tab", name="Events").click()
    expect(page.get_by_text("500 events, the newest of 2000")).to_be_visible()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_each_view_keeps_wcag(visit: Opened, scheme: str) -> None:
    axe, options = Axe(), {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]}
    page = visit("#/runs?run=tiny-0&part=episodes", Scope.READ, color_scheme=scheme)
    expect(page.get_by_role("heading", name="Episodes of iteration 2")).to_be_visible()
    found = {"run": axe.run(page, options=options)}
    page.get_by_role("tab", name="Classes and modes").click()
    expect(page.get_by_role("tabpanel").get_by_role("row").nth(1)).to_be_visible()
    found["classes"] = axe.run(page, options=options)
    page.get_by_role("button", name="Start a run").click()
    expect(page.get_by_label("Preset")).to_be_visible()
    found["start"] = axe.run(page, options=options)
    page.keyboard.press("Escape")
    page.goto(page.url.partition("#")[0] + "#/replay?run=tiny-0&episode=4&run2=tiny-1&episode2=5&step=3")
    expect(page.locator(".tag div")).to_have_count(2)
    page.get_by_text("Numbers at this step").click()
    found["replay"] = axe.run(page, options=options)
    page.goto(page.url.partition("#")[0] + EPISODES)
    expect(page.get_by_text("18 rows")).to_be_visible()
    found["query"] = axe.run(page, options=options)
    faults = {
        view: [f"{v['id']}: {n['html']}" for v in one.response["violations"] for n in v["nodes"]]
        for view, one in found.items()
    }
    assert not {view: told for view, told in faults.items() if told}
    assert all(len(one.response["passes"]) > 10 for one in found.values())


def test_a_phone_shows_the_list_then_a_run_and_the_way_back(visit: Opened) -> None:
    page = visit("", Scope.READ, **PHONE)
    page.get_by_role("link", name="tiny-0").tap()
    expect(page.get_by_role("heading", name="tiny-0")).to_be_visible()
    expect(page.locator(".list")).to_be_hidden()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.get_by_role("link", name="← all runs").tap()
    expect(page.locator(".list")).to_be_visible()
