"""Options of groups of agents with their sources, and the two presets.

``recommended`` is every field's default. ``paper`` is safety-starter-agents' setting, which the paper took
over unchanged; it assumes rollouts of 30,000 steps (``rollout_steps`` x ``num_envs`` of the trial). Options
given together with ``preset`` override its values. Without torch, so that validating a grid is fast.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from recrl.environments.options import Options
from recrl.environments.plugins import IMPORT_PATH

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Width = Annotated[int, Field(ge=1, le=4096)]

STARTER_AGENTS_SETTING: Mapping[str, Any] = {
    "hidden_sizes": (256, 256),
    "initialisation": "xavier",
    "last_layer_scale": 1.0,
    "discount": 0.99,
    "reward_trace_decay": 0.97,
    "cost_trace_decay": 0.97,
    "critic_steps": 80,
    "minibatch_size": None,
    "value_target": "reward-to-go",
    "value_scale": "none",
    "encoder": "none",
    "normalise_observations": "none",
    "constraint_window": 1,
    "policy_average": 0.0,
    "min_std": 0.0,
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


def require_effect(options: Options, names: Sequence[str], deciding: str) -> None:
    """Check that options which another one makes ineffective have their defaults.

    Args:
        options: of an agent.
        names: the ineffective ones.
        deciding: the other one, with its value, for the error.

    Raises:
        ValueError: one of them has another value.
    """
    is_paper = getattr(options, "preset", None) == "paper"
    preset: Mapping[str, Any] = getattr(options, "paper", {}) if is_paper else {}
    for name in names:
        value, default = getattr(options, name), type(options).model_fields[name].default
        if value != preset.get(name, default):
            raise ValueError(f"{name} has no effect with {deciding}: leave it out, got {value}")


class ActorCriticConfig(Options):
    """Settings of all agents with a policy and 1 + k critics."""

    paper: ClassVar[Mapping[str, Any]] = STARTER_AGENTS_SETTING

    preset: Literal["recommended", "paper"] = Field(
        default="recommended",
        description="Source of unset options: recommended (ours), or paper "
        "(safety-starter-agents, as used in the paper; give run: {num_envs: 30, rollout_steps: 1000}, too).",
    )
    hidden_sizes: Annotated[tuple[Width, ...], Field(max_length=8)] = Field(
        default=(64, 64),
        description="Widths of the hidden layers of each network (ours; paper 256, 256).",
    )
    activation: Literal["tanh", "relu", "elu", "silu", "gelu"] = Field(
        default="tanh",
        description="Activation between the layers (paper tanh). tanh is the fastest.",
    )
    network: Annotated[str, Field(pattern=f"^{IMPORT_PATH.pattern}$")] | None = Field(
        default=None,
        description="Import path package.module:function of your own network. The function takes "
        "the numbers of inputs and outputs and returns a torch.nn.Module from [U, "
        "inputs] to [U, outputs]. It makes the policy and every critic. Then "
        "hidden_sizes, activation, initialisation and last_layer_scale must be left out.",
    )
    initialisation: Literal["orthogonal", "xavier"] = Field(
        default="orthogonal", description="Initialisation of the weights (ours; paper xavier)."
    )
    last_layer_scale: Positive = Field(
        default=0.01,
        description="Factor on the initial weights of the policy's last layer, so that it begins "
        "nearly uniform (Andrychowicz et al. 2021; paper 1).",
    )
    encoder: Literal["proximity", "none"] = Field(
        default="proximity",
        description="Additional inputs of the networks: proximity, features of the task's lidars "
        "that resolve small distances (ours); or none (paper).",
    )
    proximity_scales: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=8)] = Field(
        default=(0.15, 0.4),
        description="Length scales of the proximity features, metres (ours).",
    )
    normalise_observations: Literal["unbounded", "all", "none"] = Field(
        default="unbounded",
        description="Which observation numbers are standardised by their running mean and standard "
        "deviation: all; none (paper); or unbounded, numbers without finite bounds (ours). If the task "
        "declares its components, unbounded is none. Deviations below 0.0001 are not brought to 1.",
    )
    discount: Share = Field(
        default=0.995,
        description="Discount gamma of the critics, per step (ours; paper 0.99). After 1 / (1 - gamma) steps "
        "the weight of a reward has fallen to 37%.",
    )
    reward_trace_decay: Share = Field(
        default=0.9, description="GAE lambda of the reward's advantages (ours; paper 0.97)."
    )
    cost_trace_decay: Share = Field(
        default=0.9, description="GAE lambda of the costs' advantages (ours; paper 0.97)."
    )
    critic_learning_rate: Positive = Field(
        default=1e-3, description="Learning rate of the critics' Adam (paper)."
    )
    minibatch_size: Count | None = Field(
        default=1024,
        description="Minibatch size, if a rollout has more distinct observations; null for all "
        "(ours; paper: all).",
    )
    critic_steps: Count = Field(
        default=40, description="Gradient steps of the critics per update (ours; paper 80)."
    )
    critic_passes: Count = Field(
        default=5,
        description="Epochs of the critics per update, if these are more steps than critic_steps (ours).",
    )
    constraint: Literal["mean", "cvar"] = Field(
        default="mean",
        description="Constrained measure of the episode cost: mean (paper), or cvar, the "
        "conditional value at risk (suggested by the paper). It is the mean of the "
        "worst episodes.",
    )
    cvar_level: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(
        default=0.9,
        description="alpha of the CVaR, which is the mean of the worst fraction 1 - alpha of the "
        "episodes; only with the constraint cvar (ours).",
    )
    constraint_window: Count = Field(
        default=16,
        description="Least number of episodes for a mean cost. If fewer finish in an update, it is that "
        "of a life table, which averages over this number of steps of each age. With "
        "cvar, episodes of earlier updates are included (ours).",
    )
    value_target: Literal["lambda-return", "reward-to-go"] = Field(
        default="lambda-return",
        description="Targets of the critics: advantage plus value (ours), or the bootstrapped "
        "discounted reward-to-go (paper).",
    )
    value_scale: Literal["running", "none"] = Field(
        default="running",
        description="Whether critics learn targets divided by their running root mean square "
        "(ours), which makes the scale of rewards and costs irrelevant, or raw "
        "targets (paper).",
    )
    target_kl: Positive = Field(
        default=0.01, description="Size of the trust region, mean KL in nats per update (paper)."
    )
    policy_average: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(
        default=0.9,
        description="Decay of the exponential moving average over the policies after each update. The "
        "average is the final policy, for evaluation and export (ours). 0: the last policy (paper).",
    )
    min_std: Share = Field(
        default=0.4,
        description="Lower bound of the standard deviations of continuous actions, as a fraction of half "
        "the action's range; of more than two actions, m, it is times sqrt(2 / m). They are raised to it "
        "after each update (ours). Under a falling limit a policy without it can become too "
        "certain to change in time. Where the noise itself costs, lower it. 0: no bound (paper).",
    )
    noise_form: Literal["match-mixture", "temperature"] = Field(
        default="match-mixture",
        description="Meaning of policy noise (ours; the paper does not define it). match-mixture: "
        "make the policy as random as its mixture with a uniform one; with more than two continuous "
        "actions, less random than that. temperature: divide logits or multiply standard "
        "deviations by 1 / (1 - noise).",
    )
    compaction: bool = Field(
        default=True,
        description="Evaluate networks once for each distinct observation of a rollout, which is faster "
        "(ours). If off, all samples count as distinct, also for minibatch_size.",
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_in_preset(cls, options: Any) -> Any:
        if isinstance(options, Mapping) and options.get("preset") == "paper":
            return {**cls.paper, **options}
        return options

    @model_validator(mode="after")
    def _options_have_an_effect(self) -> Self:
        if self.constraint == "mean":
            require_effect(self, ["cvar_level"], "constraint: mean")
        if self.encoder == "none":
            require_effect(self, ["proximity_scales"], "encoder: none")
        if self.network is not None:
            of_ours = ["hidden_sizes", "activation", "initialisation", "last_layer_scale"]
            require_effect(self, of_ours, "a network of your own")
        return self


class AscentConfig(ActorCriticConfig):
    """Settings of agents that ascend an objective by Adam until the KL is too large."""

    paper: ClassVar[Mapping[str, Any]] = {**STARTER_AGENTS_SETTING, **STARTER_AGENTS_ASCENT}

    target_kl: Positive = Field(
        default=0.02,
        description="Size of the trust region, mean KL in nats per update (ours; paper 0.01).",
    )
    policy_learning_rate: Positive = Field(
        default=5e-4,
        description="Learning rate of the policy's Adam; the KL bounds the change (ours; paper 3e-4).",
    )
    policy_steps: Count = Field(
        default=20,
        description="Gradient steps of the policy per update; the KL may stop it earlier (ours; paper 80).",
    )
    policy_passes: Count = Field(
        default=10,
        description="Epochs of the policy per update, if these are more steps than policy_steps; "
        "the KL may stop it earlier (ours).",
    )
    stop_kl_factor: Positive = Field(
        default=1.2, description="Stop the policy's steps when the KL exceeds this times target_kl (paper)."
    )


class RadiusConfig(AscentConfig):
    """Settings of first-order agents that keep their trust region."""

    paper: ClassVar[Mapping[str, Any]] = {**AscentConfig.paper, "trust_region": "passed"}

    policy_learning_rate: Positive = Field(
        default=3e-4,
        description="Learning rate of the policy's Adam (paper). Larger steps go far beyond the trust region "
        "before the KL is measured.",
    )
    trust_region: Literal["kept", "passed"] = Field(
        default="kept",
        description="If the mean KL of an update exceeds target_kl: whether the change of the policy is "
        "scaled back to it (kept, ours) or left (passed; the algorithm's source).",
    )


class LagrangianConfig(Options):
    """Options of Lagrange multipliers, in addition to those of an ``ActorCriticConfig``."""

    multiplier_rule: Literal["projected", "softplus-adam", "proportional-integral"] = Field(
        default="proportional-integral",
        description="Update rule of the multipliers: proportional-integral, a damped dual ascent (Stooke "
        "et al. 2020; ours), plain projected dual ascent, or softplus with Adam (paper).",
    )
    multiplier_initial: NonNegative = Field(
        default=0.0, description="Initial value of every multiplier (ours; paper 1)."
    )
    multiplier_unit: Literal["relative", "cost"] = Field(
        default="relative",
        description="Units of violations and multipliers. relative: violations per limit and "
        "standard error, multipliers per ratio of the running spreads of reward and "
        "cost advantages; the task's units do not matter (ours). cost: violations in "
        "episode cost, multipliers in standard deviations of the reward advantages "
        "per unit of cost (paper).",
    )
    multiplier_error_decay: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(
        default=0.0,
        description="How much of the average of squared standard errors remains in an update (ours). With "
        "0 a relative violation is divided by the error of its own update. Take 0.9 if costs are rare.",
    )
    multiplier_step: Positive = Field(
        default=0.1,
        description="Step of the dual ascent, K_I, or Adam's learning rate (ours; paper 0.05). With "
        "multiplier_unit: cost, the first two are per unit of episode cost.",
    )
    multiplier_proportional: NonNegative = Field(
        default=1.0, description="K_P of the rule proportional-integral (ours)."
    )
    multiplier_maximum: Positive = Field(
        default=1000.0,
        description="Largest multiplier, but for softplus-adam (ours; anti-wind-up).",
    )

    @model_validator(mode="after")
    def _first_multiplier_is_in_range(self) -> Self:
        if self.multiplier_rule == "softplus-adam" and self.multiplier_initial <= 0.0:
            raise ValueError(
                f"multiplier_initial must be above 0 with the rule softplus-adam, "
                f"got {self.multiplier_initial}"
            )
        if self.multiplier_rule != "softplus-adam" and self.multiplier_initial > self.multiplier_maximum:
            raise ValueError(
                f"multiplier_initial must be at most multiplier_maximum, {self.multiplier_maximum}, "
                f"got {self.multiplier_initial}"
            )
        return self

    @model_validator(mode="after")
    def _options_of_the_rule_have_an_effect(self) -> Self:
        deciding = f"multiplier_rule: {self.multiplier_rule}"
        if self.multiplier_rule != "proportional-integral":
            require_effect(self, ["multiplier_proportional"], deciding)
        if self.multiplier_rule == "softplus-adam":
            require_effect(self, ["multiplier_maximum"], deciding)
        if self.multiplier_unit == "cost":
            require_effect(self, ["multiplier_error_decay"], "multiplier_unit: cost")
        return self


class TrustRegionConfig(ActorCriticConfig):
    """Settings of agents that take one trust-region step per update."""

    paper: ClassVar[Mapping[str, Any]] = {**STARTER_AGENTS_SETTING, **STARTER_AGENTS_TRUST_REGION}

    damping: NonNegative = Field(
        default=0.1, description="Multiple of the identity added to the Hessian of the KL (paper)."
    )
    conjugate_gradient_steps: Count = Field(default=10, description="Iterations for each direction (paper).")
    metric_samples: Count | None = Field(
        default=2048,
        description="Number of samples, drawn at random, for the Hessian of the KL; null for all "
        "(ours; paper: all).",
    )
    backtrack_ratio: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=0.8, description="Factor by which each try of the line search shortens the step (paper)."
    )
    backtrack_tries: Count = Field(default=10, description="Tries of the line search (paper).")
