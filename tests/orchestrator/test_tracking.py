"""MLflow shows what the files say: nothing is lost, nothing is there twice, and nobody waits for it."""

from __future__ import annotations

import json
import math
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import pandas as pd
import pytest
from sqlalchemy import make_url

import recrl
from recrl.analysis.data import sweep_data
from recrl.analysis.report import table_files as sweep_tables
from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.cli.launch import MlflowWarning
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import RecrlError, TrackingError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.launch_grid import LaunchOptions
from recrl.orchestrator.process_scope import process_scope
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.tracking import background_sync, client, mlflow_sync
from recrl.orchestrator.tracking.background_sync import BackgroundSync, start_sync
from recrl.orchestrator.tracking.chart_view import view_tag
from recrl.orchestrator.tracking.client import sqlite_path, tracking_uri
from recrl.orchestrator.tracking.final_outcomes import (
    FinalOutcome,
    FinalOutcomes,
    _outcome,
    trial_note,
)
from recrl.orchestrator.tracking.mlflow_sync import sync
from recrl.orchestrator.tracking.positions import Position, read_position
from recrl.orchestrator.tracking.run_content import (
    final_points,
    note,
    params,
    points,
    rows_after,
    thinned,
)
from recrl.orchestrator.tracking.run_status import trial_run_status
from recrl.orchestrator.tracking.ui import open_ui, ui_command, ui_url
from tests.faults.chaos import comm
from tests.faults.committing import commit_file

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient

ROWS = b"update,phase,noise\n1,training,0.0\n2,training,0.5\n3,training,0.0\n4,training,0.0\n"


# What is shown, without MLflow


def test_twelve_costs_are_in_their_order() -> None:
    costs = {f"cost_{i}": str(float(i)) for i in range(12)}
    limits = {f"deploy_limit_{i}": str(100.0 + i) for i in range(12)}
    verdict = {"feasible": "True", "optimal": "False", "exact": "False", "episode_return": "1"}
    verdict |= {f"excess_{i}": str(0.5 * i) if i in (2, 11) else "" for i in range(12)}
    outcome = _outcome(
        {"trial_id": "x", "task": "t", "agent": "a", "method": "m", **costs, **limits, **verdict}
    )
    assert outcome.costs == tuple(map(float, range(12)))
    assert outcome.limits == tuple(100.0 + i for i in range(12))
    assert outcome.excesses == (0.0, 0.0, 1.0, *[0.0] * 8, 5.5)


def test_a_database_that_another_process_made_first_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "mlflow.db"

    class Client:
        def __init__(self, uri: str) -> None:
            self.path = sqlite_path(uri)

        def search_experiments(self, max_results: int) -> None:
            assert self.path
            self.path.write_bytes(b"empty")
            path.write_bytes(b"runs of another launch")  # meanwhile

    monkeypatch.setattr("mlflow.tracking.MlflowClient", Client)
    client.connect(f"sqlite:///{path}")
    assert path.read_bytes() == b"runs of another launch"
    assert {it.name for it in tmp_path.iterdir()} == {"mlflow.db", ".mlflow.db.lock"}


def test_what_a_killed_process_left_of_a_database_is_removed(tmp_path: Path) -> None:
    left = tmp_path / ".mlflow.db-0123abcd"
    left.mkdir()
    (left / "recrl-scratch.lock").touch()
    (left / "mlflow.db").write_bytes(b"half of the tables")
    client.connect(f"sqlite:///{tmp_path}/mlflow.db")
    assert {it.name for it in tmp_path.iterdir()} == {"mlflow.db", ".mlflow.db.lock"}


def test_a_full_disk_ends_a_pass_and_not_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    tracker = mlflow_sync.Tracker(SweepStore(tmp_path, "s"), "sqlite:///x.db")
    monkeypatch.setattr(tracker, "bring_up_to_date", full)
    report = background_sync._pass(tracker, mlflow_sync.SyncReport(), live=True)
    assert "No space left" in report.problem
    assert not report.is_up_to_date
    assert "No space left" in capsys.readouterr().out


def test_rows_behind_a_byte_are_read_with_the_byte_behind_each() -> None:
    first, *_, last = rows_after(ROWS, 0)
    assert first == (34, {"update": "1", "phase": "training", "noise": "0.0"})
    assert last[0] == len(ROWS)
    assert [row["update"] for _, row in rows_after(ROWS, first[0])] == ["2", "3", "4"]
    assert list(rows_after(ROWS, len(ROWS))) == []
    assert list(rows_after(b"", 0)) == []


def updates_shown(num_updates: int) -> list[int]:
    rows = ((end, {"update": str(end), "noise": "0.0"}) for end in range(1, num_updates + 1))
    return [end for end, _ in thinned(rows, num_updates)]


def test_a_long_trial_is_thinned_evenly_and_keeps_its_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recrl.orchestrator.tracking.run_content.POINTS_PER_METRIC", 4)
    assert updates_shown(4) == [1, 2, 3, 4]
    assert updates_shown(11) == [1, 3, 6, 9, 11]
    assert updates_shown(1) == [1]


def test_thinning_does_not_depend_on_when_the_file_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recrl.orchestrator.tracking.run_content.POINTS_PER_METRIC", 2)
    whole = list(thinned(rows_after(ROWS, 0), 4))
    lengths = [end for end, _ in rows_after(ROWS, 0)]
    for cut in lengths:
        early = list(thinned(rows_after(ROWS[:cut], 0), 4))
        late = list(thinned(rows_after(ROWS, early[-1][0]), 4))
        assert early + late == whole


def test_a_burst_of_noise_is_not_thinned_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recrl.orchestrator.tracking.run_content.POINTS_PER_METRIC", 1)
    assert [row["noise"] for _, row in thinned(rows_after(ROWS, 0), 4)] == ["0.0", "0.5"]


