"""Scalar Gymnasium environments as a batch: nothing of an episode's last step is lost."""

from __future__ import annotations

import functools
import os
import re
from functools import partial
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit

from recrl.agents.spaces import environment_actions
from recrl.environments.cmdp import ObservationComponent
from recrl.environments.gymnasium_adapter import SyncCMDPVectorEnv
from recrl.environments.gymnasium_spaces import float32_vectors
from recrl.environments.gymnasium_tasks import (
    GymnasiumOptions,
    draw_from_callable,
    draw_gymnasium,
    make_from_callable,
    make_gymnasium,
)
from recrl.environments.registry import KeywordOptions, make_vector, task_options


class Countdown(gymnasium.Env[Any, Any]):
    """Ends after ``steps`` steps; step t costs t (and its double); observes t and the last action."""

    cost_names: ClassVar = ("time", "double")

    def __init__(self, steps: int = 3, *, terminates: bool = True) -> None:
        self.observation_space = spaces.Dict(
            {"action": spaces.Discrete(3), "time": spaces.Box(0.0, 100.0, (1,), np.float64)}
        )
        self.action_space = spaces.Discrete(3)
        self.steps, self.terminates, self.time, self.action = steps, terminates, 0, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.time, self.action = 0, 0
        return self.observe(), {"cost": -1.0}  # a trap: the reset's info is not a step's

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time, self.action = self.time + 1, int(action)
        ended = self.time >= self.steps
        info = {"cost": [self.time, 2 * self.time]}
        return self.observe(), 1.0, ended and self.terminates, ended, info

    def observe(self) -> Any:
        return {"action": self.action, "time": np.array([self.time], np.float64)}


class Forgetful(Countdown):
    """Its episodes depend on more than their seed: on how many there were."""

    episodes = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episodes += 1
        self.time = self.episodes
        return self.observe(), {}


class Steered(gymnasium.Env[Any, Any]):
    """Observes the action that reached it."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-9.0, 9.0, (2,), np.float32)
        self.action_space = spaces.Box(np.array([-1.0, 0.0]), np.array([1.0, 2.0]), dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return action.astype(np.float32), 0.0, False, False, {"cost": 0.5}


class Scaling(Steered):
    """Halves its action in place."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        action *= 0.5
        return super().step(action)


class Worn(Countdown):
    """Its second cost rises with every episode, which no observation shows."""

    cost_names: ClassVar = ("time", "wear")
    episodes = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.episodes += 1
        return super().reset(seed=seed)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, _ = super().step(action)
        return observation, reward, terminated, truncated, {"cost": [self.time, self.episodes]}


def test_the_cost_and_observation_of_the_last_step_are_kept() -> None:
    environment = SyncCMDPVectorEnv("countdown", [lambda: Countdown(2), lambda: Countdown(3)])
    first, _ = environment.reset(seed=0)
    assert first.tolist() == [[1, 0, 0, 0], [1, 0, 0, 0]]  # one-hot action, time
    environment.step(np.array([1, 1]))
    observations, rewards, terminated, truncated, info = environment.step(np.array([2, 1]))
    assert info["cost"].tolist() == [[2.0, 4.0], [2.0, 4.0]]
    assert rewards.tolist() == [1.0, 1.0]
    assert terminated.tolist() == [True, False]
    assert truncated.tolist() == [False, False]
    assert info["final_obs"][0].tolist() == [0, 0, 1, 2]
    assert observations.tolist() == [[1, 0, 0, 0], [0, 1, 0, 2]]


def test_gymnasiums_own_batch_would_lose_that_cost() -> None:
    theirs = SyncVectorEnv([lambda: Countdown(1)], autoreset_mode=AutoresetMode.SAME_STEP)
    theirs.reset(seed=0)
    assert theirs.step(np.array([0]))[4]["cost"].tolist() == [-1.0]
    ours = SyncCMDPVectorEnv("countdown", [lambda: Countdown(1)])
    ours.reset(seed=0)
    assert ours.step(np.array([0]))[4]["cost"].tolist() == [[1.0, 2.0]]


