"""The report is drawn again while a sweep runs, and never in anybody's way."""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from recrl.orchestrator import report_refresh
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.report_refresh import refreshing
from tests.faults.chaos import comm


def test_a_report_appears_while_the_sweep_runs_and_says_so(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(
        seeds=1, tasks=["a"], agents=["cpo"], methods=["none"], unfinished=["a cpo none seed 0"]
    )
    store.write_info({"name": store.name})
    page, end = store.figures_folder / "report.md", time.monotonic() + 120.0
    with refreshing(store, first_seconds=0.0, interval_seconds=60.0):
        while not page.exists() and time.monotonic() < end:
            time.sleep(0.1)
    assert "running or interrupted, 50% of its steps done" in page.read_text()
    assert '<meta http-equiv="refresh" content="120">' in page.with_suffix(".html").read_text()


def test_the_end_does_not_wait_for_a_drawing(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "pid"
    program = f"import os, time; open({str(path)!r}, 'w').write(f'{{os.getpid()}}\\n'); time.sleep(600)"
    monkeypatch.setattr(report_refresh, "sketch_command", lambda _: [sys.executable, "-c", program])
    store = made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none"])
    with refreshing(store, first_seconds=0.0):
        end = time.monotonic() + 120.0
        while not (path.exists() and path.read_text().endswith("\n")) and time.monotonic() < end:
            time.sleep(0.05)
        ended = time.monotonic()
    assert time.monotonic() - ended < 300.0
    assert comm(int(path.read_text())) == ""


def test_a_report_that_cannot_be_drawn_is_said_once(
    made_up_sweep: Callable[..., SweepStore],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    tries = tmp_path / "tries"
    program = (
        f"open({str(tries)!r}, 'a').write('.'); raise SystemExit('first line\\nrecrl-sweep: no disk ***')"
    )
    monkeypatch.setattr(report_refresh, "sketch_command", lambda _: [sys.executable, "-c", program])
    monkeypatch.setattr(report_refresh, "REST", 0.0)
    store = made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none"])
    with refreshing(store, first_seconds=0.0, interval_seconds=0.0):
        end = time.monotonic() + 120.0
        while not (tries.exists() and len(tries.read_text()) > 2) and time.monotonic() < end:
            time.sleep(0.05)
    (record,) = caplog.records
    assert record.getMessage() == (
        "the report of the running sweep could not be drawn (no disk ***); training goes on, and it is tried "
        "again"
    )


def test_nothing_is_drawn_before_there_is_something_to_draw(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = tmp_path / "asked"
    program = f"open({str(asked)!r}, 'w')"
    monkeypatch.setattr(report_refresh, "sketch_command", lambda _: [sys.executable, "-c", program])
    with refreshing(SweepStore(tmp_path, "small"), first_seconds=0.0, interval_seconds=0.05):
        time.sleep(1.0)
    assert not asked.exists()


def test_a_short_sweep_is_left_alone(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none"])
    with refreshing(store):
        pass
    assert not store.figures_folder.exists()
