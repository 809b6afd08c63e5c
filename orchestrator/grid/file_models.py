"""Pydantic models of a grid file's content; ``checking`` checks its meaning.

Symbols: ``train_limits`` is d_t, ``deploy_limits`` is d_d, T ``rollout_steps``. Limits are undiscounted costs
per episode.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    WithJsonSchema,
    model_validator,
)

from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.untrusted import PlainText, ShortText, as_seen
from recrl.orchestrator.validation_sentences import as_written

REQUIRED = "required"
MAX_SEEDS = 10_000
MAX_STEPS = 10**12


def _not_a_truth_value(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError(f"must be a number, got {as_written(value)}")
    return value


def _read_limits(value: Any) -> tuple[float, ...]:
    """Read one number for all costs, or a list with one number per cost."""
    values = value if isinstance(value, list) else [value]
    if isinstance(value, dict) or any(isinstance(limit, list | dict) for limit in values):
        raise ValueError(
            "must be a number, or a list with one number per cost in the order of the task's costs, got "
            f"{as_written(value)}; for several limits name the task again, with another label"
        )
    if not values:
        raise ValueError("must be a number or a list of numbers, got []")
    for limit in values:
        if isinstance(limit, bool) or not isinstance(limit, int | float) or not limit >= 0:
            raise ValueError(f"must be numbers of at least 0 (cost per episode), got {as_written(limit)}")
        if isinstance(limit, int) and limit > sys.float_info.max:
            raise ValueError(f"must be at most {sys.float_info.max:.1e}, got {as_written(limit)}")
    return tuple(float(limit) + 0.0 for limit in values)  # 0 for -0.0, which would be another trial


def _read_train_limits(value: Any) -> tuple[float, ...]:
    """As ``_read_limits``; ``auto`` is infinite: the curriculum measures its start."""
    if isinstance(value, str):
        if value != "auto":
            raise ValueError(f"must be 'auto', a number or a list of numbers, got {as_written(value)}")
        return (math.inf,)
    return _read_limits(value)


def _read_deploy_limits(value: Any) -> tuple[float, ...]:
    limits = _read_limits(value)
    if not all(math.isfinite(limit) for limit in limits):
        raise ValueError(
            "must be finite, got infinity; for a cost without a limit give more than an episode can cost"
        )
    return limits


def _read_seeds(value: Any) -> tuple[int, ...]:
    """Read seeds: ``5`` is 0, 1, 2, 3, 4; a list is itself."""
    if isinstance(value, int) and not isinstance(value, bool):
        if not 1 <= value <= MAX_SEEDS:
            raise ValueError(f"must be a number of seeds from 1 to {MAX_SEEDS}, or a list, got {value}")
        return tuple(range(value))
    if not isinstance(value, list) or not 1 <= len(value) <= MAX_SEEDS:
        raise ValueError(f"must be a number of seeds or a list of seeds, got {as_written(value)}")
    seen: set[int] = set()
    for seed in value:
        if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
            raise ValueError(f"must be whole numbers from 0 to 2^63 - 1, got {as_written(seed)}")
        if seed in seen:
            raise ValueError(f"must differ, got {seed} twice")
        seen.add(seed)
    return tuple(value)


def _read_custom(value: Any) -> dict[str, float]:
    """Read amounts of a cluster's custom resources, by name; Ray's own resources have separate settings."""
    if not isinstance(value, dict):
        raise ValueError(f"must be a mapping of names to amounts, got {as_written(value)}")
    for name, amount in value.items():
        if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_.:-]{0,63}", name):
            raise ValueError(f"must have names of letters, digits and _ . : - only, got {as_written(name)}")
        if name.lower() in ("cpu", "gpu", "memory", "object_store_memory"):
            raise ValueError(f"must not name {name}; see cpus_per_trial and gpus_per_trial")
        if isinstance(amount, bool) or not isinstance(amount, int | float) or not 0.0 < amount <= 1e6:
            raise ValueError(f"must be amounts above 0 and at most 1e6, got {as_written(amount)} of {name}")
    return {name: float(amount) for name, amount in value.items()}


def _share_or_whole(gpus: float) -> float:
    """Check GPUs of a trial as Ray does: parts of one, or a whole number."""
    if gpus > 1.0 and not gpus.is_integer():
        raise ValueError(f"must be a whole number above 1, or less than 1 to share a GPU, got {gpus:g}")
    if 0.0 < gpus < 1e-4:
        raise ValueError(f"must be 0 or at least 0.0001, got {gpus:g}")
    return gpus


def _listed(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


def _read_name(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", value):
        raise ValueError(
            "must be a name for a folder: letters, digits and . _ - only, at most 64, "
            f"got {as_written(value)}"
        )
    if value.lower().endswith((".zip", ".yaml", ".yml")):
        raise ValueError(f"must not end like a file, with .zip, .yaml or .yml, got {as_written(value)}")
    return value


def _read_label(text: str) -> str:
    if text and (text != text.strip() or not as_seen(text)):
        raise ValueError(f"must be visible text without spaces at its ends, got {text!a}")
    return text


def _one_or_list(value: Mapping[str, Any], **others: Any) -> WithJsonSchema:
    """Return the JSON schema of a value, of a list of such values, or of another type."""
    listed = {"type": "array", "items": value, "minItems": 1}
    return WithJsonSchema({"anyOf": [value, listed, *([others] if others else [])]})


# For editors. Digits grouped by _ are a number in YAML 1.1, which recrl reads, and text in YAML 1.2.
_AMOUNT = {"type": "number", "minimum": 0}
_TEXT = {"type": "string"}
_COUNT = {"anyOf": [{"type": "integer"}, {"type": "string", "pattern": "^[0-9][0-9_]*$"}]}

SweepName = Annotated[
    str,
    PlainValidator(_read_name),
    WithJsonSchema({"type": "string", "pattern": "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"}),
]
Whole = Annotated[int, BeforeValidator(_not_a_truth_value), WithJsonSchema(_COUNT)]
Number = Annotated[float, BeforeValidator(_not_a_truth_value), Field(allow_inf_nan=False)]
TrainLimits = Annotated[
    tuple[float, ...], PlainValidator(_read_train_limits), _one_or_list(_AMOUNT, const="auto")
]
DeployLimits = Annotated[tuple[float, ...], PlainValidator(_read_deploy_limits), _one_or_list(_AMOUNT)]
Seeds = Annotated[
    tuple[int, ...], PlainValidator(_read_seeds), _one_or_list({"type": "integer", "minimum": 0})
]
_AT_LEAST_ONE = Field(min_length=1)
Label = Annotated[PlainText, AfterValidator(_read_label)]
Labels = Annotated[list[str], BeforeValidator(_listed), _AT_LEAST_ONE, _one_or_list(_TEXT)]
CustomResources = Annotated[
    dict[str, float],
    PlainValidator(_read_custom),
    WithJsonSchema({"type": "object", "additionalProperties": {"type": "number"}}),
]


@dataclass(frozen=True)
class ShownDefault:
    """What reference and ``recrl-sweep options`` show as the default of a key; ``None`` in its model.

    Attributes:
        text: the default as JSON, or ``required``.
    """

    text: str


class _Written(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Entry(_Written):
    """An agent or a method: its name, or a mapping."""

    name: ShortText = Field(description="Registry name, entry point or package.module:attribute.")
    label: Label = Field(
        default="", max_length=60, description="Label in tables and figures; by default the name."
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description="Its options, as listed by recrl-sweep options."
    )

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        if isinstance(value, str):
            return {"name": value}
        if not isinstance(value, dict):
            raise ValueError(f"must be a name or a mapping with a name, got {as_written(value)}")
        return value


class Limits(_Written):
    """The limits of a task's costs: one number for all costs, or a list with one number per cost."""

    train_limits: Annotated[TrainLimits | None, ShownDefault('"auto"')] = Field(
        default=None,
        description="Training limits d_t, at the task or for all tasks: 'auto' (the curriculum measures "
        "them), a number for every cost, or a list.",
    )
    deploy_limits: Annotated[DeployLimits | None, ShownDefault(REQUIRED)] = Field(
        default=None,
        description="Deployment limits d_d, at the task or for all tasks: a number for every cost, or a "
        "list.",
    )


