"""RiverGrid: by hand, on MiniGrid, and the fast one equal to MiniGrid's step for step."""

from __future__ import annotations

import json
import pickle
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from minigrid.minigrid_env import MiniGridEnv

from recrl.environments.cmdp import CostLimits
from recrl.environments.registration import register_all
from recrl.environments.registry import make_vector, optimal_return
from recrl.environments.rivergrid.grid_world import (
    FORWARD,
    LEFT,
    RIGHT,
    CostName,
    ObservationName,
    RiverGridMapOptions,
    RiverGridVectorEnv,
    state_index,
    vector_of_task,
)
from recrl.environments.rivergrid.instances import InstanceSettings, draw_instance
from recrl.environments.rivergrid.maps import MAPS, parse_map
from recrl.environments.rivergrid.minigrid_drawing import render_frame
from recrl.environments.rivergrid.minigrid_env import RiverGridEnv
from recrl.environments.saved_state import IDENTITY
from recrl.environments.vector import CMDPVectorEnv

register_all()
IDENTIFIERS = ["recrl/RiverGrid-1a-v0", "recrl/RiverGrid-1b-v0", "recrl/RiverGrid-v0"]


def episode(name: str, actions: Sequence[int], **options: Any) -> tuple[list[float], list[list[float]], bool]:
    """Rewards, costs and whether the last step terminated."""
    environment = make_vector(name, 1, options=options)
    environment.reset(seed=0)
    steps = [environment.step(np.array([action])) for action in actions]
    return (
        [float(step[1][0]) for step in steps],
        [step[4]["cost"][0].tolist() for step in steps],
        bool(steps[-1][2][0]),
    )


def test_crossing_1a_earns_nine_and_a_half_at_a_cost_of_five() -> None:
    rewards, costs, terminated = episode("rivergrid-1a", [FORWARD] * 6)
    assert rewards == [-0.1] * 5 + [10.0]
    assert costs == [[1.0]] * 5 + [[0.0]]
    assert terminated
    assert sum(rewards) == pytest.approx(9.5)


def test_walking_round_1b_earns_nine_at_no_cost() -> None:
    actions = [RIGHT, FORWARD, LEFT, *[FORWARD] * 6, LEFT, FORWARD]
    rewards, costs, terminated = episode("rivergrid-1b", actions)
    assert sum(rewards) == pytest.approx(9.0)
    assert sum(cost for (cost,) in costs) == 0.0
    assert terminated


def test_turning_and_bumping_in_the_water_cost_too() -> None:
    drawing = "####\n#>~#\n#.G#\n####"
    _, costs, _ = episode("rivergrid", [FORWARD, FORWARD, RIGHT, LEFT, RIGHT, FORWARD], map=drawing)
    assert costs == [[1.0], [1.0], [1.0], [1.0], [1.0], [0.0]]


def test_turns_are_a_second_cost_in_the_order_asked_for() -> None:
    _, costs, _ = episode("rivergrid-1a", [LEFT, RIGHT, FORWARD], costs=("turns", "river"))
    assert costs == [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]


def test_mud_is_a_cost_of_its_own_and_no_river() -> None:
    drawing = "######\n#>%~G#\n######"
    _, costs, terminated = episode(
        "rivergrid", [FORWARD, RIGHT, LEFT, FORWARD, FORWARD], map=drawing, costs=("river", "mud")
    )
    assert costs == [[0.0, 1.0], [0.0, 1.0], [0.0, 1.0], [1.0, 0.0], [0.0, 0.0]]
    assert terminated


def test_with_river_and_mud_limited_the_optimum_mixes_all_three_ways() -> None:
    # Straight on: 3 steps, 2 in the river. North: 4 steps, 2 in the mud. South: 6 steps, dry.
    way = "#G#####|#%#####|#%#####|#>~~G##|#.#####|#.#####|#.#####|#.#####|#G#####"
    drawing = "\n".join(["#######", *way.split("|"), "#######"])
    options = {"map": drawing, "horizon": 30, "costs": ["river", "mud"]}
    assert optimal_return("rivergrid", options, CostLimits((0.0, 0.0))) == pytest.approx(9.5)
    # Half straight on at 9.8, a quarter north at 9.7, a quarter south at 9.5.
    assert optimal_return("rivergrid", options, CostLimits((1.0, 0.5))) == pytest.approx(9.7)


def test_staying_is_truncated_after_two_hundred_steps_at_minus_twenty() -> None:
    environment = make_vector("rivergrid-1a", 1)
    environment.reset(seed=0)
    steps = [environment.step(np.array([LEFT])) for _ in range(200)]
    assert sum(float(step[1][0]) for step in steps) == pytest.approx(-20.0)
    assert [bool(step[3][0]) for step in steps] == [False] * 199 + [True]


