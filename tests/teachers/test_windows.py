"""What is remembered of the agent's episodes, and how windows are cut from it."""

import math

import pytest

from recrl.environments.cmdp import CostLimits, EpisodeStats, Phase
from recrl.teachers.windows import WindowStatistics, last_two_windows


def of_costs(*costs: float, env_steps: int = 100) -> WindowStatistics:
    """An update in which episodes of these costs finished, each with the return 2 x cost."""
    episodes = [
        EpisodeStats(b, Phase.TRAINING, 0, 1, 2 * cost, (cost,), CostLimits((9.0,)), 0.0)
        for b, cost in enumerate(costs)
    ]
    return WindowStatistics.of_update(episodes, env_steps=env_steps, num_costs=1)


def test_an_update_is_summed_up_by_its_means_and_its_scatter() -> None:
    update = of_costs(1.0, 2.0, 6.0)
    assert update == WindowStatistics(
        100, 3, 6.0, mean_costs=(3.0,), cost_scatter=(14.0,), return_scatter=56.0
    )
    assert update.return_spread == pytest.approx(math.sqrt(56 / 2))
    assert update.standard_errors[0] == pytest.approx(math.sqrt(14 / 2 / 3))


def test_one_episode_has_no_standard_error() -> None:
    assert of_costs(4.0).standard_errors == (0.0,)


def test_an_update_without_episodes_says_nothing() -> None:
    assert of_costs() == WindowStatistics(100, 0, 0.0, (0.0,), (0.0,))


def test_pooled_updates_are_one_update() -> None:
    pooled = WindowStatistics.pooled([of_costs(1.0, 2.0), of_costs(), of_costs(6.0)])
    assert pooled == WindowStatistics(
        300, 3, 6.0, mean_costs=(3.0,), cost_scatter=(14.0,), return_scatter=56.0
    )


def test_windows_of_updates_count_updates() -> None:
    history = [of_costs(c) for c in (1.0, 2.0, 3.0, 4.0, 5.0)]
    assert last_two_windows(history, 2, is_enough=bool) == (tuple(history[1:3]), tuple(history[3:]))
    assert last_two_windows(history[:3], 2, is_enough=bool) is None


def test_a_window_grows_until_it_is_enough() -> None:
    history = [of_costs(c) for c in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)]
    windows = last_two_windows(history, 1, is_enough=lambda window: window.episodes >= 3)
    assert windows == (tuple(history[:3]), tuple(history[3:]))
    assert last_two_windows(history[1:], 1, is_enough=lambda it: it.episodes >= 3) is None


def test_a_window_that_grows_ends_with_an_update_that_has_episodes() -> None:
    empty = of_costs()
    history = [of_costs(1.0), of_costs(2.0), empty, empty, of_costs(3.0), empty, of_costs(4.0), empty]
    windows = last_two_windows(history, 2, is_enough=lambda window: window.episodes >= 2)
    assert windows == (tuple(history[:4]), tuple(history[4:]))
    assert WindowStatistics.pooled(windows[1]).env_steps == 400
    assert last_two_windows(history[1:], 2, is_enough=lambda window: window.episodes >= 2) is None
    asked: list[tuple[int, int]] = []

    def never(window: WindowStatistics) -> bool:
        asked.append((window.env_steps, window.episodes))
        return False

    assert last_two_windows(history, 1, is_enough=never) is None
    assert asked == [(100, 0), (200, 1), (400, 2), (700, 3), (800, 4)]


def test_windows_of_episodes_are_rounded_up_to_whole_updates() -> None:
    def windows(*history: WindowStatistics) -> object:
        return last_two_windows(history, 1, is_enough=lambda window: window.episodes >= 3)

    few, many = of_costs(1.0), of_costs(*[2.0] * 30)
    assert windows(few, few, few, many) == ((few, few, few), (many,))
    assert windows(many, many) == ((many,), (many,))
    assert windows(few, few, many) is None


def test_a_stretch_survives_json() -> None:
    statistics = of_costs(1.0, 2.0)
    assert WindowStatistics.from_json(statistics.to_json()) == statistics
