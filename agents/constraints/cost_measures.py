"""Constrained measures of the episode cost: the mean, or the mean of the worst episodes (CVaR).

The conditional value at risk at level alpha of an episode's cost C is the mean of its worst fraction 1 -
alpha,

    CVaR(C) = min over nu of  nu + E[max(C - nu, 0)] / (1 - alpha)        (Rockafellar and Uryasev 2000),

and the value at risk, the alpha-quantile of C, is a nu that attains it. alpha = 0 is the mean. Since nu
minimises, a small change of the policy changes the CVaR as if nu were fixed (Tamar et al. 2015; Chow et al.
2017): by E[max(C - nu, 0)] / (1 - alpha) alone. That is the mean over episodes of the *tail costs*

    c'_t = (max(S_{t+1} - nu, 0) - max(S_t - nu, 0)) / (1 - alpha),  S_t the episode's cost before step t,

which sum to max(C - nu, 0) / (1 - alpha) over an episode: only cost beyond the quantile counts. Any agent for
mean costs can therefore constrain the CVaR. It receives c'_t in place of the costs, and nu + the mean of
their sums in place of the mean episode cost.

If all episodes have about the same cost, none has cost beyond the quantile. The CVaR then has no gradient,
and an agent that violates its limit d could not improve (Greenberg et al. 2022). But the CVaR is at most d if
and only if nu + E[max(C - nu, 0)] / (1 - alpha) is, for some nu <= d. Hence nu is the smaller of the value at
risk and d. If the limit holds, that is the value at risk.

Left out: in Chow et al., policy and critics observe S_t. Here both see only the task's observations, so the
critics are baselines for the average S_t. The effect of a step on later tail costs is therefore estimated by
the trace, not by bootstrapping: with ``cvar``, choose a ``cost_trace_decay`` near 1. Only a fraction 1 -
alpha of the episodes of an update counts, so an update needs many.

Notation: T steps, B environments, k costs, E finished episodes, alpha the level, nu the value at risk.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.agents.agent import Rollout
from recrl.agents.constraints.life_table import LifeTable
from recrl.agents.experience import Constraints
from recrl.environments.cmdp import Floats


def value_at_risk(costs: Floats, level: float) -> Floats:
    """Return nu, the smallest of E costs that a fraction of at least alpha does not exceed, [E, k] -> [k].

    >>> value_at_risk(np.array([[4.0], [1.0], [3.0], [2.0]]), 0.75)
    array([3.])
    """
    # Without the tolerance a level that is a multiple of 1 / E, 0.9 of 10, may round up to the next one.
    rank = max(math.ceil(level * len(costs) - 1e-9), 1)
    quantile: Floats = np.sort(costs, axis=0)[rank - 1]
    return quantile


def tail_bound(costs: Floats, threshold: Floats, level: float) -> Floats:
    """Return nu + mean(max(C - nu, 0)) / (1 - alpha), an upper bound on the CVaR, [E, k] -> [k].

    It is the CVaR, the mean of the worst fraction 1 - alpha, where nu is the ``value_at_risk``.

    >>> tail_bound(np.array([[4.0], [1.0], [3.0], [2.0]]), np.array([2.5]), 0.5)
    array([3.5])
    """
    bound: Floats = threshold + np.maximum(costs - threshold, 0.0).mean(axis=0) / (1.0 - level)
    return bound


def tail_costs(
    costs: Floats, *, carried: Floats, ended: npt.NDArray[np.bool_], threshold: Floats, level: float
) -> Floats:
    """Return the module's tail costs c'_t.

    Args:
        costs: of each step, at least 0, [T, B, k].
        carried: S of the running episodes before the first step, [B, k].
        ended: the step ended an episode, [T, B].
        threshold: nu, [k].
        level: alpha in [0, 1).

    Returns:
        [T, B, k].
    """
    beyond = np.empty_like(costs)
    so_far = carried
    for step in range(len(costs)):
        after = so_far + costs[step]
        beyond[step] = np.maximum(after - threshold, 0.0) - np.maximum(so_far - threshold, 0.0)
        so_far = np.where(ended[step][:, None], 0.0, after)
    return beyond / (1.0 - level)


def standard_errors(costs: Floats) -> Floats:
    """Return the standard errors of the means of E costs, [E, k] -> [k]; 0 where E is less than 2.

    >>> standard_errors(np.array([[1.0], [3.0]]))
    array([1.])
    """
    if len(costs) < 2:
        return np.zeros(costs.shape[1])
    errors: Floats = costs.std(axis=0, ddof=1) / math.sqrt(len(costs))
    return errors


@dataclass(frozen=True, eq=False)
class Episodes:
    """Episodes that finished lately.

    Attributes:
        costs: undiscounted, [E, k].
        lengths: steps, [E].
        finished: number of them that finished in the newest update, at most E.
    """

    costs: Floats
    lengths: npt.NDArray[np.int64]
    finished: int

    @property
    def mean_length(self) -> float:
        """Their mean number of steps, if there is an episode."""
        return float(self.lengths.mean())


class RecentEpisodes:
    """Window of the last finished episodes: of the newest update, and of earlier ones until it is full.

    Args:
        window: the least number of episodes, at least 1; fewer are used only at the start.
        num_costs: k.
    """

    def __init__(self, window: int, num_costs: int) -> None:
        self._window = window
        self._updates: list[tuple[Floats, npt.NDArray[np.int64]]] = []
        self._no_costs = np.empty((0, num_costs))

    def add(self, costs: Floats, lengths: npt.NDArray[np.int64]) -> Episodes:
        """Include the episodes that finished in an update, and return those of the window.

        Args:
            costs: undiscounted, [F, k].
            lengths: steps, [F].

        Raises:
            ValueError: there are not as many costs as lengths.
        """
        if len(costs) != len(lengths):
            raise ValueError(
                "episode_costs must have one row for each episode that ended in the rollout, "
                f"{len(lengths)}, got {len(costs)}"
            )
        if len(costs):
            self._updates.append((costs, lengths))
        while sum(len(each) for each, _ in self._updates[1:]) >= self._window:
            del self._updates[0]
        return Episodes(*self._window_of_episodes(), len(costs))

    def _window_of_episodes(self) -> tuple[Floats, npt.NDArray[np.int64]]:
        """Return costs [E, k] and lengths [E] of all episodes of the window."""
        costs = [self._no_costs, *(costs for costs, _ in self._updates)]
        lengths = [np.empty(0, np.int64), *(lengths for _, lengths in self._updates)]
        return np.concatenate(costs), np.concatenate(lengths)

    def state_dict(self) -> dict[str, Any]:
        """Return the window's episodes, and the number of episodes of each of its updates."""
        costs, lengths = self._window_of_episodes()
        return {
            "costs": costs,
            "lengths": lengths,
            "episodes": np.array([len(costs) for costs, _ in self._updates], np.int64),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        ends = np.cumsum(state["episodes"])[:-1]
        costs = np.split(np.array(state["costs"], np.float64), ends)
        lengths = np.split(np.array(state["lengths"], np.int64), ends)
        self._updates = list(zip(costs, lengths, strict=True)) if len(state["episodes"]) else []


@dataclass(frozen=True, eq=False)
class MeasuredCosts:
    """What an agent constrains after a rollout.

    Attributes:
        step_costs: per step, whose sums over an episode are constrained, [T, B, k].
        values: for comparison with the limits, [k].
        standard_errors: of ``values``, [k], at least 0; those of a CVaR for a given value at risk.
        episode_length: mean steps of an episode, at least 1.
    """

    step_costs: Floats
    values: Floats
    standard_errors: Floats
    episode_length: float

    def against(self, limits: Floats) -> Constraints:
        """Compare the constrained values with the limits, [k]."""
        gaps = np.where(np.isfinite(limits), self.values - limits, -np.inf)
        return Constraints(limits, gaps, self.standard_errors, self.episode_length)


class MeanCost:
    """Constraint on the mean episode cost.

    Args:
        window: the least number of episodes finished in a rollout for their plain mean, and of steps that
            an age counts in the life table.
        num_costs: k.
    """

    def __init__(self, window: int, num_costs: int) -> None:
        self._window = window
        self._table = LifeTable(window, num_costs)

    def measure(self, rollout: Rollout, episodes: Episodes, limits: Floats) -> MeasuredCosts:
        """Estimate the mean cost and the mean length from what the newest policies did.

        If at least ``window`` episodes finished in the rollout, return their means, otherwise those of the
        life table. Until an episode has finished these are lower bounds: steps of later ages are not known.
        The table's standard error is that of a mean of as many episodes as it has steps of each age.

        The table never wholly forgets old steps of ages that fewer than ``window`` steps of a rollout have.
        So the mean of a cost is 0 exactly if no episode of the window and no running one has it.

        Args:
            rollout: the steps.
            episodes: of the window.
            limits: d, [k], possibly infinite; the mean does not need them.
        """
        self._table.add(rollout)
        errors = standard_errors(episodes.costs)
        if episodes.finished >= self._window:
            return MeasuredCosts(rollout.costs, episodes.costs.mean(axis=0), errors, episodes.mean_length)
        means = self._table.means()
        errors = errors * math.sqrt(len(episodes.costs) / means.number)
        running = rollout.costs.any(axis=(0, 1)) | rollout.carried_costs.any(axis=0)
        occurred = running | episodes.costs.any(axis=0)
        return MeasuredCosts(rollout.costs, np.where(occurred, means.costs, 0.0), errors, means.length)

    def state_dict(self) -> dict[str, Any]:
        """Return the life table."""
        return self._table.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._table.load_state_dict(state)


class TailCost:
    """Constraint on the CVaR of the episode cost, over the episodes of the window.

    Args:
        level: alpha in [0, 1).
    """

    def __init__(self, level: float) -> None:
        self._level = level

    def measure(self, rollout: Rollout, episodes: Episodes, limits: Floats) -> MeasuredCosts:
        """Return the tail costs, and the CVaR if it is within the limit, else a bound on it.

        Until a first episode has finished, those under way count as if they had. Their costs are too low.

        Args:
            rollout: the steps.
            episodes: of the window.
            limits: d, [k], possibly infinite.
        """
        if not len(episodes.costs):
            episodes = _under_way(rollout)
        threshold = np.minimum(value_at_risk(episodes.costs, self._level), limits)
        values = tail_bound(episodes.costs, threshold, self._level)
        beyond = np.maximum(episodes.costs - threshold, 0.0) / (1.0 - self._level)
        costs = tail_costs(
            rollout.costs,
            carried=rollout.carried_costs,
            ended=rollout.terminated | rollout.truncated,
            threshold=threshold,
            level=self._level,
        )
        return MeasuredCosts(costs, values, standard_errors(beyond), episodes.mean_length)


def _under_way(rollout: Rollout) -> Episodes:
    """Return the B episodes of a rollout in which none ended, as if they ended with it."""
    costs = rollout.carried_costs + rollout.costs.sum(axis=0)
    return Episodes(costs, rollout.carried_lengths + len(rollout.costs), finished=0)