def test_points_are_sorted_into_chart_sections(made_up_sweep: Callable[..., SweepStore]) -> None:
    spec = first_trial(made_up_sweep(**SMALL)).spec
    row = {
        "update": "7",
        "phase": "training",
        "end_step": "2800",
        "episodes": "3",
        "episode_return": "-1.5",
        "noise": "0.0",
        "time": "1700000000.25",
        "collect_seconds": "0.3",
        "update_seconds": "0.1",
        "cost_0": "nan",
        "limit_0": "inf",
        "kl": "0.01",
        "cost_value_loss": "2.0",
    }
    assert {point.key: point.value for point in points(row, spec)} == {
        "train/return": -1.5,
        "perf/episodes": 3.0,
        "curriculum/noise": 0.0,
        "perf/steps_per_second": pytest.approx(400 / 0.4),
        "agent/kl": 0.01,
        "agent/cost_value_loss": 2.0,
    }
    assert {(point.step, point.milliseconds) for point in points(row, spec)} == {(2800, 1700000000250)}
    changed = {"phase": "deployment", "cost_0": "4.5", "limit_0": "5.0", "entropy_coefficient": "0.25"}
    deployed = points({**row, **changed}, spec)
    values = {point.key: point.value for point in deployed}
    assert values["curriculum/entropy_coefficient"] == 0.25
    assert (values["deploy/return"], values["deploy/cost_0"]) == (-1.5, 4.5)
    assert (values["deploy/limit_0"], values["curriculum/limit_0"]) == (5.0, 5.0)


def test_the_summary_weighs_updates_by_their_episodes() -> None:
    updates = pd.DataFrame(
        {
            "phase": ["training", "deployment", "deployment", "deployment"],
            "episodes": [10, 1, 3, 0],
            "episode_return": [-9.0, 4.0, 8.0, math.nan],
            "cost_0": [99.0, 2.0, 6.0, math.nan],
        }
    )
    evaluation = pd.DataFrame({"policy": ["deterministic"], "episode_return": [9.5], "cost_0": [5.0]})
    last_row = {"time": "1.0", "end_step": "400"}
    final = final_points(updates, evaluation, last_row)
    assert {(point.step, point.milliseconds) for point in final} == {(0, 1000)}  # drawn as bars
    assert {point.key: point.value for point in final} == {
        "summary/deploy_return": 7.0,
        "summary/deploy_cost_0": 5.0,
        "evaluation/deterministic_return": 9.5,
        "evaluation/deterministic_cost_0": 5.0,
    }
    training = final_points(updates[:1], evaluation[:0], last_row)
    assert training == []


def test_the_view_has_each_cost_and_its_limit_in_one_chart() -> None:
    view = json.loads(view_tag(2)["mlflow.sharedViewState.recrl"])
    charts = view["compareRunCharts"]
    names = [name for section in ("deploy", "train") for i in range(2) for name in charts_of(section, i)]
    assert [(it["metricKey"], it["deleted"]) for it in charts] == names
    assert charts[0]["selectedMetricKeys"] == ["deploy/cost_0", "deploy/limit_0"]
    assert {it["metricSectionId"] for it in charts} < {it["uuid"] for it in view["compareRunSections"]}
    assert json.loads(view_tag(0)["mlflow.sharedViewState.recrl"])["compareRunCharts"] == []


def charts_of(section: str, i: int) -> list[tuple[str, bool]]:
    """Metrics of two charts, and whether MLflow leaves them out."""
    return [(f"{section}/cost_{i}", False), (f"{section}/limit_{i}", True)]


REPORT = """\
# demo

- map: 1 of 2 final policies solve it.

| task | agent | verdict |
| --- | --- | --- |
| map | cpo | solved 1 of 2 |

## Trials and warnings

2 trials
"""


def test_the_note_has_the_progress_links_and_what_the_report_begins_with() -> None:
    counts = {"complete": 2, "failed": 0, "running": 1}
    text = note("demo", counts, charts="#/charts", report="#/report", report_text=REPORT)
    assert text.splitlines() == [
        "**demo**: 3 trials (2 complete, 1 running). [Charts, seeds averaged](#/charts).",
        "[Report](#/report); its figures are artifacts of this run.",
        *REPORT.splitlines()[1:7],
    ]
    before = note("demo", counts, charts="#/charts", report="#/report", report_text="")
    assert before.splitlines() == [
        text.splitlines()[0],
        "No report of these results yet: `recrl-sweep figures demo` draws it.",
    ]


def test_a_long_note_is_cut_where_mlflow_would_refuse_it() -> None:
    rows = "\n".join(f"| task-{index} | cpo | none | solved | 5.00 |" for index in range(999))
    text = note(
        "demo", {"complete": 999}, charts="#/charts", report="#/report", report_text=f"# demo\n{rows}"
    )
    assert 7000 < len(text) < 8000
    assert text.endswith("| solved | 5.00 |\n\nMore than fits here: see the report.")


def test_params_are_few_and_flat(made_up_sweep: Callable[..., SweepStore]) -> None:
    flat = params(first_trial(made_up_sweep(**SMALL)).spec)
    assert flat["task"] == "river-a"
    assert flat["task.horizon"] == "10"
    assert (flat["seed"], flat["train_limits"], flat["deploy_limits"]) == ("0", "100", "5")


def test_params_are_what_the_grid_says(made_up_sweep: Callable[..., SweepStore]) -> None:
    spec = replace(
        first_trial(made_up_sweep(**SMALL)).spec,
        train_limits=CostLimits((math.inf, 1_234_567.0, 6.5)),
        deploy_limits=CostLimits((25.0, 0.1234567, 0.0)),
        train_steps=9_500_001,
        deploy_steps=500_000,
    )
    flat = params(spec)
    assert flat["train_limits"] == "auto, 1234567, 6.5"  # of d_t = auto only the curriculum knows a number
    assert flat["deploy_limits"] == "25, 0.1234567, 0"
    assert (flat["total_steps"], flat["train_steps"], flat["deploy_steps"]) == (
        "10000001",
        "9500001",
        "500000",
    )


# Where and in what state


def test_the_default_store_is_a_database_in_the_sweeps_folder(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "demo")
    assert tracking_uri(store, None) == f"sqlite:///{tmp_path}/demo/mlflow.db"
    assert tracking_uri(store, "sqlite:///some.db") == f"sqlite:///{Path.cwd()}/some.db"
    assert tracking_uri(store, "http://mlflow:5000") == "http://mlflow:5000"


