"""B environments of one MuJoCo task, stepped together: the common part of all task families.

Notation: B environments.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.saved_state import SavedState

if TYPE_CHECKING:
    from recrl.environments.simulation.mujoco_batch import Simulations

Booleans = npt.NDArray[np.bool_]
Observations = npt.NDArray[np.float32]

MOST_STEPS = 2**31
"""Upper bound of the steps in a saved episode. The caller may go on after the end of one."""


class Named(Protocol):
    """A task with a name."""

    @property
    def name(self) -> str:
        """The task's name in a grid."""
        ...


class StepOutcome(Protocol):
    """Result of one step of all environments."""

    @property
    def rewards(self) -> Floats:
        """The rewards, [B]."""
        ...

    @property
    def terminated(self) -> Booleans:
        """Whether each episode has ended, [B]."""
        ...

    @property
    def truncated(self) -> Booleans:
        """Whether each episode was truncated at the horizon, [B]."""
        ...

    @property
    def finished(self) -> npt.NDArray[np.intp]:
        """Environments whose episode is over."""
        ...


TaskT = TypeVar("TaskT", bound=Named)
OutcomeT = TypeVar("OutcomeT", bound=StepOutcome)


class EnvironmentBatch(ABC, Generic[TaskT, OutcomeT]):
    """B environments of one task. The caller restarts environments whose episode is over.

    Copies are exact, as is pickling.

    Args:
        task: which task.
        number: B, at least 1.
        horizon: steps after which an episode is truncated.
        num_threads: threads of the physics; results do not depend on it.

    Attributes:
        task, number, horizon: as given.
        simulations: the physics, made by each family of tasks.
        generators: one generator for each environment; none before ``seed``.

    Raises:
        ValueError: there are no environments.
    """

    simulations: Simulations

    def __init__(self, task: TaskT, number: int, *, horizon: int, num_threads: int = 1) -> None:
        if number < 1:
            raise ValueError(f"{task.name}: num_envs must be at least 1, got {number}")
        self.task = task
        self.number = number
        self.horizon = horizon
        self._num_threads = num_threads
        self.generators: list[np.random.Generator] = []

    def __reduce__(self) -> tuple[Any, ...]:
        options = {"horizon": self.horizon, "num_threads": self._num_threads}
        state = self.state_dict() if self.generators else None
        return _rebuilt, (type(self), self.task, self.number, options, state)

    def seed(self, seed: int | None, ids: npt.NDArray[np.intp] | None = None) -> None:
        """Give some environments, or all, a generator; that of environment i does not depend on B."""
        streams = np.random.SeedSequence(seed).spawn(self.number)
        generators = [np.random.Generator(np.random.PCG64(stream)) for stream in streams]
        if ids is None:
            self.generators = generators
        else:
            for index in ids:
                self.generators[index] = generators[index]

    @abstractmethod
    def restart(self, ids: npt.NDArray[np.intp]) -> None:
        """Begin new episodes in some environments."""

    @abstractmethod
    def set_actions(self, actions: npt.NDArray[Any]) -> bool:
        """Set the actions of the next step, [B, m]; return False if one is not a number within the bounds."""

    @abstractmethod
    def advance(self) -> OutcomeT:
        """Take one step in every environment with the actions that were set."""

    @abstractmethod
    def observations(self) -> Observations:
        """Return the present observations, [B, n]."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the future depends on, generators included."""
        states = [copy.deepcopy(dict(one.bit_generator.state)) for one in self.generators]
        return {**self._own_state(), "generators": states}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken.

        Raises:
            ValueError: the state is damaged, or of another number of environments.
        """
        saved = SavedState(f"{self.task.name}: saved state", state)
        generators = saved.generators("generators", self.number)
        self._load_own_state(saved)
        self.generators = generators

    @abstractmethod
    def _own_state(self) -> dict[str, Any]:
        """Return what the future depends on besides the generators."""

    @abstractmethod
    def _load_own_state(self, saved: SavedState) -> None:
        """Restore the result of ``_own_state``; check its arrays before anything is changed."""


def _rebuilt(
    kind: type[EnvironmentBatch[Any, Any]],
    task: Any,
    number: int,
    options: dict[str, int],
    state: dict[str, Any] | None,
) -> EnvironmentBatch[Any, Any]:
    """Return a copy of a pickled batch."""
    batch: EnvironmentBatch[Any, Any] = kind(task, number, **options)
    if state is not None:
        batch.load_state_dict(state)
    return batch
