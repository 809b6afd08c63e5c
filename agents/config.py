"""What can be set of each student, where the numbers come from, and the two presets.

``recommended`` is every field's default. ``paper`` is safety-starter-agents' setting, which the paper took
over unchanged; it assumes rollouts of 30,000 steps (``rollout_steps`` x ``num_envs`` of the trial). Options
given beside ``preset`` override its values. Imports no torch, so that a grid is validated in a moment.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Width = Annotated[int, Field(ge=1, le=4096)]
IMPORT_PATH = r"^[A-Za-z_][\w.]*:[A-Za-z_][\w.]*$"

STARTER_AGENTS_SETTING: Mapping[str, Any] = {
    "hidden_sizes": (256, 256),
    "initialisation": "xavier",
    "last_layer_scale": 1.0,
    "reward_trace_decay": 0.97,
    "cost_trace_decay": 0.97,
    "critic_steps": 80,
    "minibatch_size": None,
    "value_target": "reward-to-go",
    "value_scale": "none",
    "encoder": "none",
    "constraint_window": 1,
    "noise_form": "match-mixture",
}

STARTER_AGENTS_ASCENT: Mapping[str, Any] = {
    "target_kl": 0.01,
    "policy_learning_rate": 3e-4,
    "policy_steps": 80,
}
STARTER_AGENTS_TRUST_REGION: Mapping[str, Any] = {"metric_samples": None}
STARTER_AGENTS_MULTIPLIERS: Mapping[str, Any] = {
    "multiplier_rule": "softplus-adam",
    "multiplier_unit": "cost",
    "multiplier_initial": 1.0,
    "multiplier_step": 0.05,
}


class StudentConfig(BaseModel):
    """Settings that all students with a policy and 1 + k critics share."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    paper: ClassVar[Mapping[str, Any]] = STARTER_AGENTS_SETTING

    preset: Literal["recommended", "paper"] = Field(
        default="recommended",
        description="Where unset options come from: ours, or safety-starter-agents' as used in the paper.",
    )
    hidden_sizes: Annotated[tuple[Width, ...], Field(max_length=8)] = Field(
        default=(64, 64),
        description="Widths of the hidden layers of each network (ours; paper 256, 256).",
    )
    activation: Literal["tanh", "relu", "elu", "silu", "gelu"] = Field(
        default="tanh",
        description="Function between the layers (paper tanh). tanh is the fastest.",
    )
    network: Annotated[str, Field(pattern=IMPORT_PATH)] | None = Field(
        default=None,
        description="Import path package.module:function of a network of your own: the function takes the "
        "numbers of inputs and outputs and returns a torch.nn.Module from [U, inputs] to [U, outputs]; it "
        "makes the policy and every critic. hidden_sizes, activation and initialisation are then not used.",
    )
    initialisation: Literal["orthogonal", "xavier"] = Field(
        default="orthogonal", description="How weights begin (ours; paper xavier)."
    )
    last_layer_scale: Positive = Field(
        default=0.01,
        description="Factor on the policy's last initial weights, so that it begins nearly uniform "
        "(Andrychowicz et al. 2021; paper 1).",
    )
    encoder: Literal["proximity", "none"] = Field(
        default="proximity",
        description="What networks see beside the observation: where a task declares a lidar, features that "
        "resolve small distances (ours), or nothing (paper).",
    )
    proximity_scales: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=8)] = Field(
        default=(0.15, 0.4),
        description="Length scales of the proximity features, metres (ours).",
    )
    normalise_observations: bool = Field(
        default=False,
        description="Standardise observations by their running mean and standard deviation (ours).",
    )
    discount: Share = Field(default=0.99, description="gamma of the critics, per step (paper).")
    reward_trace_decay: Share = Field(
        default=0.9, description="lambda of the reward's advantages (ours; paper 0.97)."
    )
    cost_trace_decay: Share = Field(
        default=0.9, description="lambda of the costs' advantages (ours; paper 0.97)."
    )
    critic_learning_rate: Positive = Field(default=1e-3, description="Adam's, for the critics (paper).")
    minibatch_size: Count | None = Field(
        default=1024,
        description="Samples of a gradient step where a rollout has more distinct observations than that; "
        "null for all (ours; paper: all).",
    )
    critic_steps: Count = Field(default=40, description="Steps of the critics an update (ours; paper 80).")
    critic_passes: Count = Field(
        default=5,
        description="Passes of the critics over the samples an update, where these are more steps than "
        "critic_steps (ours).",
    )
    constraint: Literal["mean", "cvar"] = Field(
        default="mean",
        description="What of an episode's cost is constrained: its mean (paper), or its mean in the worst "
        "episodes, the conditional value at risk (named by the paper as an extension).",
    )
    cvar_level: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(
        default=0.9,
        description="alpha of the CVaR, which is the mean of the worst share 1 - alpha of the episodes; only "
        "with the constraint cvar (ours).",
    )
    constraint_window: Count = Field(
        default=16,
        description="Episodes, at least, from which a mean cost is estimated: where fewer finish in an "
        "update, those of the updates before it count as well (ours).",
    )
    limit_margin: NonNegative = Field(
        default=0.0,
        description="Standard errors of an update's mean episode cost that are added to it before it is "
        "compared with its limit; only with the constraint mean (ours).",
    )
    value_target: Literal["lambda-return", "reward-to-go"] = Field(
        default="lambda-return",
        description="What critics learn: advantage plus value (ours), or the bootstrapped discounted "
        "reward-to-go (paper).",
    )
    value_scale: Literal["running", "none"] = Field(
        default="running",
        description="Whether critics learn their targets divided by the targets' running root mean square, "
        "so that the size of rewards and costs does not matter (ours), or the targets themselves (paper).",
    )
    target_kl: Positive = Field(
        default=0.01, description="Size of the trust region, mean KL in nats an update (paper)."
    )
    noisy_target_kl: Positive | None = Field(
        default=None,
        description="target_kl of an update from samples of a policy to which the teacher added noise, which "
        "has to be undone beside what is learnt, or in which it rewards entropy; null for target_kl (ours).",
    )
    noise_form: Literal["match-mixture", "temperature"] = Field(
        default="match-mixture",
        description="What policy noise does: make the policy as random as its mixture with a uniform one, or "
        "divide logits (multiply standard deviations) by 1 / (1 - noise) (ours; the paper is silent).",
    )
    compaction: bool = Field(
        default=True,
        description="Evaluate networks once for each distinct observation of a rollout; exact, only faster.",
    )

    def in_update(self, *, noisy: bool) -> Self:
        """The settings of one update: target_kl is noisy_target_kl under noise or rewarded entropy."""
        if not noisy or self.noisy_target_kl is None:
            return self
        return self.model_copy(update={"target_kl": self.noisy_target_kl})

    @model_validator(mode="after")
    def _margin_is_of_means(self) -> Self:
        if self.limit_margin > 0.0 and self.constraint != "mean":
            raise ValueError(
                f"limit_margin counts standard errors of a mean: with the constraint {self.constraint} "
                f"it must be 0, got {self.limit_margin}"
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _fill_in_preset(cls, options: Any) -> Any:
        if isinstance(options, Mapping) and options.get("preset") == "paper":
            return {**cls.paper, **options}
        return options


class AscentConfig(StudentConfig):
    """Settings of students that climb an objective by Adam until the policy has moved far enough."""

    paper: ClassVar[Mapping[str, Any]] = {**STARTER_AGENTS_SETTING, **STARTER_AGENTS_ASCENT}

    target_kl: Positive = Field(
        default=0.02,
        description="Size of the trust region, mean KL in nats an update (ours; paper 0.01).",
    )
    policy_learning_rate: Positive = Field(
        default=5e-4,
        description="Adam's, for the policy; the KL keeps it in bounds (ours; paper 3e-4).",
    )
    policy_steps: Count = Field(
        default=20, description="Steps of the policy an update; the KL may stop it before (ours; paper 80)."
    )
    policy_passes: Count = Field(
        default=10,
        description="Passes of the policy over the samples an update, where these are more steps than "
        "policy_steps; the KL may stop it before (ours).",
    )
    stop_kl_factor: Positive = Field(
        default=1.2, description="Stop the policy's steps when the KL exceeds this times target_kl (paper)."
    )


class MultiplierConfig(StudentConfig):
    """Settings of students that price the constraints: how their multipliers move."""

    multiplier_rule: Literal["projected", "softplus-adam", "pid"] = Field(
        default="pid",
        description="How multipliers move: PID, a damped dual ascent (Stooke et al. 2020; ours), plain "
        "projected dual ascent, or softplus with Adam (paper).",
    )
    multiplier_initial: NonNegative = Field(
        default=0.0, description="First value of every multiplier (ours; paper 1)."
    )
    multiplier_unit: Literal["relative", "cost"] = Field(
        default="relative",
        description="What violations and multipliers are counted in. relative: violations per limit and "
        "standard error, multipliers per ratio of the running spreads of reward and cost advantages, so that "
        "no unit of the task matters (ours). cost: violations in episode cost, multipliers in standard "
        "deviations of the reward advantages per unit of cost (paper).",
    )
    multiplier_step: Positive = Field(
        default=0.1,
        description="Step of the dual ascent, K_I, or Adam's learning rate, without unit (ours; paper 0.05).",
    )
    multiplier_proportional: NonNegative = Field(default=0.2, description="K_P of the PID rule (ours).")
    multiplier_derivative: NonNegative = Field(default=0.0, description="K_D of the PID rule (ours).")
    multiplier_maximum: Positive = Field(
        default=1000.0,
        description="The largest multiplier that projected ascent and PID give (ours; anti-wind-up).",
    )
    multiplier_geometric: bool = Field(
        default=False,
        description="Let the integral I of PID grow and fall by shares of 1 + I, so that a price that had to "
        "be high is not high for long; only with the rule pid (ours).",
    )
    multiplier_waits: bool = Field(
        default=False,
        description="Sum up no violation that the teacher may have caused: in an update from samples of a "
        "policy with added noise, or in which it rewards entropy, the integral of PID stays, and the other "
        "rules' multipliers (ours).",
    )
    multiplier_reset: bool = Field(
        default=False,
        description="Begin a multiplier anew when its limit changes (ours); not for limits that always move.",
    )

    @model_validator(mode="after")
    def _softplus_begins_above_zero(self) -> Self:
        if self.multiplier_rule == "softplus-adam" and self.multiplier_initial <= 0.0:
            raise ValueError(
                f"multiplier_initial must be above 0 with the rule softplus-adam, "
                f"got {self.multiplier_initial}"
            )
        return self

    @model_validator(mode="after")
    def _shares_are_of_an_integral(self) -> Self:
        if self.multiplier_geometric and self.multiplier_rule != "pid":
            raise ValueError(
                "multiplier_geometric is how the integral of PID moves: with the rule "
                f"{self.multiplier_rule} it must be false"
            )
        return self


class TrustRegionConfig(StudentConfig):
    """Settings of students that take one trust-region step an update."""

    paper: ClassVar[Mapping[str, Any]] = {**STARTER_AGENTS_SETTING, **STARTER_AGENTS_TRUST_REGION}

    damping: NonNegative = Field(
        default=0.1, description="Multiple of the identity added to the Hessian of the KL (paper)."
    )
    conjugate_gradient_steps: Count = Field(default=10, description="Iterations for each direction (paper).")
    metric_samples: Count | None = Field(
        default=2048,
        description="Samples, drawn at random, on which the Hessian of the KL is evaluated; null for all "
        "(ours; paper: all).",
    )
    backtrack_ratio: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=0.8, description="Factor on the step from one try of the line search to the next (paper)."
    )
    backtrack_tries: Count = Field(default=10, description="Tries of the line search (paper).")