@pytest.mark.parametrize("name", ["a?b", "a%41b", "a#b", "a b", "ä"])
def test_a_database_may_lie_below_any_folder(tmp_path: Path, name: str) -> None:
    store = SweepStore(tmp_path / name, "demo")
    uri = tracking_uri(store, None)
    assert sqlite_path(uri) == store.mlflow_database
    assert tracking_uri(store, uri) == uri
    assert make_url(uri).database == str(store.mlflow_database)


@pytest.mark.parametrize("given", ["mlruns", "file:///tmp/mlruns", "http://", "sqlite:///", "databricks"])
def test_a_place_that_mlflow_cannot_keep_a_sweep_in_is_refused(tmp_path: Path, given: str) -> None:
    with pytest.raises(RecrlError, match=r"^the tracking address must be .*, got '") as caught:
        tracking_uri(SweepStore(tmp_path, "demo"), given)
    assert type(caught.value) is RecrlError  # a wrong argument, and not an MLflow that is away


@pytest.mark.parametrize(
    ("status", "live", "expected"),
    [
        (TrialStatus.COMPLETE, True, "FINISHED"),
        (TrialStatus.FAILED, True, "FAILED"),
        (TrialStatus.RUNNING, True, "RUNNING"),
        (TrialStatus.WAITING, True, "SCHEDULED"),
        (TrialStatus.WAITING, False, "KILLED"),
    ],
)
def test_run_states_are_true(status: TrialStatus, live: bool, expected: str) -> None:
    record = TrialRecord(
        status=status, attempt=1, heartbeat=time.time(), pid=os.getpid(), pid_scope=process_scope()
    )
    assert trial_run_status(record, live=live, silence_seconds=300.0) == expected


def test_a_trial_that_died_or_fell_silent_does_not_run_for_ever() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    here = TrialRecord(
        status=TrialStatus.RUNNING, heartbeat=time.time(), pid=process.pid, pid_scope=process_scope()
    )
    assert trial_run_status(here, live=True, silence_seconds=300.0) == "KILLED"
    elsewhere = replace(here, pid_scope="another container of this host")
    assert trial_run_status(elsewhere, live=True, silence_seconds=300.0) == "RUNNING"
    silent = replace(elsewhere, heartbeat=time.time() - 301.0)
    assert trial_run_status(silent, live=True, silence_seconds=300.0) == "KILLED"


# Against a real database

SMALL: dict[str, Any] = {
    "tasks": ("river-a",),
    "agents": ("cpo",),
    "methods": ("none", "dynamic"),
    "seeds": 1,
}
NONE, DYNAMIC = "river-a cpo none seed 0", "river-a cpo dynamic seed 0"


@pytest.fixture
def write(made_up_sweep: Callable[..., SweepStore], empty_database: Path) -> Callable[..., SweepStore]:
    """A function that writes a made-up sweep with an MLflow store that is ready."""

    def write(**fields: Any) -> SweepStore:
        store = made_up_sweep(**{**SMALL, **fields})
        shutil.copy(empty_database, store.mlflow_database)
        return store

    return write


def first_trial(store: SweepStore) -> TrialStore:
    return store.trials()[0]


def trial_titled(store: SweepStore, title: str) -> TrialStore:
    return next(trial for trial in store.trials() if trial.spec.title == title)


def connect(store: SweepStore) -> MlflowClient:
    from mlflow.tracking import MlflowClient  # noqa: PLC0415  (takes seconds, and reads the environment)

    return MlflowClient(tracking_uri(store, None))


def runs(store: SweepStore) -> dict[str, Run]:
    """The runs that MLflow shows of the sweep, by name; each name once."""
    client = connect(store)
    experiment = client.get_experiment_by_name(f"recrl/{store.name}")
    assert experiment is not None
    found = list(client.search_runs([experiment.experiment_id]))
    assert len({run.info.run_name for run in found}) == len(found)
    return {str(run.info.run_name): run for run in found}


def history(store: SweepStore, run: Run) -> dict[str, list[tuple[int, int, float]]]:
    """Every point of a run: (step, time, value) by key."""
    client = connect(store)
    return {
        key: sorted((m.step, m.timestamp, m.value) for m in client.get_metric_history(run.info.run_id, key))
        for key in run.data.metrics
    }


def everything(store: SweepStore) -> dict[str, Any]:
    """All that MLflow shows of a sweep, but for names that MLflow made up itself."""
    return {
        name: {
            "points": history(store, run),
            "params": run.data.params,
            "tags": {key: value for key, value in run.data.tags.items() if key != "mlflow.parentRunId"},
            "status": run.info.status,
            "end": run.info.end_time,
            "artifacts": sorted(file.path for file in connect(store).list_artifacts(run.info.run_id)),
        }
        for name, run in runs(store).items()
    }


def test_a_sweep_is_shown_as_a_parent_and_a_run_a_trial(write: Callable[..., SweepStore]) -> None:
    store = write(
        unfinished=(NONE,), failed=("river-a cpo linear seed 0",), methods=("none", "linear", "dynamic")
    )
    report = sync(store, tracking_uri(store, None))
    assert (report.trials, report.behind, report.problem) == (3, 0, "")
    shown = runs(store)
    parent = shown.pop("made-up")
    assert {name: run.info.status for name, run in shown.items()} == {
        DYNAMIC: "FINISHED",
        NONE: "RUNNING",
        "river-a cpo linear seed 0": "FAILED",
    }
    assert {run.data.tags["mlflow.parentRunId"] for run in shown.values()} == {parent.info.run_id}
    assert parent.data.metrics == {}
    assert "3 trials (1 complete, 1 running, 1 failed)" in parent.data.tags["mlflow.note.content"]
    assert shown["river-a cpo linear seed 0"].data.tags["recrl.error"] == "ValueError: the river froze"
    run = shown[DYNAMIC]
    assert (run.data.params["method"], run.data.params["seed"]) == ("dynamic", "0")
    updates = trial_titled(store, DYNAMIC).updates()
    points = history(store, run)
    assert [value for _, _, value in points["agent/kl"]] == updates["kl"].tolist()
    assert [step for step, _, _ in points["agent/kl"]] == updates["end_step"].tolist()
    assert len(points["train/return"]) == 38
    assert len(points["deploy/return"]) == 2
    assert len(points["evaluation/deterministic_return"]) == 1
    artifacts = {file.path for file in connect(store).list_artifacts(run.info.run_id)}
    assert {"spec.json", "evaluation.csv", "checkpoint-00000040.recrl"} <= artifacts
    assert store.mlflow_artifacts.is_dir()


