"""An agent of your own: trust-region steps with a fixed multiplier for every violated cost."""

from pydantic import Field

from recrl.agents.algorithms.trpo import trust_region_step
from recrl.agents.building_blocks.advantages import standardised_advantages
from recrl.agents.learning.actor_critic import fresh_agent
from recrl.agents.learning.policy_rule import indexed
from recrl.agents.registry import AgentEntry
from recrl.agents.shared_options import TrustRegionConfig


class FixedMultiplierConfig(TrustRegionConfig):
    """``options: {multiplier: 2.0}`` in a grid, beside all that a trust-region agent has."""

    multiplier: float = Field(default=1.0, ge=0.0, description="Of a violated cost, in standard deviations.")
    warm_up: int = Field(default=10, ge=1, description="Updates until the multiplier has its full value.")


class UpdateCount:
    """Number of updates. A checkpoint holds it, because the rule names it in ``parts``."""

    def __init__(self):
        self.value = 0

    def state_dict(self):
        return {"value": self.value}

    def load_state_dict(self, state):
        self.value = state["value"]


class FixedMultiplier:
    """The rule alone: collecting, critics, noise, checkpoints and metrics are there already."""

    def __init__(self, config: FixedMultiplierConfig) -> None:
        self.config = config
        self.updates = UpdateCount()
        self.parts = {"updates": self.updates}  # all that changes from one update to the next

    def improve(self, policy, experience, generator):
        self.updates.value += 1
        share = min(1.0, self.updates.value / self.config.warm_up)
        violated = experience.constraints.gaps > 0.0  # [k]; false if the limit is infinite
        multipliers = share * self.config.multiplier * violated
        advantages, _ = standardised_advantages(experience.advantages)  # [N, 1 + k]
        objective = advantages[:, 0] - advantages[:, 1:] @ multipliers
        metrics = trust_region_step(policy, experience, objective, self.config, generator)
        return {**metrics, **indexed("multiplier", multipliers)}


def make_fixed_multiplier(cmdp, config, seed):
    return fresh_agent(cmdp, config, seed, lambda policy: FixedMultiplier(config))


FIXED_MULTIPLIER = AgentEntry(
    "A fixed multiplier for every violated limit.", FixedMultiplierConfig, make_fixed_multiplier
)