def test_a_step_that_terminates_at_the_time_limit_is_not_truncated() -> None:
    for terminates in (True, False):
        environment = SyncCMDPVectorEnv("countdown", [partial(Countdown, 1, terminates=terminates)])
        environment.reset(seed=0)
        _, _, terminated, truncated, _ = environment.step(np.array([0]))
        assert (terminated[0], truncated[0]) == (terminates, not terminates)


def test_cost_names_are_the_environments_unless_given() -> None:
    assert SyncCMDPVectorEnv("countdown", [Countdown]).cmdp.cost_names == ("time", "double")
    assert SyncCMDPVectorEnv("countdown", [Countdown], cost_names=("a", "b")).cmdp.cost_names == ("a", "b")
    assert SyncCMDPVectorEnv("steered", [Steered]).cmdp.cost_names == ("cost",)


def test_an_environment_that_reports_no_cost_is_refused_unless_told() -> None:
    silent = make_vector("gymnasium", 1, options={"id": "CartPole-v1"})
    silent.reset(seed=0)
    with pytest.raises(
        ValueError, match=r"gymnasium: the environment must report info\['cost'\] at every step"
    ):
        silent.step(np.array([0]))
    costless = make_vector("gymnasium", 1, options={"id": "CartPole-v1", "costless": True})
    costless.reset(seed=0)
    assert costless.step(np.array([0]))[4]["cost"].tolist() == [[0.0]]
    assert costless.cmdp.horizon == 500


def test_gymnasiums_own_mujoco_tasks_can_be_made() -> None:
    """They import packages that only the extra ``gymnasium[mujoco]`` requires."""
    environments = make_vector("gymnasium", 2, options={"id": "HalfCheetah-v5", "costless": True})
    observations, _ = environments.reset(seed=0)
    assert observations.shape == (2, 17)
    assert environments.cmdp.horizon == 1000


def test_the_horizon_is_that_of_a_time_limit_if_nothing_else_says_it() -> None:
    def limited(*steps: int) -> gymnasium.Env[Any, Any]:
        return functools.reduce(TimeLimit, steps, Countdown(1000))

    assert SyncCMDPVectorEnv("countdown", [limited]).cmdp.horizon is None
    assert SyncCMDPVectorEnv("countdown", [partial(limited, 7)]).cmdp.horizon == 7
    assert SyncCMDPVectorEnv("countdown", [partial(limited, 5, 7)]).cmdp.horizon == 5
    assert SyncCMDPVectorEnv("countdown", [partial(limited, 7, 5)]).cmdp.horizon == 5


def test_a_wrapper_that_changes_observations_must_say_what_they_consist_of() -> None:
    class Declared(gymnasium.Env[Any, Any]):
        observation_space = spaces.Box(0.0, 1.0, (3,), np.float32)
        action_space = spaces.Discrete(2)
        observation_components = (ObservationComponent("lidar", 3, lidar_range=1.0),)

    class Doubled(gymnasium.ObservationWrapper[Any, Any, Any]):
        def __init__(self, environment: gymnasium.Env[Any, Any], **attributes: Any) -> None:
            super().__init__(environment)
            self.observation_space = spaces.Box(0.0, 1.0, (6,), np.float32)
            vars(self).update(attributes)

        def observation(self, observation: Any) -> Any:
            return np.tile(observation, 2)

    with pytest.raises(
        ValueError, match=r"describe 3 numbers, and its wrappers give 6; .* or \(\) for none$"
    ):
        SyncCMDPVectorEnv("declared", [lambda: Doubled(Declared())])
    plain = SyncCMDPVectorEnv("declared", [lambda: Doubled(Declared(), observation_components=())])
    assert plain.cmdp.components == ()


@pytest.mark.parametrize("declared", [None, "lidar", (3,)])
def test_wrong_components_are_refused_with_the_name_of_the_task(declared: Any) -> None:
    class Wrong(Countdown):
        observation_components = declared

    with pytest.raises(ValueError, match=r"^wrong: observation_components must hold recrl\."):
        SyncCMDPVectorEnv("wrong", [Wrong])


