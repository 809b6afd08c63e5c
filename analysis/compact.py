"""A finished sweep in one small file, from which all its figures and tables can be drawn again.

A zip archive of plain text, so that any tool can open it:

    sweep.json         name, notes, grid file, the trials (spec, standing, provenance), digests of the tables
    phases.csv, ...    the other frames of ``recrl.analysis.frames`` but KEY: ``trial`` is the position of the
                       trial in sweep.json

Left out are single episodes (``phases`` has their sums), timing, and the students' metrics that no figure
reads. What was measured at single updates, and the policies' tables, are rounded to DIGITS significant
digits; outcomes (phases, evaluations) are exact. Equal sweeps give equal bytes.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from recrl.analysis.frames import ROWS, TRIAL, Sweep, TrialFacts, assemble, drawn_columns
from recrl.orchestrator.archives import UNREADABLE, unpacked
from recrl.orchestrator.errors import DamagedError, RecrlError, missing
from recrl.orchestrator.row_files import Extent
from recrl.orchestrator.small_files import write_atomically
from recrl.orchestrator.spec import TrialSpec, TrialState

SUFFIX = ".zip"
FORMAT = 2
WITHOUT_DIGESTS = 1  # the format before: its tables are read as they are
DIGITS = 6
ROUNDED = ("updates", "policies")
MAX_BYTES = 512 * 2**20  # unpacked; about 50 times the largest sweep so far
LONG_AGO = (1980, 1, 1, 0, 0, 0)  # the time of every member: zip knows none before


def save(sweep: Sweep, path: Path) -> Path:
    """Write the compact file of a sweep.

    Args:
        sweep: finished or not.
        path: of the file; its folder is made if it is not there.

    Raises:
        RecrlError: nobody would read it back, as it is too large, or its folder cannot be made.
    """
    tables = {}
    for name in ROWS:
        rows = sweep.rows(name)
        if name == "updates":
            rows = rows[[TRIAL, *drawn_columns(map(str, rows))]]
        tables[f"{name}.csv"] = (_rounded(rows) if name in ROUNDED else rows).to_csv(
            index=False, lineterminator="\n"
        )
    digests = {name: Extent.of(text.encode()).sha256 for name, text in tables.items()}
    told = json.dumps({**_told(sweep), "digests": digests}, indent=1, allow_nan=False) + "\n"
    members = {"sweep.json": told, **tables}
    size = sum(len(text.encode()) for text in members.values())
    if size > MAX_BYTES:
        raise RecrlError(f"{path}: a compact file may unpack to {MAX_BYTES} bytes, this one has {size}")
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, text in members.items():
            archive.writestr(zipfile.ZipInfo(name, LONG_AGO), text, zipfile.ZIP_LZMA)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, FileNotFoundError, NotADirectoryError) as error:
        raise RecrlError(f"{path}: its folder cannot be made ({error.strerror})") from error
    write_atomically(path, data.getvalue())
    return path


def load(path: Path) -> Sweep:
    """Read a compact file back.

    Raises:
        RecrlError: the file is not there, is none, or unpacks to more than MAX_BYTES.
    """
    names = ("sweep.json", *(f"{name}.csv" for name in ROWS))
    try:
        with zipfile.ZipFile(path) as archive:
            sweep, *frames = unpacked(archive, names, max_bytes=MAX_BYTES)
        told = json.loads(sweep)
        rows = {name: pd.read_csv(io.BytesIO(data)) for name, data in zip(ROWS, frames, strict=True)}
    except FileNotFoundError as error:
        raise RecrlError(f"{path}: {missing(path)}") from error
    except UNREADABLE as error:
        raise RecrlError(f"{path}: cannot be read as a sweep's compact file ({error})") from error
    found = told.get("format") if isinstance(told, dict) else None
    if found not in (FORMAT, WITHOUT_DIGESTS):
        raise RecrlError(f"{path}: its format must be {FORMAT} or {WITHOUT_DIGESTS}, got {found!r}")
    if found == FORMAT:
        for name, data in zip(names[1:], frames, strict=True):
            if Extent.of(data).sha256 != told["digests"][name]:
                raise DamagedError(f"{path}: its {name} is not what was written: export the sweep again")
    return assemble(
        told["name"],
        [_facts(trial, told["provenance"]) for trial in told["trials"]],
        **rows,
        grid=told["grid"],
        notes=told["notes"],
    )


def _told(sweep: Sweep) -> dict[str, Any]:
    """Everything but the frames; equal provenances are there once."""
    origins = list(Counter(it.provenance for it in sweep.facts))
    return {
        "format": FORMAT,
        "name": sweep.name,
        "notes": list(sweep.notes),
        "grid": sweep.grid,
        "provenance": origins,
        "trials": [
            {
                "spec": it.spec.to_json(),
                "status": it.status.value,
                "error": it.error,
                "env_steps": it.env_steps,
                "cpu_seconds": it.cpu_seconds,
                "start_limits": it.start_limits,
                "provenance": origins.index(it.provenance),
            }
            for it in sweep.facts
        ],
    }


def _facts(value: dict[str, Any], origins: list[str]) -> TrialFacts:
    facts = TrialFacts(
        **{**value, "spec": TrialSpec.from_json(value["spec"]), "provenance": origins[value["provenance"]]}
    )
    return replace(facts, status=TrialState(facts.status))


def _rounded(rows: pd.DataFrame) -> pd.DataFrame:
    """Floats with DIGITS significant digits, as the shortest text."""
    floats = rows.select_dtypes("float").columns
    return rows.assign(**{name: _significant(rows[name].to_numpy(np.float64)) for name in floats})


def _significant(values: np.ndarray) -> np.ndarray:
    """Each value at DIGITS significant digits.

    >>> _significant(np.array([0.0012345678, -98765.4321, np.inf])).tolist()
    [0.00123457, -98765.4, inf]
    """
    return np.array([float(f"{value:.{DIGITS}g}") for value in values.tolist()])
