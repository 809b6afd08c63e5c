"""A sweep is read from MLflow by the export file that the sync uploads."""

from __future__ import annotations

import calendar
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlparse

import pandas as pd
import pytest

import recrl
from recrl.analysis.data import export, from_mlflow, sweep_data
from recrl.analysis.data.sweep_data import Sweep
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.tracking import export_file
from recrl.orchestrator.tracking.client import MLFLOW_SETTINGS, connect, tracking_uri
from recrl.orchestrator.tracking.export_file import ExportUpload, write_in_own_process
from recrl.orchestrator.tracking.mlflow_runs import SweepRuns
from recrl.orchestrator.tracking.mlflow_sync import Tracker, sync
from recrl.orchestrator.tracking.positions import Position
from recrl.orchestrator.tracking.ui import open_ui
from tests.faults.committing import commit_file


def write(store: SweepStore, path: Path) -> None:
    """Write the export file in this process."""
    export.save(sweep_data.load(store), path)


def told(store: SweepStore, empty_database: Path) -> SweepStore:
    """The sweep, after it was sent to a database of its own."""
    shutil.copy(empty_database, store.mlflow_database)
    report = sync(store, tracking_uri(store, None), write_export=write)
    assert (report.problem, report.remark) == ("", "")
    return store


@pytest.fixture(scope="module")
def sweep(
    tmp_path_factory: pytest.TempPathFactory, finished_sweep: SweepStore, empty_database: Path
) -> SweepStore:
    """Part of a finished sweep, with a policy and a grid, and sent to MLflow."""
    store = SweepStore(tmp_path_factory.mktemp("runs"), finished_sweep.name)
    for trial in finished_sweep.trials():
        if trial.spec.task.label == "river-a" and trial.spec.agent.label == "cpo":
            shutil.copytree(trial.folder, store.trial(trial.spec).folder)
    trial = store.trials()[0]
    commit_file(trial, "policy.csv", "action_0,action_1\n0.25,0.75\n1.0,0.0\n")
    commit_file(trial, "provenance.json", '{"torch": "9.9"}')
    store.write_info({"name": store.name})
    store.write_specs([trial.spec for trial in store.trials()], b"name: made-up\n")
    return told(store, empty_database)


