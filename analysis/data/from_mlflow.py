"""A sweep's frames from MLflow alone, for whoever has a tracking address and no files.

What MLflow holds is equal to what the files say, with these exceptions:

    trials       those that have begun; of a grid that was cut down, the others too
    updates      about ``tracking_points.POINTS_PER_METRIC`` of a trial's updates (noise: the largest since
                 the one before); of the students' metrics only those that figures and tables read
                 (``frames.DRAWN_METRICS``); no ``collect_seconds`` and ``update_seconds``
    phases, evaluations, events, policies    of complete trials only

An infinite limit and the mean of no episodes have no point in MLflow: they are put back where an update is
shown but the value is not.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from recrl.analysis.data.labels import TRIAL
from recrl.analysis.data.sweep_data import DRAWN_METRICS, EVENT_COLUMNS, Rows, Sweep, TrialFacts, assemble
from recrl.environments.cmdp import Floats, Phase
from recrl.orchestrator.tracking.reader import History, TrackedSweep, TrackedTrial, find_sweep

SHOWN_WITH_EVERY_UPDATE = "curriculum/noise"
SECTIONS = ("train", "deploy")


def load(uri: str, name: str | None = None) -> Sweep:
    """Read a sweep from an MLflow server or database.

    Args:
        uri: http(s)://host:port, sqlite:///file.db or another database's address.
        name: of the sweep; may be left out where MLflow shows only one.

    Raises:
        TrackingError: MLflow cannot be reached, or shows no such sweep.
    """
    tracked = find_sweep(uri, name)
    complete = [bool(trial.phases) for trial in tracked.trials]
    provenance = tracked.files("provenance.json")

    def files(name: str) -> list[bytes | None]:
        return tracked.files(name) if any(complete) else [None] * len(complete)

    notes = ["Read from MLflow, which holds only some of the updates of a long trial."]
    if tracked.untold:
        notes.append(
            f"{tracked.untold} trials: sent to MLflow by an older version, left out; "
            f"recrl-sweep sync --rebuild sends them again"
        )
    grid = tracked.own_file("grid.yaml")
    return assemble(
        tracked.name,
        [_facts(trial, data) for trial, data in zip(tracked.trials, provenance, strict=True)],
        Rows(
            phases=_records([trial.phases for trial in tracked.trials]),
            updates=_updates(tracked),
            evaluations=_tables(files("evaluation.csv")),
            events=_records([_events(data) for data in files("events.jsonl")]),
            policies=_with_states(_tables(files("policy.csv"))),
        ),
        grid=grid.decode() if grid else "",
        notes=notes,
    )


def _facts(trial: TrackedTrial, provenance: bytes | None) -> TrialFacts:
    progress = trial.progress
    return TrialFacts(
        spec=trial.spec,
        status=trial.status,
        error=trial.error,
        env_steps=int(progress.get("env_steps", 0)),
        cpu_seconds=float(progress.get("cpu_seconds", 0.0)),
        start_limits=progress.get("start_limits"),
        provenance=provenance.decode() if provenance else "",
    )


def _updates(tracked: TrackedSweep) -> pd.DataFrame:
    """The shown updates of all trials at once: a row for every point that each update has."""
    specs = [trial.spec for trial in tracked.trials]
    names = set().union(*(trial.metrics for trial in tracked.trials))
    num_costs = max((len(spec.deploy_limits) for spec in specs), default=0)
    own = sorted(
        name
        for section, _, name in (metric.partition("/") for metric in names)
        if section == "student" and DRAWN_METRICS.fullmatch(name)
    )
    means = ["episodes", "return", *(f"cost_{i}" for i in range(num_costs))]
    wanted = {SHOWN_WITH_EVERY_UPDATE, *(f"curriculum/limit_{i}" for i in range(num_costs))}
    wanted |= {f"{section}/{name}" for section in SECTIONS for name in means} & names
    histories = tracked.histories(sorted(wanted | {f"student/{name}" for name in own}))
    shown = histories[SHOWN_WITH_EVERY_UPDATE]
    sizes = np.array([spec.steps_per_update for spec in specs], dtype=np.int64)[shown.trials]
    budgets = np.array([spec.train_steps for spec in specs], dtype=np.int64)[shown.trials]
    counts = np.array([len(spec.deploy_limits) for spec in specs], dtype=np.int64)[shown.trials]
    cells = _Cells(shown)

    def of_phases(name: str) -> Floats:
        return cells.fill([histories[key] for it in SECTIONS if (key := f"{it}/{name}") in histories])

    columns: dict[str, Any] = {
        TRIAL: shown.trials,
        "update": shown.steps // sizes,
        "phase": np.where(shown.steps - sizes < budgets, Phase.TRAINING.value, Phase.DEPLOYMENT.value),
        "end_step": shown.steps,
        "episodes": of_phases("episodes"),
        "episode_return": of_phases("return"),
        "noise": shown.values,
        "time": shown.milliseconds / 1000.0,
        "collect_seconds": math.nan,
        "update_seconds": math.nan,
    }
    for i in range(num_costs):
        columns[f"cost_{i}"] = of_phases(f"cost_{i}")
    for i in range(num_costs):
        limits = cells.fill([histories[f"curriculum/limit_{i}"]])
        columns[f"limit_{i}"] = np.where(np.isnan(limits) & (counts > i), math.inf, limits)
    for name in own:
        columns[name] = cells.fill([histories[f"student/{name}"]])
    return pd.DataFrame(columns)


class _Cells:
    """The (trial, step) pairs of the shown updates, to which points of other metrics are brought."""

    def __init__(self, shown: History) -> None:
        self._scale = int(shown.steps.max(initial=0)) + 1
        self._known = self._numbered(shown)  # ascending, as a history is in order

    def fill(self, histories: list[History]) -> Floats:
        """The points' values, one for every shown update, NaN where there is none."""
        values = np.full(len(self._known), math.nan)
        for history in histories:
            wanted = self._numbered(history)
            at = np.searchsorted(self._known, wanted)
            found = (at < len(self._known)) & (wanted == self._known[np.minimum(at, len(self._known) - 1)])
            values[at[found]] = history.values[found]
        return values

    def _numbered(self, history: History) -> npt.NDArray[np.int64]:
        return history.trials * self._scale + np.minimum(history.steps, self._scale - 1)


