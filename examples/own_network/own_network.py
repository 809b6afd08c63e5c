"""An agent with a network of its own: policy gradients, and a multiplier for every cost. Discrete actions."""

import numpy as np
import torch
from gymnasium.spaces import flatdim
from pydantic import BaseModel, Field
from torch import nn

from recrl.agents.registry import AgentEntry


class OwnNetworkConfig(BaseModel, frozen=True, extra="forbid"):
    """``options: {width: 64}`` in a grid."""

    width: int = Field(default=32, ge=1, description="Units of the hidden layer.")
    learning_rate: float = Field(default=1e-2, gt=0.0, description="Adam's.")
    multiplier_step: float = Field(default=0.01, gt=0.0, description="Of the dual ascent, per unit of cost.")


class OwnNetwork:
    """Any class with these methods is an agent; NumPy arrays go in and out."""

    def __init__(self, cmdp, config, seed):
        torch.manual_seed(int(seed.generate_state(1)[0]))
        hidden = nn.Linear(flatdim(cmdp.observation_space), config.width)
        self.network = nn.Sequential(
            hidden, nn.SiLU(), nn.LayerNorm(config.width), nn.Linear(config.width, int(cmdp.action_space.n))
        )
        self.optimiser = torch.optim.Adam(self.network.parameters(), config.learning_rate)
        self.multipliers = np.zeros(cmdp.num_costs)
        self.config = config

    def act(self, observations, generator):
        """Sample actions by the Gumbel trick, with the generator that is given."""
        logits = self._logits(observations)
        return np.argmax(logits + generator.gumbel(size=logits.shape), axis=1)

    def act_greedily(self, observations):
        """Take the most probable actions."""
        return np.argmax(self._logits(observations), axis=1)

    def update(self, rollout, episode_costs, limits):
        """Learn from a rollout of T steps in B environments, under limits [k]."""
        if len(episode_costs):
            gaps = np.where(np.isfinite(limits), episode_costs.mean(axis=0) - limits, -self.multipliers)
            self.multipliers = np.maximum(self.multipliers + self.config.multiplier_step * gaps, 0.0)
        values = rollout.rewards - rollout.costs @ self.multipliers  # [T, B]
        ended = rollout.terminated | rollout.truncated
        for t in reversed(range(len(values) - 1)):
            values[t] += 0.99 * values[t + 1] * ~ended[t]
        advantages = torch.as_tensor((values - values.mean()) / (values.std() + 1e-8), dtype=torch.float32)
        logits = self.network(torch.as_tensor(rollout.observations))
        chosen = torch.distributions.Categorical(logits=logits).log_prob(torch.as_tensor(rollout.actions))
        self.optimiser.zero_grad()
        loss = -(chosen * advantages).mean()
        loss.backward()
        self.optimiser.step()
        return {"loss": loss.item()} | {f"multiplier_{i}": float(it) for i, it in enumerate(self.multipliers)}

    def add_noise(self, noise, observations):
        """Flatten the policy once, as a curriculum may ask."""
        with torch.no_grad():
            self.network[-1].weight *= 1.0 - noise
        return {"scale": 1.0 - noise}

    def state_dict(self):
        """Everything that learning goes on from: dicts, lists, numbers and NumPy arrays."""
        adam = [{key: it.numpy().copy() for key, it in one.items()} for one in self.optimiser.state.values()]
        weights = {name: it.numpy().copy() for name, it in self.network.state_dict().items()}
        return {"weights": weights, "adam": adam, "multipliers": self.multipliers}

    def load_state_dict(self, state):
        """Continue exactly from there."""
        self.network.load_state_dict({name: torch.as_tensor(it) for name, it in state["weights"].items()})
        for one, saved in zip(self.network.parameters(), state["adam"], strict=False):  # empty at the start
            self.optimiser.state[one] = {key: torch.as_tensor(it) for key, it in saved.items()}
        self.multipliers = np.array(state["multipliers"])

    def _logits(self, observations):
        with torch.no_grad():
            return self.network(torch.as_tensor(observations)).numpy()


OWN_NETWORK = AgentEntry("Policy gradients with a network of one's own.", OwnNetworkConfig, OwnNetwork)
