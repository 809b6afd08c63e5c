"""A finished sweep in one small file, from which all its figures and tables can be drawn again.

A zip archive of plain text, so that any tool can open it:

    sweep.json         name, notes, grid file, the trials (spec, status, provenance), digests of all members
    phases.csv, ...    the other data frames of ``recrl.analysis.data.sweep_data``;
                       instead of KEY, ``trial`` is the position of the trial in sweep.json

Left out are single episodes (``phases`` has their sums), timing, and metrics of agents without a figure.
Measurements at single updates and the policies' tables are rounded to DIGITS significant digits. Outcomes
(phases, evaluations) are exact. Equal sweeps give equal bytes.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from recrl.analysis.data.archives import UNREADABLE, unpacked
from recrl.analysis.data.exact_values import DETERMINISTIC, STOCHASTIC
from recrl.analysis.data.labels import TRIAL
from recrl.analysis.data.sweep_data import (
    EVENT_COLUMNS,
    PHASE_COLUMNS,
    PHASE_COST_COLUMNS,
    ROWS,
    Sweep,
    TrialFacts,
    assemble,
    drawn_columns,
)
from recrl.environments.cmdp import Phase
from recrl.orchestrator.errors import DamagedError, RecrlError, missing
from recrl.orchestrator.files.atomic_files import write_atomically
from recrl.orchestrator.files.row_files import Extent
from recrl.orchestrator.files.trial_files import EVALUATION_COLUMNS, UPDATE_COLUMNS
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.untrusted import LimitValues, check_name
from recrl.orchestrator.validation_sentences import sentences

SUFFIX = ".zip"
FORMAT = 2
DIGITS = 6
ROUNDED = ("updates", "policies")
MAX_BYTES = 512 * 2**20  # unpacked; about 50 times the largest sweep so far
# Columns that every data frame must have if it has rows, columns per cost, and columns of text.
REQUIRED = {
    "phases": PHASE_COLUMNS,
    "updates": drawn_columns(UPDATE_COLUMNS),
    "evaluations": EVALUATION_COLUMNS,
    "events": EVENT_COLUMNS,
    "policies": ("state", "action_0"),
}
COSTLY = {
    "phases": tuple(f"{kind}_{{}}{end}" for kind, end in PHASE_COST_COLUMNS),
    "updates": ("cost_{}", "limit_{}"),
    "evaluations": ("cost_{}",),
    "events": (),
    "policies": (),
}
MEASURED = {  # columns without missing numbers, and those per cost
    "phases": (("episodes", "episode_return"), ("cost_{}", "cost_{}_total", "excess_{}_total")),
    "evaluations": (("episode_return",), ("cost_{}",)),
}
CHOICES = {"phase": [phase.value for phase in Phase], "policy": [STOCHASTIC, DETERMINISTIC]}
TEXTS = (*CHOICES, "event")
OTHER_VERSION = "is a compact file of another version of recrl, or was changed"
LONG_AGO = (1980, 1, 1, 0, 0, 0)  # the time of every member: the earliest possible in zip


class OtherVersionError(RecrlError):
    """A compact file has a format or content that this version does not write."""


def save(sweep: Sweep, path: Path) -> Path:
    """Write the compact file of a sweep.

    Args:
        sweep: finished or not.
        path: of the file; its folder is created if necessary.

    Raises:
        RecrlError: the file is too large to be read back, or its folder cannot be created.
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
    content = _content(sweep)
    digests["sweep.json"] = _digest(json.loads(json.dumps(content, allow_nan=False)))
    text = json.dumps({**content, "digests": digests}, indent=1, allow_nan=False) + "\n"
    members = {"sweep.json": text, **tables}
    size = sum(len(text.encode()) for text in members.values())
    if size > MAX_BYTES:
        raise RecrlError(
            f"{path}: an export may unpack to {MAX_BYTES} bytes, this one has {size}; use the sweep's own "
            "folder"
        )
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

    The options of a task, agent or curriculum may be those of an earlier version: results are shown without
    them. Only what is computed from a finite task's options is then missing, with a note (``optima_of``).

    Raises:
        OtherVersionError: this version cannot read the content.
        DamagedError: a member is not what was written.
        RecrlError: the file is missing or no zip archive, or unpacks to more than MAX_BYTES.
    """
    names = ("sweep.json", *(f"{name}.csv" for name in ROWS))
    try:
        with zipfile.ZipFile(path) as archive:
            sweep, *frames = unpacked(archive, names, max_bytes=MAX_BYTES)
        content = json.loads(sweep)
        rows = {name: pd.read_csv(io.BytesIO(data)) for name, data in zip(ROWS, frames, strict=True)}
    except FileNotFoundError as error:
        raise RecrlError(f"{path}: {missing(path)}") from error
    except UNREADABLE as error:
        reason = getattr(error, "strerror", None) or error
        raise RecrlError(f"{path}: cannot be read as a sweep's compact file ({reason})") from error
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise OtherVersionError(f"{path}: {OTHER_VERSION}: its format must be {FORMAT}, got {found!r:.60}")
    try:
        checked = _SweepFile.model_validate(content)
        digests = {name: Extent.of(data).sha256 for name, data in zip(names[1:], frames, strict=True)}
        if "sweep.json" in checked.digests:  # earlier versions wrote none
            digests["sweep.json"] = _digest(
                {name: value for name, value in content.items() if name != "digests"}
            )
        for name, digest in digests.items():
            if digest != checked.digests.get(name):
                raise DamagedError(f"{path}: its {name} is not what was written; export the sweep again")
        facts = [_trial_facts(trial, checked.provenance) for trial in content["trials"]]
        _check_facts(facts)
        for name, frame in rows.items():
            _check_rows(name, frame, facts)
        _check_limits(rows["updates"], facts)
        check_name(checked.name)
    except ValidationError as error:
        place, sentence = next(sentences(error, None))
        where = ".".join(map(str, place))
        raise OtherVersionError(f"{path}: {OTHER_VERSION}: sweep.json: {where}: {sentence}") from error
    except (ValueError, IndexError, OverflowError) as error:
        raise OtherVersionError(f"{path}: {OTHER_VERSION}: {error}") from error
    return assemble(checked.name, facts, rows, grid=checked.grid, notes=checked.notes)


class _TrialFile(BaseModel):
    """Entry of a trial in sweep.json, without its spec, which ``TrialSpec`` checks itself."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    spec: dict[str, Any]
    status: Literal["waiting", "running", "complete", "failed", "damaged"]
    error: str
    env_steps: int = Field(ge=0, le=10**15)
    cpu_seconds: float = Field(ge=0, le=1e12)
    start_limits: LimitValues | None
    provenance: int = Field(ge=0)