def test_a_goal_reached_on_the_last_step_terminates_and_does_not_truncate() -> None:
    environment = make_vector("rivergrid-1a", 1, options={"horizon": 6})
    environment.reset(seed=0)
    for _ in range(6):
        _, _, terminated, truncated, _ = environment.step(np.array([FORWARD]))
    assert terminated[0]
    assert not truncated[0]


def test_the_observation_is_one_hot_x_y_and_heading() -> None:
    environment = make_vector("rivergrid", 1, options={"map": "####\n#.~#\n#.G#\n#^.#\n####"})
    observation = environment.reset(seed=0)[0][0]
    assert observation.tolist() == [*(0, 1, 0, 0), *(0, 0, 0, 1, 0), *(0, 0, 0, 1)]


def test_the_joint_state_is_one_hot_as_a_whole() -> None:
    options = {"map": "####\n#.~#\n#.G#\n#^.#\n####", "observation": "joint"}
    environment = make_vector("rivergrid", 1, options=options)
    observation = environment.reset(seed=0)[0][0]
    assert observation.shape == (4 * 5 * 4,)
    assert np.flatnonzero(observation).tolist() == [(1 * 5 + 3) * 4 + 3]  # x = 1, y = 3, north
    assert observation.sum() == 1.0


@pytest.mark.parametrize("observation", ["factored", "joint"])
@pytest.mark.parametrize("costs", [("river",), ("mud", "turns", "river")])
@pytest.mark.parametrize(
    "drawing",
    [
        MAPS["1a"],
        MAPS["1b"],
        "######\n#.%~G#\n#>~%.#\n#.%~.#\n######",
        *(str(draw_instance(InstanceSettings(map_seed=seed))) for seed in range(4)),
    ],
    ids=["1a", "1b", "mud", "random-0", "random-1", "random-2", "random-3"],
)
def test_the_fast_environment_equals_minigrids_step_for_step(
    drawing: str, costs: tuple[CostName, ...], observation: ObservationName
) -> None:
    horizon = 40
    options = RiverGridMapOptions(map=drawing, horizon=horizon, costs=costs, observation=observation)
    slow = RiverGridEnv("rivergrid", **options.model_dump())
    fast = RiverGridVectorEnv("rivergrid", parse_map(drawing), options, num_envs=2)
    generator = np.random.default_rng(0)
    slow_observation, _ = slow.reset(seed=1)
    fast_observations, _ = fast.reset(seed=1)
    ends = {"terminated": 0, "truncated": 0}
    for _ in range(2_500):
        np.testing.assert_array_equal(fast_observations[0], slow_observation)
        # Forward more often than not, so that goals are reached.
        actions = generator.choice(3, size=2, p=[0.2, 0.2, 0.6])
        slow_observation, reward, terminated, truncated, info = slow.step(int(actions[0]))
        fast_observations, fast_rewards, fast_terminated, fast_truncated, fast_info = fast.step(actions)
        assert fast_rewards[0] == reward
        assert (fast_terminated[0], fast_truncated[0]) == (terminated, truncated)
        np.testing.assert_array_equal(fast_info["cost"][0], info["cost"])
        if terminated or truncated:
            np.testing.assert_array_equal(fast_info["final_obs"][0], slow_observation)
            slow_observation, _ = slow.reset()
            ends["terminated" if terminated else "truncated"] += 1
    assert sum(ends.values()) >= 50
    assert ends["terminated"] > 0


