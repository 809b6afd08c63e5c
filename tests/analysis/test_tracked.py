"""MLflow alone gives the frames that the files give, as far as it holds them."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import numpy as np
import pandas as pd
import pytest

from recrl.analysis.data import export, sweep_data
from recrl.analysis.data import from_mlflow as mlflow_data
from recrl.analysis.data.labels import KEY
from recrl.analysis.data.sweep_data import Sweep
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.store import SweepStore
from recrl.orchestrator.tracking.database import (
    Database,
    OtherTables,
    Points,
    ShownRun,
    SqliteTables,
    unreadable,
)
from recrl.orchestrator.tracking.mlflow_sync import sync, tracking_uri
from recrl.orchestrator.tracking.reader import find_sweep
from recrl.orchestrator.tracking.snapshot import (
    SNAPSHOT_FOLDER,
    SNAPSHOT_TAG,
    Announcement,
    ShownTrial,
    Snapshot,
)
from recrl.orchestrator.tracking.ui import UI, open_ui
from tests.faults.committing import commit_file

# MLflow 3.17 maps its tables in a way that SQLAlchemy 2.1 calls deprecated; not ours to mend.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy is deprecated")

PORT = 5713
SERVER = f"http://127.0.0.1:{PORT}"
NOT_IN_MLFLOW = ["collect_seconds", "update_seconds"]


@pytest.fixture(scope="module")
def sweep(
    tmp_path_factory: pytest.TempPathFactory, finished_sweep: SweepStore, empty_database: Path
) -> SweepStore:
    """Part of a finished sweep, with policies and a grid, and told to MLflow."""
    root = tmp_path_factory.mktemp("runs")
    store = SweepStore(root, finished_sweep.name)
    for trial in finished_sweep.trials():
        labels = (trial.spec.task.label, trial.spec.agent.label)
        if labels == ("river-a", "cpo") and trial.spec.method.label != "linear":
            shutil.copytree(trial.folder, store.trial(trial.spec).folder)
    trial = store.trials()[0]
    commit_file(trial, "policy.csv", "action_0,action_1\n0.25,0.75\n1.0,0.0\n")
    commit_file(trial, "provenance.json", '{"torch": "9.9"}')
    store.grid_path.write_text("name: made-up\n")
    store.write_info({"name": store.name})
    shutil.copy(empty_database, store.mlflow_database)
    assert sync(store, tracking_uri(store, None)).problem == ""
    return store


@pytest.fixture(scope="module")
def from_files(sweep: SweepStore) -> Sweep:
    return sweep_data.load(sweep)


@pytest.fixture(scope="module")
def from_mlflow(sweep: SweepStore) -> Sweep:
    return mlflow_data.load(tracking_uri(sweep, None), sweep.name)


@pytest.mark.parametrize("name", ["trials", "phases", "evaluations", "events", "policies"])
def test_mlflow_holds_the_same_outcomes(from_mlflow: Sweep, from_files: Sweep, name: str) -> None:
    found, expected = getattr(from_mlflow, name), getattr(from_files, name)
    assert len(expected)
    pd.testing.assert_frame_equal(found[expected.columns], expected, check_exact=True)


def test_every_update_of_a_short_trial_is_there(from_mlflow: Sweep, from_files: Sweep) -> None:
    expected = from_files.updates.drop(columns=NOT_IN_MLFLOW)
    found = from_mlflow.updates[expected.columns].astype({"episodes": np.int64})
    pd.testing.assert_frame_equal(found, expected, check_exact=True)


def test_settings_and_provenance_are_there(from_mlflow: Sweep, from_files: Sweep) -> None:
    assert from_mlflow.grid == "name: made-up\n"
    assert sorted(it.provenance for it in from_mlflow.facts) == sorted(
        it.provenance for it in from_files.facts
    )
    assert from_mlflow.task_options == from_files.task_options


def test_an_infinite_limit_and_a_cost_of_no_episodes_come_back(
    made_up_sweep: Callable[..., SweepStore], empty_database: Path
) -> None:
    store = made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["unconstrained"])
    trial = store.trials()[0]
    text = trial.updates_path.read_text().splitlines()
    header = text[0].split(",")
    cells = text[5].split(",")
    for name in ("cost_0", "episode_return"):
        cells[header.index(name)] = "nan"
    text[5] = ",".join(cells)
    commit_file(trial, "updates.csv", "\n".join(text) + "\n")
    shutil.copy(empty_database, store.mlflow_database)
    assert sync(store, tracking_uri(store, None)).problem == ""
    updates = mlflow_data.load(tracking_uri(store, None), store.name).updates
    assert np.isinf(updates["limit_0"].iloc[:38]).all()
    assert updates["limit_0"].iloc[38:].tolist() == [5.0, 5.0]
    assert np.isnan(updates[["cost_0", "episode_return"]].iloc[4]).all()
    assert updates["cost_0"].notna().sum() == 39


def test_a_long_trial_is_thinned_but_true(
    made_up_sweep: Callable[..., SweepStore], empty_database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recrl.orchestrator.tracking.points.POINTS_PER_METRIC", 10)
    store = made_up_sweep(seeds=2, tasks=["a"], agents=["cpo"], methods=["none"])
    shutil.copy(empty_database, store.mlflow_database)
    assert sync(store, tracking_uri(store, None)).problem == ""
    found, whole = (
        mlflow_data.load(tracking_uri(store, None), store.name).updates,
        sweep_data.load(store).updates,
    )
    assert found["update"].tolist() == [1, *range(4, 41, 4)] * 2
    kept = whole.merge(found[["seed", "update"]])
    for name in ("phase", "end_step", "episodes", "episode_return", "cost_0", "limit_0", "kl", "time"):
        assert found[name].tolist() == kept[name].tolist()


@pytest.fixture(scope="module")
def server(sweep: SweepStore) -> Iterator[UI]:
    ui = open_ui(sweep, tracking_uri(sweep, None), port=PORT)
    yield ui
    ui.close()


def test_a_server_says_what_its_database_says(server: UI, from_mlflow: Sweep) -> None:
    same(mlflow_data.load(SERVER, "made-up"), from_mlflow)


def test_a_server_without_a_snapshot_says_the_same(
    server: UI, from_mlflow: Sweep, sweep: SweepStore, caplog: pytest.LogCaptureFixture
) -> None:
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    client = MlflowClient(SERVER)
    (parent,) = client.search_runs(
        [find_sweep(SERVER, "made-up").experiment_id], "tags.`recrl.kind` = 'sweep'"
    )
    client.delete_tag(parent.info.run_id, SNAPSHOT_TAG)
    try:
        same(mlflow_data.load(SERVER, "made-up"), from_mlflow)
    finally:
        client.set_tag(parent.info.run_id, SNAPSHOT_TAG, parent.data.tags[SNAPSHOT_TAG])
    assert caplog.messages == []


@contextmanager
def announced(store: SweepStore, data: bytes, **changes: Any) -> Iterator[None]:
    """Let MLflow announce other bytes as the sweep's snapshot for a while."""
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    client = MlflowClient(tracking_uri(store, None))
    experiment_id = find_sweep(tracking_uri(store, None), store.name).experiment_id
    (parent,) = client.search_runs([experiment_id], "tags.`recrl.kind` = 'sweep'")
    before = Announcement.of(parent.data.tags[SNAPSHOT_TAG])
    path = Path(urlparse(parent.info.artifact_uri).path) / SNAPSHOT_FOLDER / before.name
    kept = path.read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    told = before.model_copy(update={"size": len(data), "sha256": digest, **changes})
    path.write_bytes(data)
    client.set_tag(parent.info.run_id, SNAPSHOT_TAG, told.model_dump_json())
    try:
        yield
    finally:
        path.write_bytes(kept)
        client.set_tag(parent.info.run_id, SNAPSHOT_TAG, before.model_dump_json())


