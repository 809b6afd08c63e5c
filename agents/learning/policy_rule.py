"""The rule by which an algorithm improves the policy of an actor-critic, and its metrics.

Notation: N samples, k costs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch

from recrl.agents.building_blocks.distributions import mean_divergence
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.surrogates import surrogate
from recrl.agents.experience import Experience


class Stateful(Protocol):
    """An object that is saved and restored with an agent."""

    def state_dict(self) -> dict[str, Any]:
        """Return all learnt and adapted state: a tree of dicts, lists, JSON scalars and NumPy arrays."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        ...


class PolicyRule(Protocol):
    """Rule that improves an agent's policy; the part that differs between algorithms."""

    @property
    def parts(self) -> Mapping[str, Stateful]:
        """State that the rule keeps between updates, by name."""
        ...

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Change the policy once.

        Args:
            policy: the policy that collected the samples; changed in place.
            experience: the samples, raw advantages, and the constraints.
            generator: the agent's own randomness.

        Returns:
            Metrics with constant keys: ``policy_steps``, ``multiplier_i``, and the rule's own.
        """
        ...


def indexed(name: str, values: npt.NDArray[np.floating]) -> dict[str, float]:
    """Return one metric per cost, [k]: ``name_0``, ``name_1``, ...; infinite values become NaN."""
    return {
        f"{name}_{i}": float(value) if np.isfinite(value) else float("nan") for i, value in enumerate(values)
    }


def improve_and_measure(
    rule: PolicyRule, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
) -> dict[str, float]:
    """Let a rule improve the policy; return its metrics and those of the change.

    Returns:
        The rule's metrics; ``kl``, the mean KL from the old policy in nats; the mean ``entropy``; and
        ``surrogate_reward`` and ``surrogate_cost_i``, the gains to first order in the advantages' unit.
    """
    metrics = rule.improve(policy, experience, generator)
    policy.bound_std()
    batch, advantages = experience.batch, experience.advantages
    new = policy.distribution(batch.unique_observations)
    centred = batch.per_pair(advantages - advantages.mean(axis=0))
    gains = surrogate(experience.ratios(new), centred).numpy(force=True)
    return united(
        metrics,
        {
            "kl": float(mean_divergence(experience.old, new, batch.observation_weights)),
            "entropy": float(torch.dot(batch.observation_weights, new.entropy())),
            "surrogate_reward": float(gains[0]),
            **indexed("surrogate_cost", gains[1:]),
        },
    )


def united(of_rule: Mapping[str, float], common: Mapping[str, float]) -> dict[str, float]:
    """Return the metrics of a rule and those that every agent has.

    Raises:
        TypeError: those of the rule are no mapping.
        ValueError: a metric of the rule has the name of another one.
    """
    if not isinstance(of_rule, Mapping):
        raise TypeError(f"a rule's improve must return a mapping of metrics, got {of_rule!r}")
    if taken := sorted(of_rule.keys() & common.keys()):
        raise ValueError(f"a rule's metrics need other names than the agent's own, got {', '.join(taken)}")
    return {**of_rule, **common}
