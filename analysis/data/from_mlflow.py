"""Read a sweep from MLflow, without its files.

The parent run of a sweep has the export file among its artifacts; the sweep is read from it.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

from recrl.analysis.data import export
from recrl.analysis.data.sweep_data import Sweep
from recrl.orchestrator.errors import RecrlError, TrackingError
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.tracking.export_download import downloaded_export

TRIES = 3  # a file that is being uploaded is incomplete
PAUSE_SECONDS = 1.0

pause = partial(time.sleep, PAUSE_SECONDS)


def load(uri: str, name: str | None = None) -> Sweep:
    """Read a sweep from an MLflow server or database.

    Args:
        uri: http(s)://host:port, sqlite:///file.db or another database's address.
        name: of the sweep; optional if MLflow has only one.

    Raises:
        TrackingError: MLflow cannot be reached, has no such sweep, or its export file is damaged or of
            another version.
    """
    for tries_left in range(TRIES - 1, -1, -1):
        with downloaded_export(uri, name) as download:
            try:
                sweep = export.load(download.path)
            except RecrlError as error:
                reason = str(error).removeprefix(f"{download.path}: ")
                if isinstance(error, export.OtherVersionError):  # an upload of the same sweep is no cure
                    raise TrackingError(
                        f"MLflow at {redacted(uri)}: this version of recrl cannot read the sweep's export "
                        f"file ({reason})"
                    ) from error
                if not tries_left:
                    raise TrackingError(
                        f"MLflow at {redacted(uri)}: the sweep's export file is damaged ({reason}); "
                        "recrl-sweep sync --rebuild uploads it again"
                    ) from error
            else:
                return replace(sweep, notes=(download.note, *sweep.notes))
        pause()
    raise AssertionError("the last try returns or raises")
