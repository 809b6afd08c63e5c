"""The final policies on the map are those of the tables, and what is said of them is exact."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from matplotlib.quiver import Quiver

from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures.policy_map import mean_behaviour, policy_maps, river_task
from recrl.environments.rivergrid.grid_world import FORWARD, LEFT, RIGHT, RiverGridOptions, state_index
from recrl.environments.rivergrid.maps import MAPS, RiverMap, parse_map
from recrl.orchestrator.spec import Choice, TrialSpec

OPTIONS = RiverGridOptions(horizon=30)


def table(river_map: RiverMap, actions: dict[tuple[int, int, int], int]) -> np.ndarray:
    """A policy that goes forward but for the given (x, y, heading)."""
    policy = np.tile(np.eye(3)[FORWARD], (river_map.width * river_map.height * 4, 1))
    for pose, action in actions.items():
        policy[state_index(river_map, *pose)] = np.eye(3)[action]
    return policy


def rows(policy: np.ndarray, seed: int) -> pd.DataFrame:
    columns = {f"action_{j}": policy[:, j] for j in range(3)}
    return pd.DataFrame({"seed": seed, "state": np.arange(len(policy)), **columns})


@pytest.fixture
def river_sweep(finished: Sweep) -> Sweep:
    """The made-up sweep, its first task a RiverGrid 1b with the policies of two seeds."""
    river_map = parse_map(MAPS["1b"])
    swim = table(river_map, {})
    walk = table(river_map, {(1, 6, 0): RIGHT, (1, 7, 1): LEFT, (7, 7, 0): LEFT})
    policies = pd.concat([rows(swim, 0), rows(walk, 1)], ignore_index=True)
    for name, label in (("task", "river-a"), ("agent", "cpo"), ("method", "linear")):
        labels = pd.Categorical([label] * len(policies), finished.trials[name].cat.categories, ordered=True)
        policies[name] = labels
    trials = finished.trials.assign(task_name="rivergrid-1b")
    facts = [
        dataclasses.replace(it, spec=dataclasses.replace(it.spec, task=river_task_of(it.spec)))
        for it in finished.facts
    ]
    return dataclasses.replace(finished, trials=trials, policies=policies, facts=tuple(facts))


def river_task_of(spec: TrialSpec) -> Choice:
    """RiverGrid 1b under the label that the trial's task has."""
    return Choice("rivergrid-1b", OPTIONS.model_dump(), spec.task.label)


def test_swimming_and_walking_average_to_what_is_counted_by_hand(river_sweep: Sweep) -> None:
    behaviour = mean_behaviour(river_sweep.policies, parse_map(MAPS["1b"]), OPTIONS)
    assert behaviour is not None
    assert behaviour.runs == 2
    # swim: 5 steps at -0.1, then 10, five of them in the water; walk: 3 turns and 8 forward, the last to G
    assert behaviour.episode_return == pytest.approx(((10.0 - 0.5) + (10.0 - 1.0)) / 2)
    assert behaviour.costs.tolist() == pytest.approx([5.0 / 2])
    assert behaviour.visits.sum() == pytest.approx((6 + 11) / 2)


def test_arrows_go_where_the_policies_go(river_sweep: Sweep) -> None:
    figure = policy_maps(river_sweep, "cpo")
    assert figure is not None
    panel = figure.axes[0]
    assert panel.get_title() == "linear, 2 runs\nreturn 9.25, cost 2.50"
    (arrows,) = (artist for artist in panel.collections if isinstance(artist, Quiver))
    squares = {(int(x), int(y)) for x, y in np.asarray(arrows.get_offsets())}
    # through the water on row 6; down, along row 7 and up to G; at the turns there are dots
    assert squares == {(x, 6) for x in range(1, 7)} | {(x, 7) for x in range(1, 8)}


def test_a_table_that_does_not_fit_is_not_on_the_map(river_sweep: Sweep) -> None:
    last = river_sweep.policies.index[-1]
    figure = policy_maps(dataclasses.replace(river_sweep, policies=river_sweep.policies.drop(last)), "cpo")
    assert figure is not None
    assert figure.axes[0].get_title() == "linear, 1 run\nreturn 9.50, cost 5.00"
    none = river_sweep.policies.assign(action_0=0.7)
    assert policy_maps(dataclasses.replace(river_sweep, policies=none), "cpo") is None


def test_an_agent_without_a_table_has_no_map(river_sweep: Sweep) -> None:
    assert policy_maps(river_sweep, "ppo-lag") is None


def test_other_finite_tasks_have_no_map(finished: Sweep) -> None:
    assert river_task(finished, "river-a") is None
    assert policy_maps(finished, "cpo") is None


def test_a_task_whose_options_are_of_another_version_has_no_map(river_sweep: Sweep) -> None:
    facts = [
        dataclasses.replace(
            it,
            spec=dataclasses.replace(it.spec, task=dataclasses.replace(it.spec.task, options={"ice": True})),
        )
        for it in river_sweep.facts
    ]
    assert policy_maps(dataclasses.replace(river_sweep, facts=tuple(facts)), "cpo") is None


def test_maps_of_one_method_lie_side_by_side(river_sweep: Sweep) -> None:
    other = river_sweep.policies.assign(
        task=pd.Categorical(
            ["river-b"] * len(river_sweep.policies),
            river_sweep.policies["task"].cat.categories,
            ordered=True,
        )
    )
    policies = pd.concat([river_sweep.policies, other], ignore_index=True)
    figure = policy_maps(dataclasses.replace(river_sweep, policies=policies), "cpo")
    assert figure is not None
    one, another = (axes for axes in figure.axes if axes.get_title())
    assert one.get_subplotspec().get_gridspec().get_geometry() == (1, 2)  # type: ignore[union-attr]
    assert [axes.texts[-1].get_text() for axes in (one, another)] == ["river-a", "river-b"]