@pytest.mark.parametrize("dtype", [np.int32, np.uint8, np.int64])
def test_discrete_actions_of_any_type_are_those_of_an_agent(dtype: Any) -> None:
    class Typed(Countdown):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = spaces.Discrete(3, dtype=dtype)

        def step(self, action: Any) -> Any:
            assert self.action_space.contains(action)
            return super().step(action)

    environments = SyncCMDPVectorEnv("typed", [Typed, Typed])
    environments.reset(seed=0)
    actions = environment_actions(environments.single_action_space, np.array([0, 2]))
    assert actions.dtype == dtype
    for given in (actions, np.array([0, 2], np.uint64), [0, 2]):
        environments.step(np.asarray(given))
    for wrong in (np.array([0, 3]), np.array([-1, 0]), np.array([0.0, 1.0])):
        with pytest.raises(ValueError, match=r"^typed: actions must lie in Discrete\(3"):
            environments.step(wrong)


@pytest.mark.parametrize(
    ("attribute", "spec_horizon", "horizon"),
    [
        (None, None, None),
        (30, None, 30),
        (np.int64(30), None, 30),
        (30, 20, 20),
        (30.0, None, 30),
        ("far", None, None),
        (0, None, None),
    ],
)
@pytest.mark.parametrize("name", ["horizon", "max_episode_steps"])
def test_the_horizon_is_the_specs_or_else_the_environments(
    name: str, attribute: Any, spec_horizon: int | None, horizon: int | None
) -> None:
    def build() -> Countdown:
        environment = Countdown()
        environment.spec = gymnasium.envs.registration.EnvSpec("C-v0", max_episode_steps=spec_horizon)
        if attribute is not None:
            setattr(environment, name, attribute)
        return environment

    assert SyncCMDPVectorEnv("countdown", [build]).cmdp.horizon == horizon


@pytest.mark.parametrize("kind", [int, np.int64, np.bool_, np.asarray])
def test_flags_may_be_numbers_and_rewards_may_be_huge(kind: Any) -> None:
    class Loose(Countdown):
        def step(self, action: Any) -> Any:
            observation, _, terminated, truncated, info = super().step(action)
            return observation, 1e39, kind(terminated), kind(truncated), info

    def plain() -> SyncCMDPVectorEnv:
        return SyncCMDPVectorEnv("loose", [Loose])

    environments, reference = plain(), SyncCMDPVectorEnv("countdown", [Countdown])
    for each in (environments, reference):
        each.reset(seed=0)
    for _ in range(5):
        _, rewards, terminated, truncated, _ = environments.step(np.array([0]))
        _, _, *flags, _ = reference.step(np.array([0]))
        assert rewards.tolist() == [1e39]
        assert [terminated.tolist(), truncated.tolist()] == [flag.tolist() for flag in flags]
    again = plain()
    again.reset(seed=0)
    again.load_state_dict(environments.state_dict())


def test_another_number_of_costs_than_named_is_refused() -> None:
    environment = SyncCMDPVectorEnv("countdown", [Countdown], cost_names=("time",))
    environment.reset(seed=0)
    with pytest.raises(
        ValueError,
        match=r"info\['cost'\] has 2 numbers, so .* cost_names must have 2 names, got time \(default: cost\)",
    ):
        environment.step(np.array([0]))


def test_bounds_beyond_float32_are_infinite() -> None:
    largest = np.finfo(np.float64).max
    space = float32_vectors("x", spaces.Box(-largest, largest, (2,), np.float64))
    assert space.low.tolist() == [-np.inf, -np.inf]
    assert space.high.tolist() == [np.inf, np.inf]


def test_continuous_actions_reach_the_environment_within_its_bounds() -> None:
    environment = SyncCMDPVectorEnv("steered", [Steered] * 2)
    environment.reset(seed=0)
    observations, *_ = environment.step(np.array([[-5.0, 1.5], [0.5, 5.0]], np.float32))
    assert observations.tolist() == [[-1.0, 1.5], [0.5, 2.0]]


def test_an_environment_with_hidden_state_is_not_resumed_silently() -> None:
    environment = SyncCMDPVectorEnv("forgetful", [lambda: Forgetful(5)])
    environment.reset(seed=0)
    for _ in range(7):
        environment.step(np.array([1]))
    with pytest.raises(
        ValueError, match=r"forgetful: cannot be resumed, because replaying the episode of envi"
    ):
        SyncCMDPVectorEnv("forgetful", [lambda: Forgetful(5)]).load_state_dict(environment.state_dict())


