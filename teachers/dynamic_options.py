"""Options of the dynamic curriculum and of Algorithm 2, which is its preset ``paper``."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from recrl.environments.options import Options
from recrl.teachers.start_limits import START_FRACTION

# Algorithm 2. The paper gives neither W nor eps_pi: W is five updates of 16 episodes. It has no floors.
PAPER = {"start_fraction": 0.0, "window": 80, "return_floor": 0.0, "cost_floor": 0.0}


class DynamicConfig(Options):
    """The settings of the dynamic curriculum.

    The preset ``paper`` selects Algorithm 2 (``recrl.teachers.algorithm_2``), with the values of ``PAPER``
    for options that are not given.
    """

    preset: Literal["recommended", "paper"] = Field(
        default="recommended",
        description="recommended: our curriculum; paper: Algorithm 2 literally, with start_fraction 0, "
        "window 80 and no floors.",
    )
    start_fraction: float = Field(
        default=START_FRACTION,
        ge=0.0,
        le=0.5,
        description="Fraction of the training steps without limits for measuring the start, if "
        "train_limits is infinite; 0 starts at infinity, as Algorithm 2 does.",
    )
    window: int = Field(
        default=5,
        ge=1,
        description="W of Algorithm 2, which the paper does not give. It counts policy updates, and a window "
        "includes more until its means are precise. With preset: paper it counts finished episodes.",
    )
    return_tolerance: float = Field(
        default=0.1,
        gt=0.0,
        description="eps_r: largest relative change of a converged mean return (paper: 0.1). A window needs "
        "up to 1 / eps_r^2 episodes, except with preset: paper.",
    )
    cost_tolerance: float = Field(
        default=0.1,
        gt=0.0,
        description="eps_c: largest relative change of a converged mean cost (paper: 0.1). A window needs "
        "up to 1 / eps_c^2 episodes, except with preset: paper.",
    )
    return_floor: float = Field(
        default=1.0,
        ge=0.0,
        description="Least absolute mean return in the convergence test, in units of the return; "
        "smaller ones count as this. Not with preset: paper.",
    )
    cost_floor: float = Field(
        default=1.0,
        ge=0.0,
        description="Least mean cost in the convergence test, and least limit in the tolerance above a "
        "limit, in units of the episode cost; smaller ones count as this. Not with preset: paper.",
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

    @model_validator(mode="after")
    def _algorithm_2_has_no_floors(self) -> Self:
        for name in ("return_floor", "cost_floor") if self.preset == "paper" else ():
            if (value := getattr(self, name)) != 0.0:
                raise ValueError(f"{name} has no effect with preset: paper: leave it out, got {value}")
        return self
