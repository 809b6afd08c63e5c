"""Initial limits of a curriculum if the training limits d_t are infinite.

A decay from infinity is not defined. Section 5.1 of the paper: "a finite initial cost limit should be used.
For instance, the agent can be executed on the training model M_t for a few episodes, and the incurred costs
can be used as the initial cost limits."

The choice of the episodes matters. An untrained agent may have the highest cost, as on RiverGrid, where it
moves at random in the river. Or it has the lowest, as on Safety Gym, where it hardly moves and an agent with
reward costs twice as much. A limit measured there would be tight from the start. So for a fraction f of the
training budget the agent learns without limits in the infinite dimensions. Then

    d_t := max(d_d, the largest mean cost of any window of episodes so far),

where windows are consecutive and of at least 32 finished episodes. First episodes that are cut, to spread the
environments over an episode's steps, do not count. If no window is complete by then, the episodes so far are
one, possibly fewer than 32. If no episode has finished by then, the measurement continues until one has. As
the largest of many means d_t is somewhat above what the agent costs on average.

Notation: k the number of costs, B the training budget in environment steps, f = ``start_fraction``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from recrl.environments.cmdp import CostLimits
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState

START_FRACTION = 0.05  # by default
WINDOW_EPISODES = 32
KEYS = ("start_limits", "start_episodes", "start_cost_sums", "start_peaks")


@dataclass(frozen=True)
class StartMeasurement:
    """Initial limits of a curriculum: d_t where it is finite, else measured.

    It keeps four keys in the curriculum's state: ``start_limits`` (the actual d_t, [k], None during the
    measurement); ``start_episodes`` and ``start_cost_sums`` [k] of the present window; and ``start_peaks``,
    the largest mean cost of a whole window, [k], None before the first.

    Attributes:
        spec: of the curriculum.
        start_fraction: f; 0 uses d_t even if it is infinite.
    """

    spec: TeacherSpec
    start_fraction: float

    def begin(self) -> dict[str, Any]:
        """Return the four keys before any update."""
        measure = self.start_fraction > 0.0 and any(map(math.isinf, self.spec.train_limits))
        return {
            "start_limits": None if measure else self.spec.train_limits.to_json(),
            "start_episodes": 0,
            "start_cost_sums": [0.0] * len(self.spec.train_limits),
            "start_peaks": None,
        }

    def advance(self, state: TeacherState, report: ProgressReport) -> dict[str, Any]:
        """Return the four keys after ``report``."""
        keys = {key: state[key] for key in KEYS}
        if keys["start_limits"] is not None:
            return keys
        episodes = keys["start_episodes"] + len(report.episodes)
        sums = [
            math.fsum([so_far, *(episode.costs[i] for episode in report.episodes)])
            for i, so_far in enumerate(keys["start_cost_sums"])
        ]
        peaks = keys["start_peaks"]
        is_over = report.env_steps >= self.start_fraction * self.spec.train_steps
        # An incomplete last window counts only if there is no complete one.
        if episodes >= WINDOW_EPISODES or (is_over and peaks is None and episodes > 0):
            means = [cost_sum / episodes for cost_sum in sums]
            peaks = means if peaks is None else [max(pair) for pair in zip(peaks, means, strict=True)]
            episodes, sums = 0, [0.0] * len(sums)
        measured = self._measured(peaks) if is_over and peaks is not None else None
        return dict(zip(KEYS, (measured, episodes, sums, peaks), strict=True))

    def _measured(self, peaks: list[float]) -> list[float | str]:
        """Return d_t where it is finite, else the peak, but at least d_d, as JSON."""
        spec = self.spec
        return CostLimits(
            tuple(
                train if math.isfinite(train) else max(deploy, peak)
                for train, deploy, peak in zip(spec.train_limits, spec.deploy_limits, peaks, strict=True)
            )
        ).to_json()

    def limits(self, keys: TeacherState) -> CostLimits:
        """Return the d_t in force: the start limits, or d_t itself during the measurement, [k]."""
        start = keys["start_limits"]
        return self.spec.train_limits if start is None else CostLimits.from_json(start)
