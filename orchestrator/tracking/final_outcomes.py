"""Outcome of each trial's final policy, by the same measure as in the report.

The analysis writes ``outcomes.csv`` into the sweep's figures folder, and this module reads that file. So
MLflow and the report show the same numbers, and this package does not import the analysis. The file is
written with the report, and at the end of a launch without figures. ``recrl-sweep sync`` writes it if a
complete trial is not in it.
"""

from __future__ import annotations

import csv
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from recrl.orchestrator.files.outcomes_file import (
    FEASIBLE,
    INFEASIBLE,
    OUTCOMES_FILE,
    SOLVED,
    VERDICT_MEASURE,
)
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.number_texts import cost_with_error, number
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.tracking.positions import file_mark

logger = logging.getLogger("recrl.mlflow")


@dataclass(frozen=True)
class FinalOutcome:
    """Outcome of one final policy (stochastic, without learning).

    Attributes:
        trial_id: of the trial.
        episode_return: exact where ``exact``, else a mean over episodes.
        costs: episode costs, likewise, [k].
        limits: d_d, [k].
        is_feasible: whether every cost is within its limit and the tolerance.
        is_solved: whether it is also near a known optimum.
        exact: whether the values were computed, not sampled.
        excesses: how far each cost is above its limit; 0 within the tolerance or if it is missing, [k].
        cpu_seconds: CPU time of the trial, which differs from that of an earlier run; None if not known.
    """

    trial_id: str
    episode_return: float
    costs: tuple[float, ...]
    limits: tuple[float, ...]
    is_feasible: bool
    is_solved: bool
    exact: bool
    excesses: tuple[float, ...] = ()
    cpu_seconds: float | None = None

    @property
    def verdict(self) -> str:
        """The verdict in one word, as in the report."""
        return SOLVED if self.is_solved else FEASIBLE if self.is_feasible else INFEASIBLE

    @property
    def metrics(self) -> dict[str, float]:
        """The values by the names of their metrics."""
        values = {"final/return": self.episode_return}
        for i, (cost, limit) in enumerate(zip(self.costs, self.limits, strict=True)):
            values |= {f"final/cost_{i}": cost, f"final/limit_{i}": limit}
        return values


class FinalOutcomes:
    """The outcomes of a sweep's complete trials, as last written; read again when the file changes.

    Args:
        store: the sweep.
    """

    def __init__(self, store: SweepStore) -> None:
        self._store = store
        self._path = store.figures_folder / OUTCOMES_FILE
        self._mark = ""
        self._found: dict[str, FinalOutcome] = {}  # by trial id, as labels may be those of an earlier grid

    def of(self, spec: TrialSpec, record: TrialRecord) -> FinalOutcome | None:
        """Return the outcome of a trial; None before the file has it, or if it has that of an earlier run.

        Args:
            spec: the trial.
            record: of the trial.
        """
        self._refresh()
        found = self._found.get(spec.trial_id)
        if found is None or record.status is not TrialStatus.COMPLETE:
            return None
        is_of_this_run = found.cpu_seconds is None or found.cpu_seconds == record.cpu_seconds
        return found if is_of_this_run else None

    def lack_a_complete_trial(self) -> bool:
        """Whether a complete trial of the grid, whose policy was evaluated, is not in the file."""
        evaluated = (spec for spec in self._store.specs() if spec.evaluation_episodes)
        records = ((spec, self._store.trial(spec).record()) for spec in evaluated)
        return any(
            record.status is TrialStatus.COMPLETE and self.of(spec, record) is None
            for spec, record in records
        )

    def has_sampled(self) -> bool:
        """Whether an outcome is sampled: its task is not finite, or was not trusted when it was measured."""
        self._refresh()
        return not all(outcome.exact for outcome in self._found.values())

    def _refresh(self) -> None:
        try:
            mark = file_mark(self._path)
            if mark == self._mark:
                return
            with self._path.open(encoding="utf-8", newline="") as file:
                rows = [row for row in csv.DictReader(file) if row.get("measure") == VERDICT_MEASURE]
            outcomes = list(map(_outcome, rows))
        except FileNotFoundError:
            mark, outcomes = "", []
        except (KeyError, TypeError, ValueError):  # another version wrote it, or it is being written
            logger.debug("outcomes of %s", self._store.name, exc_info=True)
            return
        self._mark = mark
        self._found = {outcome.trial_id: outcome for outcome in outcomes}


def trial_note(outcome: FinalOutcome, start_limits: Sequence[float]) -> str:
    """Return the description of a trial's run in Markdown: verdict, return, cost, limit, d_t.

    Args:
        outcome: of its final policy.
        start_limits: the d_t that its curriculum began with, [k].
    """
    how = "computed exactly" if outcome.exact else "means over sampled episodes"
    verdict = f"{outcome.verdict}{_by(outcome.excesses)}"
    costs = ", ".join(cost_with_error(cost, math.nan, exact=outcome.exact) for cost in outcome.costs)
    return (
        f"**{verdict}**: return {number(outcome.episode_return)}, cost {costs}, "
        f"limit d_d {_listed(outcome.limits)}, training limit d_t {_listed(start_limits)}.\n\n"
        f"These are the metrics `final/...` of the final policy (stochastic, without learning), {how}, as in "
        "the report. `evaluation/...` are means over sampled episodes of the same policy. "
        "`summary/deploy_...` averages the deployment phase, in which learning goes on."
    )


def _by(excesses: Sequence[float]) -> str:
    """Return the excess of each exceeded cost; empty if there is none.

    One cost: `` by 0.28``. Several: ``, cost 0 by 0.50, cost 1 by 0.25``.
    """
    names = [f", cost {i}" for i in range(len(excesses))] if len(excesses) > 1 else [""]
    by = zip(names, excesses, strict=True)
    return "".join(f"{name} by {number(excess)}" for name, excess in by if excess > 0.0)


def _outcome(row: Mapping[str, str]) -> FinalOutcome:
    names = (name for name in row if re.fullmatch(r"cost_\d+", name) and row[name])
    costs = sorted(names, key=lambda name: int(name.removeprefix("cost_")))
    return FinalOutcome(
        trial_id=row["trial_id"],
        episode_return=float(row["episode_return"]),
        costs=tuple(float(row[name]) for name in costs),
        limits=tuple(float(row[f"deploy_limit_{name.removeprefix('cost_')}"]) for name in costs),
        is_feasible=row["feasible"] == "True",
        is_solved=row["optimal"] == "True",
        exact=row["exact"] == "True",
        excesses=tuple(float(row[f"excess_{name.removeprefix('cost_')}"] or 0.0) for name in costs),
        cpu_seconds=float(row["cpu_seconds"]) if row.get("cpu_seconds") else None,
    )


def _listed(values: Sequence[float]) -> str:
    return ", ".join(map(number, values))