@pytest.mark.filterwarnings("ignore:The system font")  # MiniGrid's tests ignore it too
@pytest.mark.parametrize("identifier", IDENTIFIERS)
def test_the_minigrid_environment_passes_gymnasiums_checker(
    identifier: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # the checker also opens a window
    environment = gymnasium.make(identifier, disable_env_checker=True).unwrapped
    assert isinstance(environment, MiniGridEnv)
    check_env(environment)


@pytest.mark.parametrize("identifier", IDENTIFIERS)
def test_the_minigrid_environment_passes_minigrids_own_checks(identifier: str) -> None:
    """MiniGrid's tests/test_envs.py: repeatable rollouts, spec as JSON, horizon, pickling, old_run_test."""
    spec = gymnasium.spec(identifier)
    assert json.loads(spec.to_json())["id"] == identifier
    first, second = spec.make(horizon=50), spec.make(horizon=50)
    np.testing.assert_array_equal(first.reset(seed=0)[0], second.reset(seed=0)[0])
    first.action_space.seed(0)
    for _ in range(50):
        action = first.action_space.sample()
        one, other = first.step(action), second.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[0] in first.observation_space
        assert one[1:4] == other[1:4]
        if one[2] or one[3]:
            first.reset(seed=0)
            second.reset(seed=0)
    turning = spec.make(horizon=7)
    turning.reset()
    assert [turning.step(LEFT)[3] for _ in range(7)] == [False] * 6 + [True]
    copied = pickle.loads(pickle.dumps(spec.make()))  # noqa: S301
    np.testing.assert_array_equal(copied.reset()[0], first.reset()[0])
    raw = first.unwrapped
    assert isinstance(raw, RiverGridEnv)
    raw.reset(seed=1337)
    grid = raw.grid
    drawn = [grid.get(x, y) for y in range(raw.height) for x in range(raw.width)]
    kinds = {"#": "wall", "~": "floor", "%": "floor", "G": "goal"}
    assert [tile and tile.type for tile in drawn] == [kinds.get(tile) for tile in "".join(raw.river_map.rows)]
    raw.step(FORWARD)
    raw.reset(seed=1337)  # a step changes neither the map nor the next start
    assert raw.grid == grid
    assert (raw.agent_pos, raw.agent_dir) == (raw.river_map.start, raw.river_map.heading)
    assert raw.pprint_grid().count(">>") == 1  # type: ignore[no-untyped-call]
    first.close()


def test_an_action_that_minigrid_has_but_rivergrid_has_not_is_refused() -> None:
    environment = RiverGridEnv()
    environment.reset()
    with pytest.raises(ValueError, match=r"^rivergrid-1a: the action must be 0, 1 or 2, got 3$"):
        environment.step(3)


@pytest.mark.parametrize(
    ("task", "wrong", "message"),
    [
        ("rivergrid-1a", {"observation": "Joint"}, "Input should be 'factored' or 'joint'"),
        ("rivergrid-1a", {"costs": ("foo",)}, "Input should be 'river', 'turns' or 'mud'"),
        ("rivergrid-1a", {"horizon": 0}, "Input should be greater than or equal to 1"),
        ("rivergrid-1a", {"horizon": 5}, "horizon must be at least 6, the steps to the goal of"),
        ("rivergrid-1a", {"max_steps": 9}, "max_steps"),
        ("rivergrid", {}, "map"),
        ("rivergrid-1c", {}, "task must be one of rivergrid-1a, rivergrid-1b, rivergrid, rivergrid-gen"),
    ],
)
@pytest.mark.parametrize("make", [RiverGridEnv, vector_of_task])
def test_wrong_options_are_refused_as_in_a_grid(
    make: Any, task: str, wrong: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make(task, **wrong)


def test_a_step_or_a_frame_before_reset_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^rivergrid-1a: call reset before the first step$"):
        RiverGridEnv().step(FORWARD)
    with pytest.raises(ValueError, match=r"^rivergrid-1a: call reset before the first frame$"):
        make_vector("rivergrid-1a", 2).render()
    with pytest.raises(ValueError, match=r"^rivergrid-1a: call reset before the first frame$"):
        RiverGridEnv(render_mode="rgb_array").render()


@pytest.mark.parametrize("identifier", IDENTIFIERS)
def test_a_batch_of_a_registered_id_is_that_of_the_task(identifier: str) -> None:
    environments = gymnasium.make_vec(identifier, num_envs=3, horizon=7, costs=["turns"])
    assert isinstance(environments.unwrapped, RiverGridVectorEnv)
    assert environments.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    environments.reset(seed=0)
    for _ in range(7):
        _, _, _, truncated, info = environments.step(np.zeros(3, np.int64))
        assert info["cost"].tolist() == [[1.0]] * 3
    assert truncated.all()
    assert "final_obs" in info


def test_a_batch_draws_its_frames_or_names_the_modes() -> None:
    environments = gymnasium.make_vec(IDENTIFIERS[0], num_envs=2, render_mode="rgb_array")
    environments.reset(seed=0)
    frames = environments.render()
    assert frames is not None
    assert len(frames) == 2
    with pytest.raises(ValueError, match="render_mode must be None or 'rgb_array', got 'human'"):
        gymnasium.make_vec(IDENTIFIERS[0], num_envs=2, render_mode="human")
    blind = gymnasium.make_vec(IDENTIFIERS[0], num_envs=2)
    blind.reset(seed=0)
    assert blind.render_mode is None
    assert blind.render() is None
    with pytest.raises(ValueError, match="render_mode must be None, 'human', 'rgb_array', got 'nope'"):
        RiverGridEnv(render_mode="nope")


@pytest.mark.parametrize(("options", "horizon"), [({}, 200), ({"horizon": 30}, 30)])
def test_the_task_gymnasium_knows_the_horizon_of_a_registered_id(
    options: dict[str, int], horizon: int
) -> None:
    made = {"id": f"recrl.environments.registration:{IDENTIFIERS[1]}", "keywords": options}
    assert make_vector("gymnasium", 1, options=made).cmdp.horizon == horizon


def test_both_environments_draw_the_same_picture() -> None:
    slow = RiverGridEnv("rivergrid-1b", render_mode="rgb_array")
    fast = make_vector("rivergrid-1b", 2)
    assert isinstance(fast, RiverGridVectorEnv)
    slow.reset()
    fast.reset(seed=0)
    for action in (FORWARD, RIGHT):
        slow.step(action)
        fast.step(np.array([action, LEFT]))
    frames = fast.render()
    assert frames is not None
    np.testing.assert_array_equal(frames[0], slow.render())
    assert frames[0].shape == (9 * 32, 9 * 32, 3)
    assert frames[0].dtype == np.uint8


def test_a_picture_shows_walls_river_goal_and_agent_where_they_are() -> None:
    frame = render_frame(parse_map("#####\n#>~G#\n#####"), (1, 1), 0)
    assert frame.shape == (96, 160, 3)
    wall, agent, river, goal = (frame[y, x] for y, x in ((16, 16), (48, 48), (48, 80), (48, 112)))
    assert len(set(wall.tolist())) == 1
    assert agent.argmax() == 0
    assert river.argmax() == 2
    assert goal.argmax() == 1


def test_states_are_numbered_by_column_row_and_heading() -> None:
    river_map = parse_map(MAPS["1a"])
    environment = make_vector("rivergrid-1a", 1)
    assert isinstance(environment, RiverGridVectorEnv)
    environment.reset(seed=0)
    environment.step(np.array([LEFT]))
    assert environment.states.tolist() == [state_index(river_map, 1, 4, 3)]
    seen = environment.observations[environment.states[0]]
    assert np.flatnonzero(seen).tolist() == [1, 9 + 4, 9 + 9 + 3]


def begun(name: str) -> CMDPVectorEnv:
    environments = make_vector(name, 2)
    environments.reset(seed=0)
    environments.step(np.array([LEFT, FORWARD]))
    return environments


def of_old(state: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A saved state of before the task was in it, with some numbers changed."""
    return {**{key: value for key, value in state.items() if key != IDENTITY}, **changes}


def test_a_state_of_another_task_or_horizon_is_refused() -> None:
    state = begun("rivergrid-1b").state_dict()
    with pytest.raises(ValueError) as error:
        make_vector("rivergrid-1a", 2).load_state_dict(state)
    assert str(error.value) == (
        "rivergrid-1a: saved state: identity.task must be 'rivergrid-1a', got 'rivergrid-1b'"
    )
    with pytest.raises(ValueError, match=r"identity\.horizon must be 100, got 200$"):
        make_vector("rivergrid-1b", 2, options={"horizon": 100}).load_state_dict(state)


def test_an_old_state_without_the_tasks_name_is_loaded() -> None:
    environments = begun("rivergrid-1a")
    resumed = make_vector("rivergrid-1a", 2)
    resumed.load_state_dict(of_old(environments.state_dict()))
    actions = np.array([FORWARD, FORWARD])
    np.testing.assert_array_equal(resumed.step(actions)[0], environments.step(actions)[0])


WALL_STATE = state_index(parse_map(MAPS["1a"]), 0, 0, 0)
GOAL_STATE = state_index(parse_map(MAPS["1a"]), 7, 4, 0)
IMPOSSIBLE = "must be states of an episode under way"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"states": np.array([-5, 60])}, "states must have numbers that are from 0 to 323, got -5"),
        ({"states": np.array([324, 60])}, "states must have numbers that are from 0 to 323, got 324"),
        (
            {"states": np.array([60.0, 60.0])},
            "states must be int64 of shape (2,), got float64 of shape (2,)",
        ),
        ({"states": np.array([60])}, "states must be of 2 environments, got 1"),
        ({"states": np.array([52, WALL_STATE])}, f"states {IMPOSSIBLE}, got {WALL_STATE}"),
        ({"states": np.array([52, GOAL_STATE])}, f"states {IMPOSSIBLE}, got {GOAL_STATE}"),
        ({"elapsed": np.array(3)}, "elapsed must be int64 of shape (2,), got int64 of shape ()"),
        ({"elapsed": np.array([-1, 3])}, "elapsed must have numbers that are from 0 to 199, got -1"),
        ({"elapsed": np.array([200, 3])}, "elapsed must have numbers that are from 0 to 199, got 200"),
        ({"generator": {}}, "generator must be the state of a PCG64 (state must be for a PCG64 RNG)"),
    ],
)
def test_a_state_that_no_episode_can_have_is_refused(changes: dict[str, Any], sentence: str) -> None:
    state = begun("rivergrid-1a").state_dict()
    with pytest.raises(ValueError) as error:
        make_vector("rivergrid-1a", 2).load_state_dict(of_old(state, **changes))
    assert str(error.value) == f"rivergrid-1a: saved state: {sentence}"
