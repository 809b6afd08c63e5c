"""Vocabulary of constrained Markov decision processes (CMDPs), used by all packages.

A CMDP is (S, A, T, gamma, R, C, d) (paper, section 3). ``CMDPSpec`` holds what a task fixes. The limits d are
separate (``CostLimits``), because in RECRL they change. The discount gamma belongs to the agent's critics.
Returns, episode costs and limits are *undiscounted* sums over an episode, as in the paper.

Notation: k is the number of cost functions, b an episode's index, B the training budget.

Imports neither Gymnasium nor torch at run time, so that curricula do not depend on them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import gymnasium

Floats = npt.NDArray[np.float64]


class Phase(StrEnum):
    """Phase of a trial: the paper's training (limits d_t ... d_d) or deployment (d_d)."""

    TRAINING = "training"
    DEPLOYMENT = "deployment"


@dataclass(frozen=True)
class ObservationComponent:
    """A named slice of a flattened observation.

    Attributes:
        name: for example ``hazards_lidar``.
        size: length of the slice, at least 1.
        lidar_range: range in metres if the slice is a lidar, else None. Each value v in [0, 1] belongs to one
            direction. The nearest object there is at the distance ``(1 - v) * lidar_range``; v is 0 if there
            is none.
    """

    name: str
    size: int
    lidar_range: float | None = None

    def __post_init__(self) -> None:
        if self.size < 1:
            raise ValueError(f"observation component {self.name}: size must be at least 1, got {self.size}")
        if self.lidar_range is not None and not 0.0 < self.lidar_range < math.inf:
            raise ValueError(
                f"observation component {self.name}: lidar_range must be finite and above 0 metres, "
                f"got {self.lidar_range}"
            )


@dataclass(frozen=True)
class CMDPSpec:
    """The parts of a CMDP that a task fixes: spaces, cost functions and horizon, but not the limits d.

    Attributes:
        name: the task's registry name, for example ``rivergrid-1a``.
        observation_space: of one environment (not batched).
        action_space: of one environment; ``Discrete`` or a bounded or unbounded ``Box``.
        cost_names: names of the k >= 1 cost functions, in the order of every cost vector.
        horizon: steps after which an episode is truncated, or None if it never is.
        components: the slices of a flattened observation in order; empty if the task does not declare them.
    """

    name: str
    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    cost_names: tuple[str, ...]
    horizon: int | None
    components: tuple[ObservationComponent, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.cost_names, str):
            raise ValueError(f"{self.name}: cost_names must be a tuple of names, got {self.cost_names!r}")
        if not self.cost_names:
            raise ValueError(f"{self.name}: a CMDP needs at least one cost function, got none")
        if len(set(self.cost_names)) != len(self.cost_names):
            raise ValueError(f"{self.name}: cost names must differ, got {self.cost_names}")
        declared, size = sum(part.size for part in self.components), self._observation_size
        if self.components and size is not None and declared != size:
            raise ValueError(
                f"{self.name}: the observation components must add up to the {size} numbers of an "
                f"observation, got {declared}"
            )

    @property
    def _observation_size(self) -> int | None:
        """Size of an observation if it is an array, else None."""
        shape = self.observation_space.shape
        return None if shape is None else math.prod(shape)

    @property
    def has_continuous_actions(self) -> bool:
        """Whether actions are floating-point numbers."""
        return np.issubdtype(self.action_space.dtype, np.floating)

    @property
    def num_costs(self) -> int:
        """Number of cost functions, k."""
        return len(self.cost_names)


@dataclass(frozen=True)
class CostLimits:
    """Upper limits d on the expected undiscounted episode costs, one per cost function.

    Attributes:
        values: [k], each >= 0 and possibly infinite (no constraint in that dimension).

    >>> CostLimits((5.0, math.inf)).finite
    (True, False)
    """

    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if isinstance(self.values, str) or not isinstance(self.values, Iterable):
            raise ValueError(f"cost limits must be a list of numbers, got {self.values!r}")
        object.__setattr__(self, "values", tuple(float(value) + 0.0 for value in self.values))  # no -0.0
        if not self.values:
            raise ValueError("cost limits: at least one is needed, got none")
        for value in self.values:
            if not value >= 0.0:  # also catches NaN
                raise ValueError(f"cost limits must be at least 0, got {value}")

    def require_one_per_cost(self, num_costs: int, task: str) -> None:
        """Check that there is one limit for each of a task's costs.

        Args:
            num_costs: k of the task.
            task: its name, for the error.

        Raises:
            ValueError: there is another number of limits.
        """
        if len(self.values) != num_costs:
            raise ValueError(f"{task}: there must be one limit per cost, {num_costs}, got {len(self.values)}")

    def __len__(self) -> int:
        return len(self.values)

    def __iter__(self) -> Iterator[float]:
        return iter(self.values)

    def __getitem__(self, index: int) -> float:
        return self.values[index]

    @property
    def finite(self) -> tuple[bool, ...]:
        """Whether each dimension constrains anything, [k]."""
        return tuple(math.isfinite(value) for value in self.values)

    @property
    def array(self) -> Floats:
        """The limits as a new float64 array, [k]."""
        return np.array(self.values, dtype=np.float64)

    def to_json(self) -> list[float | str]:
        """Return the limits as strict JSON, with ``"inf"`` for infinity, which JSON lacks."""
        return [value if math.isfinite(value) else "inf" for value in self.values]

    @classmethod
    def from_json(cls, values: Iterable[float | str]) -> CostLimits:
        """Inverse of ``to_json``."""
        return cls(tuple(float(value) for value in values))

    @classmethod
    def unlimited(cls, num_costs: int) -> CostLimits:
        """Limits that constrain nothing: the CMDP becomes an MDP (paper, section 4)."""
        return cls((math.inf,) * num_costs)


