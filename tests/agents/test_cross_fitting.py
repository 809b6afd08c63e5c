"""What samples that did not choose a step confirm of it: against both halves' own algebra, and laws."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete

from recrl.agents.algorithms.cpo import ConstrainedPolicyOptimisation, LocalModel
from recrl.agents.algorithms.pcpo import ProjectionBasedConstrainedPolicyOptimisation
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.config import CPOConfig, PCPOConfig
from recrl.agents.constraints.cross_fitting import MEMORY, SMALLEST_SHARE, KeptShares, confirmed, halves
from recrl.agents.experience import Constraints, Experience
from recrl.agents.learning.actor_critic import fresh_student, improve_and_measure
from recrl.agents.learning.batch import LearningBatch
from recrl.agents.learning.networks import NetworkForm, orthogonal
from recrl.agents.learning.policies import StochasticPolicy
from recrl.agents.trust_region.cpo_dual import StepCase
from recrl.agents.trust_region.line_search import conjugate_gradient
from recrl.environments.cmdp import Floats
from recrl.environments.registry import make_vector

LENGTH = 10.0


@pytest.mark.parametrize(("num_samples", "num_envs"), [(12, 4), (12, 3), (12, 1), (7, 1), (10, 2)])
def test_both_halves_are_there_and_an_environment_is_in_one(num_samples: int, num_envs: int) -> None:
    signs = halves(num_samples, num_envs)
    assert set(signs) == {-1.0, 1.0}
    if num_envs > 1:
        assert all(len(set(signs[index::num_envs])) == 1 for index in range(num_envs))


@pytest.mark.parametrize("num_envs", [4, 3, 1])
def test_what_is_confirmed_is_the_product_of_the_halves(num_envs: int) -> None:
    """Gradients of 12 samples in 5 parameters, and a metric: b_A.H^-1 b_B, each half's mean by itself."""
    generator = np.random.default_rng(0)
    samples = generator.normal(size=(12, 5))
    root = generator.normal(size=(5, 5))
    metric = root @ root.T + np.eye(5)
    signs = halves(12, num_envs)
    whole, contrast = samples.mean(axis=0), (signs[:, None] * samples).mean(axis=0)
    first, second = samples[signs > 0].mean(axis=0), samples[signs < 0].mean(axis=0)
    squares = [np.array([vector @ np.linalg.solve(metric, vector)]) for vector in (whole, contrast)]
    expected = first @ np.linalg.solve(metric, second)
    assert confirmed(squares[0], squares[1], signs) == pytest.approx([expected], rel=1e-12)


def test_the_promise_is_too_good_by_the_noise_and_the_confirmation_is_not() -> None:
    """E[b.b] = beta.beta + P sigma^2 / N, E[confirmed] = beta.beta, for N samples in P parameters, H = 1."""
    generator = np.random.default_rng(1)
    beta, num_samples, rounds = np.array([0.2, 0.0, 0.1]), 20, 20_000
    samples = beta + generator.normal(size=(rounds, num_samples, 3))
    signs = halves(num_samples, 4)
    promised = np.square(samples.mean(axis=1)).sum(axis=1)
    contrasts = np.square((signs[:, None] * samples).mean(axis=1)).sum(axis=1)
    kept = confirmed(promised, contrasts, signs)
    for found, expected in ((promised, 0.05 + 3 / num_samples), (kept, 0.05)):
        assert abs(found.mean() - expected) < 4.0 * found.std() / np.sqrt(rounds)


def test_a_single_sample_confirms_nothing() -> None:
    assert confirmed(np.array([2.0]), np.array([2.0]), halves(1, 1)).tolist() == [0.0]


def test_shares_are_ratios_of_averages_within_their_bounds() -> None:
    shares = KeptShares(3)
    index = np.array([0, 2])
    assert shares.learn(index, np.array([4.0, 2.0]), np.array([1.0, 3.0])).tolist() == [0.25, 1.0]
    found = shares.learn(index, np.array([4.0, 2.0]), np.array([3.0, -9.0]))
    assert found.tolist() == pytest.approx([(MEMORY * 1 + 3) / (MEMORY * 4 + 4), SMALLEST_SHARE])
    assert shares.learn(np.array([1]), np.zeros(1), np.zeros(1)).tolist() == [1.0]


def sampled(*, noise: bool) -> tuple[StochasticPolicy, LearningBatch, Floats]:
    """A policy with more parameters than there are samples, in two environments.

    The cost's advantages are noise; or both environments saw the same, and it is the action that costs.
    """
    generator = np.random.default_rng(0)
    form = NetworkForm((16, 16), orthogonal)
    policy = StochasticPolicy(3, Discrete(3), form, 0.1, torch.Generator().manual_seed(0))
    observations = generator.normal(size=(100, 3)).astype(np.float32)
    actions = policy.sample(observations, generator)
    cost = actions - 1.0
    if noise:
        cost = generator.normal(size=100)
    else:
        observations[1::2], actions[1::2], cost[1::2] = observations[::2], actions[::2], cost[::2]
    advantages = np.stack([generator.normal(size=100), cost], axis=1)
    return policy, LearningBatch.gather(observations, actions, compact=False), advantages


