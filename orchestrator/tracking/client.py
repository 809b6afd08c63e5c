"""Addresses of MLflow stores, a server's or a database's, and connections to them.

MLflow takes seconds to import, so it is imported at the first use.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote, unquote

from recrl.orchestrator.errors import RecrlError, TrackingError, described
from recrl.orchestrator.files.locks import locked
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.redaction import redacted

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

SQLITE = "sqlite:///"
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


def tracking_uri(store: SweepStore, given: str | None) -> str:
    """Return the sweep's MLflow address: the given one, or a database in the sweep's folder.

    Args:
        store: the sweep.
        given: a server's address or a database's, as for MLflow, or None.

    Raises:
        RecrlError: MLflow has no such kind of store.
    """
    return _sqlite_uri(store.mlflow_database) if given is None else checked_uri(given)


def checked_uri(given: str) -> str:
    """Return the absolute address, if MLflow accepts it.

    Raises:
        RecrlError: MLflow has no such kind of store.
    """
    if not given.isprintable() or " " in given:
        raise RecrlError("the tracking address must hold no spaces and no control characters")
    scheme, separator, rest = given.partition("://")
    if scheme != "sqlite" and re.search(
        "[/?#].*@", rest
    ):  # other programs would take a part of it for a host
        raise RecrlError(
            "the tracking address must have no @ after its host; in a password write %2F for /, "
            "%3F for ?, %23 for # and %40 for @"
        )
    if scheme == "sqlite" and rest.startswith("/") and len(rest) > 1:
        return _sqlite_uri(Path(unquote(rest.removeprefix("/"))).absolute())
    if separator and rest and scheme.partition("+")[0] in ("http", "https", "postgresql", "mysql", "mssql"):
        return given
    raise RecrlError(
        "the tracking address must be http(s)://host:port, sqlite:///file.db or another database "
        f"of MLflow (postgresql, mysql, mssql), got {redacted(given)!r}"
    )


def is_server(uri: str) -> bool:
    """Return whether the address is that of a running MLflow server."""
    return uri.startswith(("http://", "https://"))


def sqlite_path(uri: str) -> Path | None:
    """Return the file of an sqlite database, None for other addresses."""
    return Path(unquote(uri.removeprefix(SQLITE))) if uri.startswith(SQLITE) else None


def _sqlite_uri(path: Path) -> str:
    """Return a database's address; ``?`` and ``%`` have a meaning there."""
    return f"{SQLITE}{quote(str(path))}"


@contextmanager
def mlflow_settings(settings: Mapping[str, str]) -> Iterator[None]:
    """Set those of MLflow's environment variables that the user has not set, and remove them at the end."""
    added = {key: value for key, value in settings.items() if key not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for key in added:
            os.environ.pop(key, None)


def connect(uri: str) -> MlflowClient:
    """Return a client of a store; a missing sqlite file is created.

    ``MLFLOW_SETTINGS`` stay set, but for a caller within ``mlflow_settings``.

    Args:
        uri: of ``tracking_uri``.

    Raises:
        Exception: raised by mlflow if the store cannot be used.
    """
    for key, value in MLFLOW_SETTINGS.items():
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
    """Create MLflow's tables in a temporary file, then rename it, unless another process was quicker.

    MLflow creates them by fifty migrations, not in one transaction: a kill in between would leave an unusable
    database.
    """
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    path.parent.mkdir(parents=True, exist_ok=True)
    with scratch_folder(str(path.parent), prefix=f".{path.name}-") as folder:
        temporary = folder / path.name
        MlflowClient(_sqlite_uri(temporary)).search_experiments(max_results=1)
        with locked(path.with_name(f".{path.name}.lock")):
            if not path.exists():  # another launch may have made it meanwhile, and written to it
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
    return redacted(described(error))[:500]
