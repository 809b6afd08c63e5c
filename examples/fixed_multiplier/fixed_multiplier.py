"""An agent of one's own: trust-region steps with a fixed multiplier for every violated cost."""

from pydantic import Field

from recrl.agents.algorithms.trpo import trust_region_step
from recrl.agents.learning.actor_critic import fresh_agent
from recrl.agents.learning.advantages import SMALLEST_STD
from recrl.agents.learning.policy_rule import indexed
from recrl.agents.registry import AgentEntry
from recrl.agents.shared_options import TrustRegionConfig


class FixedMultiplierConfig(TrustRegionConfig):
    """``options: {multiplier: 2.0}`` in a grid, beside all that a trust-region agent has."""

    multiplier: float = Field(default=1.0, ge=0.0, description="Of a violated cost, in standard deviations.")


class FixedMultiplier:
    """The rule alone: collecting, critics, noise, checkpoints and metrics are there already."""

    def __init__(self, config: FixedMultiplierConfig) -> None:
        self.config = config
        self.parts = {}  # what the rule itself must remember from one update to the next: nothing

    def improve(self, policy, experience, generator):
        advantages = experience.advantages - experience.advantages.mean(axis=0)  # [N, 1 + k]
        advantages /= advantages.std(axis=0).clip(SMALLEST_STD)
        multipliers = self.config.multiplier * (experience.constraints.gaps > 0.0)  # [k]
        objective = advantages[:, 0] - advantages[:, 1:] @ multipliers
        metrics = trust_region_step(policy, experience, objective, self.config, generator)
        return {**metrics, **indexed("multiplier", multipliers)}


def make_fixed_multiplier(cmdp, config, seed):
    return fresh_agent(cmdp, config, seed, lambda policy: FixedMultiplier(config))


FIXED_MULTIPLIER = AgentEntry(
    "A fixed multiplier for every violated limit.", FixedMultiplierConfig, make_fixed_multiplier
)
