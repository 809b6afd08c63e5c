"""A batch of scalar Gymnasium environments as a ``CMDPVectorEnv``: for users' own tasks.

Gymnasium's ``SyncVectorEnv`` loses the cost of an episode's last step. With same-step autoreset it moves the
last info to ``final_info`` and puts the *reset's* info in its place, so ``info["cost"]`` is that of the
reset. Here it stays.

Requirements for a scalar environment:

- It reports ``info["cost"]``, a number or k numbers, at every step.
- Its action space is ``Discrete`` from 0, or a floating-point ``Box`` of one dimension, bounded or not.
- It is a function of its seed and its actions: ``reset(seed=...)`` determines an episode.

An environment may name its costs in an attribute ``cost_names``. Its horizon, for the agents' defaults, is
the smallest of ``spec.max_episode_steps``, a number in an attribute ``horizon`` or ``max_episode_steps``, and
the steps of Gymnasium's ``TimeLimit``. It may describe the slices of its flattened observation in
``observation_components``, a sequence of ``recrl.environments.cmdp.ObservationComponent``; from it agents
learn which of them are lidars.
Observations of any kind are flattened to float32 vectors (``gymnasium.spaces.flatten``), actions clipped to
their bounds.

Every episode starts with ``reset(seed=...)`` and a new seed drawn here. A checkpoint holds that seed and the
actions so far, so the environment need not be pickled. Restoring replays them, at most one episode per
environment. It checks that the last observation is the same. A checksum compares all observations, rewards,
costs and ends, rounded to float32.
"""

from __future__ import annotations

import copy
import functools
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import TimeLimit

from recrl.environments.cmdp import CMDPSpec, Floats, ObservationComponent
from recrl.environments.gymnasium_spaces import float32_vectors, integer_check, supported_actions
from recrl.environments.saved_state import SavedState
from recrl.environments.vector import CMDPVectorEnv, masked_environments

Environment = gymnasium.Env[Any, Any]
SEED_BOUND = 2**31  # exclusive; some simulators take 32-bit signed seeds


