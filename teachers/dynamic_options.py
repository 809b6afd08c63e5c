"""The options of the dynamic curriculum, and the values that the paper gives."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from recrl.teachers.start import START_FRACTION
from recrl.teachers.windows import WindowUnit

# The pseudocode as it stands. W and eps_pi are not given in the paper: W is five updates of 16 episodes.
PAPER = {
    "start_fraction": 0.0,
    "window": 80,
    "window_unit": "episodes",
    "window_grows": False,
    "return_floor": 0.0,
    "cost_floor": 0.0,
    "adherence_tolerance": "none",
    "windows_after_noise": 1,
    "remaining": "episodes",
    "clock_reset": "convergence",
    "dimensions": "joint",
}


class DynamicConfig(BaseModel):
    """The settings of the dynamic curriculum."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: Literal["recommended", "paper"] = Field(
        default="recommended",
        description="What fills in the settings that are not given: sound ones, or Algorithm 2 literally.",
    )
    start_fraction: float = Field(
        default=START_FRACTION,
        ge=0.0,
        le=0.5,
        description="Share of the training steps without limits in which the start is measured where "
        "train_limits is infinite; 0 starts at infinity, as Algorithm 2 does.",
    )
    window: int = Field(
        default=5, ge=1, description="W of Algorithm 2, in window_unit; the paper does not give it."
    )
    window_unit: WindowUnit = Field(
        default="updates",
        description="What W counts: policy updates, or finished episodes (rounded up to whole updates).",
    )
    window_grows: bool = Field(
        default=True,
        description="Whether a window takes in more updates until the standard errors of its means are "
        "within the tolerances: enough episodes, or no decision (ours). The tolerances are then of the mean "
        "or of the episodes' standard deviation, whichever is more.",
    )
    return_tolerance: float = Field(
        default=0.1,
        ge=0.0,
        description="eps_r: relative change of the mean return up to which it has converged (paper: 0.1).",
    )
    cost_tolerance: float = Field(
        default=0.1,
        ge=0.0,
        description="eps_c: relative change of a mean cost up to which it has converged (paper: 0.1).",
    )
    return_floor: float = Field(
        default=1.0,
        ge=0.0,
        description="Mean returns nearer to zero than this, in units of the return, count as this much "
        "in the convergence test.",
    )
    cost_floor: float = Field(
        default=1.0,
        ge=0.0,
        description="Mean costs below this, in units of the episode cost, count as this much in the "
        "convergence test.",
    )
    adherence_tolerance: Literal["relative", "standard_error", "none"] = Field(
        default="relative",
        description="By how much a mean cost may exceed its limit and still keep it: one standard error of "
        "the mean or cost_tolerance x the limit, whichever is more; the standard error; or nothing "
        "(Algorithm 2, line 6).",
    )
    windows_after_noise: int = Field(
        default=2,
        ge=1,
        le=2,
        description="How many of the two windows must lie after the last noise: both, or the newer one "
        "(literal).",
    )
    remaining: Literal["windows", "episodes"] = Field(
        default="windows",
        description="What the step of line 7 divides by: the windows that are left but two, which "
        "reaches deploy_limits before B, or the episodes that are left after the next one, B - b (literal), "
        "which does not.",
    )
    clock_reset: Literal["change", "convergence"] = Field(
        default="change",
        description="When last_change begins anew: when limits or policy have changed, or whenever the "
        "agent has converged, also where nothing changes then (line 11, literal).",
        exclude_if=lambda value: value == "change",  # trials from before this option keep their identity
    )
    dimensions: Literal["separate", "joint"] = Field(
        default="separate",
        description="Whether each limit falls on its own, or all together once all costs have converged "
        "and are kept (literal).",
    )
    policy_noise: float = Field(
        default=0.3,
        ge=0.0,
        le=1.0,
        description="eps_pi: noise added to the policy of an agent that is stuck; not given in the paper.",
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_in_preset(cls, options: Any) -> Any:
        is_paper = isinstance(options, dict) and options.get("preset") == "paper"
        return {**PAPER, **options} if is_paper else options
