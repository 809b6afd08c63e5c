"""A policy and what it did, for the tests of one update."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium.spaces import Space

from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.policy_families import make_policy
from recrl.agents.networks.architecture import NetworkArchitecture, orthogonal
from recrl.environments.cmdp import Floats

NUM_SAMPLES = 400


def sampled(space: Space[object]) -> tuple[StochasticPolicy, LearningBatch, Floats]:
    """A policy, what it did, and advantages: the reward likes what the first cost dislikes."""
    generator = np.random.default_rng(0)
    policy = make_policy(
        3, space, NetworkArchitecture((8, 8), orthogonal), 0.1, torch.Generator().manual_seed(0)
    )
    observations = generator.normal(size=(NUM_SAMPLES, 3)).astype(np.float32)
    actions = policy.sample(observations, generator)
    liked = actions.astype(np.float64) if actions.ndim == 1 else actions[:, 0].astype(np.float64)
    advantages = np.stack([liked, 0.8 * liked, observations[:, 1] * liked], axis=1)
    return policy, LearningBatch.deduplicate(observations, actions, compact=True), advantages