def test_an_environment_whose_cost_has_hidden_state_is_not_resumed_silently() -> None:
    environment = SyncCMDPVectorEnv("worn", [lambda: Worn(5)])
    environment.reset(seed=0)
    for _ in range(7):
        environment.step(np.array([1]))
    state = environment.state_dict()
    with pytest.raises(ValueError) as error:
        SyncCMDPVectorEnv("worn", [lambda: Worn(5)]).load_state_dict(state)
    assert str(error.value) == (
        "worn: cannot be resumed, because replaying the episode of environment 0 gave other observations, "
        "rewards, costs or ends on the way; reset(seed=...) must determine an episode"
    )
    del state["checksums"]  # as in states of before
    SyncCMDPVectorEnv("worn", [lambda: Worn(5)]).load_state_dict(state)


def test_a_resumed_environment_can_be_saved_and_resumed_again() -> None:
    environment = SyncCMDPVectorEnv("countdown", [lambda: Countdown(5)] * 2)
    environment.reset(seed=0)
    for _ in range(7):
        environment.step(np.array([1, 2]))
    resumed = SyncCMDPVectorEnv("countdown", [lambda: Countdown(5)] * 2)
    resumed.load_state_dict(environment.state_dict())
    for each in (environment, resumed):
        each.step(np.array([0, 1]))
    assert resumed.state_dict()["checksums"] == environment.state_dict()["checksums"]
    again = SyncCMDPVectorEnv("countdown", [lambda: Countdown(5)] * 2)
    again.load_state_dict(resumed.state_dict())


def test_an_environment_that_scales_its_action_in_place_is_resumed() -> None:
    environment = SyncCMDPVectorEnv("scaling", [Scaling] * 2)
    environment.reset(seed=0)
    actions = np.array([[0.5, 1.5], [1.0, 2.0]])
    for _ in range(3):
        observations = environment.step(actions)[0]
    assert observations.tolist() == [[0.25, 0.75], [0.5, 1.0]]
    state = environment.state_dict()
    assert [taken.tolist() for taken in state["episode_actions"]] == [[row.tolist()] * 3 for row in actions]
    resumed = SyncCMDPVectorEnv("scaling", [Scaling] * 2)
    resumed.load_state_dict(state)
    np.testing.assert_array_equal(resumed.state_dict()["episode_actions"], state["episode_actions"])


def test_environments_of_a_batch_do_not_repeat_each_other_nor_the_next_seeds() -> None:
    first_observations = set()
    for seed in range(5):
        environment = make_vector("gymnasium", 4, options={"id": "CartPole-v1", "costless": True})
        first_observations |= {row.tobytes() for row in environment.reset(seed=seed)[0]}
    assert len(first_observations) == 20  # Gymnasium's seed + i would repeat 12 of them


@pytest.mark.parametrize(
    "space",
    [
        spaces.MultiDiscrete([2, 2]),
        spaces.Discrete(2, start=1),
        spaces.Box(0.0, 1.0, (2, 2)),
        spaces.Box(0.0, 1.0, (0,)),
    ],
)
def test_action_spaces_that_no_agent_handles_are_refused(space: spaces.Space[Any]) -> None:
    def build() -> Countdown:
        environment = Countdown()
        environment.action_space = space
        return environment

    with pytest.raises(
        ValueError, match="countdown: actions must be Discrete from 0 or a Box of one dimension"
    ):
        SyncCMDPVectorEnv("countdown", [build])


def test_an_unknown_gymnasium_id_is_found_when_options_are_checked() -> None:
    with pytest.raises(ValueError, match="CartPoole"):
        task_options("gymnasium", {"id": "CartPoole-v1"})


@pytest.mark.parametrize(
    "identifier",
    ["recrl.environments.registration:recrl/CarGoal2-v0", "gymnasium.envs:CartPole-v1"],
)
def test_an_id_with_a_module_in_front_imports_it_first(identifier: str) -> None:
    costless = "CartPole" in identifier
    options = {"id": identifier, "costless": costless}
    assert task_options("gymnasium", options).model_dump()["id"] == identifier
    environments = make_vector("gymnasium", 2, options=options)
    observations, _ = environments.reset(seed=0)
    assert observations.shape == environments.observation_space.shape
    assert environments.step(np.stack([environments.single_action_space.sample()] * 2))[4]["cost"].shape == (
        2,
        1,
    )
    environments.close()


