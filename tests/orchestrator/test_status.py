"""Progress is read from files alone, and the silence of a trial is noticed."""

import io
import os
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from recrl.orchestrator.cli import display
from recrl.orchestrator.cli.output import print_table
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.launch_plan import make_plan
from recrl.orchestrator.process_scope import process_scope
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.sweep_progress import (
    DisplayStatus,
    SweepProgress,
    TrialProgress,
    display_status,
    progress,
)

GRID = b"""\
name: status
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag]
methods: [none, linear, cosine]
seeds: 2
run: {total_steps: 1000, num_envs: 1}
"""
SPECS = parse_grid(GRID, source="grid.yaml").trials()


def _trial(spec: TrialSpec, record: TrialRecord) -> TrialProgress:
    return TrialProgress(spec, display_status(record, now=1000.0, silence_seconds=300.0), record)


RUNNING = TrialRecord(TrialStatus.RUNNING, attempt=1, env_steps=250, heartbeat=995.0, steps_per_second=50.0)


def test_a_silent_trial_is_interrupted() -> None:
    for silence in (300.0, 3600.0):
        for sign in (-1.0, 1.0):  # before: the clock of another host is ahead
            now = 995.0 + sign * silence
            assert display_status(RUNNING, now=now, silence_seconds=silence) is DisplayStatus.RUNNING
            now += 0.1 * sign
            assert display_status(RUNNING, now=now, silence_seconds=silence) is DisplayStatus.INTERRUPTED


def test_a_trial_in_another_container_of_the_same_host_is_not_taken_for_dead() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    ended = replace(RUNNING, host=socket.gethostname(), pid=process.pid, pid_scope=process_scope())
    elsewhere = replace(ended, pid_scope=f"{process_scope()} of another container")
    old = {name: value for name, value in ended.to_json().items() if name != "pid_scope"}
    for record, status in (
        (ended, DisplayStatus.INTERRUPTED),
        (replace(ended, pid=os.getpid()), DisplayStatus.RUNNING),
        (elsewhere, DisplayStatus.RUNNING),
        (TrialRecord.from_json(old), DisplayStatus.RUNNING),  # until its silence is too long
    ):
        assert display_status(record, now=1000.0, silence_seconds=300.0) is status


@pytest.mark.parametrize(("told", "expected"), [(None, 300.0), (5.0, 300.0), (3600.0, 3600.0)])
def test_the_grid_says_how_long_a_trial_may_be_silent(
    tmp_path: Path, told: float | None, expected: float
) -> None:
    store = SweepStore(tmp_path, "status")
    assert store.silence_seconds == 300.0
    known = {} if told is None else {"silence_seconds": told}
    store.write_info({"name": "status", "created": 1.0, **known})
    store.write_specs(SPECS[:1])
    assert store.silence_seconds == expected
    writer = store.trial(SPECS[0]).begin(SPECS[0])
    later = writer.record.heartbeat + 301.0
    status = progress(SPECS[:1], store, now=later).trials[0].status
    assert status is (DisplayStatus.RUNNING if expected > 301.0 else DisplayStatus.INTERRUPTED)


@pytest.mark.parametrize(
    ("record", "status"),
    [
        (TrialRecord(), DisplayStatus.WAITING),
        (TrialRecord(TrialStatus.WAITING, attempt=1), DisplayStatus.STOPPED),
        (TrialRecord(TrialStatus.COMPLETE, attempt=1), DisplayStatus.COMPLETE),
        (TrialRecord(TrialStatus.FAILED, attempt=1), DisplayStatus.FAILED),
    ],
)
def test_every_state_has_its_display_status(record: TrialRecord, status: DisplayStatus) -> None:
    assert display_status(record, now=1e9, silence_seconds=300.0) is status


def test_the_time_left_counts_what_runs_and_what_waits_but_not_what_failed() -> None:
    sweep = SweepProgress(
        (
            _trial(SPECS[0], RUNNING),
            _trial(SPECS[1], replace(RUNNING, steps_per_second=100.0, env_steps=500)),
            _trial(SPECS[2], TrialRecord()),
            _trial(SPECS[3], TrialRecord(TrialStatus.COMPLETE, attempt=1, env_steps=1000)),
            _trial(SPECS[4], TrialRecord(TrialStatus.FAILED, attempt=1, env_steps=10)),
        )
    )
    assert sweep.steps_per_second == 150.0
    assert sweep.steps_left == 750 + 500 + 1000
    assert sweep.seconds_left == 15.0
    assert sweep.fraction == pytest.approx((0.25 + 0.5 + 0.0 + 1.0 + 0.01) / 5)
    assert display.status_sentence(sweep) == (
        "1 of 5 complete, 2 running, 1 waiting, 1 failed; 35%; 150 steps/s; 15 s left"
    )


