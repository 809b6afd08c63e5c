"""Finite constrained Markov decision processes as tables, and a batch environment that steps them.

The constrained optimum of a finite CMDP is known exactly (``recrl.environments.finite.exact_solver``), so
learners can be compared with it. A batch is stepped by table look-ups.

Notation: S states, A actions, m successors that a (state, action) pair can have, k costs, B environments,
n observation components.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box, Discrete
from gymnasium.vector.utils import batch_space

from recrl.environments.cmdp import CMDPSpec, Floats
from recrl.environments.saved_state import IDENTITY, SavedState, identity
from recrl.environments.vector import CMDPVectorEnv, masked_environments

Integers = npt.NDArray[np.int64]
Booleans = npt.NDArray[np.bool_]


class InfeasibleLimitsError(ValueError):
    """No policy keeps the cost limits."""


@dataclass(frozen=True, eq=False)
class FiniteCMDP:
    """The tables of a finite CMDP with a finite horizon (Altman 1999, chapter 2).

    An episode starts in a state drawn from ``start``, ends for good on *entering* a terminal state, and is
    truncated after ``horizon`` steps. Rewards and costs belong to the current (state, action) pair.

    Attributes:
        successors: the states that can follow, [S, A, m]; padding repeats any state with probability 0.
        probabilities: T(s' | s, a) of each of them, [S, A, m]; sums to 1 over m.
        rewards: R(s, a), [S, A].
        costs: C_i(s, a) >= 0, [S, A, k].
        terminal: states in which an episode is over, [S].
        start: distribution of the first state, [S].
        horizon: steps after which an episode is truncated, at least 1.
        cost_names: names of the k costs.
    """

    successors: Integers
    probabilities: Floats
    rewards: Floats
    costs: Floats
    terminal: Booleans
    start: Floats
    horizon: int
    cost_names: tuple[str, ...]

    def __post_init__(self) -> None:
        pairs = self.rewards.shape
        shapes = {
            "successors": (self.successors.shape[:2], pairs),
            "probabilities": (self.probabilities.shape, self.successors.shape),
            "costs": (self.costs.shape, (*pairs, len(self.cost_names))),
            "terminal": (self.terminal.shape, pairs[:1]),
            "start": (self.start.shape, pairs[:1]),
        }
        for name, (actual, expected) in shapes.items():
            if actual != expected:
                raise ValueError(f"{name} must have shape {expected}, got {actual}")
        if self.successors.min() < 0 or self.successors.max() >= self.num_states:
            raise ValueError(f"successors must be states 0 to {self.num_states - 1}")
        for name, rows in (("probabilities", self.probabilities), ("start", self.start)):
            if not rows.min() >= 0.0 or not np.allclose(rows.sum(axis=-1), 1.0):
                raise ValueError(f"{name} must be at least 0 and sum to 1")
        if self.start[self.terminal].any():
            raise ValueError("an episode must not start in a terminal state")
        if not np.isfinite(self.rewards).all():
            raise ValueError("rewards must be finite numbers")
        if not (self.costs.min() >= 0.0 and np.isfinite(self.costs).all()):
            raise ValueError(f"costs must be finite and at least 0, got {self.costs.min()}")
        if self.horizon < 1:
            raise ValueError(f"the horizon must be at least 1 step, got {self.horizon}")

    @property
    def num_states(self) -> int:
        """S, terminal states included."""
        return int(self.rewards.shape[0])

    @property
    def num_actions(self) -> int:
        """The number of actions, A."""
        return int(self.rewards.shape[1])

    @property
    def num_costs(self) -> int:
        """The number of costs, k."""
        return len(self.cost_names)

    def reachable(self) -> Booleans:
        """Return the states that some policy can enter, given enough steps, start included, [S]."""
        reached = self.start > 0.0
        newest = np.flatnonzero(reached)
        while len(newest):
            following = self.successors[newest][self.probabilities[newest] > 0.0]
            newest = np.unique(following[~reached[following]])
            reached[newest] = True
        return reached


class FiniteVectorEnv(CMDPVectorEnv):
    """B environments of one finite CMDP, stepped together by table look-ups.

    Args:
        name: the task's name, for ``cmdp.name``.
        model: the tables to step.
        observations: what an agent sees in each state, float32 [S, n].
        num_envs: B, at least 1.

    Attributes:
        observations: as given; row s is the observation of state s.
        states: the current state of each environment, [B].
    """

    def __init__(
        self, name: str, model: FiniteCMDP, observations: npt.NDArray[np.float32], *, num_envs: int
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"{name}: num_envs must be at least 1, got {num_envs}")
        if len(observations) != model.num_states:
            raise ValueError(
                f"{name}: {model.num_states} states need {model.num_states} "
                f"observations, got {len(observations)}"
            )
        self.num_envs = num_envs
        self.observations = observations
        self.single_observation_space = Box(
            observations.min(), observations.max(), observations.shape[1:], np.float32
        )
        self.single_action_space = Discrete(model.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.cmdp = CMDPSpec(
            name, self.single_observation_space, self.single_action_space, model.cost_names, model.horizon
        )
        self._model = model
        # One row per (state, action) pair: a single index then serves every table.
        self._successors = model.successors.reshape(-1, model.successors.shape[2])
        probabilities = model.probabilities.reshape(self._successors.shape)
        self._deterministic = bool((probabilities.max(axis=1) == 1.0).all())
        self._likeliest = self._successors[np.arange(len(probabilities)), probabilities.argmax(axis=1)]
        self._cumulative = np.cumsum(probabilities, axis=1)
        # Rounding must not leave a draw without a successor, or with one of probability 0 (padding).
        last = probabilities.shape[1] - 1 - np.argmax(probabilities[:, ::-1] > 0.0, axis=1)
        self._cumulative[np.arange(probabilities.shape[1]) >= last[:, None]] = np.inf
        self._rewards = model.rewards.reshape(-1).copy()
        self._costs = model.costs.reshape(-1, model.num_costs).copy()
        self._start_states = np.flatnonzero(model.start)
        self._start_cumulative = np.cumsum(model.start[self._start_states])
        self._start_cumulative[-1] = np.inf
        self.states: Integers = np.zeros(num_envs, np.int64)
        self._elapsed: Integers | None = None

    @property
    def has_begun(self) -> bool:
        """Whether there was a reset, or a state was loaded."""
        return self._elapsed is not None

    def finite_cmdp(self) -> FiniteCMDP:
        """The model, for exact solutions."""
        return self._model

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start B episodes; ``seed`` restarts the generator that they share."""
        masked = masked_environments(self.cmdp, self.num_envs, options, has_begun=self._elapsed is not None)
        super().reset(seed=seed)
        if masked is not None:
            return self.restart(masked), {}
        self.states = self._first_states(self.num_envs)
        self._elapsed = np.zeros(self.num_envs, np.int64)
        return self.observations[self.states], {}

    def step(
        self, actions: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.float32], Floats, Booleans, Booleans, dict[str, Any]]:
        """Take one step in every environment; see ``recrl.environments.vector`` for what is returned."""
        if self._elapsed is None:
            raise ValueError(f"{self.cmdp.name}: call reset before the first step")
        pairs = self.states * self._model.num_actions + self._checked(actions)
        states = self._next_states(pairs)
        self._elapsed += 1
        terminated = self._model.terminal[states]
        truncated = (self._elapsed >= self._model.horizon) & ~terminated
        info: dict[str, Any] = {"cost": self._costs[pairs]}
        finished = terminated | truncated
        if finished.any():
            info["final_obs"], info["_final_obs"] = self.observations[states], finished
            states[finished] = self._first_states(int(np.count_nonzero(finished)))
            self._elapsed[finished] = 0
        self.states = states
        return self.observations[states], self._rewards[pairs], terminated, truncated, info

    def restart(self, index: npt.NDArray[np.intp]) -> npt.NDArray[np.float32]:
        """Begin new episodes in some environments; see ``recrl.environments.vector``."""
        if self._elapsed is None:
            raise ValueError(f"{self.cmdp.name}: call reset before restart")
        self.states = self.states.copy()  # the caller may still hold the last returned array
        self.states[index] = self._first_states(len(index))
        self._elapsed[index] = 0
        return self.observations[self.states]

    def state_dict(self) -> dict[str, Any]:
        """Return the task, the states, the steps taken in each episode, and the generator."""
        if self._elapsed is None:
            raise ValueError(f"{self.cmdp.name}: there is no state before reset")
        return {
            IDENTITY: identity(self.cmdp),
            "states": self.states.copy(),
            "elapsed": self._elapsed.copy(),
            "generator": copy.deepcopy(dict(self.np_random.bit_generator.state)),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken.

        Raises:
            ValueError: the state is damaged, or of another task.
        """
        model, like = self._model, np.zeros(self.num_envs, np.int64)
        saved = SavedState(f"{self.cmdp.name}: saved state", state)
        saved.check_identity(self.cmdp)
        saved.check_number("states", self.num_envs)
        states = saved.array("states", like, least=0, most=model.num_states - 1)
        elapsed = saved.array("elapsed", like, least=0, most=model.horizon - 1)
        possible = model.reachable() & ~model.terminal
        if not possible[states].all():
            state_index = states[~possible[states]][0]
            raise saved.error("states", f"must be states of an episode under way, got {state_index}")
        generator = saved.generator("generator")
        self.states, self._elapsed = states, elapsed
        self.np_random.bit_generator.state = generator.bit_generator.state

    def _checked(self, actions: npt.NDArray[np.int64]) -> Integers:
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or actions.dtype.kind not in "iu":
            raise ValueError(
                f"{self.cmdp.name}: actions must be {self.num_envs} integers, "
                f"got {actions.dtype} of shape {actions.shape}"
            )
        actions = actions.astype(np.int64, copy=False)
        # As an unsigned integer a negative action is huge, so one comparison checks both ends.
        if actions.view(np.uint64).max() >= self._model.num_actions:
            raise ValueError(
                f"{self.cmdp.name}: actions must be 0 to {self._model.num_actions - 1}, "
                f"got {actions.tolist()}"
            )
        return actions

    def _next_states(self, pairs: Integers) -> Integers:
        if self._deterministic:
            states: Integers = self._likeliest[pairs]
            return states
        drawn = self.np_random.random(self.num_envs)
        choices = (drawn[:, None] >= self._cumulative[pairs]).sum(axis=1)
        states = self._successors[pairs, choices]
        return states

    def _first_states(self, number: int) -> Integers:
        if len(self._start_states) == 1:
            return np.full(number, self._start_states[0])
        drawn = self.np_random.random(number)
        return self._start_states[np.searchsorted(self._start_cumulative, drawn, side="right")]