class TaskEntry(Entry, Limits):
    """A task, with limits if they differ from the grid's."""


class Run(_Written):
    """Length and width of every trial."""

    total_steps: Whole = Field(
        ge=1, le=MAX_STEPS, description="Environment steps of both phases, over all environments."
    )
    deploy_fraction: Number = Field(
        default=0.05,
        ge=0.0,
        le=0.9,
        description="Fraction of the steps in deployment (paper, section 5: 5%).",
    )
    num_envs: Whole = Field(
        default=64,
        ge=1,
        le=4096,
        description="Number of parallel environments; many, so that an update has many episodes (ours).",
    )
    rollout_steps: Whole | None = Field(
        default=None,
        ge=1,
        le=10_000_000,
        description="T, steps of each environment between two policy updates; by default 64, or "
        "the task's horizon if that is shorter. Episodes continue across updates "
        "(ours).",
    )
    evaluation_episodes: Whole = Field(
        default=100,
        ge=0,
        le=1_000_000,
        description="Episodes of each final evaluation; with 0 only finite tasks have results of final "
        "policies (ours).",
    )
    videos: Literal["none", "first-seed", "all"] = Field(
        default="none",
        description="The complete trials that a launch films, one episode each; no result depends on it.",
    )


class Resources(_Written):
    """Resources of a trial. Results depend only on whether it learns on a GPU, and on the kind of it."""

    cpus_per_trial: Number = Field(default=1.0, ge=1e-4, le=1024.0, description="Cores of a running trial.")
    gpus_per_trial: Annotated[Number, AfterValidator(_share_or_whole)] = Field(
        default=0.0,
        ge=0.0,
        le=64.0,
        description="GPUs of a running trial. Above 0 it learns on CUDA; below 1 trials share a GPU.",
    )
    custom_per_trial: CustomResources = Field(
        default_factory=dict,
        description="Custom resources of a running trial, by the names given to a cluster's nodes "
        "(ray start --resources); a launch on one machine has none.",
    )
    max_concurrent: Whole | None = Field(
        default=None, ge=1, le=10_000, description="Largest number of parallel trials; by default as fit."
    )
    teacher: Literal["service", "inline"] = Field(
        default="service",
        description="Process of the curricula: one service for the sweep, or each trial's own "
        "process (for hundreds of parallel trials with updates below a second).",
    )
    silence_seconds: Number = Field(
        default=300.0,
        ge=5.0,
        le=1e7,
        description="A trial that uses no processor time for this many wall seconds hangs (five "
        "times as many before its first sign of life). It is started again from its "
        "last checkpoint (ours). In an object store it is at least 50.",
    )