def test_a_pass_beside_a_launch_does_not_say_that_its_waiting_trials_were_killed(
    write: Callable[..., SweepStore],
) -> None:
    store = write(missing=(NONE,))
    [begun] = store.specs()
    store.write_specs([begun, replace(begun, seed=7)])
    for ended in (True, False, True):
        with nullcontext() if ended else store.lock():
            assert sync(store, tracking_uri(store, None)).is_up_to_date
        assert runs(store)["made-up"].info.status == ("KILLED" if ended else "RUNNING")


def test_a_pass_over_what_is_known_sends_nothing(write: Callable[..., SweepStore]) -> None:
    store = write()
    uri = tracking_uri(store, None)
    assert sync(store, uri).points > 0
    before = everything(store)
    assert sync(store, uri).points == 0
    assert everything(store) == before


def grow(store: SweepStore, other: SweepStore, title: str) -> None:
    """Replace a half-done trial's files by those of the same trial when it was done."""
    trial = trial_titled(store, title)
    shutil.rmtree(trial.folder)
    shutil.copytree(other.trial(trial.spec).folder, trial.folder)


@pytest.fixture
def half_and_done(write: Callable[..., SweepStore], tmp_path: Path) -> tuple[SweepStore, SweepStore]:
    """A sweep of which a trial is half done, and what it looks like when it is done."""
    done = write()
    kept = tmp_path / "later"
    shutil.move(done.folder, kept / done.name)
    return write(unfinished=(DYNAMIC,)), SweepStore(kept, done.name)


def test_a_view_that_grew_equals_one_rebuilt_from_the_files(
    half_and_done: tuple[SweepStore, SweepStore],
) -> None:
    store, done = half_and_done
    uri = tracking_uri(store, None)
    first = sync(store, uri)
    grow(store, done, DYNAMIC)
    second = sync(store, uri)
    assert min(first.points, second.points) > 0
    grown = everything(store)
    assert sync(store, uri, rebuild=True).points == first.points + second.points
    assert everything(store) == grown
    assert grown[DYNAMIC]["status"] == "FINISHED"


def test_killed_between_mlflows_reply_and_the_position_nothing_doubles(
    half_and_done: tuple[SweepStore, SweepStore],
) -> None:
    store, done = half_and_done
    uri = tracking_uri(store, None)
    sync(store, uri)
    (positions,) = store.sync_folder.iterdir()
    saved = {path: path.read_bytes() for path in positions.glob("trial-*.json")}
    grow(store, done, DYNAMIC)
    sync(store, uri)
    shown = everything(store)
    for path, text in saved.items():
        path.write_bytes(text)
    assert sync(store, uri).points > 0
    assert everything(store) == shown


@pytest.mark.parametrize("text", ["", '{"run_id": "0", "offset": "many"}'])
def test_a_damaged_position_is_made_anew(write: Callable[..., SweepStore], text: str) -> None:
    store = write()
    uri = tracking_uri(store, None)
    sync(store, uri)
    shown = everything(store)
    for path in store.sync_folder.glob("*/trial-*.json"):
        path.write_text(text)
    assert sync(store, uri).behind == 0
    assert everything(store) == shown


def test_a_damaged_trial_is_failed_and_the_others_go_on(
    half_and_done: tuple[SweepStore, SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, done = half_and_done
    uri = tracking_uri(store, None)
    tracker = mlflow_sync.Tracker(store, uri)
    assert tracker.bring_up_to_date(live=True).is_up_to_date
    trial = trial_titled(store, NONE)
    whole = trial.episodes_path.read_bytes()
    trial.episodes_path.write_bytes(whole[:-9])
    points = len(history(store, runs(store)[NONE])["agent/kl"])
    monkeypatch.setattr(mlflow_sync, "_View", None)  # must not be needed again
    report = tracker.bring_up_to_date(live=True)
    assert (report.problem, report.behind, report.is_broken_off) == ("", 0, False)
    shown = runs(store)[NONE]
    assert (shown.info.status, shown.data.tags["recrl.status"]) == ("FAILED", "damaged")
    assert shown.data.tags["recrl.error"] == trial.record().error
    assert len(history(store, shown)["agent/kl"]) == points
    grow(store, done, DYNAMIC)
    assert tracker.bring_up_to_date(live=True).points > 0  # of the other trial
    trial.episodes_path.write_bytes(whole)
    assert tracker.bring_up_to_date(live=True).is_up_to_date
    mended = runs(store)[NONE]
    assert (mended.info.status, mended.data.tags.get("recrl.error")) == ("FINISHED", None)


def test_a_trial_that_is_damaged_before_it_is_shown_gets_its_params_when_mended(
    write: Callable[..., SweepStore],
) -> None:
    store = write()
    uri = tracking_uri(store, None)
    trial = trial_titled(store, NONE)
    whole = trial.episodes_path.read_bytes()
    trial.episodes_path.write_bytes(whole[:-9])
    report = sync(store, uri)
    assert (report.behind, report.is_broken_off) == (1, False)
    assert NONE not in runs(store)
    trial.episodes_path.write_bytes(whole)
    assert sync(store, uri).is_up_to_date
    assert runs(store)[NONE].data.params.keys() == runs(store)[DYNAMIC].data.params.keys()


def test_a_damaged_spec_takes_the_outcome_from_its_run(
    write: Callable[..., SweepStore],
) -> None:
    store = write()
    uri = tracking_uri(store, None)
    write_outcomes(store)
    assert sync(store, uri).is_up_to_date
    trial = trial_titled(store, NONE)
    whole = trial.spec_path.read_bytes()
    trial.spec_path.write_bytes(whole[:-9])
    damaged = SweepStore(store.folder.parent, store.name)
    assert sync(damaged, uri).is_up_to_date
    shown = runs(store)[NONE]
    assert shown.info.status == "FAILED"
    assert not {"recrl.verdict", "mlflow.note.content"} & shown.data.tags.keys()
    note = runs(store)["made-up"].data.tags["mlflow.note.content"]
    assert "1 damaged" in note
    trial.spec_path.write_bytes(whole)
    assert sync(SweepStore(store.folder.parent, store.name), uri).is_up_to_date
    assert runs(store)[NONE].data.tags["recrl.verdict"] == "solved"


def test_a_position_of_an_earlier_version_is_read(tmp_path: Path) -> None:
    """It had one more key."""
    path = tmp_path / "position.json"
    Position("run", 7, "row").write(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), "summary": {"summary/deploy_return": 1.0}}))
    assert read_position(path) == Position("run", 7, "row")


