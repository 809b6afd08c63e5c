"""Fetch a sweep's export file from MLflow, for figures without the sweep's folder."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from recrl.orchestrator.errors import RecrlError, TrackingError
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.tracking.client import (
    EXPERIMENTS,
    MLFLOW_SETTINGS,
    connect,
    mlflow_settings,
    one_line,
    sqlite_path,
)
from recrl.orchestrator.tracking.export_file import FILE_NAME, FOLDER, UPLOADED_TAG

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient

MAX_BYTES = 512 * 2**20
TIMEOUT_SECONDS = 120  # timeout of a server
EXPORT = f"{FOLDER}/{FILE_NAME}"


@dataclass(frozen=True)
class Download:
    """A fetched export file.

    Attributes:
        path: of the file.
        note: one sentence on what is missing in the file.
    """

    path: Path
    note: str


@contextmanager
def downloaded_export(uri: str, name: str | None) -> Iterator[Download]:
    """Fetch the export file of the newest sweep of a name to a folder that exists during the context.

    Args:
        uri: of ``client.checked_uri``.
        name: of the sweep; None if there is only one.

    Raises:
        TrackingError: MLflow cannot be reached, shows no such sweep, or has no export file of it.
    """
    settings = MLFLOW_SETTINGS | {"MLFLOW_HTTP_REQUEST_TIMEOUT": str(TIMEOUT_SECONDS)}
    with scratch_folder(tempfile.gettempdir()) as folder:
        try:
            with mlflow_settings(settings):  # the user's own requests have other time-outs
                download = _download(uri, name, folder)
        except RecrlError:
            raise
        except Exception as error:  # MLflow passes on the errors of its database or its server
            raise TrackingError(f"MLflow at {redacted(uri)} cannot be read: {one_line(error)}") from error
        yield download


def _download(uri: str, name: str | None, folder: Path) -> Download:
    path = sqlite_path(uri)
    if path is not None and not path.exists():
        raise TrackingError(f"{path}: no such file; MLflow would make an empty one")
    client = connect(uri)
    parent = _parent(client, uri, name)
    run_id = str(parent.info.run_id)
    sizes = {file.path: file.file_size or 0 for file in client.list_artifacts(run_id, FOLDER)}
    sweep = parent.data.tags.get("recrl.sweep", "")
    if EXPORT not in sizes:
        raise TrackingError(
            f"MLflow at {redacted(uri)} has no export file of {sweep}; recrl-sweep sync {sweep} with this "
            "--tracking-uri uploads it, with --rebuild also if it was there and was deleted"
        )
    if sizes[EXPORT] > MAX_BYTES:
        raise TrackingError(f"{EXPORT} has {sizes[EXPORT]} bytes, at most {MAX_BYTES} are read")
    at = parent.data.tags.get(UPLOADED_TAG, "an unknown time")
    note = f"Read from the export file that MLflow has; points after {at} UTC, its last upload, are missing."
    return Download(Path(client.download_artifacts(run_id, EXPORT, str(folder))), note)


def _parent(client: MlflowClient, uri: str, name: str | None) -> Run:
    """Return the newest parent run of a sweep.

    Raises:
        TrackingError: MLflow has no such sweep, or several.
    """
    found = client.search_experiments(filter_string=f"name LIKE '{EXPERIMENTS}%'")
    names = {it.name.removeprefix(EXPERIMENTS): str(it.experiment_id) for it in found}
    if name is None and len(names) == 1:
        (name,) = names
    if name in names:
        query = "tags.`recrl.kind` = 'sweep'"
        newest = client.search_runs([names[name]], query, max_results=1, order_by=["start_time DESC"])
        if newest:
            return newest[0]
    listed = f"it shows {', '.join(sorted(names))}" if names else "it shows none"
    which = f"no sweep {name!r}" if name else f"{len(names)} sweeps; say which one"
    raise TrackingError(f"MLflow at {redacted(uri)} shows {which}; {listed}")