@pytest.mark.parametrize(
    ("keywords", "sentence"),
    [
        ({"sutton_barto_rewards": True}, "takes no keyword 'sutton_barto_rewards'; did you mean "),
        ({"disable_env_checker": True}, "keywords: disable_env_checker is given by recrl; leave it out"),
    ],
)
def test_keywords_of_an_id_are_checked(keywords: dict[str, Any], sentence: str) -> None:
    options = {"id": "CartPole-v1", "costless": True, "keywords": keywords}
    with pytest.raises(ValueError, match=re.escape(sentence)):
        make_vector("gymnasium", 1, options=options)


def test_keywords_of_gymnasium_and_of_the_class_are_passed_on() -> None:
    keywords = {"sutton_barto_reward": True, "max_episode_steps": 7}
    options = {"id": "CartPole-v1", "costless": True, "keywords": keywords}
    made = make_vector("gymnasium", 1, options=options)
    assert made.cmdp.horizon == 7
    made.reset(seed=0)
    assert made.step(np.array([0]))[1].tolist() == [0.0]  # Sutton and Barto's reward; else it is 1
    made.close()


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        (
            "observation",
            np.array([np.nan]),
            "wrong: an observation must be finite in float32, got ndarray of shape ",
        ),
        ("observation", np.zeros(2), "wrong: an observation must lie in Box("),
        ("observation", None, "wrong: an observation must lie in Box("),
        ("reward", np.inf, "wrong: a reward must be finite, got inf"),
        ("reward", None, "wrong: a reward must be a number, got None"),
        ("cost", -1.0, "wrong: info['cost'] must be at least 0, got -1.0"),
        (
            "cost",
            "x",
            "wrong: info['cost'] must be a finite number for each of cost (the environment's cost_names), ",
        ),
        (
            "cost",
            "1",
            "wrong: info['cost'] must be a finite number for each of cost (the environment's cost_names), ",
        ),
        ("terminated", "no", "wrong: terminated must be True or False, got str 'no'"),
        ("truncated", None, "wrong: truncated must be True or False, got None"),
        ("truncated", 2, "wrong: truncated must be True or False, got int 2"),
    ],
)
def test_what_an_environment_returns_is_looked_at(field: str, value: Any, sentence: str) -> None:
    returned: dict[str, Any] = {
        **{"observation": np.zeros(1), "reward": 0.0, "cost": 0.0},
        **{"terminated": np.False_, "truncated": False, field: value},
    }

    class Wrong(gymnasium.Env[Any, Any]):
        observation_space = spaces.Box(-1.0, 1.0, (1,))
        action_space = spaces.Discrete(2)

        def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
            return np.zeros(1), {}

        def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
            info = {"cost": returned["cost"]}
            ends = returned["terminated"], returned["truncated"]
            return returned["observation"], returned["reward"], *ends, info

    environments = SyncCMDPVectorEnv("wrong", [Wrong])
    environments.reset(seed=0)
    with pytest.raises(ValueError) as caught:
        environments.step(np.array([0]))
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize(("values", "wrapper"), [(4, False), (6, True), (7, False)])
def test_a_separate_cost_is_told_of_the_wrapper(values: int, wrapper: bool) -> None:
    class Separate(Steered):
        def step(self, action: Any) -> Any:
            return (np.zeros(2, np.float32), *[0.0] * values)[:values]

    environments = SyncCMDPVectorEnv("separate", [Separate])
    environments.reset(seed=0)
    with pytest.raises(ValueError, match=r"^separate: step must return \(observation, reward, ") as caught:
        environments.step(np.zeros((1, 2)))
    assert str(caught.value).endswith("by a wrapper as in examples/cost_wrapper") == wrapper


class Observing(Countdown):
    """Has an observation space, and returns the observation that it was given, in the space or not."""

    def __init__(self, space: spaces.Space[Any], observation: Any) -> None:
        super().__init__()
        self.observation_space, self.observation = space, observation

    def observe(self) -> Any:
        return self.observation


IMAGE, WHOLE = spaces.Box(0, 255, (2, 2), np.uint8), spaces.Box(-5, 5, (2,), np.int64)


