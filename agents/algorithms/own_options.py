"""What can be set of each algorithm; ``recrl.agents.shared_options`` has what several of them share.

Imports no torch, so that a grid is validated in a moment: that is why these are not beside the algorithms.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from recrl.agents.shared_options import (
    STARTER_AGENTS_ASCENT,
    STARTER_AGENTS_MULTIPLIERS,
    STARTER_AGENTS_SETTING,
    STARTER_AGENTS_TRUST_REGION,
    AscentConfig,
    LagrangianConfig,
    NonNegative,
    Positive,
    TrustRegionConfig,
)


class PPOConfig(AscentConfig):
    """Settings of ``ppo``, which knows no constraint."""

    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=0.2, description="How far the probability ratio pays off: 1 +- clip (paper)."
    )
    entropy_bonus: NonNegative = Field(
        default=0.0, description="Weight of the mean entropy, nats, in the objective (paper: none)."
    )


class PPOLagConfig(LagrangianConfig, AscentConfig):
    """Settings of ``ppo-lag``, PPO on the Lagrangian."""

    paper: ClassVar[Mapping[str, Any]] = {
        **STARTER_AGENTS_SETTING,
        **STARTER_AGENTS_ASCENT,
        **STARTER_AGENTS_MULTIPLIERS,
        "penalty": "separate",
    }

    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=0.2, description="How far the probability ratio pays off: 1 +- clip (paper)."
    )
    entropy_bonus: NonNegative = Field(
        default=0.0, description="Weight of the mean entropy, nats, in the objective (paper: none)."
    )
    penalty: Literal["combined", "separate"] = Field(
        default="combined",
        description="Clip the surrogate of reward minus multiplied costs (ours) or the reward's (paper).",
    )


class FOCOPSConfig(LagrangianConfig, AscentConfig):
    """Settings of ``focops``, first-order constrained optimisation in policy space."""

    paper: ClassVar[Mapping[str, Any]] = {
        **STARTER_AGENTS_SETTING,
        **STARTER_AGENTS_ASCENT,
        "target_kl": 0.02,
        "stop_kl_factor": 1.0,
        "multiplier_rule": "projected",
        "multiplier_unit": "cost",
        "multiplier_step": 0.01,
        "multiplier_maximum": 2.0,
        "focops_lambda": 1.5,
        "trust_region": "passed",
    }

    policy_learning_rate: Positive = Field(
        default=3e-4,
        description="Adam's, for the policy (Zhang et al. 2020). Larger steps go far past the trust region "
        "before the KL is seen.",
    )
    focops_lambda: Positive = Field(
        default=0.5,
        description="lambda, standard deviations of the reward advantages that are worth a nat (ours; Zhang "
        "et al. 2020: 1.5).",
    )
    trust_region: Literal["kept", "passed"] = Field(
        default="kept",
        description="Whether the step that goes past target_kl is taken back to it (ours), or stands as the "
        "last (Zhang et al. 2020).",
    )


class P3OConfig(AscentConfig):
    """Settings of ``p3o``, penalised proximal policy optimisation."""

    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=0.2, description="How far the probability ratio pays off: 1 +- clip (paper)."
    )
    penalty_factor: Positive = Field(
        default=20.0,
        description="kappa, reward per unit of cost; must exceed every multiplier of the task (ours; Zhang "
        "et al. 2022 fix one for all tasks).",
    )


class IPOConfig(AscentConfig):
    """Settings of ``ipo``, interior-point policy optimisation."""

    paper: ClassVar[Mapping[str, Any]] = {
        **STARTER_AGENTS_SETTING,
        **STARTER_AGENTS_ASCENT,
        "barrier_sharpness": 20.0,
        "cost_surrogate": "plain",
    }

    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=0.2, description="How far the probability ratio pays off: 1 +- clip (paper)."
    )
    barrier_sharpness: Positive = Field(
        default=2000.0,
        description="t of the barrier log(slack) / t; at the optimum it gives away 1 / t of the reward "
        "advantages' standard deviation a step and constraint (ours; Liu et al. 2020: 20).",
    )
    cost_surrogate: Literal["pessimistic", "plain"] = Field(
        default="pessimistic",
        description="Whether a cost's surrogate counts relief beyond the clip range: not (ours), or however "
        "far the policy goes (Liu et al. 2020).",
    )
    barrier_slope: Positive = Field(
        default=20.0,
        description="The barrier's steepest slope, with which it goes on where there is no slack, reward per "
        "unit of cost; must exceed every multiplier of the task (ours).",
    )


class CPOConfig(TrustRegionConfig):
    """Settings of ``cpo``, constrained policy optimisation."""


class PCPOConfig(TrustRegionConfig):
    """Settings of ``pcpo``, projection-based constrained policy optimisation."""


class TRPOConfig(TrustRegionConfig):
    """Settings of ``trpo``, which knows no constraint."""


class TRPOLagConfig(LagrangianConfig, TrustRegionConfig):
    """Settings of ``trpo-lag``, TRPO on the Lagrangian."""

    paper: ClassVar[Mapping[str, Any]] = {
        **STARTER_AGENTS_SETTING,
        **STARTER_AGENTS_TRUST_REGION,
        **STARTER_AGENTS_MULTIPLIERS,
        "kl_price": 0.0,
    }

    kl_price: NonNegative = Field(
        default=1.0,
        description="lambda, what a nat of KL must be worth in the surrogate, that is 1 + the multipliers "
        "standard deviations of the reward advantages, so that steps end with the gain (ours; paper 0).",
    )


class CRPOConfig(TrustRegionConfig):
    """Settings of ``crpo``, constraint-rectified policy optimisation."""

    paper: ClassVar[Mapping[str, Any]] = {
        **STARTER_AGENTS_SETTING,
        **STARTER_AGENTS_TRUST_REGION,
        "kl_price": 0.0,
    }

    kl_price: NonNegative = Field(
        default=1.0,
        description="lambda, what a nat of KL must be worth beyond a limit, in standard deviations of the "
        "reward advantages, so that steps end with the gain; 0 for steps as long as the trust region allows "
        "(ours; Xu et al. 2021: 0).",
    )
    tolerance: NonNegative = Field(
        default=0.0,
        description="eta, the violation that is borne, in episode cost (ours; Xu et al. 2021: 0.5).",
    )