class _SweepFile(BaseModel):
    """Content of sweep.json."""

    model_config = ConfigDict(strict=True, extra="forbid")
    format: int
    name: str
    notes: list[str]
    grid: str
    provenance: list[str]
    trials: list[_TrialFile]
    digests: dict[str, str]


def _check_facts(facts: Sequence[TrialFacts]) -> None:
    """Check what the specifications of the trials alone do not.

    Raises:
        ValueError: a trial occurs twice, or has not as many start_limits as limits.
    """
    counts = Counter(it.spec.trial_id for it in facts)
    for it in facts:
        if counts[it.spec.trial_id] > 1:
            raise ValueError(f"the trial {it.spec.title} is there {counts[it.spec.trial_id]} times")
        if it.start_limits and len(it.start_limits) != len(it.spec.deploy_limits):
            raise ValueError("start_limits must be as many as deploy_limits")


def _check_limits(updates: pd.DataFrame, facts: Sequence[TrialFacts]) -> None:
    """Check that the limits in force in the deployment phase are those of the specifications.

    Raises:
        ValueError: they are not, beyond the rounding of ``updates``.
    """
    deployed = updates[updates["phase"] == Phase.DEPLOYMENT.value] if len(updates) else updates
    for position, run in deployed.groupby(TRIAL):
        spec = facts[cast(int, position)].spec
        for i, limit in enumerate(spec.deploy_limits):
            if not np.allclose(run[f"limit_{i}"], limit, rtol=10.0 ** (1 - DIGITS)):
                raise ValueError(
                    f"{spec.title}: deploy_limits has {limit:g}, but updates.csv has the limit "
                    f"{run[f'limit_{i}'].iloc[0]:g} in the deployment phase"
                )


def _check_rows(name: str, rows: pd.DataFrame, facts: Sequence[TrialFacts]) -> None:
    """Check that a data frame has the required columns, and what the statistics need in them.

    Raises:
        ValueError: a column is missing or not numeric, or has unknown words or missing numbers.
    """
    columns = list(map(str, rows))
    if TRIAL not in columns:
        raise ValueError(f"{name}.csv has no column {TRIAL!r}")
    if not len(rows):
        return
    costs = max(len(it.spec.deploy_limits) for it in facts) if facts else 0
    for column in (*REQUIRED[name], *(it.format(i) for it in COSTLY[name] for i in range(costs))):
        if column not in columns:
            raise ValueError(f"{name}.csv has no column {column!r}")
    for column in columns:
        if column not in TEXTS and not pd.api.types.is_numeric_dtype(rows[column].dtype):
            raise ValueError(f"{name}.csv: the column {column!r} must hold numbers")
        if column in CHOICES and not rows[column].isin(CHOICES[column]).all():
            raise ValueError(f"{name}.csv: the column {column!r} must hold {' or '.join(CHOICES[column])}")
    trials = rows[TRIAL].to_numpy()
    if trials.dtype.kind != "i" or trials.min() < 0 or trials.max() >= len(facts):
        raise ValueError(f"{name}.csv: the column {TRIAL!r} must be positions from 0 to {len(facts) - 1}")
    num_costs = np.array([len(it.spec.deploy_limits) for it in facts])[trials]
    always, per_cost = MEASURED.get(name, ((), ()))
    for i in range(costs):
        for column in (*always, *(it.format(i) for it in per_cost)):
            if not np.isfinite(rows.loc[num_costs > i, column]).all():
                raise ValueError(f"{name}.csv: the column {column!r} lacks numbers")


def _digest(content: dict[str, Any]) -> str:
    """Return the digest of everything in sweep.json besides the digests."""
    return Extent.of(json.dumps(content, sort_keys=True).encode()).sha256


def _content(sweep: Sweep) -> dict[str, Any]:
    """Return everything except the data frames; equal provenances are stored once."""
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


def _trial_facts(value: dict[str, Any], origins: list[str]) -> TrialFacts:
    trial = TrialFacts(
        **{**value, "spec": TrialSpec.from_json(value["spec"]), "provenance": origins[value["provenance"]]}
    )
    return replace(trial, status=TrialStatus(trial.status))


def _rounded(rows: pd.DataFrame) -> pd.DataFrame:
    """Format floats with DIGITS significant digits, as the shortest text."""
    floats = rows.select_dtypes("float").columns
    return rows.assign(**{name: _significant(rows[name].to_numpy(np.float64)) for name in floats})


def _significant(values: np.ndarray) -> np.ndarray:
    """Round each value to DIGITS significant digits.

    >>> _significant(np.array([0.0012345678, -98765.4321, np.inf])).tolist()
    [0.00123457, -98765.4, inf]
    """
    return np.array([float(f"{value:.{DIGITS}g}") for value in values.tolist()])