@pytest.mark.parametrize(
    ("space", "observation"),
    [
        *((IMAGE, np.full((2, 2), value)) for value in (0.7, 300, -1, np.nan)),
        (WHOLE, np.array([0.9, -0.9])),
        (spaces.Discrete(3), -1),
        (spaces.Discrete(3), np.array([0, 2])),
        (spaces.Discrete(3, start=5), 2),
        (spaces.MultiDiscrete([3, 2]), np.array([-1, 0])),
        (spaces.MultiDiscrete([3, 2]), np.array([0, 2])),
        (spaces.MultiDiscrete([3, 2], start=[5, 5]), np.array([4, 5])),
        (spaces.MultiBinary(2), np.array([0, 2])),
        (spaces.Dict({"a": spaces.Discrete(3), "b": spaces.Box(0.0, 1.0)}), {"a": -1, "b": np.zeros(1)}),
        (spaces.Tuple((spaces.Discrete(3), WHOLE)), (0, np.array([6, 0]))),
        (spaces.OneOf((spaces.Discrete(3), WHOLE)), (-1, np.zeros(2, np.int64))),
        (spaces.OneOf((spaces.Discrete(3), WHOLE)), (0, -1)),
    ],
)
def test_an_integer_outside_its_space_is_refused(space: spaces.Space[Any], observation: Any) -> None:
    environments = SyncCMDPVectorEnv("odd", [partial(Observing, space, observation)])
    with pytest.raises(ValueError) as caught:
        environments.reset(seed=0)
    assert str(caught.value).startswith(f"odd: an observation must lie in {space}, got ")


@pytest.mark.parametrize(
    ("space", "observation", "row"),
    [
        (IMAGE, [[0, 255], [1, 2]], [0, 255, 1, 2]),
        (IMAGE, np.full((2, 2), 7.0), [7, 7, 7, 7]),
        (WHOLE, np.array([-5, 5], np.int8), [-5, 5]),
        (spaces.Discrete(3), np.array([2]), [0, 0, 1]),
        (spaces.Discrete(3, start=5), np.uint8(5), [1, 0, 0]),
        (spaces.MultiDiscrete([3, 2]), [2, 1], [0, 0, 1, 0, 1]),
        (spaces.MultiDiscrete([3, 2], start=[5, 5]), np.array([5, 6]), [1, 0, 0, 0, 1]),
        (spaces.MultiBinary(2), np.array([True, False]), [1, 0]),
        (spaces.Box(0.0, 1.0, (2,)), np.array([-7.5, 9.0]), [-7.5, 9.0]),
        (spaces.Tuple((spaces.Discrete(2), WHOLE)), (1, np.array([3, 4])), [0, 1, 3, 4]),
        (spaces.OneOf((spaces.Discrete(2), WHOLE)), (1, np.array([3, 4])), [1, 3, 4]),
    ],
)
def test_integers_of_any_type_are_observed(space: spaces.Space[Any], observation: Any, row: Any) -> None:
    environments = SyncCMDPVectorEnv("odd", [partial(Observing, space, observation)])
    assert environments.reset(seed=0)[0].tolist() == [row]


def _breezy(wind: float = 0.0, *, length: int = 3) -> gymnasium.Env[Any, Any]:
    return gymnasium.make("CartPole-v1")


def _nothing() -> gymnasium.Env[Any, Any]:
    return _breezy()


@pytest.mark.parametrize(
    ("factory", "options", "sentence"),
    [
        (
            _breezy,
            {"winds": 1.0},
            "breezy takes no option 'winds'; did you mean 'wind'? (its options: wind, length)",
        ),
        (_breezy, {"zebra": 1}, "breezy takes no option 'zebra' (its options: wind, length)"),
        (_nothing, {"wind": 1.0}, "breezy takes no option 'wind' (it has no options)"),
    ],
)
def test_a_wrong_option_of_a_users_task_names_the_known_ones(
    factory: Any, options: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError) as caught:
        make_from_callable(factory, "breezy", 1, KeywordOptions(**options))
    assert str(caught.value) == sentence