def test_rows_that_changed_in_a_byte_break_no_pass_off(write: Callable[..., SweepStore]) -> None:
    store = write()
    path = trial_titled(store, NONE).updates_path
    path.write_bytes(path.read_bytes()[:-2] + b"x\n")
    report = sync(store, tracking_uri(store, None))
    assert (report.behind, report.is_broken_off) == (1, False)
    assert "updates.csv is not what was committed: its checksum differs" in report.problem


def test_a_run_deleted_by_hand_is_made_again(write: Callable[..., SweepStore]) -> None:
    store = write()
    uri = tracking_uri(store, None)
    sync(store, uri)
    shown = everything(store)
    for run in runs(store).values():
        connect(store).delete_run(run.info.run_id)
    sync(store, uri)
    assert everything(store) == shown


def test_two_processes_make_one_run_of_a_trial(
    half_and_done: tuple[SweepStore, SweepStore], tmp_path: Path
) -> None:
    store, done = half_and_done
    uri = tracking_uri(store, None)
    started = trial_titled(store, DYNAMIC).folder
    shutil.move(started, tmp_path / "not-yet")
    launch = mlflow_sync.Tracker(store, uri)
    assert launch.bring_up_to_date(live=True).trials == 1
    shutil.move(tmp_path / "not-yet", started)
    assert sync(store, uri).points > 0  # as `recrl-sweep sync` does during the launch
    grow(store, done, DYNAMIC)
    assert launch.bring_up_to_date(live=True).points > 0
    run = runs(store)[DYNAMIC]  # `runs` refuses two runs of one name
    assert run.info.status == "FINISHED"
    assert len(history(store, run)["agent/kl"]) == 40


def test_a_run_whose_maker_died_over_it_gets_its_params(write: Callable[..., SweepStore]) -> None:
    store = write()
    uri = tracking_uri(store, None)
    sync(store, uri)
    shown, client = runs(store)[NONE], connect(store)
    client.delete_run(shown.info.run_id)
    half = client.create_run(
        shown.info.experiment_id, run_name=NONE, start_time=shown.info.start_time, tags=shown.data.tags
    )
    assert sync(store, uri).is_up_to_date
    assert runs(store)[NONE].info.run_id == half.info.run_id
    assert runs(store)[NONE].data.params == shown.data.params


