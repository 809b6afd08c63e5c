"""Where a curriculum starts when the training limits d_t are infinite.

A decay from infinity is not defined. Section 5.1 of the paper: "a finite initial cost limit should be used.
For instance, the agent can be executed on the training model M_t for a few episodes, and the incurred costs
can be used as the initial cost limits." So the first K policy updates are left unconstrained in the infinite
dimensions, and then d_t := max(d_d, mean episode cost of these updates). If no episode has finished by then,
the measurement goes on until one has.

Letters: k the number of costs, K = ``start_updates``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from recrl.environments.cmdp import CostLimits
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState


@dataclass(frozen=True)
class StartMeasurement:
    """The limits a curriculum starts from: d_t where it is finite, else measured.

    It keeps three keys in the teacher's state: ``start_limits`` (the d_t that is really used, [k], None as
    long as it is being measured), ``start_episodes`` and ``start_cost_sums`` [k] (what was measured).

    Attributes:
        spec: the teacher's.
        start_updates: K; 0 takes d_t as it is, infinite or not.
    """

    spec: TeacherSpec
    start_updates: int

    def begin(self) -> dict[str, Any]:
        """The three keys before any update."""
        is_open = any(
            math.isinf(train) and math.isfinite(deploy)
            for train, deploy in zip(self.spec.train_limits, self.spec.deploy_limits, strict=True)
        )
        measure = is_open and self.start_updates > 0
        return {
            "start_limits": None if measure else self.spec.train_limits.to_json(),
            "start_episodes": 0,
            "start_cost_sums": [0.0] * len(self.spec.train_limits),
        }

    def advance(self, state: TeacherState, report: ProgressReport) -> dict[str, Any]:
        """The three keys after ``report``."""
        keys = {key: state[key] for key in ("start_limits", "start_episodes", "start_cost_sums")}
        if keys["start_limits"] is not None:
            return keys
        episodes = keys["start_episodes"] + len(report.episodes)
        cost_sums = [
            math.fsum([so_far, *(episode.costs[i] for episode in report.episodes)])
            for i, so_far in enumerate(keys["start_cost_sums"])
        ]
        measured = None
        if report.update >= self.start_updates and episodes > 0:
            measured = CostLimits(
                tuple(
                    train if math.isfinite(train) else max(deploy, cost_sum / episodes)
                    for train, deploy, cost_sum in zip(
                        self.spec.train_limits, self.spec.deploy_limits, cost_sums, strict=True
                    )
                )
            ).to_json()
        return {"start_limits": measured, "start_episodes": episodes, "start_cost_sums": cost_sums}

    def limits(self, keys: TeacherState) -> CostLimits:
        """The d_t in force: the start limits, or d_t itself while they are being measured, [k]."""
        start = keys["start_limits"]
        return self.spec.train_limits if start is None else CostLimits.from_json(start)