def taken(store: SweepStore, *, share: float) -> bytes:
    """The snapshot of a time when each trial had done only so much of its updates, in [0, 1]."""
    runs = {trial.spec.trial_id: trial for trial in find_sweep(tracking_uri(store, None), store.name).trials}
    shown = []
    for trial in store.trials():
        lines = trial.updates_path.read_bytes().splitlines(keepends=True)
        committed = sum(map(len, lines[: 1 + round(share * (len(lines) - 1))]))
        run = runs[trial.spec.trial_id]
        complete = share == 1.0
        shown.append(ShownTrial(trial, run.run_id, run.attempt, committed, complete=complete))
    return Snapshot.take(shown).pack()


def same(found: Sweep, expected: Sweep) -> None:
    for name in ("trials", "phases", "updates", "evaluations", "events", "policies"):
        pd.testing.assert_frame_equal(getattr(found, name), getattr(expected, name), check_exact=True)
    assert (found.facts, found.grid, found.notes) == (expected.facts, expected.grid, expected.notes)


def test_a_fresh_snapshot_spares_every_question(
    server: UI, from_mlflow: Sweep, sweep: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recrl.orchestrator.tracking.reader.HISTORY", "/api/2.0/mlflow/not-there")
    same(mlflow_data.load(SERVER, "made-up"), from_mlflow)
    with announced(sweep, taken(sweep, share=0.9)), pytest.raises(TrackingError, match="cannot be read"):
        mlflow_data.load(SERVER, "made-up")


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_what_a_stale_snapshot_lacks_is_asked_for(
    server: UI, from_mlflow: Sweep, sweep: SweepStore, share: float, caplog: pytest.LogCaptureFixture
) -> None:
    with announced(sweep, taken(sweep, share=share)):
        same(mlflow_data.load(SERVER, "made-up"), from_mlflow)
    assert caplog.messages == []


def test_a_snapshot_of_runs_that_are_gone_is_no_use_and_no_harm(
    server: UI, from_mlflow: Sweep, sweep: SweepStore
) -> None:
    whole = Snapshot.unpack(taken(sweep, share=1.0))
    runs = tuple(run.model_copy(update={"run_id": f"gone-{run.run_id}"}) for run in whole.runs)
    with announced(sweep, dataclasses.replace(whole, runs=runs).pack()):
        same(mlflow_data.load(SERVER, "made-up"), from_mlflow)


@pytest.fixture
def warnings(caplog: pytest.LogCaptureFixture, from_mlflow: Sweep) -> Callable[[], list[str]]:
    """A function that reads from the server, finds the same as ever, and returns what it was warned of."""

    def read() -> list[str]:
        same(mlflow_data.load(SERVER, "made-up"), from_mlflow)
        return caplog.messages

    return read


@pytest.mark.parametrize(
    ("kept", "changes", "sentence"),
    [
        (-9, {"size": 10_000}, r"snapshot/[ab]\.zip must have 10000 bytes, got \d+"),
        (None, {"sha256": "0"}, r"snapshot/[ab]\.zip is not what was announced: its SHA-256 differs"),
        (-9, {}, "the snapshot cannot be read: File is not a zip file"),
    ],
    ids=["a part of it", "another one", "a part announced as whole"],
)
@pytest.mark.usefixtures("server")
def test_a_damaged_snapshot_costs_a_warning_and_time(
    sweep: SweepStore,
    kept: int | None,
    changes: dict[str, Any],
    sentence: str,
    warnings: Callable[[], list[str]],
) -> None:
    with announced(sweep, taken(sweep, share=1.0)[:kept], **changes):
        (warning,) = warnings()
    assert re.fullmatch(f"{sentence}; MLflow is asked run by run instead, which takes longer", warning)


def test_every_way_to_a_database_gives_the_same(sweep: SweepStore) -> None:
    uri = tracking_uri(sweep, None)
    one, other = Database(uri, SqliteTables(uri)), Database(uri, OtherTables(uri))
    experiment = one.experiments()["recrl/made-up"]
    assert one.experiments() == other.experiments()

    def runs(database: Database) -> list[ShownRun]:
        return sorted(database.runs(experiment), key=lambda run: run.run_id)

    assert runs(one) == runs(other)
    metrics = {metric for run in runs(one) for metric in run.metrics}
    assert {"train/return", "curriculum/limit_0", "student/kl"} < metrics
    for metric in [*metrics, "of nobody"]:
        found = rows(one.points(metric, experiment))
        assert found == rows(other.points(metric, experiment))
        assert bool(found) == (metric in metrics)


def test_a_sweep_alone_in_its_database_is_read_as_among_others(sweep: SweepStore, tmp_path: Path) -> None:
    database = tmp_path / "alone.db"
    shutil.copy(sweep.mlflow_database, database)
    both, alone = Database(tracking_uri(sweep, None)), Database(f"sqlite:///{database}")
    experiment = both.experiments()["recrl/made-up"]
    connection = sqlite3.connect(database)
    others = "SELECT run_uuid FROM runs WHERE experiment_id <> ?"
    for table in ("metrics", "latest_metrics", "tags", "params", "runs"):
        connection.execute(f"DELETE FROM {table} WHERE run_uuid IN ({others})", (experiment,))
    connection.commit()
    connection.close()
    found = rows(alone.points("train/return", experiment))
    assert found == rows(both.points("train/return", experiment))
    assert len(found) == 6 * 38


def rows(points: Points) -> list[tuple[str, int, float, int]]:
    runs = [points.run_ids[run] for run in points.runs]
    numbers = (array.tolist() for array in (points.steps, points.values, points.milliseconds))
    return sorted(zip(runs, *numbers, strict=True))


def test_reading_waits_for_whoever_writes(sweep: SweepStore, tmp_path: Path) -> None:
    database = tmp_path / "busy.db"
    shutil.copy(sweep.mlflow_database, database)
    writer = sqlite3.connect(database, check_same_thread=False)
    writer.execute("BEGIN EXCLUSIVE")
    end = threading.Timer(0.3, writer.rollback)
    end.start()
    assert "recrl/made-up" in Database(f"sqlite:///{database}").experiments()
    end.join()
    writer.close()


def test_a_server_that_is_away_is_named() -> None:
    with pytest.raises(TrackingError, match=r"MLflow at http://127\.0\.0\.1:9 cannot be read: .*refused"):
        mlflow_data.load("http://127.0.0.1:9")


def test_what_goes_wrong_behind_the_first_rows_is_a_sentence(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "odd.db")) as connection, connection:
        connection.execute("CREATE TABLE experiments (name, experiment_id, lifecycle_stage)")
        rows = [(1, number, "active") for number in range(65_536)]  # a batch whose names seem to be numbers
        connection.executemany("INSERT INTO experiments VALUES (?, ?, ?)", [*rows, ("a", 0, "active")])
    with pytest.raises(TrackingError, match=r"odd\.db cannot be read: .*Type mismatch"):
        Database(f"sqlite:///{tmp_path / 'odd.db'}").experiments()


