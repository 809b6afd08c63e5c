"""Connections to MLflow. It takes seconds to import, so it is imported at the first use."""

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

EXPERIMENTS = "recrl/"  # prefix of the experiments of sweeps
SQLITE_HEAD = b"SQLite format 3\0"

# Read by mlflow at its import. A lost server must delay a pass by seconds, not by MLflow's own four minutes;
# the next pass tries again. A user's own settings have priority.
MLFLOW_SETTINGS = {
    "DO_NOT_TRACK": "true",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "MLFLOW_LOGGING_LEVEL": "CRITICAL",
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}


def connect(uri: str, *, settings: Mapping[str, str] = MLFLOW_SETTINGS) -> MlflowClient:
    """Return a client of a store; a missing sqlite file is created.

    Args:
        uri: of ``address.tracking_uri``.
        settings: of MLflow, as environment variables; the user's own environment has priority.

    Raises:
        Exception: raised by mlflow if the store cannot be used.
    """
    for key, value in settings.items():
        os.environ.setdefault(key, value)
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    path = sqlite_path(uri)
    if path is not None:
        if not path.exists():
            _make_database(path)
        elif not _is_sqlite(path):
            raise TrackingError(f"{path}: not a sqlite database; delete it, and it is created anew")
    return MlflowClient(uri)


def _make_database(path: Path) -> None:
    """Create MLflow's tables in a temporary file, then rename it.

    MLflow creates them by fifty migrations, not in one transaction: a kill in between would leave an unusable
    database.
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
    """Return whether a request to MLflow about another trial would fail in the same way."""
    from mlflow.exceptions import MlflowException  # noqa: PLC0415

    about_the_trial = ("INVALID_PARAMETER_VALUE", "BAD_REQUEST", "RESOURCE_DOES_NOT_EXIST")
    return isinstance(error, MlflowException) and error.error_code not in about_the_trial


def one_line(error: Exception) -> str:
    """Return an error as one line without secrets."""
    return " ".join(redacted(f"{type(error).__name__}: {error}").split())[:500]