@pytest.mark.parametrize("options", [{}, {"wind": 1.0, "length": 2}])
def test_right_options_of_a_users_task_are_passed_on(options: dict[str, Any]) -> None:
    given: list[dict[str, Any]] = []

    def of_two(wind: float = 0.0, *, length: int = 3) -> gymnasium.Env[Any, Any]:
        given.append({"wind": wind, "length": length})
        return _breezy()

    def of_any(**keywords: Any) -> gymnasium.Env[Any, Any]:
        given.append(keywords)
        return _breezy()

    for factory in (of_two, of_any):
        make_from_callable(factory, "breezy", 1, KeywordOptions(**options)).close()
    assert given == [{"wind": 0.0, "length": 3} | options, options]


class Strict(Countdown):
    """Checks its options itself; ``known`` are those that it has."""

    known: ClassVar[tuple[str, ...]] = ("length",)

    def __init__(self, **options: Any) -> None:
        if unknown := [name for name in options if name not in self.known]:
            raise ValueError(f"unknown options {unknown}")
        super().__init__(options.get("length", 3))
        self.render_mode = options.get("render_mode")


class Rendering(Strict):
    known = ("length", "render_mode")


class ForPeople(Countdown):
    """Draws for people only."""

    metadata: dict[str, Any] = {"render_modes": ["human"]}  # noqa: RUF012

    def __init__(self, length: int = 3, render_mode: str | None = None) -> None:
        assert render_mode in (None, "human")
        super().__init__(length)
        self.render_mode = render_mode


@pytest.mark.parametrize(
    ("factory", "options", "render_mode"),
    [
        (Strict, {}, None),
        (Rendering, {}, "rgb_array"),
        (ForPeople, {}, None),
        (ForPeople, {"render_mode": "human"}, "human"),
        (Rendering, {"render_mode": "ansi"}, "ansi"),
    ],
)
def test_a_users_class_renders_if_it_takes_the_mode_or_as_it_is_told(
    factory: type[Strict], options: dict[str, Any], render_mode: str | None
) -> None:
    environment = draw_from_callable(factory, "strict", KeywordOptions(length=2, **options))
    assert isinstance(environment, factory)
    assert (environment.render_mode, environment.steps) == (render_mode, 2)


@pytest.mark.parametrize("factory", [Strict, Rendering])
def test_a_users_class_that_refuses_an_option_says_which(factory: type[Strict]) -> None:
    with pytest.raises(ValueError, match=r"^unknown options \['width'\]$"):
        draw_from_callable(factory, "strict", KeywordOptions(width=2))


def test_a_factory_that_makes_no_environment_is_named() -> None:
    with pytest.raises(ValueError, match=r"^os:getpid must return a Gymnasium environment, got int 3$"):
        SyncCMDPVectorEnv("os:getpid", [lambda: 3])  # type: ignore[list-item, return-value]


class Closing(Countdown):
    """Counts those that are closed; one of three raises an error."""

    closed = 0

    def close(self) -> None:
        type(self).closed += 1
        if self.closed == 2:
            raise OSError("no port")


def test_all_environments_are_closed_also_if_one_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Closing, "closed", 0)
    environment = SyncCMDPVectorEnv("closing", [Closing] * 3)
    with pytest.raises(OSError, match="no port"):
        environment.close()
    assert Closing.closed == 3
    with pytest.raises(ValueError, match="must return a Gymnasium environment"):
        SyncCMDPVectorEnv("closing", [Closing, Closing, lambda: 3])  # type: ignore[list-item, return-value]
    assert Closing.closed == 5


