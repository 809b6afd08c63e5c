"""Specification of a trial: a frozen value, convertible to JSON, that determines the result.

Two trials with equal specs give equal bytes. So it does not contain paths, cluster addresses, logging or the
number of workers. ``trial_id`` is a hash of the spec's canonical JSON; ``group`` is the same hash without the
seed, so that runs to be averaged share it.

Notation: d_t training limits, d_d deployment limits, B the training budget, T rollout steps.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Annotated, Any

from pydantic import Field

from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.untrusted import ChoiceFile, LimitValues, check_json, file_model
from recrl.teachers.registry import may_measure_start
from recrl.teachers.teacher import TeacherSpec


class TrialStatus(StrEnum):
    """Status of a trial in its files."""

    WAITING = "waiting"
    RUNNING = "running"
    COMPLETE = "complete"
    FAILED = "failed"
    DAMAGED = "damaged"  # found by a reader; stored only in a local copy, of its original

    @property
    def is_finished(self) -> bool:
        """Whether another launch of the same grid would leave the trial alone."""
        return self in (TrialStatus.COMPLETE, TrialStatus.FAILED)


@dataclass(frozen=True)
class Choice:
    """A task, agent or curriculum chosen in a grid.

    Attributes:
        name: registry name, entry point or import path.
        options: its settings, as JSON values, validated by its own config class.
        label: its label in tables, figures and folders; the name unless the grid has another.
    """

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""

    def __post_init__(self) -> None:
        if not self.label:
            object.__setattr__(self, "label", self.name)

    def to_json(self) -> dict[str, Any]:
        """The choice as JSON values."""
        return {"name": self.name, "options": dict(self.options), "label": self.label}

    @property
    def file_name(self) -> str:
        """A readable, unique and safe name for files about it: ``dynamic__3fa2b1c09d``."""
        return f"{_in_file_names(self.label)}__{_digest(self.to_json())}"


@dataclass(frozen=True)
class TrialSpec:
    """One trial of a sweep.

    The bounds are checked where a spec is read from JSON; a grid has narrower ones.

    Attributes:
        task: the CMDP.
        agent: the agent.
        method: the curriculum; its label is the method's name in tables and figures.
        train_limits: d_t, [k]; infinite if the curriculum measures its start or needs none.
        deploy_limits: d_d, [k], finite, at most d_t.
        train_steps: B, environment steps of the training phase, at least 1.
        deploy_steps: environment steps of the deployment phase, at least 0.
        num_envs: number of environments, at least 1.
        rollout_steps: T, steps of each environment between two policy updates, at least 1.
        evaluation_episodes: episodes of each final evaluation, at least 0.
        seed: at least 0; the same seed gives the same initial policy and the same environment stream
            under every method.
    """

    task: Choice
    agent: Choice
    method: Choice
    train_limits: CostLimits
    deploy_limits: CostLimits
    train_steps: Annotated[int, Field(ge=1, le=10**13)]
    deploy_steps: Annotated[int, Field(ge=0, le=10**13)]
    num_envs: Annotated[int, Field(ge=1, le=10**6)]
    rollout_steps: Annotated[int, Field(ge=1, le=10**9)]
    evaluation_episodes: Annotated[int, Field(ge=0, le=10**9)]
    seed: Annotated[int, Field(ge=0, lt=2**63)]

    @property
    def total_steps(self) -> int:
        """Environment steps of both phases, over all environments."""
        return self.train_steps + self.deploy_steps

    @property
    def steps_per_update(self) -> int:
        """Environment steps between two policy updates, T x num_envs."""
        return self.num_envs * self.rollout_steps

    @property
    def num_updates(self) -> int:
        """Policy updates of the whole trial; the last one ends at or after ``total_steps``."""
        return -(-self.total_steps // self.steps_per_update)

    @property
    def train_updates(self) -> int:
        """Policy updates of the training phase; the last one may end after it."""
        return -(-self.train_steps // self.steps_per_update)

    @property
    def deploy_updates(self) -> int:
        """Policy updates of the deployment phase."""
        return self.num_updates - self.train_updates

    @property
    def teacher(self) -> TeacherSpec:
        """Return the curriculum's part of the spec."""
        return TeacherSpec(
            name=self.method.name,
            options=self.method.options,
            train_limits=self.train_limits,
            deploy_limits=self.deploy_limits,
            train_steps=self.train_steps,
        )

    def is_no_curriculum(self, start_limits: Sequence[float | str] | None) -> bool:
        """Whether the measured d_t is not above d_d anywhere: then the limits are d_d once it is measured.

        Args:
            start_limits: the measured d_t, [k]; None if it was not measured.
        """
        is_given = all(map(math.isfinite, self.train_limits))
        if start_limits is None or is_given or not may_measure_start(self.method.name):
            return False
        pairs = zip(start_limits, self.deploy_limits, strict=True)
        return all(float(start) <= deploy for start, deploy in pairs)

    @property
    def trial_id(self) -> str:
        """Ten hex digits that change with anything that affects the result."""
        return _digest(self.to_json())

    @property
    def group(self) -> str:
        """The trial's identity without its seed, for averaging over seeds."""
        return _digest({key: value for key, value in self.to_json().items() if key != "seed"})

    @property
    def folder_name(self) -> str:
        """A readable, unique and safe name for the trial's folder."""
        labels = (self.task.label, self.agent.label, self.method.label)
        readable = "__".join(_in_file_names(label) for label in labels)
        return f"{readable}__s{self.seed}__{self.trial_id}"

    @property
    def title(self) -> str:
        """The trial's name for people: ``rivergrid-1a ppo-lag dynamic seed 3``."""
        return f"{self.task.label} {self.agent.label} {self.method.label} seed {self.seed}"

    def to_json(self) -> dict[str, Any]:
        """Return the spec as strict JSON values; ``from_json`` is its inverse."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value if isinstance(value, int) else value.to_json() for name, value in values.items()}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> TrialSpec:
        """Return the spec of ``to_json``.

        Raises:
            ValueError: the values are invalid; the message is one line.
        """
        check_json(value, _SPEC_FILE)
        if len(value["train_limits"]) != len(value["deploy_limits"]):
            raise ValueError("train_limits and deploy_limits: must have the same length")
        train_limits, deploy_limits = (
            CostLimits.from_json(value[name]) for name in ("train_limits", "deploy_limits")
        )
        if not all(map(math.isfinite, deploy_limits)):
            raise ValueError(f"deploy_limits: must be finite, got {deploy_limits.to_json()}")
        if any(train < deploy for train, deploy in zip(train_limits, deploy_limits, strict=True)):
            raise ValueError(
                f"train_limits: must be at least deploy_limits, {deploy_limits.to_json()}, "
                f"got {train_limits.to_json()}"
            )
        return cls(
            **{
                **value,
                "task": Choice(**value["task"]),
                "agent": Choice(**value["agent"]),
                "method": Choice(**value["method"]),
                "train_limits": train_limits,
                "deploy_limits": deploy_limits,
            }
        )


_SPEC_FILE = file_model(TrialSpec, {Choice: ChoiceFile, CostLimits: LimitValues})


def _in_file_names(label: str) -> str:
    """Return a label without what file names cannot have; two labels may give the same."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "-", label).strip(".-")[:40]


def _digest(value: Mapping[str, Any]) -> str:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:10]
