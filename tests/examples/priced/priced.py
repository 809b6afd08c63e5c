"""A student of one's own: trust-region steps on the reward less a fixed price for every violated cost."""

from pydantic import Field

from recrl.agents.algorithms.trpo import step_up
from recrl.agents.config import TrustRegionConfig
from recrl.agents.learning.actor_critic import fresh_agent, indexed
from recrl.agents.learning.advantages import SMALLEST_STD
from recrl.agents.registry import AgentEntry


class PricedConfig(TrustRegionConfig):
    """``options: {price: 2.0}`` in a grid, beside all that a trust-region student has."""

    price: float = Field(default=1.0, ge=0.0, description="Of a violated cost, in standard deviations.")


class Priced:
    """The rule alone: collecting, critics, noise, checkpoints and metrics are there already."""

    def __init__(self, config: PricedConfig) -> None:
        self.config = config
        self.parts = {}  # what the rule itself must remember from one update to the next: nothing

    def improve(self, policy, experience, generator):
        advantages = experience.advantages - experience.advantages.mean(axis=0)  # [N, 1 + k]
        advantages /= advantages.std(axis=0).clip(SMALLEST_STD)
        prices = self.config.price * (experience.constraints.gaps > 0.0)  # [k]
        objective = advantages[:, 0] - advantages[:, 1:] @ prices
        metrics = step_up(policy, experience, objective, self.config, generator)
        return {**metrics, **indexed("multiplier", prices)}


def make_priced(cmdp, config, seed):
    return fresh_agent(cmdp, config, seed, lambda policy: Priced(config))


PRICED = AgentEntry("A fixed price for every violated limit.", PricedConfig, make_priced)