@pytest.fixture(scope="module")
def exported(sweep: SweepStore, tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    """What the export file of the files holds."""
    return export.load(export.save(sweep_data.load(sweep), tmp_path_factory.mktemp("zip") / "sweep.zip"))


@pytest.fixture(scope="module")
def server(sweep: SweepStore) -> Iterator[str]:
    """The address of MLflow's server for the sweep."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    ui = open_ui(sweep, tracking_uri(sweep, None), port=port)
    yield f"http://127.0.0.1:{port}"
    ui.close()


def same(found: Sweep, expected: Sweep) -> None:
    for name in ("trials", "phases", "updates", "evaluations", "events", "policies"):
        assert len(getattr(expected, name)), name
        pd.testing.assert_frame_equal(getattr(found, name), getattr(expected, name), check_exact=True)
    assert (found.name, found.facts, found.grid) == (expected.name, expected.facts, expected.grid)
    assert found.notes[1:] == expected.notes


def artifact(store: SweepStore) -> Path:
    """The export file, where a bare database keeps it."""
    client = connect(tracking_uri(store, None))
    experiment = client.get_experiment_by_name(f"recrl/{store.name}")
    assert experiment is not None
    (parent,) = client.search_runs([experiment.experiment_id], "tags.`recrl.kind` = 'sweep'")
    return Path(urlparse(parent.info.artifact_uri).path) / "export" / "sweep.zip"


def test_a_database_gives_the_sweep_and_says_what_is_missing(sweep: SweepStore, exported: Sweep) -> None:
    found = from_mlflow.load(tracking_uri(sweep, None), sweep.name)
    same(found, exported)
    started, ended = (
        "Read from the export file that MLflow has; points after ",
        " UTC, its last upload, are missing.",
    )
    note = found.notes[0]
    assert note.startswith(started)
    assert note.endswith(ended)
    told = calendar.timegm(time.strptime(note.removeprefix(started).removesuffix(ended), "%Y-%m-%d %H:%M:%S"))
    assert abs(artifact(sweep).stat().st_mtime - told) < 60  # by a machine under load


def test_the_python_api_takes_an_address(sweep: SweepStore, exported: Sweep) -> None:
    same(recrl.load_sweep(tracking_uri(sweep, None), sweep.name), exported)


def test_afterwards_mlflow_has_the_settings_of_the_user(
    sweep: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    for key in MLFLOW_SETTINGS:
        monkeypatch.delenv(key, raising=False)
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "7")
    before = dict(os.environ)
    from_mlflow.load(tracking_uri(sweep, None), sweep.name)
    assert dict(os.environ) == before


def test_a_server_gives_the_same(server: str, exported: Sweep) -> None:
    same(from_mlflow.load(server, "made-up"), exported)


def test_nothing_new_is_not_uploaded_again(
    made_up_sweep: Callable[..., SweepStore], empty_database: Path
) -> None:
    store = told(made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none"]), empty_database)
    before = artifact(store).stat().st_mtime_ns
    uri = tracking_uri(store, None)
    sync(store, uri, write_export=write)
    assert artifact(store).stat().st_mtime_ns == before
    sync(store, uri, rebuild=True, write_export=write)
    assert from_mlflow.load(uri, "made-up").name == store.name


def test_a_sweep_that_runs_is_uploaded_at_intervals(
    made_up_sweep: Callable[..., SweepStore], empty_database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fields = {"seeds": 1, "tasks": ["a"], "agents": ["cpo"], "methods": ["none", "linear"]}
    store = made_up_sweep(**fields, unfinished=["a cpo none seed 0"])
    shutil.copy(empty_database, store.mlflow_database)
    uri = tracking_uri(store, None)
    tracker = Tracker(store, uri, write)
    tracker.bring_up_to_date(live=True)
    with pytest.raises(TrackingError, match="has no export file of made-up; recrl-sweep sync made-up"):
        from_mlflow.load(uri, "made-up")
    monkeypatch.setattr(export_file, "INTERVAL_SECONDS", 0.0)
    tracker = Tracker(store, uri, write)
    tracker.bring_up_to_date(live=True)
    assert set(from_mlflow.load(uri, "made-up").trials["status"]) == {"running", "complete"}
    tracker.bring_up_to_date(live=False)
    assert len(from_mlflow.load(uri, "made-up").updates) == 20 + 40


def test_an_upload_takes_a_hundredth_of_the_time_at_most(
    sweep: SweepStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 1000.0, 1000.0, 1030.0, 3999.0, 4031.0, 4031.0, 4032.0])
    monkeypatch.setattr(export_file, "now", lambda: next(clock))
    uploads: list[Path] = []

    def fail(store: SweepStore, path: Path) -> None:
        uploads.append(path)
        raise OSError("no room")

    upload = ExportUpload(sweep, SweepRuns(sweep, tracking_uri(sweep, None)), fail, tmp_path)
    records = {trial.folder.name: trial.record() for trial in sweep.trials()}
    position = Position("0")
    assert upload.bring_up_to_date(position, records, live=True) == (position, "no room")  # took 30 s
    assert upload.bring_up_to_date(position, records, live=True) == (position, "")
    assert upload.bring_up_to_date(position, records, live=True) == (position, "no room")
    assert len(uploads) == 2


def test_an_upload_that_fails_is_a_remark_and_made_good_later(
    made_up_sweep: Callable[..., SweepStore], empty_database: Path
) -> None:
    store = made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none"])
    shutil.copy(empty_database, store.mlflow_database)
    uri = tracking_uri(store, None)

    def fail(store: SweepStore, path: Path) -> None:
        raise OSError("no room")

    report = sync(store, uri, write_export=fail)
    assert (report.is_up_to_date, report.remark) == (True, "no room")
    assert sync(store, uri, write_export=write).remark == ""
    assert len(from_mlflow.load(uri, "made-up").updates) == 40


def test_the_export_file_is_written_in_a_process_of_its_own(
    sweep: SweepStore, exported: Sweep, tmp_path: Path
) -> None:
    write_in_own_process(sweep, tmp_path / "sweep.zip")
    found = export.load(tmp_path / "sweep.zip")
    same(replace(found, notes=("", *found.notes)), exported)
    with pytest.raises(TrackingError, match=r"recrl-sweep export failed: .*holds 0 sweeps|holds no sweep"):
        write_in_own_process(SweepStore(tmp_path, "other"), tmp_path / "other.zip")


def test_a_file_that_is_just_being_uploaded_is_waited_for(
    sweep: SweepStore, exported: Sweep, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = artifact(sweep)
    whole = path.read_bytes()
    monkeypatch.setattr(from_mlflow, "pause", lambda: path.write_bytes(whole))
    path.write_bytes(whole[: len(whole) // 2])
    try:
        same(from_mlflow.load(tracking_uri(sweep, None), "made-up"), exported)
    finally:
        path.write_bytes(whole)


def test_a_file_that_stays_damaged_is_named(sweep: SweepStore, monkeypatch: pytest.MonkeyPatch) -> None:
    path = artifact(sweep)
    whole = path.read_bytes()
    monkeypatch.setattr(from_mlflow, "pause", lambda: None)
    path.write_bytes(whole[:-9])
    try:
        with pytest.raises(TrackingError) as caught:
            from_mlflow.load(tracking_uri(sweep, None), "made-up")
    finally:
        path.write_bytes(whole)
    assert "the sweep's export file is damaged (cannot be read as" in str(caught.value)
    assert str(caught.value).endswith("recrl-sweep sync --rebuild uploads it again")


def test_a_file_of_another_version_is_named_at_once(
    sweep: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = artifact(sweep)
    whole = path.read_bytes()
    monkeypatch.setattr(export, "FORMAT", 3)
    export.save(sweep_data.load(sweep), path)
    monkeypatch.undo()
    monkeypatch.setattr(from_mlflow, "pause", lambda: pytest.fail("waited for a file that is whole"))
    try:
        with pytest.raises(TrackingError) as caught:
            from_mlflow.load(tracking_uri(sweep, None), "made-up")
    finally:
        path.write_bytes(whole)
    assert str(caught.value).endswith(
        "this version of recrl cannot read the sweep's export file (is a compact file of another version of "
        "recrl, or was changed: its format must be 2, got 3)"
    )


def test_a_server_that_is_away_is_named() -> None:
    with pytest.raises(TrackingError, match=r"MLflow at http://127\.0\.0\.1:9 cannot be read: .*refused"):
        from_mlflow.load("http://127.0.0.1:9")


def test_a_databases_password_is_not_shown() -> None:
    with pytest.raises(TrackingError) as caught:
        from_mlflow.load("postgresql://me:hunter2@127.0.0.1:9/mlflow")
    assert "hunter2" not in str(caught.value)
    assert str(caught.value).startswith("MLflow at postgresql://***@127.0.0.1:9/mlflow cannot be read: ")


def test_a_database_that_is_not_there_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(TrackingError, match="no such file; MLflow would make an empty one"):
        from_mlflow.load(f"sqlite:///{tmp_path / 'none.db'}")
    assert not (tmp_path / "none.db").exists()


def test_a_file_that_is_no_database_is_named(tmp_path: Path) -> None:
    (tmp_path / "other.db").write_text("no database")
    with pytest.raises(TrackingError, match=r"other\.db: not a sqlite database"):
        from_mlflow.load(f"sqlite:///{tmp_path / 'other.db'}")


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
        from_mlflow.load(tracking_uri(sweep, None), name)
    assert sentence in str(caught.value)


@pytest.mark.usefixtures("unrendered")
def test_commands_take_mlflow_or_an_export_file_for_the_files(
    sweep: SweepStore,
    exported: Sweep,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    uri = tracking_uri(sweep, None)
    file = tmp_path / "made-up.zip"
    assert main(["export", "made-up", "--tracking-uri", uri, "--to", str(file)]) == ExitCode.OK
    assert "9 trials" in capsys.readouterr().out
    assert len(export.load(file).updates) == len(exported.updates)
    assert main(["figures", str(file), "--band", "iqm", "--sketch"]) == ExitCode.OK
    assert (tmp_path / "made-up-figures" / "report.html").exists()
    assert main(["bound", str(file)]) == ExitCode.OK