def test_a_databases_password_is_not_shown() -> None:
    uri = "postgresql://me:hunter2@host/mlflow"
    assert str(unreadable(uri, OSError())) == "MLflow at postgresql://***@host/mlflow cannot be read: OSError"


def test_a_file_that_is_no_database_of_mlflows_is_named(tmp_path: Path) -> None:
    (tmp_path / "other.db").write_text("no database")
    with pytest.raises(TrackingError, match=r"other\.db cannot be read: .*file is not a database"):
        mlflow_data.load(f"sqlite:///{tmp_path / 'other.db'}")
    sqlite3.connect(tmp_path / "empty.db").execute("CREATE TABLE other (key TEXT)")
    with pytest.raises(TrackingError, match=r"empty\.db cannot be read: .*no such table: experiments"):
        mlflow_data.load(f"sqlite:///{tmp_path / 'empty.db'}")


def test_what_an_older_version_sent_is_named(sweep: SweepStore, tmp_path: Path) -> None:
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    database = tmp_path / "old.db"
    shutil.copy(sweep.mlflow_database, database)
    uri = f"sqlite:///{database}"
    MlflowClient(uri).delete_tag(find_sweep(uri, sweep.name).trials[0].run_id, "recrl.spec")
    assert (
        "1 trials: sent to MLflow by an older version, left out; recrl-sweep sync --rebuild sends them again"
        in (mlflow_data.load(uri, sweep.name).notes)
    )


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("other", "shows no sweep 'other'; it shows empty, made-up"),
        ("mad'e", "shows no sweep"),
        (None, "shows 2 sweeps; say which one; it shows empty, made-up"),
    ],
)
def test_a_sweep_that_mlflow_does_not_show_is_named(
    sweep: SweepStore, name: str | None, sentence: str
) -> None:
    with pytest.raises(TrackingError) as caught:
        mlflow_data.load(tracking_uri(sweep, None), name)
    assert sentence in str(caught.value)


def test_a_database_that_is_not_there_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(TrackingError, match="no such file"):
        mlflow_data.load(f"sqlite:///{tmp_path / 'none.db'}")
    assert not (tmp_path / "none.db").exists()


def test_commands_take_mlflow_or_a_compact_file_for_the_files(
    sweep: SweepStore, from_files: Sweep, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    uri = tracking_uri(sweep, None)
    file = tmp_path / "made-up.zip"
    assert main(["export", "made-up", "--tracking-uri", uri, "--to", str(file)]) == ExitCode.OK
    assert "6 trials" in capsys.readouterr().out
    assert len(export.load(file).updates) == len(from_files.updates)
    assert main(["figures", str(file), "--band", "iqm", "--sketch"]) == ExitCode.OK
    assert (tmp_path / "figures" / "report.html").exists()
    assert main(["bound", str(file)]) == ExitCode.OK


def test_key_columns_have_one_type_from_every_source(from_mlflow: Sweep, from_files: Sweep) -> None:
    for name in KEY:
        assert from_mlflow.updates[name].dtype == from_files.updates[name].dtype
