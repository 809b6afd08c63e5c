"""MLflow's UI for a sweep, served on this machine only."""

from __future__ import annotations

import os
import shlex
import socket
import subprocess
import sys
import time
from dataclasses import dataclass

from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.tracking.chart_view import charts_page
from recrl.orchestrator.tracking.client import MLFLOW_SETTINGS, is_server
from recrl.orchestrator.tracking.mlflow_sync import last_report, sync
from recrl.orchestrator.tracking.positions import sync_folder

# Without the job runner of MLflow's language-model features a server takes 0.5 GB of memory and not 2.5.
SERVER_SETTINGS = ("DO_NOT_TRACK", "MLFLOW_DISABLE_TELEMETRY", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION")

START_SECONDS = 300.0  # until the server must answer


def ui_command(store: SweepStore, uri: str, *, port: int = 5000) -> list[str]:
    """Return the command of an MLflow server for a database, on this machine only, with one process."""
    stores = ["--artifacts-destination", str(store.mlflow_artifacts)]
    if (
        "@" not in uri and "?" not in uri
    ):  # otherwise it is an environment variable, which other users cannot see
        stores += ["--backend-store-uri", uri]
    address = ["--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
    settings = [f"{name}={os.environ.get(name, MLFLOW_SETTINGS[name])}" for name in SERVER_SETTINGS]
    return ["env", *settings, sys.executable, "-m", "mlflow", "server", *stores, *address]


def ui_url(store: SweepStore, uri: str, *, port: int = 5000) -> str:
    """Return the address of the sweep's charts, grouped by task, agent and method."""
    address = uri.rstrip("/") if is_server(uri) else f"http://127.0.0.1:{port}"
    report = last_report(store, uri)
    if report is None or not report.experiment_id:
        return address
    return f"{address}/#{charts_page(report.experiment_id)}"


@dataclass
class UI:
    """MLflow's UI.

    Attributes:
        url: the page to open.
        process: the server, or None if it was running already.
    """

    url: str
    process: subprocess.Popen[bytes] | None

    def close(self) -> None:
        """End the server that was started."""
        if self.process:
            self.process.terminate()
            self.process.wait()


def open_ui(store: SweepStore, uri: str, *, port: int = 5000) -> UI:
    """Start MLflow's server at the loopback address and wait until it answers.

    Args:
        store: the sweep.
        uri: of ``tracking_uri``; for a server's address nothing is started.
        port: of 127.0.0.1.

    Raises:
        TrackingError: the port is taken, or the server does not start.
    """
    if not is_server(uri) and _answers(port):
        raise TrackingError(f"port {port} of 127.0.0.1 is taken by another program; choose another --port")
    if last_report(store, uri) is None:
        sync(store, uri)
    url = ui_url(store, uri, port=port)
    if is_server(uri):
        return UI(url, None)
    command = ui_command(store, uri, port=port)
    log_path = sync_folder(store, uri) / "ui.txt"
    flags = os.O_CREAT | os.O_WRONLY | os.O_TRUNC | os.O_NOFOLLOW
    with open(os.open(log_path, flags, 0o600), "wb") as log:
        environment = {**os.environ, "MLFLOW_BACKEND_STORE_URI": uri}
        server = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        ui = UI(url, server)
    try:
        if not _starts(server, port):
            raise TrackingError(
                f"MLflow's server did not start; its output is in {log_path}, the command was "
                f"{shlex.join(command)}"
            )
    except BaseException:  # also a signal
        ui.close()
        raise
    return ui


def _starts(server: subprocess.Popen[bytes], port: int) -> bool:
    """Wait until a server accepts connections; return False if it ends or takes too long."""
    end = time.monotonic() + START_SECONDS
    while time.monotonic() < end and server.poll() is None:
        if _answers(port):
            return True
        time.sleep(0.2)
    return False


def _answers(port: int) -> bool:
    """Whether a program accepts connections on a port of the loopback address."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
