"""The gradient of every loss of every agent against finite differences, in float64, through the network."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, Space

from recrl.agents.algorithms.focops import projection_objective
from recrl.agents.algorithms.ipo import barrier_surrogate_objective
from recrl.agents.algorithms.own_options import IPOConfig
from recrl.agents.algorithms.p3o import penalised_surrogate_objective
from recrl.agents.algorithms.ppo_lag import combined_surrogate_objective, separate_surrogate_objective
from recrl.agents.building_blocks.distributions import Distribution
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.policy_families import make_policy
from recrl.agents.building_blocks.surrogates import SignedAdvantages, clipped_surrogate, surrogate
from recrl.agents.constraints.relative_units import RelativeConstraints, RelativeUnits
from recrl.agents.experience import Constraints, Experience
from recrl.agents.learning.gradient_ascent import Objective, with_entropy
from recrl.agents.networks import tanh_stack
from recrl.agents.networks.architecture import NetworkArchitecture, orthogonal
from recrl.agents.networks.flat_parameters import FlatParameters
from recrl.environments.cmdp import Floats

SPACES = [Discrete(3), Box(-1.0, 1.0, (2,))]
FORM = NetworkArchitecture((5, 4), orthogonal)
CLIP = 0.1
STEP = 1e-6


pytestmark = pytest.mark.usefixtures("double_precision")


def moved_policy(space: Space[object], compact: bool) -> tuple[StochasticPolicy, Experience]:
    """A policy that has moved so far that some ratios are clipped, and what it was before."""
    generator = np.random.default_rng(0)
    policy = make_policy(3, space, FORM, 1.0, torch.Generator().manual_seed(0))
    observations = generator.normal(size=(8, 3))[generator.integers(8, size=30)]
    actions = policy.sample(observations, generator)  # type: ignore[arg-type]
    batch = LearningBatch.deduplicate(observations, actions, compact=compact)  # type: ignore[arg-type]
    constraints = Constraints(np.array([1.0, 1.0]), np.array([0.3, -0.5]), np.zeros(2), 2.0)
    advantages = generator.normal(size=(30, 3))
    experience = Experience.of(policy, batch, advantages, constraints)
    policy.parameters.values.add_(0.1 * torch.randn(len(policy.parameters.values)))
    return policy, experience


def of_ratios(gain: Callable[[torch.Tensor], torch.Tensor]) -> Objective:
    return lambda _, ratios: gain(ratios)


def clipped(experience: Experience) -> Objective:
    signed = SignedAdvantages.split(experience.batch, experience.advantages[:, 0])
    return with_entropy(partial(clipped_surrogate, advantages=signed, clip=CLIP), experience.batch, 0.3)


def plain(experience: Experience) -> Objective:
    return of_ratios(partial(surrogate, advantages=experience.batch.per_pair(experience.advantages[:, 1])))


def lagrangian(
    experience: Experience, gain: Callable[..., Callable[[torch.Tensor], torch.Tensor]]
) -> Objective:
    active = RelativeConstraints.of(experience, RelativeUnits(2))
    return of_ratios(gain(experience.batch, active.rewards, active.costs, np.array([2.0, 0.5]), CLIP))


def p3o(experience: Experience) -> Objective:
    active = RelativeConstraints.of(experience, RelativeUnits(2))
    gain = penalised_surrogate_objective(
        experience.batch, active.rewards, active.costs, active.violations, clip=CLIP, factor=5.0
    )
    return of_ratios(lambda ratios: gain(ratios)[0])


def ipo(experience: Experience) -> Objective:
    config = IPOConfig(barrier_sharpness=10.0, clip=CLIP)
    active = RelativeConstraints.of(experience, RelativeUnits(2))
    gain = barrier_surrogate_objective(
        experience.batch, active.rewards, active.costs, active.violations, config
    )
    return of_ratios(lambda ratios: gain(ratios)[0])


def focops(experience: Experience) -> Objective:
    return projection_objective(experience, experience.advantages[:, 0], focops_lambda=0.5, radius=0.2)


OBJECTIVES: dict[str, Callable[[Experience], Objective]] = {
    "ppo": clipped,
    "trust region": plain,
    "ppo-lag combined": partial(lagrangian, gain=combined_surrogate_objective),
    "ppo-lag separate": partial(lagrangian, gain=separate_surrogate_objective),
    "p3o": p3o,
    "ipo": ipo,
    "focops": focops,
}


def differences(parameters: FlatParameters, value: Callable[[], float]) -> Floats:
    """The central differences of a function of the parameters, [P]."""
    found = np.zeros(len(parameters.values))
    for index in range(len(found)):
        start = float(parameters.values[index])
        ends = []
        for change in (STEP, -STEP):
            parameters.values[index] = start + change
            ends.append(value())
        parameters.values[index] = start
        found[index] = (ends[0] - ends[1]) / (2.0 * STEP)
    return found


@pytest.mark.parametrize("compact", [True, False])
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", OBJECTIVES)
def test_an_objectives_gradient_is_its_finite_differences(
    name: str, space: Space[object], compact: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tanh_stack, "BLOCK_ROWS", 7)
    torch.manual_seed(0)
    policy, experience = moved_policy(space, compact)
    objective = OBJECTIVES[name](experience)

    def of_policy(distribution: Distribution) -> torch.Tensor:
        return objective(distribution, experience.ratios(distribution))

    now = policy.evaluate(experience.batch.unique_observations)
    ratios = experience.ratios(now.distribution)
    assert float(ratios.detach().max()) > 1.0 + CLIP and float(ratios.detach().min()) < 1.0 - CLIP
    exact = now.gradient(of_policy(now.distribution)).clone().numpy()
    expected = differences(
        policy.parameters, lambda: float(of_policy(policy.distribution(experience.batch.unique_observations)))
    )
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(exact, expected, atol=1e-7)
