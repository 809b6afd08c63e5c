"""``ui`` and ``sync``: the sweep in MLflow."""

from __future__ import annotations

import signal

from rich.console import Console

from recrl.orchestrator.cli.output import say
from recrl.orchestrator.cli.requests import SyncRequest, UIRequest
from recrl.orchestrator.cli.sweeps import open_store
from recrl.orchestrator.counting import counted
from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.tracking.client import is_server, one_line, tracking_uri
from recrl.orchestrator.tracking.export_file import write_in_own_process
from recrl.orchestrator.tracking.final_outcomes import FinalOutcomes
from recrl.orchestrator.tracking.mlflow_sync import sync, without_export
from recrl.orchestrator.tracking.ui import open_ui


def run_ui(request: UIRequest, console: Console) -> ExitCode:
    """Open MLflow's pages about a sweep, on this machine only."""
    store = open_store(request)
    for number in (signal.SIGINT, signal.SIGTERM):  # open_ui, too, ends the server before it raises
        signal.signal(number, signal.default_int_handler)
    uri = tracking_uri(store, request.tracking_uri)
    if not is_server(uri):
        say(console, "Starting MLflow's server ...")  # up to a minute on a busy machine
    ui = open_ui(store, uri, port=request.port)
    say(console, f"Open {ui.url}")
    if ui.process is not None:
        say(console, "Ctrl-C ends it.")
        try:
            ui.process.wait()
        except KeyboardInterrupt:
            ui.close()
    return ExitCode.OK


def run_sync(request: SyncRequest, console: Console) -> ExitCode:
    """Bring MLflow up to date with the files."""
    store = open_store(request)
    uri = tracking_uri(store, request.tracking_uri)
    outcomes = FinalOutcomes(store)
    if outcomes.lack_a_complete_trial() or (request.trust and outcomes.has_sampled()):
        _measure(store, console)
    report = sync(store, uri, rebuild=request.rebuild, write_export=write_in_own_process)
    trials = counted(report.trials, "trial")
    if not report.is_up_to_date:
        raise TrackingError(
            f"MLflow is behind by {report.behind} of {trials}: {report.problem}; the files have all that was "
            "committed: sync again later, or see 'recrl-sweep check' for damaged files"
        )
    say(console, f"MLflow is up to date with {store.name}: {trials}, {counted(report.points, 'new point')}")
    if report.remark:
        say(console, without_export(report.remark))
    return ExitCode.OK


def _measure(store: SweepStore, console: Console) -> None:
    """Write the outcomes of the final policies, for the metrics ``final/...``; if that fails, say so."""
    from recrl.analysis.data import sweep_data  # noqa: PLC0415  (imports pandas)
    from recrl.analysis.report.table_files import write_outcomes  # noqa: PLC0415

    try:
        write_outcomes(sweep_data.load(store), store.figures_folder)
    except Exception as error:  # a task of the user's may raise anything
        say(console, f"without the values final/...: {one_line(error)}")
