"""Laws of steering, in a browser: what may be asked, what is refused in place, and that nothing is lost meanwhile."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from pathlib import Path

import pytest
from loopback import PATIENT, Server, commit, listening
from playwright.sync_api import Page, expect

from t6gps.service import config as configuration
from t6gps.service.launch import control
from t6gps.service.launch import job as records
from t6gps.service.pool.state import RunState
from t6gps.service.remote.messages import Scope
from t6gps.service.server import app
from t6gps.service.steering import status as statuses
from t6gps.service.steering.events import EventKind, EventLog, Happened
from t6gps.service.steering.requests import STOP_DEADLINE_S
from t6gps.service.steering.status import Status
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode

Opened = Callable[..., Page]


def at_work(run: Run, wanted: int) -> None:
    """Let the status of a run be that of this process, with so many workers."""
    workers = [
        {"slot": slot, "incarnation": 0, "pid": 7, "node": "n", "phase": "sampling", "for_s": 1.0, "episodes": [slot]}
        for slot in range(wanted)
    ]
    known: Status = {
        "time_s": time.time(),
        "pid": catalog.process_of(run) or 0,
        "most": 8,
        "state": RunState.RUNNING,
        "reason": "",
        "phase": "sampling",
        "wanted": wanted,
        "ready": wanted,
        "workers": workers,
        "waits": [{"what": "the learner waits for 3 episodes", "for_s": 2.0}],
    }
    statuses.publish(run, known)


def test_a_wrong_token_is_refused_in_place_and_a_right_one_opens_the_page(visit: Opened, served: Server) -> None:
    page = visit("#/runs?run=tiny-0", scope=None)
    for _ in range(3):
        page.keyboard.press("Escape")
    page.get_by_label("Token", exact=True).fill("t6gps_\u2026")
    page.get_by_role("button", name="Open").click()
    expect(page.get_by_role("dialog").get_by_role("alert")).to_contain_text("No token has the character “\u2026”")
    page.get_by_label("Token", exact=True).fill("t6gps_wrong")
    page.get_by_role("button", name="Open").click()
    expect(page.get_by_role("dialog").get_by_role("alert")).to_contain_text("not known here")
    page.get_by_label("Token", exact=True).fill(served.tokens[Scope.READ])
    page.get_by_role("button", name="Open").click()
    expect(page.get_by_role("heading", name="tiny-0")).to_be_visible()
    expect(page.get_by_role("dialog")).to_have_count(0)
    page.get_by_role("button", name="Token").click()
    page.get_by_role("button", name="Cancel").click()
    expect(page.get_by_role("dialog")).to_have_count(0)
    page.reload()  # with the token of before
    expect(page.get_by_role("heading", name="tiny-0")).to_be_visible()
    expect(page.get_by_role("img", name="3 points").first).to_be_visible()


def test_a_token_that_expires_is_asked_for_again_and_what_was_seen_stays(visit: Opened, served: Server) -> None:
    page = visit("#/query?runs=tiny-0&sql=SELECT+42+AS+answer", Scope.READ)
    expect(page.get_by_role("cell", name="42")).to_be_visible()
    page.get_by_label("SQL").fill("SELECT 43 AS answer")
    served.later = timedelta(days=2)
    try:
        page.get_by_role("button", name="Ask").click()
        expect(page.get_by_role("dialog").get_by_role("alert")).to_contain_text("expired")
        expect(page.get_by_role("cell", name="42", include_hidden=True)).to_have_count(1)
    finally:
        served.later = timedelta()
    page.get_by_label("Token", exact=True).fill(served.tokens[Scope.READ])
    page.get_by_role("button", name="Open").click()
    expect(page.get_by_role("cell", name="43")).to_be_visible()


def test_a_run_at_work_shows_its_pool_and_what_others_do_and_a_reader_may_not_scale_it(
    visit: Opened, served: Server
) -> None:
    run = catalog.open_run(served.root, "tiny-1")
    with catalog.locked(run):
        at_work(run, 1)
        page = visit("#/runs?run=tiny-1", Scope.READ)
        expect(page.get_by_text("1 of 1 workers")).to_be_visible()
        expect(page.get_by_text("the learner waits for 3 episodes")).to_be_visible()
        page.get_by_label("workers", exact=True).fill("2")
        page.get_by_role("button", name="Scale").click()
        expect(page.get_by_text("this needs operate")).to_be_visible()
        expect(page.get_by_label("workers", exact=True)).to_have_value("2")
        at_work(run, 3)  # somebody else has scaled it
        EventLog(run.pool).write([Happened(EventKind.SCALE, "workers, from 1 to 3: asked for")], "sampling")
        expect(page.get_by_text("3 of 3 workers")).to_be_visible()
        page.get_by_role("tab", name="Events").click()
        expect(page.get_by_text("workers, from 1 to 3: asked for")).to_be_visible()


def test_an_iteration_is_drawn_when_it_comes_and_a_run_that_vanishes_is_said_in_place(
    visit: Opened, served: Server, make_episode: Callable[..., Episode]
) -> None:
    page = visit("#/runs?run=watched", Scope.READ)
    expect(page.get_by_role("img", name="3 points").first).to_be_visible()
    commit(served.run, 3, make_episode)
    expect(page.get_by_role("img", name="3.50 at last, 4 points")).to_be_visible()
    shutil.rmtree(served.run.path)
    expect(page.get_by_role("alert")).to_contain_text("What is shown is the last that was known")
    expect(page.get_by_role("img", name="3.50 at last, 4 points")).to_be_visible()


def test_what_a_start_refuses_is_said_beside_what_was_typed_and_a_start_leads_to_its_run(
    visit: Opened, served: Server
) -> None:
    page = visit("", Scope.OPERATE)
    page.get_by_role("button", name="Start a run").click()
    page.get_by_label("Preset").select_option("flat-quick")
    page.get_by_role("textbox", name="Name").fill("fresh")
    page.get_by_label("Settings").fill("run.iterations = 0")
    page.get_by_role("button", name="Start", exact=True).click()
    expect(page.get_by_role("dialog").get_by_role("alert").first).to_contain_text("run.iterations")
    expect(page.get_by_role("textbox", name="Name")).to_have_value("fresh")
    page.get_by_label("Settings").fill("run.iterations = 2\nrun.episodes = 3")
    page.get_by_role("button", name="Start", exact=True).click()
    expect(page.get_by_role("heading", name="fresh")).to_be_visible()
    assert served.launched == ["fresh"]
    assert configuration.kept(catalog.open_run(served.root, "fresh")).run.iterations == 2


def test_a_server_that_dies_and_comes_back_is_said_and_found_again(visit: Opened, served: Server) -> None:
    again = app.create(served.root, start=served.launch, now=served.now, limits=PATIENT)
    with listening(again) as url:
        page = visit("", Scope.READ)
        page.goto(f"{url}/#/runs?run=tiny-0")
        expect(page.get_by_role("img", name="3 points").first).to_be_visible()
    expect(page.get_by_text("The server does not answer")).to_be_visible()
    expect(page.get_by_role("img", name="3 points").first).to_be_visible()
    with listening(again, port=int(url.rpartition(":")[2])):
        expect(page.get_by_text("The server does not answer")).to_have_count(0)


@pytest.mark.ray
@pytest.mark.slow
def test_a_run_is_started_scaled_and_watched_to_its_end(
    visit: Opened, served: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path / "state"))
    real = app.create(served.root, now=served.now, limits=PATIENT)
    with listening(real) as url:
        page = visit("", Scope.OPERATE)
        page.goto(f"{url}/")
        page.get_by_role("button", name="Start a run").click()
        page.get_by_label("Preset").select_option("flat-quick")
        page.get_by_role("textbox", name="Name").fill("lively")
        settings = ("workers=1", "iterations=2", "episodes=40", "steps=300", "evaluation_episodes=2")
        page.get_by_label("Settings").fill("\n".join(f"run.{setting}" for setting in settings))
        page.get_by_role("button", name="Start", exact=True).click()
        try:
            expect(page.get_by_text("1 of 1 workers")).to_be_visible(timeout=180_000)
            page.get_by_label("workers", exact=True).fill("2")
            page.get_by_role("button", name="Scale").click()
            expect(page.get_by_text("2 of 2 workers")).to_be_visible(timeout=180_000)
            expect(page.locator(".title .state")).to_have_text("✓ DONE", timeout=240_000)
            expect(page.get_by_role("img", name="2 points").first).to_be_visible()
        finally:
            with suppress(RunError):  # it has ended, unless something went wrong
                control.stop(served.root, "lively", records.training(served.root, "lively"), STOP_DEADLINE_S, print)