@dataclass(frozen=True)
class CurriculumStep:
    """Output of a curriculum for one policy update: it applies to collection and to learning.

    Attributes:
        limits: the cost limits d, [k].
        policy_noise: eps_pi in [0, 1], noise added to the policy once, before it collects the samples of the
            update (Algorithm 2, line 9); 0 for none.
        entropy_coefficient: reward per nat of policy entropy and step, in units of the task's reward, at
            least 0; None if the curriculum never rewards entropy.
        start_limits: the training limits d_t from which the curriculum starts, [k]; None while they are being
            measured. They are logged only; agents do not use them.
    """

    limits: CostLimits
    policy_noise: float = 0.0
    entropy_coefficient: float | None = None
    start_limits: CostLimits | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.limits, CostLimits):  # a user's curriculum may return plain numbers
            object.__setattr__(self, "limits", CostLimits(self.limits))
        if self.start_limits is not None and not isinstance(self.start_limits, CostLimits):
            object.__setattr__(self, "start_limits", CostLimits(self.start_limits))
        object.__setattr__(self, "policy_noise", float(self.policy_noise))  # perhaps a NumPy number
        if not 0.0 <= self.policy_noise <= 1.0:
            raise ValueError(f"policy noise must lie in [0, 1], got {self.policy_noise}")
        if self.entropy_coefficient is not None:
            object.__setattr__(self, "entropy_coefficient", float(self.entropy_coefficient))
        coefficient = self.entropy_coefficient
        if coefficient is not None and not 0.0 <= coefficient < math.inf:
            raise ValueError(f"entropy coefficient must be finite and at least 0, got {coefficient}")

    @property
    def rewards_entropy(self) -> bool:
        """Whether this update rewards entropy."""
        return self.entropy_coefficient is not None and self.entropy_coefficient > 0.0

    def in_deployment(self, deploy_limits: CostLimits) -> CurriculumStep:
        """Return the step with which deployment begins: limits d_d, no noise, no reward for entropy."""
        coefficient = None if self.entropy_coefficient is None else 0.0
        return CurriculumStep(deploy_limits, 0.0, coefficient, self.start_limits)

    def to_json(self) -> dict[str, Any]:
        """Return the step as strict JSON, keyed by the attributes' names."""
        return {
            "limits": self.limits.to_json(),
            "policy_noise": self.policy_noise,
            "entropy_coefficient": self.entropy_coefficient,
            "start_limits": None if self.start_limits is None else self.start_limits.to_json(),
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> CurriculumStep:
        """Inverse of ``to_json``; ``entropy_coefficient`` may be missing, and other keys are ignored."""
        start, coefficient = values["start_limits"], values.get("entropy_coefficient")
        return cls(
            CostLimits.from_json(values["limits"]),
            float(values["policy_noise"]),
            None if coefficient is None else float(coefficient),
            None if start is None else CostLimits.from_json(start),
        )


@dataclass(frozen=True)
class EpisodeStats:
    """Record of one finished episode, for curricula, figures and users.

    Attributes:
        index: b, counted from 0 over the whole trial in the order in which episodes end.
        phase: the phase in which it ended.
        end_step: environment steps of the trial when the episode ended, over all environments.
        length: its number of steps, at least 1.
        episode_return: undiscounted sum of rewards.
        costs: undiscounted sums of costs, [k].
        limits: the cost limits in force when it ended, [k].
        noise: the curriculum's policy noise in force when it ended, in [0, 1].
        begin_step: environment steps of the trial when the episode began, over all environments; None if
            unknown. An episode may last many policy updates, and begin under other limits.
    """

    index: int
    phase: Phase
    end_step: int
    length: int
    episode_return: float
    costs: tuple[float, ...]
    limits: CostLimits
    noise: float
    begin_step: int | None = None