def improve(
    *, noise: bool, gap: float, cross_fitting: bool, name: str = "cpo"
) -> tuple[dict[str, float], Floats]:
    """The metrics of one update, and the policy's parameters after it."""
    policy, batch, advantages = sampled(noise=noise)
    constraints = Constraints(np.array([5.0]), np.array([gap]), np.zeros(1), LENGTH)
    experience = Experience.of(policy, batch, advantages, constraints, num_envs=2)
    options: dict[str, Any] = {"cross_fitting": cross_fitting}
    rule = (
        ConstrainedPolicyOptimisation(CPOConfig(**options), num_costs=1)
        if name == "cpo"
        else ProjectionBasedConstrainedPolicyOptimisation(PCPOConfig(**options), num_costs=1)
    )
    metrics = improve_and_measure(rule, policy, experience, np.random.default_rng(0))
    return metrics, policy.parameters.to_numpy().astype(np.float64)


def test_noise_promises_to_mend_a_violation_and_is_not_believed() -> None:
    believed, _ = improve(noise=True, gap=0.2, cross_fitting=False)
    assert StepCase(int(believed["case"])) is StepCase.CONSTRAINED
    judged, _ = improve(noise=True, gap=0.2, cross_fitting=True)
    assert judged["kept_share_0"] < 0.2
    assert StepCase(int(judged["case"])) is StepCase.RECOVERY
    assert judged["surrogate_cost_0"] < believed["surrogate_cost_0"]


@pytest.mark.parametrize("gap", [0.1, -0.1])
@pytest.mark.parametrize("name", ["cpo", "pcpo"])
def test_where_both_halves_agree_the_step_is_the_same(name: str, gap: float) -> None:
    plain, expected = improve(noise=False, gap=gap, cross_fitting=False, name=name)
    judged, found = improve(noise=False, gap=gap, cross_fitting=True, name=name)
    assert judged.pop("kept_share_0") == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert judged == pytest.approx(plain, rel=1e-2, abs=1e-4)


@pytest.mark.parametrize("compact", [False, True])
def test_the_share_is_that_of_the_cost_that_has_a_limit(compact: bool) -> None:
    """Of two costs the second alone is limited; halves of one and two environments, each by itself."""
    policy, _, _ = sampled(noise=True)
    generator = np.random.default_rng(1)
    observations = generator.integers(0, 4, size=(99, 3)).astype(np.float32)
    actions = policy.sample(observations, generator)
    liked = (actions - 1.0) + generator.normal(size=99)
    advantages = np.stack([generator.normal(size=99), generator.normal(size=99), liked], axis=1)
    advantages -= advantages.mean(axis=0)
    batch = LearningBatch.gather(observations, actions, compact=compact)
    assert (batch.row_of_sample is not None) == compact
    constraints = Constraints(np.array([np.inf, 5.0]), np.array([-np.inf, 1.0]), np.zeros(2), LENGTH)
    experience = Experience.of(policy, batch, advantages, constraints, num_envs=3)
    config = CPOConfig(cross_fitting=True, conjugate_gradient_steps=200, metric_samples=None)
    signs = halves(99, 3)
    own = [
        LocalModel(policy, experience, advantages[:, 2:] * which[:, None]).gradients()[0]
        for which in (np.ones(99), (signs > 0) * 3.0, (signs < 0) * 1.5)
    ]
    metric = LocalModel(policy, experience, advantages).metric(config, generator)
    solved = [conjugate_gradient(metric, each, iterations=200) for each in own]
    expected = float(own[1] @ solved[2]) / float(own[0] @ solved[0])
    rule = ConstrainedPolicyOptimisation(config, num_costs=2)
    metrics = improve_and_measure(rule, policy, experience, np.random.default_rng(0))
    assert np.isnan(metrics["kept_share_0"])
    assert 0.01 < expected < 0.99
    assert metrics["kept_share_1"] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("num_envs", [2, 5])
def test_a_rule_knows_which_samples_are_of_one_environment(num_envs: int) -> None:
    seen: list[Experience] = []

    class Looking(ConstrainedPolicyOptimisation):
        def improve(
            self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
        ) -> dict[str, float]:
            seen.append(experience)
            return super().improve(policy, experience, generator)

    environments = make_vector("continuous-bandit", num_envs)
    student = fresh_student(
        environments.cmdp, CPOConfig(), np.random.SeedSequence(0), lambda _: Looking(CPOConfig(), num_costs=1)
    )
    collector = Collector(environments, num_steps=8)
    collector.reset(seed=0)
    rollout, episodes = collector.collect(student, np.random.default_rng(0))
    student.update(rollout, episode_costs(episodes, 1), np.array([1.0]))
    assert [each.num_envs for each in seen] == [num_envs]
    actions = seen[0].batch.actions.numpy().reshape(-1, 1)
    np.testing.assert_array_equal(actions[1::num_envs], rollout.actions[:, 1].reshape(-1, 1))


def test_a_limit_that_is_kept_is_taken_as_it_is() -> None:
    plain, expected = improve(noise=True, gap=-0.5, cross_fitting=False)
    judged, found = improve(noise=True, gap=-0.5, cross_fitting=True)
    np.testing.assert_array_equal(found, expected)
    assert judged.pop("kept_share_0") < 1.0
    assert judged == plain
