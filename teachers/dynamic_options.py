"""Options of the dynamic curriculum, with the paper's values."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from recrl.environments.options import Options
from recrl.teachers.start_limits import START_FRACTION
from recrl.teachers.windows import WindowUnit

# The literal pseudocode. The paper does not give W and eps_pi: W is five updates of 16 episodes.
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
    "overlapping_episodes": "count",
}


class DynamicConfig(Options):
    """The settings of the dynamic curriculum."""

    preset: Literal["recommended", "paper"] = Field(
        default="recommended",
        description="Source of unset options: recommended (ours), or paper (Algorithm 2 literally).",
    )
    start_fraction: float = Field(
        default=START_FRACTION,
        ge=0.0,
        le=0.5,
        description="Fraction of the training steps without limits for measuring the start, if "
        "train_limits is infinite; 0 starts at infinity, as Algorithm 2 does.",
    )
    window: int = Field(
        default=5, ge=1, description="W of Algorithm 2, in window_unit; the paper does not give it."
    )
    window_unit: WindowUnit = Field(
        default="updates",
        description="Unit of W: policy updates, or finished episodes (rounded up to whole updates).",
    )
    window_grows: bool = Field(
        default=True,
        description="Whether a window includes more updates until the standard errors of its "
        "means are within the tolerances, and it has at least 10 episodes (ours). The "
        "tolerances are then relative to the mean or to the episodes' standard deviation, "
        "whichever is larger.",
    )
    return_tolerance: float = Field(
        default=0.1,
        gt=0.0,
        description="eps_r: largest relative change of a converged mean return (paper: 0.1). With "
        "window_grows a window needs up to 1 / eps_r^2 episodes.",
    )
    cost_tolerance: float = Field(
        default=0.1,
        gt=0.0,
        description="eps_c: largest relative change of a converged mean cost (paper: 0.1). With "
        "window_grows a window needs up to 1 / eps_c^2 episodes.",
    )
    return_floor: float = Field(
        default=1.0,
        ge=0.0,
        description="Least absolute mean return in the convergence test, in units of the return; "
        "smaller ones count as this.",
    )
    cost_floor: float = Field(
        default=1.0,
        ge=0.0,
        description="Least mean cost in the convergence test, and least limit in adherence_tolerance, in "
        "units of the episode cost; smaller ones count as this.",
    )
    adherence_tolerance: Literal["relative", "standard_error", "none"] = Field(
        default="relative",
        description="Tolerance by which a mean cost may exceed its limit. relative: one standard "
        "error or cost_tolerance x the limit, whichever is larger. standard_error: "
        "one standard error. none: nothing (Algorithm 2, line 6).",
    )
    windows_after_noise: int = Field(
        default=2,
        ge=1,
        le=2,
        description="Number of windows that must lie after the last noise: two, or one, the newer (literal).",
    )
    remaining: Literal["windows", "episodes"] = Field(
        default="windows",
        description="Divisor of the step of line 7. windows: remaining windows but two, which "
        "can reach deploy_limits before B. episodes: remaining episodes after the next "
        "one, B - b (literal), which does not.",
    )
    clock_reset: Literal["change", "convergence"] = Field(
        default="change",
        description="When last_change is reset: when limits or policy have changed, or whenever "
        "the agent has converged, even if nothing changes then (line 11, literal).",
        exclude_if=lambda value: value == "change",  # trials from before this option keep their identity
    )
    dimensions: Literal["separate", "joint"] = Field(
        default="separate",
        description="Whether each limit falls separately, or all together once all costs have "
        "converged and are kept (literal).",
    )
    overlapping_episodes: Literal["count", "ignore"] = Field(
        default="ignore",
        description="Whether episodes count that may have begun before the last change of limits or policy. "
        "If they are ignored (ours), windows begin later by the longest episode, and line 7 has fewer steps.",
    )
    policy_noise: float = Field(
        default=0.3,
        ge=0.0,
        le=1.0,
        description="eps_pi: noise for the policy of an agent that is stuck; not given in the paper.",
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_in_preset(cls, options: Any) -> Any:
        is_paper = isinstance(options, dict) and options.get("preset") == "paper"
        return {**PAPER, **options} if is_paper else options