class SyncCMDPVectorEnv(CMDPVectorEnv):
    """B scalar environments stepped one after another; see the module's docstring.

    Args:
        name: the task's name, for ``cmdp.name``.
        factories: one callable per environment; each returns a new one.
        cost_names: names of the k costs; by default the environment's ``cost_names``, else ``cost``.
        costless: report zero costs instead of reading them from the environment.

    Raises:
        ValueError: there is no factory, two environments are the same one, or agents cannot handle them.
    """

    def __init__(
        self,
        name: str,
        factories: Sequence[Callable[[], Environment]],
        *,
        cost_names: Sequence[str] | None = None,
        costless: bool = False,
    ) -> None:
        if not factories:
            raise ValueError(f"{name}: num_envs must be at least 1, got 0")
        self.num_envs = len(factories)
        self._environments: list[Environment] = []
        try:
            for factory in factories:
                self._environments.append(made_environment(name, factory))
            self._describe(name, cost_names)
        except BaseException:
            with suppress(Exception):  # the first error says more
                self.close_extras()
            raise
        self._costless = costless
        self._episode_seeds = [0] * self.num_envs
        self._episode_actions: list[list[Any]] = [[] for _ in range(self.num_envs)]
        self._checksums = [0] * self.num_envs
        self._observations: npt.NDArray[np.float32] | None = None

    def _describe(self, name: str, cost_names: Sequence[str] | None) -> None:
        """Set the spaces and the CMDP."""
        if len({id(each.unwrapped) for each in self._environments}) < self.num_envs:
            raise ValueError(f"{name} must return a new environment each time")
        first = self._environments[0]
        self._raw_observation_space = first.observation_space
        # Found once: the dispatch on the space's type would take a tenth of a simple environment's step.
        self._flatten = functools.partial(
            spaces.flatten.dispatch(type(first.observation_space)), first.observation_space
        )
        self._integers_lie_in = integer_check(first.observation_space)
        self.single_observation_space = float32_vectors(name, first.observation_space)
        self.single_action_space = supported_actions(name, first.action_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.render_mode = first.render_mode
        self.cmdp = CMDPSpec(
            name,
            self.single_observation_space,
            self.single_action_space,
            names_of_costs(name, first, cost_names),
            _declared_horizon(first),
            _declared_components(name, first),
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start B episodes; ``seed`` restarts the generator from which episode seeds are drawn."""
        masked = masked_environments(
            self.cmdp, self.num_envs, options, has_begun=self._observations is not None
        )
        super().reset(seed=seed)
        if masked is not None:
            return self.restart(masked), {}
        self._observations = np.stack([self._start_episode(index) for index in range(self.num_envs)])
        return self._observations.copy(), {}

    def step(
        self, actions: npt.NDArray[Any]
    ) -> tuple[npt.NDArray[np.float32], Floats, npt.NDArray[np.bool_], npt.NDArray[np.bool_], dict[str, Any]]:
        """Take one step in every environment; see ``recrl.environments.vector`` for what is returned."""
        if self._observations is None:
            raise ValueError(f"{self.cmdp.name}: call reset before the first step")
        actions = self._checked(actions)
        last_observations = np.empty_like(self._observations)
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, np.bool_), np.zeros(self.num_envs, np.bool_)
        costs = np.zeros((self.num_envs, self.cmdp.num_costs))
        # The environments get copies: one may scale its action in place, and the recorded one is replayed.
        for index, (action, own) in enumerate(zip(actions, actions.copy(), strict=True)):
            result = self._step(index, own)
            last_observations[index], rewards[index], costs[index] = result[:3]
            terminated[index], truncated[index] = result[3:]
            self._episode_actions[index].append(action)
        self._check(last_observations, rewards)
        rows = _rows(last_observations, rewards, costs, terminated, truncated)
        self._checksums = list(map(zlib.crc32, rows, self._checksums))
        info: dict[str, Any] = {"cost": costs}
        self._observations = last_observations
        if (terminated | truncated).any():
            info["final_obs"], info["_final_obs"] = last_observations, terminated | truncated
            self._observations = last_observations.copy()
            for index in np.flatnonzero(terminated | truncated).tolist():
                self._observations[index] = self._start_episode(index)
        return self._observations.copy(), rewards, terminated, truncated, info

    def restart(self, index: npt.NDArray[np.intp]) -> npt.NDArray[np.float32]:
        """Begin new episodes in some environments; see ``recrl.environments.vector``."""
        if self._observations is None:
            raise ValueError(f"{self.cmdp.name}: call reset before restart")
        for environment in index.tolist():
            self._observations[environment] = self._start_episode(environment)
        return self._observations.copy()

    def render(self) -> tuple[Any, ...]:
        """One frame per environment, in the environment's own render mode."""
        return tuple(environment.render() for environment in self._environments)

    def close_extras(self, **kwargs: Any) -> None:
        """Close all environments, also if one of them raises an error."""
        with ExitStack() as stack:
            for environment in self._environments:
                stack.callback(environment.close)

    def state_dict(self) -> dict[str, Any]:
        """Return seed, actions, checksum and last observation of every episode, and the generator."""
        if self._observations is None:
            raise ValueError(f"{self.cmdp.name}: there is no state before reset")
        space = self.single_action_space
        return {
            "episode_seeds": list(self._episode_seeds),
            "episode_actions": [
                np.array(taken, dtype=space.dtype).reshape(-1, *(space.shape or ()))
                for taken in self._episode_actions
            ],
            "observations": self._observations.copy(),
            "checksums": list(self._checksums),
            "generator": copy.deepcopy(dict(self.np_random.bit_generator.state)),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken, by replaying the episodes under way.

        A state from before the checksums is only checked by the last observation.

        Raises:
            ValueError: the state is damaged, or the replay gave something else. Then the environment is not
                determined by its seed and its actions, and cannot be resumed.
        """
        saved = SavedState(f"{self.cmdp.name}: saved state", state)
        space = self.single_action_space
        seeds = saved.whole_numbers("episode_seeds", self.num_envs, most=SEED_BOUND - 1)
        actions = saved.arrays("episode_actions", self.num_envs, shape=space.shape or (), dtype=space.dtype)
        for index, taken in enumerate(actions):
            if not _lie_in(space, taken):
                raise saved.error(f"episode_actions.{index}", f"must lie in {space}")
        if "checksums" in state:
            saved.check_number("checksums", self.num_envs)
        expected = state.get("checksums")
        like = np.zeros((self.num_envs, *(self.single_observation_space.shape or ())), np.float32)
        observations, generator = saved.array("observations", like), saved.generator("generator")
        self._observations, self._episode_seeds = observations, seeds
        self._episode_actions = list(map(list, actions))
        for index in range(self.num_envs):
            if not np.array_equal(self._replayed(index), self._observations[index]):
                difference = "another observation"
            elif expected is not None and self._checksums[index] != expected[index]:
                difference = "other observations, rewards, costs or ends on the way"
            else:
                continue
            raise ValueError(
                f"{self.cmdp.name}: cannot be resumed, because replaying the episode of environment "
                f"{index} gave {difference}; reset(seed=...) must determine an episode"
            )
        self.np_random.bit_generator.state = generator.bit_generator.state

    def _start_episode(self, index: int) -> npt.NDArray[np.float32]:
        self._episode_seeds[index] = int(self.np_random.integers(SEED_BOUND))
        self._episode_actions[index] = []
        return self._first_observation(index)

    def _first_observation(self, index: int) -> npt.NDArray[np.float32]:
        """Begin the episode of the environment's seed."""
        returned = self._environments[index].reset(seed=self._episode_seeds[index])
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise ValueError(
                f"{self.cmdp.name}: reset must return (observation, info), got {_brief(returned)}"
            )
        observation = self._flat(returned[0])
        self._check(observation[np.newaxis])
        self._checksums[index] = zlib.crc32(observation.tobytes())
        return observation

    def _replayed(self, index: int) -> npt.NDArray[np.float32]:
        """Repeat an environment's episode; return its last observation."""
        observation = self._first_observation(index)
        for action in np.array(self._episode_actions[index]):  # copies, as in ``step``
            observation, reward, costs, terminated, truncated = self._step(index, action)
            row = _rows(
                observation[np.newaxis],
                np.array([reward]),
                costs[np.newaxis],
                np.array([terminated]),
                np.array([truncated]),
            )
            self._checksums[index] = zlib.crc32(row.tobytes(), self._checksums[index])
        return observation

    def _step(self, index: int, action: Any) -> tuple[npt.NDArray[np.float32], float, Floats, bool, bool]:
        """Take a step in one environment; return observation [n], reward, costs [k], and the two flags."""
        returned = self._environments[index].step(action)
        if not isinstance(returned, tuple) or len(returned) != 5 or not isinstance(returned[4], dict):
            six = isinstance(returned, tuple) and len(returned) == 6
            hint = "; six values: put the cost into info['cost'], by a wrapper as in examples/cost_wrapper"
            raise ValueError(
                f"{self.cmdp.name}: step must return (observation, reward, terminated, truncated, info), "
                f"got {_brief(returned)}{hint if six else ''}"
            )
        for name, flag in zip(("terminated", "truncated"), returned[2:4], strict=True):
            if not _is_flag(flag):
                raise ValueError(f"{self.cmdp.name}: {name} must be True or False, got {_brief(flag)}")
        observation, reward, terminated, truncated, info = returned
        return (
            self._flat(observation),
            self._number(reward),
            self._reported_costs(info),
            bool(terminated),
            bool(truncated and not terminated),
        )

    def _number(self, reward: Any) -> float:
        try:
            return float(reward)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{self.cmdp.name}: a reward must be a number, got {_brief(reward)}") from error

    def _check(self, observations: npt.NDArray[np.float32], rewards: Floats | None = None) -> None:
        """Raise an error that names the task; otherwise the policy would fail later."""
        if not np.isfinite(observations).all():
            bad = observations[~np.isfinite(observations).all(axis=-1)][0]
            raise ValueError(f"{self.cmdp.name}: an observation must be finite in float32, got {_brief(bad)}")
        if rewards is not None and not np.isfinite(rewards).all():
            bad = rewards[~np.isfinite(rewards)][0]
            raise ValueError(f"{self.cmdp.name}: a reward must be finite, got {bad:g}")

    def _flat(self, observation: Any) -> npt.NDArray[np.float32]:
        cause: Exception | None = None
        try:
            # NumPy would convert None to NaN.
            if observation is not None and (not self._integers_lie_in or self._integers_lie_in(observation)):
                with np.errstate(over="ignore"):  # then it is not finite
                    flat = np.asarray(self._flatten(observation), np.float32)
                if flat.shape == self.single_observation_space.shape:
                    return flat
        except (TypeError, ValueError, KeyError, IndexError, AttributeError) as error:
            cause = error
        raise ValueError(
            f"{self.cmdp.name}: an observation must lie in {self._raw_observation_space}, "
            f"got {_brief(observation)}"
        ) from cause

    def _checked(self, actions: npt.NDArray[Any]) -> npt.NDArray[Any]:
        space = self.single_action_space
        actions = np.asarray(actions)
        expected = (self.num_envs, *(space.shape or ()))
        if actions.shape != expected:
            raise ValueError(f"{self.cmdp.name}: actions must have shape {expected}, got {actions.shape}")
        if isinstance(space, spaces.Box):
            if actions.dtype.kind not in "fiu" or not np.isfinite(actions).all():
                raise ValueError(f"{self.cmdp.name}: actions must be finite numbers, got {actions.tolist()}")
            clipped: npt.NDArray[Any] = np.clip(actions, space.low, space.high).astype(space.dtype)
            return clipped
        if actions.dtype.kind not in "iu" or not _lie_in(space, actions):
            raise ValueError(f"{self.cmdp.name}: actions must lie in {space}, got {actions.tolist()}")
        return actions.astype(space.dtype)

    def _reported_costs(self, info: dict[str, Any]) -> Floats:
        if self._costless:
            return np.zeros(self.cmdp.num_costs)
        if "cost" not in info:
            others = f", only {', '.join(map(repr, info))}" if info else ""
            raise ValueError(
                f"{self.cmdp.name}: the environment must report info['cost'] at every step: info has no "
                f"'cost'{others} (for zero costs: the task gymnasium with costless: true)"
            )
        try:
            reported = np.asarray(info["cost"])
            costs = reported.astype(np.float64, casting="same_kind").reshape(-1)  # refuses text
        except (TypeError, ValueError):
            costs = np.empty(0)
        if len(costs) > 1 and len(costs) != self.cmdp.num_costs:
            raise ValueError(
                f"{self.cmdp.name}: info['cost'] has {len(costs)} numbers, so the environment's attribute "
                f"cost_names must have {len(costs)} names, got {', '.join(self.cmdp.cost_names)} "
                "(default: cost)"
            )
        if costs.shape != (self.cmdp.num_costs,) or not np.isfinite(costs).all():
            raise ValueError(
                f"{self.cmdp.name}: info['cost'] must be a finite number for each of "
                f"{', '.join(self.cmdp.cost_names)} (the environment's cost_names), got {info['cost']}"
            )
        if costs.min() < 0.0:
            raise ValueError(f"{self.cmdp.name}: info['cost'] must be at least 0, got {info['cost']}")
        return costs


def _rows(
    observations: npt.NDArray[np.float32],
    rewards: Floats,
    costs: Floats,
    terminated: npt.NDArray[np.bool_],
    truncated: npt.NDArray[np.bool_],
) -> npt.NDArray[np.float32]:
    """Return the result of a step as one row per environment, for checksums, [B, n + k + 3]."""
    columns = (observations, rewards[:, None], costs, terminated[:, None], truncated[:, None])
    with np.errstate(over="ignore"):  # a number above 3e38 counts as infinite here
        return np.concatenate(columns, axis=1, dtype=np.float32, casting="unsafe")


def _is_flag(value: Any) -> bool:
    """Whether a value is True or False, or 1 or 0 of any numeric type without dimensions."""
    if isinstance(value, bool | np.bool_):  # almost always
        return True
    return isinstance(value, int | np.integer | np.ndarray) and np.ndim(value) == 0 and value in (0, 1)


def names_of_costs(name: str, environment: Environment, given: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the costs: those given, or else the environment's ``cost_names``, or else ``cost``.

    Raises:
        ValueError: they are no names.
    """
    names = given
    if names is None:
        declared = environment.has_wrapper_attr("cost_names")
        names = environment.get_wrapper_attr("cost_names") if declared else ("cost",)
    if not _are_names(names):
        raise ValueError(f"{name}: cost_names must be a sequence of names, got {_brief(names)}")
    return tuple(names)


def _are_names(value: object) -> bool:
    return (
        isinstance(value, Sequence)
        and not isinstance(value, str)
        and all(isinstance(each, str) for each in value)
    )


def _declared_horizon(environment: Environment) -> int | None:
    """Return the steps after which an environment truncates an episode, or None if it does not say."""
    horizons = list(_time_limits(environment))
    if environment.spec is not None and environment.spec.max_episode_steps is not None:
        horizons.append(environment.spec.max_episode_steps)
    for name in ("horizon", "max_episode_steps"):
        declared = environment.get_wrapper_attr(name) if environment.has_wrapper_attr(name) else None
        if isinstance(declared, float) and declared.is_integer():
            declared = int(declared)
        if isinstance(declared, int | np.integer) and not isinstance(declared, bool) and declared >= 1:
            horizons.append(int(declared))
    return min(horizons, default=None)


def _time_limits(environment: Environment) -> Iterator[int]:
    """Yield the steps of each ``TimeLimit`` around an environment."""
    while isinstance(environment, gymnasium.Wrapper):
        steps = getattr(environment, "_max_episode_steps", None)  # there is no public name
        if isinstance(environment, TimeLimit) and isinstance(steps, int):
            yield steps
        environment = environment.env


def _declared_components(name: str, environment: Environment) -> tuple[ObservationComponent, ...]:
    """Return the declared slices of an environment's flattened observation, or none."""
    if not environment.has_wrapper_attr("observation_components"):
        return ()
    declared = environment.get_wrapper_attr("observation_components")
    components = tuple(declared) if isinstance(declared, Iterable) else (declared,)
    for component in components:
        if not isinstance(component, ObservationComponent):
            raise ValueError(
                f"{name}: observation_components must hold recrl.environments.cmdp.ObservationComponent, got "
                f"{_brief(component)}"
            )
    described = sum(component.size for component in components)
    size = spaces.flatdim(environment.observation_space) if components else 0
    inner = environment.unwrapped
    if described != size and inner is not environment and hasattr(inner, "observation_components"):
        raise ValueError(
            f"{name}: the environment's observation_components describe {described} numbers, and its "
            f"wrappers give {size}; let the wrapper that changes the observation have observation_components "
            "of its own, or () for none"
        )
    return components


def _lie_in(space: spaces.Space[Any], actions: npt.NDArray[Any]) -> bool:
    """Whether all actions are within the bounds of a space, whatever their type of number."""
    if isinstance(space, spaces.Box):
        return bool(((space.low <= actions) & (actions <= space.high)).all())
    assert isinstance(space, spaces.Discrete)
    return bool(((space.start <= actions) & (actions < space.start + space.n)).all())


def made_environment(name: str, factory: Callable[[], Environment]) -> Environment:
    """Return a new environment; raise an error if the factory returns something else."""
    environment = factory()
    if not isinstance(environment, gymnasium.Env):
        raise ValueError(f"{name} must return a Gymnasium environment, got {_brief(environment)}")
    return environment


def _brief(value: Any) -> str:
    """Describe a value for an error message."""
    if value is None:
        return "None"
    kind = type(value).__name__
    shape = f" of shape {value.shape}" if isinstance(value, np.ndarray) else ""
    text = " ".join(repr(value).split())
    return f"{kind}{shape} {text[:77]}..." if len(text) > 80 else f"{kind}{shape} {text}"