def test_the_time_left_has_no_damaged_trial_that_is_left_alone() -> None:
    damaged = TrialRecord(TrialStatus.DAMAGED, attempt=1, env_steps=250)
    sweep = SweepProgress(
        (
            _trial(SPECS[0], replace(damaged, is_left_alone=True)),
            _trial(SPECS[1], replace(damaged, env_steps=0)),
        )
    )
    assert sweep.steps_left == 1000  # the second one is repaired by the next launch


def test_nothing_running_has_no_time_left() -> None:
    sweep = SweepProgress(
        (_trial(SPECS[0], replace(RUNNING, heartbeat=0.0)), _trial(SPECS[1], TrialRecord()))
    )
    assert sweep.seconds_left is None
    assert display.status_sentence(sweep) == (
        "0 of 2 complete, 0 running, 1 waiting, 0 failed, 1 interrupted; 12%"
    )


def test_progress_is_what_the_files_say(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "status")
    writer = store.trial(SPECS[0]).begin(SPECS[0])
    writer.commit({}, update=1, env_steps=1000)
    writer.close(TrialStatus.COMPLETE)
    store.trial(SPECS[1]).begin(SPECS[1]).heartbeat(update=1, env_steps=500, steps_per_second=7.0)
    sweep = progress(SPECS, store)
    statuses = [trial.status for trial in sweep.trials]
    assert statuses == [DisplayStatus.COMPLETE, DisplayStatus.RUNNING, *[DisplayStatus.WAITING] * 4]
    assert sweep.fraction == 0.25
    assert not sweep.is_complete


def test_the_tables_have_a_line_for_every_trial(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "status")
    console = Console(file=io.StringIO(), width=160)
    console.print(display.status_table(progress(SPECS, store)))
    console.print(display.plan_table(make_plan(SPECS, store)))
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    for spec in SPECS:
        assert text.count(spec.trial_id) == 2


def test_the_plan_does_not_say_how_far_a_damaged_trial_is(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "status")
    writer = store.trial(SPECS[0]).begin(SPECS[0])
    writer.append_update({"update": 1})
    writer.commit({}, update=1, env_steps=100)
    store.trial(SPECS[0]).updates_path.unlink()
    console = Console(file=io.StringIO(), width=160)
    console.print(display.plan_table(make_plan(SPECS, store)))
    assert isinstance(console.file, io.StringIO)
    first, second = console.file.getvalue().splitlines()[-len(SPECS) :][:2]
    assert ("repair" in first, "?" in first, "0%" in first) == (True, True, False)
    assert ("new" in second, "?" in second, "0%" in second) == (True, False, True)


@pytest.mark.parametrize("terminal", [True, False])
def test_no_number_of_a_table_is_shortened(terminal: bool) -> None:
    """Only a terminal has a width; there the verdict is wrapped."""
    verdict = "infeasible by up to 4.06 (406%), which is more than a narrow terminal can show"
    row = ["rivergrid-1b", "ppo-lag", "exponential", "20", "-128.44 ± 12.34", "5.064", "1.00", verdict]
    console = Console(file=io.StringIO(), force_terminal=terminal, width=80)
    table = display.text_table(
        ["task", "agent", "curriculum", "n", "return", "cost", "limit", "verdict"], [row]
    )
    print_table(table, console)
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert all(number in lines[1] for number in row[:-1])
    assert (verdict in lines[1]) is not terminal
    assert console.width == 80


def test_a_followed_log_is_read_by_whole_characters_and_from_the_start_of_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(display, "LOG_SECONDS", 0.0)
    trial = TrialStore(tmp_path)
    old = "one\ntw\N{LATIN SMALL LETTER O WITH DIAERESIS}\n".encode()
    states = iter([old[:7], old, b"new\n"])

    def changes() -> bool:
        if (data := next(states, None)) is not None:
            trial.log_path.write_bytes(data)
        return data is not None

    assert list(display.lines_of(trial, may_grow=changes)) == [
        "one",
        "tw\N{LATIN SMALL LETTER O WITH DIAERESIS}",
        "new",
    ]


@pytest.mark.parametrize("terminal", [True, False])
def test_the_live_display_ends_with_its_context(
    tmp_path: Path, terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(display, "LINE_SECONDS", 0.01)
    store = SweepStore(tmp_path, "status")
    store.trial(SPECS[0]).begin(SPECS[0]).heartbeat(update=1, env_steps=500, steps_per_second=7.0)
    console = Console(file=io.StringIO(), force_terminal=terminal, width=160)
    asked = threading.Event()

    def ask() -> SweepProgress:
        asked.set()
        return progress(SPECS, store)

    with display.live_progress(ask, console):
        assert asked.wait(30.0)
    assert not any(thread.name == "progress" for thread in threading.enumerate())
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert ("two-state ppo-lag none seed 0" in shown) == terminal
    assert "1 running" in shown