def test_a_refused_write_is_noticed_also_if_the_user_logs_asynchronously(
    write: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_ENABLE_ASYNC_LOGGING", "true")
    store = write()
    uri = tracking_uri(store, None)
    connect(store).search_experiments()  # makes the tables
    with closing(sqlite3.connect(store.mlflow_database)) as database:
        database.execute(
            "CREATE TRIGGER refuse BEFORE INSERT ON metrics BEGIN SELECT RAISE(ABORT, 'disk trouble'); END"
        )
        report = sync(store, uri)
        assert not report.is_up_to_date
        assert "disk trouble" in report.problem
        database.execute("DROP TRIGGER refuse")
        assert sync(store, uri).is_up_to_date
    assert history(store, runs(store)[NONE])["train/return"]


def test_the_files_of_a_shared_database_are_beside_it(
    write: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = write()
    assert sync(store, f"sqlite:///{tmp_path}/shared/mlflow.db").is_up_to_date
    assert (tmp_path / "shared" / "mlartifacts").is_dir()
    assert not store.mlflow_artifacts.exists()


def test_where_files_do_not_fit_the_curves_are_there(write: Callable[..., SweepStore]) -> None:
    store = write()
    uri = tracking_uri(store, None)
    store.mlflow_artifacts.touch()  # where a folder should be
    report = sync(store, uri)
    assert (report.behind, report.points) == (2, 0)
    assert "mlartifacts" in report.problem
    shown = runs(store)[NONE]
    assert shown.data.metrics.keys() >= {"train/return", "summary/deploy_return"}
    assert shown.data.params["task"] == "river-a"
    assert "recrl.status" not in shown.data.tags
    store.mlflow_artifacts.unlink()
    assert sync(store, uri).is_up_to_date
    assert runs(store)[NONE].data.tags["recrl.status"] == "complete"


def test_without_the_library_of_the_files_store_the_curves_are_there(
    write: Callable[..., SweepStore], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = write()
    uri = tracking_uri(store, None)
    missing = Mock(side_effect=ModuleNotFoundError("No module named 'boto3'"))
    monkeypatch.setattr("recrl.orchestrator.tracking.mlflow_runs.SweepRuns.send_files", missing)
    assert "No module named 'boto3'" in sync(store, uri).problem
    assert runs(store)[NONE].data.metrics.keys() >= {"train/return", "summary/deploy_return"}
    monkeypatch.undo()
    assert sync(store, uri).is_up_to_date


def test_rows_that_were_cut_back_are_gone_from_mlflow_too(
    half_and_done: tuple[SweepStore, SweepStore],
) -> None:
    store, done = half_and_done
    sync(store, tracking_uri(store, None))
    grow(store, done, DYNAMIC)
    trial = trial_titled(store, DYNAMIC)
    text = trial.updates_path.read_text().replace("1700000020.0", "1700009999.0")  # update 20, written anew
    commit_file(trial, "updates.csv", text)
    sync(store, tracking_uri(store, None))
    points = history(store, runs(store)[DYNAMIC])["agent/kl"]
    assert len(points) == 40
    assert points[19][:2] == (20 * 400, 1700009999000)


def test_a_tag_that_is_gone_already_keeps_no_run_from_its_state(write: Callable[..., SweepStore]) -> None:
    store = write(failed=(DYNAMIC,))
    uri = tracking_uri(store, None)
    sync(store, uri)
    connect(store).delete_tag(runs(store)[DYNAMIC].info.run_id, "recrl.error")  # by a pass that was killed
    trial = trial_titled(store, DYNAMIC)
    trial.begin(trial.spec)
    assert sync(store, uri).is_up_to_date
    assert runs(store)[DYNAMIC].info.status == "RUNNING"


def test_a_resumed_trial_runs_again_and_loses_its_error(write: Callable[..., SweepStore]) -> None:
    store = write(failed=(DYNAMIC,))
    uri = tracking_uri(store, None)
    sync(store, uri)
    trial = trial_titled(store, DYNAMIC)
    trial.begin(trial.spec)
    sync(store, uri)
    run = runs(store)[DYNAMIC]
    assert run.info.status == "RUNNING"
    assert "recrl.error" not in run.data.tags
    assert run.data.tags["recrl.attempt"] == "2"
    trial.write_record(replace(trial.record(), pid=2**22 + 1))  # no process has this number
    sync(store, uri)
    assert runs(store)[DYNAMIC].info.status == "KILLED"


def test_a_trial_that_mlflow_refuses_does_not_stop_the_others(write: Callable[..., SweepStore]) -> None:
    store = write()
    trial_titled(store, NONE).updates_path.write_bytes(b"update\n" * 4000)
    report = sync(store, tracking_uri(store, None))
    assert report.behind == 1
    assert report.problem.startswith(trial_titled(store, NONE).folder.name)
    assert runs(store)[DYNAMIC].info.status == "FINISHED"


def test_figures_are_artifacts_of_the_parent_and_survive_a_rebuild(write: Callable[..., SweepStore]) -> None:
    store = write()
    uri = tracking_uri(store, None)
    store.figures_folder.mkdir()
    path = store.figures_folder / "curves.png"
    path.write_bytes(b"png")
    sync(store, uri)
    path.write_bytes(b"better png")
    sync(store, uri)
    sync(store, uri, rebuild=True)
    parent = runs(store)["made-up"].info.run_id
    assert [file.path for file in connect(store).list_artifacts(parent, "figures")] == ["figures/curves.png"]


def write_outcomes(store: SweepStore, *, dynamic_cost: float = 9.0625) -> None:
    """Write the table beside the report: NONE is solved, DYNAMIC infeasible."""
    none, dynamic = (trial_titled(store, title).spec.trial_id for title in (NONE, DYNAMIC))
    store.figures_folder.mkdir(exist_ok=True)
    (store.figures_folder / "outcomes.csv").write_text(f"""\
trial_id,task,agent,method,seed,measure,exact,episode_return,cost_0,deploy_limit_0,feasible,optimal,excess_0
{none},river-a,cpo,none,0,deployment,False,1.0,9.0,5.0,False,False,4.0
{none},river-a,cpo,none,0,stochastic,True,14.0,5.0,5.0,True,True,
{dynamic},river-a,cpo,dynamic,0,stochastic,True,15.0,{dynamic_cost},5.0,False,False,{dynamic_cost - 5.0}
""")


def test_each_run_has_the_verdict_of_the_report(write: Callable[..., SweepStore]) -> None:
    """The values come from the table beside the report, so both show the same."""
    store = write()
    uri = tracking_uri(store, None)
    sync(store, uri)
    assert "final/return" not in runs(store)[NONE].data.metrics
    write_outcomes(store)
    (store.figures_folder / "report.md").write_text("# made-up\n\n- river-a: solved.\n\n## More\n")
    sync(store, uri)
    shown = runs(store)
    parent, run = shown["made-up"], shown[DYNAMIC]
    final = {key: value for key, value in run.data.metrics.items() if key.startswith("final/")}
    assert final == {"final/return": 15.0, "final/cost_0": 9.0625, "final/limit_0": 5.0}
    assert {step for key in final for step, _, _ in history(store, run)[key]} == {0}
    assert [shown[name].data.tags["recrl.verdict"] for name in (NONE, DYNAMIC)] == ["solved", "infeasible"]
    assert run.data.tags["mlflow.note.content"].startswith(
        "**infeasible by 4.06**: return 15.00, cost 9.062, limit d_d 5.00, training limit d_t 100.0."
    )
    lines = parent.data.tags["mlflow.note.content"].splitlines()
    assert lines[2:] == ["", "- river-a: solved."]
    page = f"#/experiments/{parent.info.experiment_id}/runs/{parent.info.run_id}/artifacts"
    assert lines[1] == f"[Report]({page}/figures/report.html); its figures are artifacts of this run."
    assert sync(store, uri).points == 0
    write_outcomes(store)  # newer than the report
    sync(store, uri)
    assert "river-a" not in runs(store)["made-up"].data.tags["mlflow.note.content"]
    sync(store, uri, rebuild=True)
    assert runs(store)[NONE].data.metrics["final/cost_0"] == 5.0


def test_of_outcomes_measured_twice_the_newest_is_shown(write: Callable[..., SweepStore]) -> None:
    """Of equal steps MLflow shows the latest time, and of equal times the largest value."""
    store = write()
    uri = tracking_uri(store, None)
    for cost in (9.0625, 7.5):
        write_outcomes(store, dynamic_cost=cost)
        sync(store, uri)
    assert runs(store)[DYNAMIC].data.metrics["final/cost_0"] == 7.5


def test_a_trial_of_an_earlier_grid_does_not_get_the_outcome_of_its_namesake(
    write: Callable[..., SweepStore],
) -> None:
    store = write()
    write_outcomes(store)
    path = store.figures_folder / "outcomes.csv"
    path.write_text(path.read_text().replace(trial_titled(store, DYNAMIC).spec.trial_id, "0123456789"))
    sync(store, tracking_uri(store, None))
    shown = runs(store)
    assert "final/cost_0" not in shown[DYNAMIC].data.metrics
    assert shown[NONE].data.metrics["final/cost_0"] == 5.0


def test_a_trial_that_ran_again_does_not_keep_the_outcome_of_before(write: Callable[..., SweepStore]) -> None:
    store = write()
    sweep_tables.write_outcomes(sweep_data.load(store), store.figures_folder)
    outcomes = FinalOutcomes(store)
    trial = trial_titled(store, DYNAMIC)
    before = trial.record()
    found = outcomes.of(trial.spec, before)
    assert found is not None
    assert found.cpu_seconds == before.cpu_seconds > 0.0
    assert not outcomes.lack_a_complete_trial()
    assert outcomes.of(trial.spec, replace(before, status=TrialStatus.RUNNING)) is None
    again = replace(before, cpu_seconds=before.cpu_seconds + 0.25)
    assert outcomes.of(trial.spec, again) is None
    with trial.locked():
        trial.write_record(again)
    assert outcomes.lack_a_complete_trial()


def test_trials_that_left_the_grid_are_averaged_with_none_of_it(write: Callable[..., SweepStore]) -> None:
    store = write()
    uri = tracking_uri(store, None)
    write_outcomes(store)
    sync(store, uri)
    groups = {title: run.data.tags.get("recrl.group") for title, run in runs(store).items()}
    assert groups[DYNAMIC] == "dynamic, cpo, river-a"
    kept = [spec for spec in store.specs() if spec.title != DYNAMIC]
    store.write_specs(kept)
    trial = trial_titled(store, DYNAMIC)
    trial.set_status(TrialStatus.FAILED, error="no luck")
    sync(store, uri)
    shown = runs(store)
    assert shown[DYNAMIC].data.tags["recrl.group"] == "dynamic, cpo, river-a, no longer in the grid"
    parent = shown["made-up"]
    assert parent.info.status == "FINISHED"
    text = parent.data.tags["mlflow.note.content"]
    assert "1 trial (1 complete)" in text
    assert "dynamic" not in text


GRID = """\
name: small
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag]
methods: [none]
seeds: 1
run: {total_steps: 80, deploy_fraction: 0.5, num_envs: 4, rollout_steps: 10, evaluation_episodes: 2}
"""
LAUNCH = ("launch", "grid.yaml", "--executor", "inline", "--no-figures")


class FakeSync:
    """A sync that only notes which files there are at its last pass."""

    def __init__(self, store: SweepStore) -> None:
        self.folder = store.figures_folder
        self.found: list[str] = []

    def stop(self, timeout: float) -> bool:
        self.found = [path.name for path in self.folder.glob("*")]
        return True


def test_a_launch_without_figures_measures_the_final_policies_for_mlflow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("grid.yaml").write_text(GRID)
    fake = FakeSync(SweepStore(Path("runs"), "small"))
    monkeypatch.setattr("recrl.orchestrator.launch_grid._sync_to", lambda uri: lambda store: fake)
    assert main(LAUNCH) == ExitCode.OK
    assert fake.found == ["outcomes.csv"]


def test_outcomes_that_cannot_be_written_end_no_launch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError("no room")

    monkeypatch.chdir(tmp_path)
    Path("grid.yaml").write_text(GRID)
    fake = FakeSync(SweepStore(Path("runs"), "small"))
    monkeypatch.setattr("recrl.orchestrator.launch_grid._sync_to", lambda uri: lambda store: fake)
    monkeypatch.setattr("recrl.analysis.report.table_files.write_outcomes", full)
    assert main(LAUNCH) == ExitCode.OK
    assert (
        "MLflow     has no outcomes of the final policies (OSError: no room)\n"
        "           to send them later: recrl-sweep sync small\n"
    ) in capsys.readouterr().out
    with pytest.warns(
        UserWarning, match=r"MLflow has no outcomes of the final policies \(OSError: no room\)"
    ):
        recrl.launch("grid.yaml", root="other", executor="inline", figures=False, progress=False)


def test_sync_measures_the_final_policies_that_no_report_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, empty_database: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("grid.yaml").write_text(GRID)
    store = SweepStore(Path("runs"), "small")
    assert main([*LAUNCH, "--no-mlflow"]) == ExitCode.OK
    assert not store.figures_folder.exists()
    shutil.copy(empty_database, store.mlflow_database)
    assert main(["sync", "small"]) == ExitCode.OK
    run = runs(store)["two-state ppo-lag none seed 0"]
    assert run.data.metrics.keys() >= {"final/return", "final/cost_0", "final/limit_0"}
    assert run.data.tags["recrl.verdict"] in ("solved", "feasible", "infeasible")
    written = (store.figures_folder / "outcomes.csv").stat().st_mtime_ns
    assert main(["sync", "small"]) == ExitCode.OK
    assert (store.figures_folder / "outcomes.csv").stat().st_mtime_ns == written


def test_sync_rebuilds_what_mlflow_shows(
    tmp_path: Path, made_up_sweep: Callable[..., SweepStore], empty_database: Path
) -> None:
    store = made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none"])
    shutil.copy(empty_database, store.mlflow_database)
    command = ["sync", store.name, "--root", str(tmp_path)]
    assert main(command) == ExitCode.OK
    before = runs(store)
    sent = before["a cpo none seed 0"]
    connect(store).log_metric(sent.info.run_id, "stray", 1.0)
    assert main(command) == ExitCode.OK
    assert "stray" in runs(store)["a cpo none seed 0"].data.metrics
    assert main([*command, "--rebuild"]) == ExitCode.OK
    after = runs(store)
    rebuilt = after["a cpo none seed 0"]
    assert after.keys() == before.keys()
    assert rebuilt.info.run_id != sent.info.run_id
    assert rebuilt.data.metrics == sent.data.metrics


def test_the_verdict_names_every_cost_above_its_limit() -> None:
    """Cost 1 of the first policy is within its tolerance."""
    costs, limits = (5.5, 1050.0), (5.0, 1000.0)
    one = FinalOutcome("a", 4.0, costs, limits, False, False, False, excesses=(0.5, 0.0))
    both = replace(one, excesses=(0.25, 50.0))
    assert trial_note(one, (9.0, 9.0)).startswith("**infeasible, cost 0 by 0.50**: ")
    assert trial_note(both, (9.0, 9.0)).startswith("**infeasible, cost 0 by 0.25, cost 1 by 50.00**: ")


def test_outcomes_of_an_older_version_count_as_not_written(write: Callable[..., SweepStore]) -> None:
    store = write()
    write_outcomes(store)
    assert not FinalOutcomes(store).lack_a_complete_trial()
    path = store.figures_folder / "outcomes.csv"
    path.write_text(path.read_text().replace("excess_0", "worst_excess"))
    assert FinalOutcomes(store).lack_a_complete_trial()


def test_what_is_filmed_after_a_trials_end_reaches_its_run(write: Callable[..., SweepStore]) -> None:
    store = write()
    uri = tracking_uri(store, None)
    sync(store, uri)
    trial = trial_titled(store, DYNAMIC)
    trial.videos_folder.mkdir()
    (trial.videos_folder / "update-00000040__seed-own__stochastic.gif").write_bytes(b"gif")
    sync(store, uri)
    run = runs(store)[DYNAMIC].info.run_id
    assert [file.path for file in connect(store).list_artifacts(run, "videos")] == [
        "videos/update-00000040__seed-own__stochastic.gif"
    ]


# With MLflow away


@pytest.fixture
def closed_port() -> Iterator[int]:
    """A port of this machine that refuses connections: bound, but nobody listens."""
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        yield holder.getsockname()[1]


def test_a_server_that_is_away_costs_seconds_and_is_named(
    made_up_sweep: Callable[..., SweepStore], closed_port: int
) -> None:
    store, uri = made_up_sweep(**SMALL), f"http://127.0.0.1:{closed_port}"
    warning = MlflowWarning(store, LaunchOptions(store.folder.parent, tracking_uri=uri))
    assert warning.once() == ""
    begun = time.monotonic()
    report = sync(store, uri)
    assert time.monotonic() - begun < 60.0  # by itself MLflow would try for four minutes
    assert (report.trials, report.behind, report.points) == (2, 2, 0)
    assert "Connection refused" in report.problem
    assert not report.is_up_to_date
    said = warning.once()  # during a launch
    assert said == f"MLflow is behind ({report.problem}); training goes on, and it is tried again"
    assert warning.once() == ""
    assert MlflowWarning(store, LaunchOptions(store.folder.parent, tracking_uri=uri)).once() == ""


def test_what_was_missed_is_sent_when_mlflow_is_back(
    write: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = write()
    uri = tracking_uri(store, None)
    database = store.mlflow_database.rename(tmp_path / "away.db")
    store.mlflow_database.write_text("not a database")
    report = sync(store, uri)
    assert report.problem == (
        f"TrackingError: {store.mlflow_database}: not a sqlite database; delete it, and it is created anew"
    )
    database.replace(store.mlflow_database)
    assert sync(store, uri).is_up_to_date
    assert mlflow_sync.last_report(store, uri) is not None


# MLflow's pages


def test_the_pages_of_a_database_are_served_to_this_machine_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = SweepStore(tmp_path, "demo")
    command = ui_command(store, tracking_uri(store, None), port=5001)
    assert command[command.index("--host") + 1] == "127.0.0.1"
    assert command[command.index("--port") + 1] == "5001"
    assert "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false" in command
    monkeypatch.setenv("MLFLOW_SERVER_ENABLE_JOB_EXECUTION", "true")  # a user's own setting
    assert "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=true" in ui_command(store, tracking_uri(store, None))


def test_a_server_has_its_own_pages(tmp_path: Path) -> None:
    assert ui_url(SweepStore(tmp_path, "demo"), "http://mlflow:5000/") == "http://mlflow:5000"


def test_a_taken_port_is_named(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "demo")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(TrackingError) as caught:
            open_ui(store, tracking_uri(store, None), port=port)
    assert str(caught.value) == (
        f"port {port} of 127.0.0.1 is taken by another program; choose another --port"
    )


# The process


def wait_until(condition: Callable[[], bool], *, seconds: float = 120.0) -> None:
    """Look until it is so; a process of its own has no other way to tell."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.02)


def test_a_killed_sync_leaves_nothing_lost_and_nothing_twice(write: Callable[..., SweepStore]) -> None:
    store = write(seeds=4)
    uri = tracking_uri(store, None)
    background = start_sync(store, uri, interval_seconds=3600.0)
    wait_until(lambda: any(store.sync_folder.glob("*/trial-*.json")))
    background.process.kill()
    assert not background.stop(timeout=60.0)
    assert sync(store, uri).is_up_to_date
    shown = everything(store)
    for trial in store.trials():
        assert len(shown[trial.spec.title]["points"]["agent/kl"]) == 40
    sync(store, uri, rebuild=True)
    assert everything(store) == shown


def test_a_killed_sync_takes_its_children_along(tmp_path: Path) -> None:
    program = "import subprocess as s; c = s.Popen(['sleep', '600']); print(c.pid, flush=True); c.wait()"
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, start_new_session=True
    )
    assert process.stdout is not None
    with process.stdout:
        child = int(process.stdout.readline())
    assert not BackgroundSync(process).stop(timeout=0.0)
    wait_until(lambda: not comm(child))


def test_a_sync_that_is_stopped_shows_everything_first(write: Callable[..., SweepStore]) -> None:
    store = write(updates=10, unfinished=(DYNAMIC,))
    uri = tracking_uri(store, None)
    background = start_sync(store, uri, interval_seconds=3600.0)
    wait_until(lambda: mlflow_sync.last_report(store, uri) is not None)
    trial_titled(store, DYNAMIC).set_status(TrialStatus.WAITING)
    assert background.stop(timeout=60.0)
    assert {name: run.info.status for name, run in runs(store).items()} == {
        "made-up": "KILLED",
        NONE: "FINISHED",
        DYNAMIC: "KILLED",
    }


def test_a_sync_ends_with_its_parent_and_leaves_the_truth(write: Callable[..., SweepStore]) -> None:
    store = write(updates=10)
    uri = tracking_uri(store, None)
    program = (
        "import os, sys; from pathlib import Path; "
        "from recrl.orchestrator.files.sweep_store import SweepStore; "
        "from recrl.orchestrator.tracking.background_sync import start_sync; "
        "store = SweepStore(Path(sys.argv[1]), sys.argv[2]); "
        "print(start_sync(store, sys.argv[3], interval_seconds=3600.0).process.pid, flush=True); "
        "os.kill(os.getpid(), 9)"
    )
    parent = subprocess.run(
        [sys.executable, "-c", program, str(store.folder.parent), store.name, uri],
        stdout=subprocess.PIPE,
        check=False,
    )
    wait_until(lambda: not Path(f"/proc/{int(parent.stdout)}").exists())
    assert {run.info.status for run in runs(store).values()} == {"FINISHED"}
