"""Statistics of consecutive policy updates, and the two windows that Algorithm 2 compares.

A policy is constant between two updates, so a window consists of whole updates. Its episodes are summed up
once, when they are reported, and a state keeps one short record for each update of the last two windows.

Notation: k the number of costs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from recrl.environments.cmdp import EpisodeStats


@dataclass(frozen=True)
class WindowStatistics:
    """Statistics of the episodes that finished over some consecutive policy updates.

    Attributes:
        env_steps: environment steps of these updates in which finished episodes count, over all the trial's
            environments.
        episodes: number of finished episodes, n; if it is 0, the means are 0 and not meaningful.
        mean_return: r-bar, the mean undiscounted return.
        mean_costs: C-bar, the mean undiscounted episode costs, [k].
        cost_scatter: sums of squared deviations from ``mean_costs``, [k].
        return_scatter: sum of squared deviations from ``mean_return``.
    """

    env_steps: int
    episodes: int
    mean_return: float
    mean_costs: tuple[float, ...]
    cost_scatter: tuple[float, ...]
    return_scatter: float = 0.0

    @classmethod
    def of_update(
        cls, episodes: Sequence[EpisodeStats], *, env_steps: int, num_costs: int
    ) -> WindowStatistics:
        """Return the statistics of one update's report."""
        count = len(episodes)
        if count == 0:
            return cls(env_steps, 0, 0.0, (0.0,) * num_costs, (0.0,) * num_costs)
        costs = list(zip(*(episode.costs for episode in episodes), strict=True))
        mean_return = math.fsum(episode.episode_return for episode in episodes) / count
        mean_costs = tuple(math.fsum(column) / count for column in costs)
        cost_scatter = tuple(
            math.fsum((cost - mean) ** 2 for cost in column)
            for column, mean in zip(costs, mean_costs, strict=True)
        )
        return_scatter = math.fsum((episode.episode_return - mean_return) ** 2 for episode in episodes)
        return cls(env_steps, count, mean_return, mean_costs, cost_scatter, return_scatter)

    @classmethod
    def pooled(cls, parts: Sequence[WindowStatistics]) -> WindowStatistics:
        """Pool several statistics; the sums are exact, so that the order does not matter."""
        env_steps = sum(part.env_steps for part in parts)
        episodes = sum(part.episodes for part in parts)
        if episodes == 0:
            zeros = (0.0,) * len(parts[0].mean_costs)
            return cls(env_steps, 0, 0.0, zeros, zeros)
        mean_return = math.fsum(part.episodes * part.mean_return for part in parts) / episodes
        mean_costs = tuple(
            math.fsum(part.episodes * part.mean_costs[i] for part in parts) / episodes
            for i in range(len(parts[0].mean_costs))
        )
        # Between and within the parts: sum of n (mean of the part - mean)^2, plus their own scatter.
        cost_scatter = tuple(
            math.fsum(
                part.episodes * (part.mean_costs[i] - mean) ** 2 + part.cost_scatter[i] for part in parts
            )
            for i, mean in enumerate(mean_costs)
        )
        return_scatter = math.fsum(
            part.episodes * (part.mean_return - mean_return) ** 2 + part.return_scatter for part in parts
        )
        return cls(env_steps, episodes, mean_return, mean_costs, cost_scatter, return_scatter)

    def of_cost(self, index: int) -> WindowStatistics:
        """Return the same statistics with one of the costs only."""
        return replace(self, mean_costs=(self.mean_costs[index],), cost_scatter=(self.cost_scatter[index],))

    @property
    def cost_spreads(self) -> tuple[float, ...]:
        """Standard deviations of the episode costs, sqrt(scatter / (n - 1)), [k]; 0 if n < 2."""
        return tuple(self._spread(scatter) for scatter in self.cost_scatter)

    @property
    def return_spread(self) -> float:
        """Standard deviation of the returns; 0 if n < 2."""
        return self._spread(self.return_scatter)

    @property
    def standard_errors(self) -> tuple[float, ...]:
        """Standard errors of ``mean_costs``, sqrt(scatter / (n - 1) / n), [k]; 0 if n < 2."""
        return tuple(spread / math.sqrt(max(self.episodes, 1)) for spread in self.cost_spreads)

    def _spread(self, scatter: float) -> float:
        return math.sqrt(scatter / (self.episodes - 1)) if self.episodes > 1 else 0.0

    def to_json(self) -> list[Any]:
        """Return the statistics as a JSON list, in the order of the attributes."""
        return [
            self.env_steps,
            self.episodes,
            self.mean_return,
            list(self.mean_costs),
            list(self.cost_scatter),
            self.return_scatter,
        ]

    @classmethod
    def from_json(cls, values: Sequence[Any]) -> WindowStatistics:
        """Inverse of ``to_json``."""
        env_steps, episodes, mean_return, mean_costs, cost_scatter, return_scatter = values
        return cls(env_steps, episodes, mean_return, tuple(mean_costs), tuple(cost_scatter), return_scatter)


def latest_window(
    history: Sequence[WindowStatistics],
    size: int,
    *,
    is_enough: Callable[[WindowStatistics], bool],
) -> int | None:
    """Return how many of the last updates make a window; None if there are too few.

    These are the last ``size`` updates, and more of them until ``is_enough`` is true. Updates in which no
    episode finished make no difference to it, so they are passed over.

    Args:
        history: statistics of each update, in order.
        size: least number of updates, at least 1.
        is_enough: of the pooled statistics of a window.
    """
    if len(history) < size:
        return None
    count, window = size, WindowStatistics.pooled(history[-size:])
    while not is_enough(window):
        longer = next((n for n in range(count + 1, len(history) + 1) if history[-n].episodes), None)
        if longer is None:
            return None
        window = WindowStatistics.pooled([*history[-longer:-count], window])
        count = longer
    return count


def last_two_windows(
    history: Sequence[WindowStatistics],
    size: int,
    *,
    is_enough: Callable[[WindowStatistics], bool],
) -> tuple[tuple[WindowStatistics, ...], tuple[WindowStatistics, ...]] | None:
    """Return the updates of the last two windows, the older one first; None if there are too few."""
    new = latest_window(history, size, is_enough=is_enough)
    if new is None:
        return None
    split = len(history) - new
    old = latest_window(history[:split], size, is_enough=is_enough)
    if old is None:
        return None
    return tuple(history[split - old : split]), tuple(history[split:])
