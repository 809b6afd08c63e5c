"""What every registered task promises its agents (``recrl.environments.vector``), whoever adds it."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode

from recrl.environments.registry import TASKS, make_vector
from recrl.environments.vector import CMDPVectorEnv
from recrl.orchestrator.files.checkpoint_format import decode, encode
from tests.environments.sample_options import SHORT_HORIZON, has_horizon, sample_options

NUM_ENVS = 3
Transition = tuple[Any, Any, Any, Any, dict[str, Any]]

pytestmark = pytest.mark.parametrize("name", TASKS)


def build(name: str, num_envs: int = NUM_ENVS, **overrides: Any) -> CMDPVectorEnv:
    return make_vector(name, num_envs, options=sample_options(name, **overrides))


def random_actions(environment: CMDPVectorEnv, steps: int, seed: int = 0) -> list[npt.NDArray[Any]]:
    environment.action_space.seed(seed)
    return [environment.action_space.sample() for _ in range(steps)]


def run(environment: CMDPVectorEnv, actions: list[npt.NDArray[Any]]) -> Iterator[Transition]:
    for action in actions:
        yield environment.step(action)


def steps_to_end_an_episode(name: str) -> int:
    return 2 * int(sample_options(name).get("horizon", 50)) + 3


def as_bytes(transition: Transition) -> list[bytes]:
    observations, rewards, terminated, truncated, info = transition
    ended = (terminated | truncated).nonzero()[0]
    final = info["final_obs"][ended] if len(ended) else np.zeros(0)
    return [array.tobytes() for array in (observations, rewards, terminated, truncated, info["cost"], final)]


def test_the_spec_names_the_task_and_agents_can_handle_its_spaces(name: str) -> None:
    environment = build(name)
    cmdp = environment.cmdp
    assert cmdp.name == name
    assert isinstance(cmdp.observation_space, Box)
    assert len(cmdp.observation_space.shape) == 1
    assert cmdp.observation_space.dtype == np.float32
    assert isinstance(cmdp.action_space, Box | Discrete)
    assert environment.single_observation_space == cmdp.observation_space
    assert environment.single_action_space == cmdp.action_space
    assert environment.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    if "horizon" in sample_options(name):
        assert cmdp.horizon == sample_options(name)["horizon"]


@pytest.mark.parametrize("num_envs", [1, NUM_ENVS])
def test_shapes_and_types_of_what_a_step_returns(name: str, num_envs: int) -> None:
    environment = build(name, num_envs)
    observations, _ = environment.reset(seed=0)
    assert observations in environment.observation_space
    for observations, rewards, terminated, truncated, info in run(
        environment, random_actions(environment, steps_to_end_an_episode(name))
    ):
        assert observations in environment.observation_space
        assert observations.dtype == np.float32
        assert (rewards.shape, rewards.dtype) == ((num_envs,), np.float64)
        assert (terminated.shape, terminated.dtype) == ((num_envs,), np.bool_)
        assert (truncated.shape, truncated.dtype) == ((num_envs,), np.bool_)
        assert not (terminated & truncated).any()
        assert (info["cost"].shape, info["cost"].dtype) == (
            (num_envs, environment.cmdp.num_costs),
            np.float64,
        )
        assert np.isfinite(rewards).all()
        assert np.isfinite(info["cost"]).all()
        assert (info["cost"] >= 0.0).all()
        assert ("final_obs" in info) == bool((terminated | truncated).any())
        if "final_obs" in info:
            assert info["final_obs"].shape == observations.shape
            assert info["final_obs"].dtype == np.float32


def test_episodes_end_and_begin_anew_in_the_same_step(name: str) -> None:
    environment = build(name)
    environment.reset(seed=0)
    lengths, horizon = np.zeros(NUM_ENVS, np.int64), environment.cmdp.horizon
    episodes = 0
    for _, _, terminated, truncated, _ in run(
        environment, random_actions(environment, steps_to_end_an_episode(name))
    ):
        lengths += 1
        if horizon is not None:
            assert (lengths <= horizon).all()
            assert (truncated == ((lengths == horizon) & ~terminated)).all()
        episodes += int(np.count_nonzero(terminated | truncated))
        lengths[terminated | truncated] = 0
    assert episodes >= NUM_ENVS


def test_the_final_observation_is_what_a_longer_episode_would_have_seen(name: str) -> None:
    if not has_horizon(name):
        pytest.skip("the task's horizon is fixed")
    short = build(name)
    horizon = short.cmdp.horizon
    assert horizon is not None
    long = build(name, horizon=horizon + 1)
    actions = random_actions(short, horizon)
    short.reset(seed=3)
    long.reset(seed=3)
    for one, other in zip(run(short, actions), run(long, actions), strict=True):
        if one[2].any():
            pytest.skip("an episode terminated before the horizon, the two streams part")
        last_short, last_long = one, other
    assert last_short[3].all()
    assert not last_long[3].any()
    np.testing.assert_array_equal(last_short[4]["final_obs"], last_long[0])


def test_equal_seeds_give_equal_bytes(name: str) -> None:
    streams = []
    for _ in range(2):
        environment = build(name)
        first, _ = environment.reset(seed=11)
        actions = random_actions(environment, steps_to_end_an_episode(name))
        streams.append([first.tobytes(), *(as_bytes(step) for step in run(environment, actions))])
    assert streams[0] == streams[1]


def test_reset_with_a_seed_starts_the_same_stream_again(name: str) -> None:
    environment = build(name)
    actions = random_actions(environment, SHORT_HORIZON + 3)
    streams = []
    for _ in range(2):
        first, _ = environment.reset(seed=5)
        streams.append([first.tobytes(), *(as_bytes(step) for step in run(environment, actions))])
    assert streams[0] == streams[1]


def test_a_restored_environment_continues_with_equal_bytes(name: str) -> None:
    environment = build(name)
    environment.reset(seed=7)
    actions = random_actions(environment, steps_to_end_an_episode(name) + 5)
    for _ in run(environment, actions[:5]):
        pass
    state = environment.state_dict()
    kept = copy.deepcopy(state)
    uninterrupted = [as_bytes(step) for step in run(environment, actions[5:])]
    restored = build(name)  # in another process there would have been no reset either
    restored.load_state_dict(decode(encode(state), source="a checkpoint"))
    assert [as_bytes(step) for step in run(restored, actions[5:])] == uninterrupted
    again = build(name)
    again.reset(seed=99)
    again.load_state_dict(kept)
    assert [as_bytes(step) for step in run(again, actions[5:])] == uninterrupted


def test_a_restart_after_resuming_is_that_of_the_uninterrupted_environment(name: str) -> None:
    environment, resumed = build(name), build(name)
    environment.reset(seed=7)
    for _ in run(environment, random_actions(environment, 5)):
        pass
    resumed.load_state_dict(environment.state_dict())
    some = np.array([0], np.intp)
    assert resumed.restart(some).tobytes() == environment.restart(some).tobytes()
    for action in random_actions(environment, 3):
        assert as_bytes(resumed.step(action)) == as_bytes(environment.step(action))


def test_a_state_of_another_number_of_environments_is_refused(name: str) -> None:
    environment, other = build(name), build(name, NUM_ENVS + 1)
    environment.reset(seed=0)
    with pytest.raises(ValueError, match="environments"):
        other.load_state_dict(environment.state_dict())


def test_what_was_returned_is_not_changed_by_later_steps(name: str) -> None:
    environment = build(name)
    returned = [environment.reset(seed=0)[0]]
    copies = [returned[0].copy()]
    for observations, rewards, terminated, truncated, info in run(
        environment, random_actions(environment, SHORT_HORIZON + 2)
    ):
        for array in (observations, rewards, terminated, truncated, *info.values()):
            returned.append(array)
            copies.append(array.copy())
    assert all(np.array_equal(now, then) for now, then in zip(returned, copies, strict=True))


def test_a_reset_by_a_mask_is_a_restart(name: str) -> None:
    environment, twin = build(name), build(name)
    environment.reset(seed=0)
    twin.reset(seed=0)
    for actions in random_actions(environment, 5):
        environment.step(actions)
        twin.step(actions)
    mask = np.array([True] + [False] * (NUM_ENVS - 1))
    options = {"reset_mask": mask}
    observations, _ = environment.reset(options=options)
    assert options["reset_mask"] is mask
    np.testing.assert_array_equal(observations, twin.restart(np.array([0])))
    for actions in random_actions(environment, 3, seed=1):
        assert as_bytes(environment.step(actions)) == as_bytes(twin.step(actions))


def test_actions_that_mean_nothing_are_refused(name: str) -> None:
    environment = build(name)
    environment.reset(seed=0)
    good = random_actions(environment, 1)[0]
    with pytest.raises(ValueError, match="actions"):
        environment.step(good[:-1])
    if isinstance(environment.single_action_space, Discrete):
        for bad in (-1, int(environment.single_action_space.n)):
            with pytest.raises(ValueError, match="actions"):
                environment.step(np.full_like(good, bad))
    else:
        with pytest.raises(ValueError, match="actions"):
            environment.step(np.full_like(good, math.nan))
    environment.step(good)


def test_a_step_before_the_first_reset_is_refused(name: str) -> None:
    environment = build(name)
    with pytest.raises(ValueError, match="reset"):
        environment.step(random_actions(environment, 1)[0])


def test_a_batch_of_no_environments_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        build(name, 0)
