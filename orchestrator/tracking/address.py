"""Addresses of MLflow stores: a server's, or a database's."""

from __future__ import annotations

import re
from pathlib import Path

from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.redaction import redacted

SQLITE = "sqlite:///"


def tracking_uri(store: SweepStore, given: str | None) -> str:
    """Return the sweep's MLflow address: the given one, or a database in the sweep's folder.

    Args:
        store: the sweep.
        given: a server's address or a database's, as for MLflow, or None.

    Raises:
        TrackingError: MLflow has no such kind of store.
    """
    return f"{SQLITE}{store.mlflow_database}" if given is None else checked_uri(given)


def checked_uri(given: str) -> str:
    """Return the absolute address, if MLflow accepts it.

    Raises:
        TrackingError: MLflow has no such kind of store.
    """
    if not given.isprintable() or " " in given:
        raise TrackingError("the tracking address must hold no spaces and no control characters")
    scheme, separator, rest = given.partition("://")
    if scheme != "sqlite" and re.search(
        "[/?#].*@", rest
    ):  # other programs would take a part of it for a host
        raise TrackingError(
            "the tracking address must have no @ after its host; in a password write %2F for /, "
            "%3F for ?, %23 for # and %40 for @"
        )
    if scheme == "sqlite" and rest.startswith("/") and len(rest) > 1:
        return f"{SQLITE}{Path(rest.removeprefix('/')).absolute()}"
    if separator and rest and scheme.partition("+")[0] in ("http", "https", "postgresql", "mysql", "mssql"):
        return given
    raise TrackingError(
        "the tracking address must be http(s)://host:port, sqlite:///file.db or another database "
        f"of MLflow (postgresql, mysql, mssql), got {redacted(given)!r}"
    )


def is_server(uri: str) -> bool:
    """Return whether the address is that of a running MLflow server."""
    return uri.startswith(("http://", "https://"))


def sqlite_path(uri: str) -> Path | None:
    """Return the file of an sqlite database, None for other addresses."""
    return Path(uri.removeprefix(SQLITE)) if uri.startswith(SQLITE) else None