def _events(data: bytes | None) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (data or b"").splitlines()]
    return [{name: event.get(name) for name in EVENT_COLUMNS} for event in lines]


def _records(of_trials: Sequence[Sequence[Mapping[str, Any]]]) -> pd.DataFrame:
    """Rows of all trials, with the column TRIAL."""
    rows = pd.DataFrame([row for rows in of_trials for row in rows])
    return rows.assign(**{TRIAL: np.repeat(np.arange(len(of_trials)), [len(rows) for rows in of_trials])})


def _tables(files: Sequence[bytes | None]) -> pd.DataFrame:
    """CSV files of all trials, with the column TRIAL; those with the same head are parsed at once.

    Args:
        files: one of each trial, None where it has none; a line is a row.
    """
    of_head: dict[bytes, list[tuple[int, bytes]]] = {}
    for trial, data in enumerate(files):
        head, _, body = (data or b"").rstrip(b"\n").partition(b"\n")
        if body:
            of_head.setdefault(head, []).append((trial, body))
    tables = []
    for head, bodies in of_head.items():
        table = pd.read_csv(io.BytesIO(b"\n".join([head, *(body for _, body in bodies)])))
        lines = [body.count(b"\n") + 1 for _, body in bodies]
        tables.append(table.assign(**{TRIAL: np.repeat([trial for trial, _ in bodies], lines)}))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame({TRIAL: []}, dtype=np.int64)


def _with_states(policies: pd.DataFrame) -> pd.DataFrame:
    """Numbers the states of each trial, which are in their order."""
    policies.insert(0, "state", policies.groupby(TRIAL).cumcount())
    return policies