class PPOConfig(AscentConfig):
    """Settings of ``ppo``, which knows no constraint."""

    clip: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=0.2, description="How far the probability ratio pays off: 1 +- clip (paper)."
    )
    entropy_bonus: NonNegative = Field(
        default=0.0, description="Weight of the mean entropy, nats, in the objective (paper: none)."
    )


class PPOLagConfig(AscentConfig, MultiplierConfig):
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


class FOCOPSConfig(AscentConfig, MultiplierConfig):
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
        "temperature": 1.5,
        "trust_region": "passed",
    }

    policy_learning_rate: Positive = Field(
        default=3e-4,
        description="Adam's, for the policy (Zhang et al. 2020). Larger steps go far past the trust region "
        "before the KL is seen.",
    )
    temperature: Positive = Field(
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


class SettlingConfig(TrustRegionConfig):
    """Settings of students that as published take steps to the trust region's edge, and need not."""

    temperature: NonNegative = Field(
        default=0.0,
        description="T, what a nat of KL must be worth in the surrogate, in standard deviations of the "
        "reward advantages, so that steps end with the gain; 0 for steps as long as the trust region allows "
        "(ours).",
    )


class LinearisedConstraintConfig(SettlingConfig):
    """Settings of students that hold a step to linearised constraints."""

    cross_fitting: bool = Field(
        default=False,
        description="Judge what a step does to a cost on samples that did not choose it, and let a violation "
        "count for more as far as less is confirmed; where observations are many and noisy, as on Safety Gym "
        "(ours).",
    )


class CPOConfig(LinearisedConstraintConfig):
    """Settings of ``cpo``, constrained policy optimisation."""


class PCPOConfig(LinearisedConstraintConfig):
    """Settings of ``pcpo``, projection-based constrained policy optimisation."""


class TRPOConfig(SettlingConfig):
    """Settings of ``trpo``, which knows no constraint."""


class TRPOLagConfig(TrustRegionConfig, MultiplierConfig):
    """Settings of ``trpo-lag``, TRPO on the Lagrangian."""

    paper: ClassVar[Mapping[str, Any]] = {
        **STARTER_AGENTS_SETTING,
        **STARTER_AGENTS_TRUST_REGION,
        **STARTER_AGENTS_MULTIPLIERS,
        "temperature": 0.0,
    }

    temperature: NonNegative = Field(
        default=1.0,
        description="lambda, what a nat of KL must be worth in the surrogate, that is 1 + the multipliers "
        "standard deviations of the reward advantages, so that steps end with the gain (ours; paper 0).",
    )


class CRPOConfig(TrustRegionConfig):
    """Settings of ``crpo``, constraint-rectified policy optimisation."""

    paper: ClassVar[Mapping[str, Any]] = {
        **STARTER_AGENTS_SETTING,
        **STARTER_AGENTS_TRUST_REGION,
        "temperature": 0.0,
    }

    temperature: NonNegative = Field(
        default=1.0,
        description="lambda, what a nat of KL must be worth beyond a limit, in standard deviations of the "
        "reward advantages, so that steps end with the gain; 0 for steps as long as the trust region allows "
        "(ours; Xu et al. 2021: 0).",
    )
    tolerance: NonNegative = Field(
        default=0.0,
        description="eta, the violation that is borne, in episode cost (ours; Xu et al. 2021: 0.5).",
    )
