"""Entropy as a reward: advantages whose surrogate has the entropy's gradient."""

import math

import numpy as np
import pytest
import torch

from recrl.agents.building_blocks.distributions import Categorical, Distribution, Gaussian
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.surrogates import surrogate
from recrl.agents.experience import Constraints, Experience
from recrl.environments.cmdp import Floats

TEMPERATURE = 0.7


def experience_of(batch: LearningBatch, old: Distribution, num_samples: int) -> Experience:
    """Samples whose advantages are all 0, of the reward and of one cost."""
    constraints = Constraints(np.array([1.0]), np.array([0.0]), np.zeros(1), 1.0)
    log_probs = old.log_prob(batch.actions, batch.pair_observations)
    return Experience(batch, old, log_probs, np.zeros((num_samples, 2)), constraints)


def rewarded(experience: Experience) -> Floats:
    """The advantages with entropy, of the reward; those of the cost are as they were."""
    advantages = experience.with_entropy(TEMPERATURE).advantages
    assert not advantages[:, 1].any()
    assert not experience.advantages.any()
    return np.asarray(advantages[:, 0])


@pytest.mark.parametrize("compact", [True, False])
def test_a_less_likely_action_is_worth_more_by_hand(compact: bool) -> None:
    observations, actions = np.zeros((4, 1), np.float32), np.array([0, 0, 1, 2])
    batch = LearningBatch.deduplicate(observations, actions, compact=compact)
    probabilities = torch.tensor([[0.5, 0.25, 0.25]]).expand(len(batch.unique_observations), 3)
    found = rewarded(experience_of(batch, Categorical(probabilities.log()), 4))
    half = 0.5 * TEMPERATURE * math.log(2.0)  # H = 1.5 log 2; -log p is log 2, log 2, 2 log 2, 2 log 2
    assert found == pytest.approx([-half, -half, half, half], rel=1e-6)


def test_the_surrogate_climbs_the_entropy() -> None:
    """Of two observations, sampled exactly as often as the policy would: gradients by the logits."""
    shares = np.array([[0.5, 0.25, 0.25], [0.125, 0.75, 0.125]])
    counts = (8 * shares).astype(int)
    observations = np.repeat([[0.0], [1.0]], 8, axis=0).astype(np.float32)
    actions = np.concatenate([np.repeat(np.arange(3), row) for row in counts])
    batch = LearningBatch.deduplicate(observations, actions, compact=True)
    logits = torch.tensor(np.log(shares), dtype=torch.float32, requires_grad=True)
    now = Categorical(torch.log_softmax(logits, dim=1))
    experience = experience_of(batch, Categorical(now.log_probs.detach()), 16).with_entropy(TEMPERATURE)
    gain = surrogate(experience.ratios(now), batch.per_pair(experience.advantages[:, 0]))
    found = torch.autograd.grad(gain, logits, retain_graph=True)[0]
    expected = torch.autograd.grad(TEMPERATURE * torch.dot(batch.observation_weights, now.entropy()), logits)[
        0
    ]
    torch.testing.assert_close(found, expected)


def test_of_a_normal_action_the_surprise_is_half_of_z_squared_minus_1() -> None:
    actions = np.array([[0.0], [1.0], [-3.0]], np.float32)
    batch = LearningBatch.deduplicate(np.arange(3, dtype=np.float32)[:, None], actions, compact=True)
    old = Gaussian(torch.zeros(3, 1), torch.tensor([math.log(2.0)]))
    expected = TEMPERATURE * 0.5 * (np.array([0.0, 0.5, 1.5]) ** 2 - 1.0)
    assert rewarded(experience_of(batch, old, 3)) == pytest.approx(expected, rel=1e-5)