class Exclusion(_Written):
    """Trials to leave out: those that match everything given here; labels, and seeds."""

    task: Labels | None = Field(default=None, description="Labels of tasks; by default all.")
    agent: Labels | None = Field(default=None, description="Labels of agents; by default all.")
    method: Labels | None = Field(default=None, description="Labels of methods; by default all.")
    seed: Annotated[list[Whole], BeforeValidator(_listed), _AT_LEAST_ONE, _one_or_list(_COUNT)] | None = (
        Field(default=None, description="Seeds; by default all.")
    )

    def matches(self, spec: TrialSpec) -> bool:
        """Whether the trial is left out."""
        return all(
            wanted is None or value in wanted
            for wanted, value in (
                (self.task, spec.task.label),
                (self.agent, spec.agent.label),
                (self.method, spec.method.label),
                (self.seed, spec.seed),
            )
        )


class GridFile(Limits):
    """Content of a grid file; its limits apply to tasks without their own."""

    name: SweepName = Field(description="Name of the sweep and of its folder.")
    tasks: list[TaskEntry] = Field(min_length=1, description="The tasks, as names or mappings.")
    agents: list[Entry] = Field(min_length=1, description="The agents, as names or mappings.")
    methods: list[Entry] = Field(min_length=1, description="The curricula, as names or mappings.")
    seeds: Seeds = Field(description="A number of seeds (5 for 0 to 4), or a list of seeds.")
    run: Run = Field(description="Length and width of every trial.")
    resources: Resources = Field(default=Resources(), description="Resources of a trial.")
    exclude: list[Exclusion] = Field(
        default=[], description="Trials to leave out: those that match all keys of an entry."
    )
