"""Connections to MLflow. MLflow takes seconds to import, so it is imported where it is first needed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.tracking.address import SQLITE, sqlite_path

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

EXPERIMENTS = "recrl/"  # what the names of the experiments of sweeps begin with
SQLITE_HEAD = b"SQLite format 3\0"

# Read by mlflow when it is imported. A lost server must cost seconds, not MLflow's own four minutes; the
# next pass tries again. A user's own settings stand.
ENVIRONMENT = {
    "DO_NOT_TRACK": "true",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "MLFLOW_LOGGING_LEVEL": "CRITICAL",
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}


def connect(uri: str, *, environment: Mapping[str, str] = ENVIRONMENT) -> MlflowClient:
    """Return a client of a store that exists, or whose sqlite file has just been made.

    Args:
        uri: of ``address.tracking_uri``.
        environment: settings of MLflow that the user's own environment may override.

    Raises:
        Exception: whatever mlflow raises if the store cannot be used.
    """
    for key, value in environment.items():
        os.environ.setdefault(key, value)
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    path = sqlite_path(uri)
    if path is not None:
        if not path.exists():
            _make_database(path)
        elif not _is_sqlite(path):
            raise TrackingError(f"{path}: not a sqlite database; delete it to have it made anew")
    return MlflowClient(uri)


def _make_database(path: Path) -> None:
    """Make MLflow's tables in a file beside, then rename it.

    MLflow makes them by fifty migrations, not in one transaction: killed in their midst they would leave half
    a database for ever.
    """
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.unlink(missing_ok=True)
    MlflowClient(f"{SQLITE}{temporary}").search_experiments(max_results=1)
    temporary.replace(path)


def _is_sqlite(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(SQLITE_HEAD)) == SQLITE_HEAD


def is_away(error: Exception) -> bool:
    """Return whether asking MLflow about another trial would fail in the same way."""
    from mlflow.exceptions import MlflowException  # noqa: PLC0415

    about_the_trial = ("INVALID_PARAMETER_VALUE", "BAD_REQUEST", "RESOURCE_DOES_NOT_EXIST")
    return isinstance(error, MlflowException) and error.error_code not in about_the_trial


def one_line(error: Exception) -> str:
    """Return an error as one line without secrets."""
    return " ".join(redacted(f"{type(error).__name__}: {error}").split())[:500]