def test_a_factory_that_returns_the_same_environment_twice_is_named() -> None:
    one = Countdown()
    with pytest.raises(ValueError, match=r"^one:make must return a new environment each time$"):
        SyncCMDPVectorEnv("one:make", [Countdown, lambda: one, lambda: gymnasium.wrappers.TimeLimit(one, 5)])


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"episode_seeds": [1]}, "episode_seeds must be of 2 environments, got 1"),
        ({"episode_actions": 7}, "episode_actions must be a list or an array, got int"),
        (
            {"episode_seeds": [1, None]},
            "episode_seeds.1 must be a whole number from 0 to 2147483647, got None",
        ),
        ({"episode_seeds": [-1, 1]}, "episode_seeds.0 must be a whole number from 0 to 2147483647, got -1"),
        ({"episode_actions": [None, None]}, "episode_actions.0 must be int64 of shape (), got NoneType"),
        (
            {"episode_actions": [np.zeros(0, np.int64), np.zeros((1, 3), np.int64)]},
            "episode_actions.1 must be int64 of shape (1,), got int64 of shape (1, 3)",
        ),
        (
            {"episode_actions": [np.zeros(0, np.int64), np.array([0, 3])]},
            "episode_actions.1 must lie in Discrete(3)",
        ),
        ({"checksums": [0]}, "checksums must be of 2 environments, got 1"),
        (
            {"observations": np.zeros(2, np.float32)},
            "observations must be float32 of shape (2, 4), got float32 of shape (2,)",
        ),
        ({"generator": {}}, "generator must be the state of a PCG64 (state must be for a PCG64 RNG)"),
    ],
)
def test_a_damaged_state_is_refused(changes: dict[str, Any], sentence: str) -> None:
    environments = SyncCMDPVectorEnv("countdown", [Countdown, Countdown])
    environments.reset(seed=0)
    state = environments.state_dict()
    with pytest.raises(ValueError) as error:
        environments.load_state_dict({**state, **changes})
    assert str(error.value) == f"countdown: saved state: {sentence}"
    environments.load_state_dict(state)


def test_a_saved_state_is_a_dict() -> None:
    with pytest.raises(ValueError, match=r"^countdown: saved state: it must be a dict, got NoneType$"):
        SyncCMDPVectorEnv("countdown", [Countdown]).load_state_dict(None)  # type: ignore[arg-type]


def _countdown(**keywords: Any) -> Countdown:
    return Countdown(**keywords)


def _for_people(**keywords: Any) -> ForPeople:
    return ForPeople(**keywords)


def test_a_registered_environment_without_rendering_is_a_single_one_too() -> None:
    gymnasium.register("recrl-tests/Countdown-v0", entry_point=_countdown)
    try:
        environment = draw_gymnasium("gymnasium", GymnasiumOptions(id="recrl-tests/Countdown-v0"))
        assert isinstance(environment.unwrapped, Countdown)
        unknown = GymnasiumOptions(id="recrl-tests/Countdown-v0", keywords={"width": 2})
        with pytest.raises(TypeError, match="width"):
            draw_gymnasium("gymnasium", unknown)
    finally:
        del gymnasium.registry["recrl-tests/Countdown-v0"]


@pytest.mark.parametrize(("keywords", "render_mode"), [({}, None), ({"render_mode": "human"}, "human")])
def test_a_registered_environment_for_people_is_a_single_one_too(
    keywords: dict[str, Any], render_mode: str | None
) -> None:
    gymnasium.register("recrl-tests/ForPeople-v0", entry_point=_for_people)
    try:
        options = GymnasiumOptions(id="recrl-tests/ForPeople-v0", keywords=keywords)
        assert draw_gymnasium("gymnasium", options).render_mode == render_mode
    finally:
        del gymnasium.registry["recrl-tests/ForPeople-v0"]


@pytest.mark.parametrize(("given", "number"), [(None, 2), (("a", "b", "c"), 3)])
def test_a_costless_environment_has_the_costs_of_a_batch(given: tuple[str, ...] | None, number: int) -> None:
    gymnasium.register("recrl-tests/Countdown-v0", entry_point=_countdown)
    try:
        options = GymnasiumOptions(id="recrl-tests/Countdown-v0", costless=True, cost_names=given)
        environment, batch = draw_gymnasium("costless", options), make_gymnasium("costless", 1, options)
        environment.reset(seed=0)
        assert environment.step(0)[4]["cost"].tolist() == [0.0] * number
        assert batch.cmdp.num_costs == number
    finally:
        del gymnasium.registry["recrl-tests/Countdown-v0"]


def test_a_users_callable_is_checked_for_a_single_environment_as_for_a_batch() -> None:
    with pytest.raises(ValueError, match=r"^breezy takes no option 'winds'; did you mean 'wind'\?"):
        draw_from_callable(_breezy, "breezy", KeywordOptions(winds=2))
    with pytest.raises(ValueError, match=r"^os:getpid must return a Gymnasium environment, got int "):
        draw_from_callable(os.getpid, "os:getpid", KeywordOptions())  # type: ignore[arg-type]
