"""Options of each algorithm; ``recrl.agents.shared_options`` has those that several of them share.

They are separate from the algorithms, so that validating a grid does not import torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from recrl.agents.shared_options import (
    STARTER_AGENTS_MULTIPLIERS,
    AscentConfig,
    LagrangianConfig,
    NonNegative,
    Positive,
    RadiusConfig,
    TrustRegionConfig,
)

ClipRange = Annotated[
    float, Field(gt=0.0, lt=1.0, description="Clip range of the probability ratio: 1 +- clip (paper).")
]
EntropyBonus = Annotated[
    NonNegative, Field(description="Weight of the mean entropy, nats, in the objective (paper: none).")
]


class PPOConfig(AscentConfig):
    """Settings of ``ppo``, an agent without constraints."""

    clip: ClipRange = 0.2
    entropy_bonus: EntropyBonus = 0.0


class PPOLagConfig(LagrangianConfig, AscentConfig):
    """Settings of ``ppo-lag``, PPO on the Lagrangian."""

    paper: ClassVar[Mapping[str, Any]] = {
        **AscentConfig.paper,
        **STARTER_AGENTS_MULTIPLIERS,
        "penalty": "separate",
    }

    clip: ClipRange = 0.2
    entropy_bonus: EntropyBonus = 0.0
    penalty: Literal["combined", "separate"] = Field(
        default="combined",
        description="Clip the surrogate of the whole Lagrangian (combined, ours) or of the reward "
        "only (separate, paper).",
    )


class FOCOPSConfig(LagrangianConfig, RadiusConfig):
    """Settings of ``focops``, first-order constrained optimisation in policy space."""

    paper: ClassVar[Mapping[str, Any]] = {
        **RadiusConfig.paper,
        "target_kl": 0.02,
        "stop_kl_factor": 1.0,
        "multiplier_rule": "projected",
        "multiplier_unit": "cost",
        "multiplier_step": 0.01,
        "multiplier_maximum": 2.0,
        "focops_lambda": 1.5,
    }

    focops_lambda: Positive = Field(
        default=0.5,
        description="lambda, the temperature, in standard deviations of the reward advantages per "
        "nat (ours; Zhang et al. 2020: 1.5).",
    )


class P3OConfig(RadiusConfig):
    """Settings of ``p3o``, penalised proximal policy optimisation."""

    paper: ClassVar[Mapping[str, Any]] = {**RadiusConfig.paper, "penalty_factor": 20.0}

    clip: ClipRange = 0.2
    penalty_factor: Positive = Field(
        default=5.0,
        description="kappa, in ratios of the running spreads of reward and cost advantages; must exceed "
        "every multiplier of the task there (ours; Zhang et al. 2022: 20, in another unit).",
    )


class IPOConfig(AscentConfig):
    """Settings of ``ipo``, interior-point policy optimisation."""

    paper: ClassVar[Mapping[str, Any]] = {
        **AscentConfig.paper,
        "barrier_sharpness": 20.0,
        "cost_surrogate": "plain",
    }

    clip: ClipRange = 0.2
    barrier_sharpness: Positive = Field(
        default=2000.0,
        description="t of the barrier log(slack) / t. At the optimum each binding constraint "
        "loses 1 / t of the reward advantages' standard deviation a step (ours; Liu "
        "et al. 2020: 20).",
    )
    cost_surrogate: Literal["pessimistic", "plain"] = Field(
        default="pessimistic",
        description="Whether a decrease of cost beyond the clip range counts: not (pessimistic, "
        "ours), or without bound (Liu et al. 2020).",
    )
    barrier_slope: Positive = Field(
        default=20.0,
        description="Largest slope of the barrier, used where there is no slack, in ratios of the running "
        "spreads of reward and cost advantages; must exceed every multiplier of the task there (ours).",
    )


class CPOConfig(TrustRegionConfig):
    """Settings of ``cpo``, constrained policy optimisation."""

    paper: ClassVar[Mapping[str, Any]] = {**TrustRegionConfig.paper, "violation_integral_gain": 0.0}

    violation_integral_gain: NonNegative = Field(
        default=0.03,
        description="K of the integral of the violations, per update. Costs fall by less than the "
        "linear model predicts; the integral corrects that (after safety-starter-agents' learn_margin, with "
        "bounds of ours; paper 0).",
    )


class PCPOConfig(CPOConfig):
    """Settings of ``pcpo``, projection-based constrained policy optimisation."""


class TRPOConfig(TrustRegionConfig):
    """Settings of ``trpo``, an agent without constraints."""


class TRPOLagConfig(LagrangianConfig, TrustRegionConfig):
    """Settings of ``trpo-lag``, TRPO on the Lagrangian."""

    paper: ClassVar[Mapping[str, Any]] = {
        **TrustRegionConfig.paper,
        **STARTER_AGENTS_MULTIPLIERS,
        "kl_penalty": 0.0,
    }

    kl_penalty: NonNegative = Field(
        default=1.0,
        description="tau, the coefficient of the KL in the surrogate, which is the Lagrangian over "
        "1 + the multipliers, in standard deviations of the reward advantages. "
        "Steps get shorter as the gain falls (ours; paper 0).",
    )


class CRPOConfig(TrustRegionConfig):
    """Settings of ``crpo``, constraint-rectified policy optimisation."""

    paper: ClassVar[Mapping[str, Any]] = {
        **TrustRegionConfig.paper,
        "kl_penalty": 0.0,
        "tolerance": 0.5,
    }

    kl_penalty: NonNegative = Field(
        default=1.0,
        description="tau, the coefficient of the KL beyond a limit, in standard deviations of the "
        "reward advantages per nat. Steps get shorter as the gain falls; 0 for "
        "steps as long as the trust region allows (ours; Xu et al. 2021: 0).",
    )
    tolerance: NonNegative = Field(
        default=0.0,
        description="eta, the tolerated violation, in episode cost (ours; Xu et al. 2021: 0.5).",
    )
