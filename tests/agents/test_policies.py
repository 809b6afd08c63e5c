"""Policies: their distributions, sampling, noise, and the trust region's metric."""

import copy

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, Space
from torch import Tensor

from recrl.agents.building_blocks.distributions import Categorical, Gaussian, mean_divergence
from recrl.agents.building_blocks.noise_scales import matching_log_std, matching_scale, off_greedy_mass
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.policy_families import GaussianPolicy, make_policy
from recrl.agents.networks.architecture import NetworkArchitecture, orthogonal
from recrl.agents.networks.tanh_stack import TanhStack
from recrl.agents.trust_region.fisher_metric import FisherMetric

FORM = NetworkArchitecture((5, 4), orthogonal)
THREE_ACTIONS = Discrete(3)
TWO_COMPONENTS = Box(np.array([-1.0, -2.0], np.float32), np.array([1.0, 2.0], np.float32))
SPACES = [THREE_ACTIONS, TWO_COMPONENTS]


def policy_for(space: Space[object], last_scale: float = 1.0) -> StochasticPolicy:
    return make_policy(3, space, FORM, last_scale, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("space", SPACES)
def test_a_copy_acts_with_its_own_parameters(space: Space[object]) -> None:
    policy = policy_for(space)
    copied = copy.deepcopy(policy)
    rows = random_rows().numpy()
    before = policy.sample(rows, np.random.default_rng(0)).tolist()
    copied.parameters.values.mul_(-2.0)
    copied.publish()
    expected = policy_for(space)
    expected.parameters.values.mul_(-2.0)
    expected.publish()
    own = [it.sample(rows, np.random.default_rng(0)).tolist() for it in (policy, copied, expected)]
    assert own == [before, own[2], own[2]]
    assert copied.mode(rows).tolist() == expected.mode(rows).tolist() != policy.mode(rows).tolist()


def random_rows(count: int = 6) -> Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(5))


def test_categorical_quantities_are_those_computed_by_hand() -> None:
    half = Categorical(torch.log(torch.tensor([[0.5, 0.5]])))
    skewed = Categorical(torch.log(torch.tensor([[0.25, 0.75]])))
    assert half.entropy().item() == pytest.approx(np.log(2.0))
    assert half.divergence(skewed).item() == pytest.approx(0.5 * np.log(2.0) + 0.5 * np.log(2.0 / 3.0))
    assert skewed.log_prob(torch.tensor([1, 0]), torch.tensor([0, 0])).exp().tolist() == pytest.approx(
        [0.75, 0.25]
    )
    # diag(p) - p p^T times (1, 0)
    assert skewed.fisher(torch.tensor([[1.0, 0.0]]))[0].tolist() == pytest.approx([0.1875, -0.1875])


def test_gaussian_quantities_are_those_computed_by_hand() -> None:
    narrow = Gaussian(torch.tensor([[0.0, 0.0]]), torch.zeros(2))
    wide = Gaussian(torch.tensor([[1.0, 0.0]]), torch.log(torch.tensor([2.0, 1.0])))
    assert narrow.entropy().item() == pytest.approx(np.log(2.0 * np.pi * np.e))
    # summed over the components: log 2 + (1 + 1) / 8 - 1 / 2, and nothing for the second
    assert narrow.divergence(wide).item() == pytest.approx(np.log(2.0) + 0.25 - 0.5)
    assert narrow.log_prob(torch.tensor([[1.0, 2.0]]), None).item() == pytest.approx(
        -2.5 - np.log(2.0 * np.pi)
    )
    assert wide.fisher(torch.tensor([[1.0, 1.0]]))[0].tolist() == pytest.approx([0.25, 1.0])


@pytest.mark.parametrize("space", SPACES)
def test_numpy_and_pytorch_evaluate_one_policy(space: Space[object]) -> None:
    policy, rows = policy_for(space), random_rows()
    distribution = policy.distribution(rows)
    outputs = torch.from_numpy(policy.outputs(rows.numpy()))
    if isinstance(distribution, Categorical):
        torch.testing.assert_close(torch.log_softmax(outputs, dim=1), distribution.log_probs)
    else:
        torch.testing.assert_close(outputs, distribution.mean)


def test_sampled_actions_have_the_policys_probabilities() -> None:
    policy = policy_for(THREE_ACTIONS, last_scale=3.0)
    observation = random_rows(1)
    actions = policy.sample(observation.repeat(40_000, 1).numpy(), np.random.default_rng(0))
    distribution = policy.distribution(observation)
    assert isinstance(distribution, Categorical)
    expected = distribution.log_probs.exp()[0].numpy()
    assert actions.dtype == np.int64
    np.testing.assert_allclose(np.bincount(actions, minlength=3) / len(actions), expected, atol=0.01)


def test_sampled_gaussian_actions_have_the_policys_moments() -> None:
    policy = policy_for(TWO_COMPONENTS)
    observation = random_rows(1)
    actions = policy.sample(observation.repeat(40_000, 1).numpy(), np.random.default_rng(0))
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions.mean(axis=0), policy.mode(observation.numpy())[0], atol=0.02)
    np.testing.assert_allclose(actions.std(axis=0), np.exp(-0.5), rtol=0.02)


def test_a_sure_policy_never_does_anything_else() -> None:
    policy = policy_for(THREE_ACTIONS)
    assert isinstance(policy.stack, TanhStack)
    policy.stack.biases[-1].copy_(torch.tensor([[[0.0, 500.0, 0.0]]]))
    actions = policy.sample(random_rows(1000).numpy(), np.random.default_rng(0))
    assert set(actions.tolist()) == {1}


def test_the_mode_is_the_most_likely_action() -> None:
    policy, rows = policy_for(THREE_ACTIONS), random_rows()
    distribution = policy.distribution(rows)
    assert isinstance(distribution, Categorical)
    assert policy.mode(rows.numpy()).tolist() == distribution.log_probs.argmax(dim=1).tolist()


def divergence_of(policy: StochasticPolicy, flat: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """The mean KL from the policy to the one with the parameters ``flat``, evaluated independently."""
    tensors = policy.parameters.pieces(flat)
    hidden = rows
    for layer in range(3):
        hidden = hidden @ tensors[layer][0, :-1] + tensors[layer][0, -1]
        if layer < 2:
            hidden = torch.tanh(hidden)
    new = (
        Categorical(torch.log_softmax(hidden, dim=1)) if len(tensors) == 3 else Gaussian(hidden, tensors[-1])
    )
    return mean_divergence(policy.distribution(rows), new, weights)


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("space", SPACES)
def test_the_fisher_metric_is_the_hessian_of_the_divergence(space: Space[object]) -> None:
    policy, rows = policy_for(space), random_rows()
    weights = torch.arange(1.0, 7.0) / 21.0
    hessian = torch.autograd.functional.hessian(  # type: ignore[no-untyped-call]
        lambda flat: divergence_of(policy, flat, rows, weights), policy.parameters.values.clone()
    )
    vector = torch.randn(len(hessian), generator=torch.Generator().manual_seed(1))
    metric = FisherMetric(policy, rows, weights, damping=0.1)
    torch.testing.assert_close(metric(vector), hessian @ vector + 0.1 * vector)


@pytest.mark.parametrize("noise", [0.01, 0.3, 1.0])
def test_noise_makes_a_policy_as_random_as_its_mixture_with_a_uniform_one(noise: float) -> None:
    logits = np.array([[0.0, 30.0, 1.0], [5.0, 0.0, -4.0]])
    weights = np.array([0.25, 0.75])
    mass = off_greedy_mass(logits, weights)
    wanted = (1.0 - noise) * mass + noise * 2.0 / 3.0
    scale = matching_scale(logits, weights, noise)
    assert off_greedy_mass(scale * logits, weights) == pytest.approx(wanted, abs=1e-9)


def test_off_greedy_mass_is_that_computed_by_hand() -> None:
    logits = np.log(np.array([[0.5, 0.25, 0.25], [0.1, 0.8, 0.1]]))
    assert off_greedy_mass(logits, np.array([0.3, 0.7])) == pytest.approx(0.3 * 0.5 + 0.7 * 0.2)


def test_observations_that_repeat_count_as_often_as_they_do() -> None:
    rows = random_rows().numpy()
    repeated = np.concatenate([rows[[0] * 30], rows[[1] * 10]])
    one, other = policy_for(THREE_ACTIONS, last_scale=5.0), policy_for(THREE_ACTIONS, last_scale=5.0)
    masses = [off_greedy_mass(one.outputs(row[None]).astype(np.float64), np.ones(1)) for row in rows[:2]]
    metrics = one.add_noise(0.3, repeated, "match-mixture")
    assert metrics["randomness_before"] == pytest.approx(0.75 * masses[0] + 0.25 * masses[1])
    jittered = repeated + np.random.default_rng(0).normal(0.0, 1e-7, repeated.shape).astype(np.float32)
    assert other.add_noise(0.3, jittered, "match-mixture") == pytest.approx(metrics, rel=1e-4)


def test_noise_never_sharpens_a_policy() -> None:
    assert matching_scale(np.zeros((4, 3)), np.full(4, 0.25), 0.3) == pytest.approx(1.0)
    wide = np.log(np.array([10.0]))
    assert matching_log_std(wide, 0.5) == pytest.approx(wide)


def test_gaussian_noise_gives_the_variance_of_the_mixture() -> None:
    found = matching_log_std(np.log(np.array([0.1, 0.2])), 0.3)
    assert np.exp(2.0 * found) == pytest.approx([0.7 * 0.01 + 0.3 / 3.0, 0.7 * 0.04 + 0.3 / 3.0])


def test_gaussian_noise_of_many_components_is_as_long_as_that_of_two() -> None:
    found = matching_log_std(np.full(8, np.log(0.1)), 0.3)
    assert np.exp(2.0 * found) == pytest.approx(np.full(8, 0.7 * 0.01 + 0.025))  # 8 x 0.025 = 2 x 0.3 / 3


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("form", ["match-mixture", "temperature"])
def test_noise_makes_a_policy_more_random(space: Space[object], form: str) -> None:
    policy, rows = policy_for(space, last_scale=5.0), random_rows()
    if isinstance(policy, GaussianPolicy):
        policy.log_std.fill_(-3.0)
    before = float(policy.distribution(rows).entropy().mean())
    metrics = policy.add_noise(0.3, rows.numpy(), form)
    assert set(metrics) == {"noise_scale", "randomness_before", "randomness_after"}
    assert metrics["randomness_after"] > metrics["randomness_before"]
    assert float(policy.distribution(rows).entropy().mean()) > before


@pytest.mark.parametrize(("noise", "scale"), [(0.3, 0.7), (1.0, 0.0)])
def test_a_temperature_scales_logits_by_what_noise_leaves(noise: float, scale: float) -> None:
    policy, rows = policy_for(THREE_ACTIONS, last_scale=5.0), random_rows()
    before = policy.outputs(rows.numpy())
    assert policy.add_noise(noise, rows.numpy(), "temperature")["noise_scale"] == pytest.approx(scale)
    policy.publish()
    np.testing.assert_allclose(policy.outputs(rows.numpy()), scale * before, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("noise", "scale"), [(0.3, 1.0 / 0.7), (1.0, 1000.0)])
def test_a_temperature_divides_standard_deviations_by_what_noise_leaves(noise: float, scale: float) -> None:
    policy = policy_for(TWO_COMPONENTS)
    assert isinstance(policy, GaussianPolicy)
    before = policy.log_std.exp().clone()
    metrics = policy.add_noise(noise, random_rows().numpy(), "temperature")
    assert metrics["noise_scale"] == pytest.approx(scale, rel=1e-5)
    torch.testing.assert_close(policy.log_std.exp(), scale * before)


def test_the_strongest_noise_is_that_of_uniform_actions() -> None:
    policy = policy_for(TWO_COMPONENTS)
    assert isinstance(policy, GaussianPolicy)
    policy.log_std.fill_(-5.0)
    policy.add_noise(1.0, random_rows().numpy(), "match-mixture")
    assert policy.log_std.exp().tolist() == pytest.approx([3.0**-0.5] * 2)


def bounded_policy(stds: list[float]) -> GaussianPolicy:
    space = Box(-1.0, 1.0, (len(stds),))
    policy = GaussianPolicy(3, space, FORM, 1.0, torch.Generator().manual_seed(0), min_std=0.5)
    policy.log_std.copy_(torch.log(torch.tensor(stds)))
    return policy


@pytest.mark.parametrize(
    ("before", "after"), [([0.1], [0.5]), ([0.7, 0.1], [0.7, 0.5]), ([0.3] + [0.1] * 7, [0.3] + [0.25] * 7)]
)
def test_standard_deviations_are_raised_to_their_bound(before: list[float], after: list[float]) -> None:
    policy = bounded_policy(before)
    policy.bound_std()
    assert policy.log_std.exp().tolist() == pytest.approx(after)


def test_a_standard_deviation_at_its_bound_is_held_if_an_ascent_would_lower_it() -> None:
    policy = bounded_policy([0.25] * 3 + [0.6] + [0.25] * 4)
    gradients = torch.ones(2, len(policy.parameters.values))
    ascents = torch.zeros_like(gradients)
    ascents[:, -8:] = torch.tensor([[-1.0, 1.0, 1.0, -1.0] + [0.0] * 4, [0.0, -1.0, 1.0, -1.0] + [0.0] * 4])
    policy.hold_bounded_std(gradients, ascents)
    assert gradients[:, -8:].tolist() == [[0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]] * 2
    assert bool((gradients[:, :-8] == 1.0).all())


@pytest.mark.parametrize("space", SPACES)
def test_a_new_policy_acts_as_it_learns_where_acting_uses_a_copy(
    space: Space[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    def policy() -> StochasticPolicy:  # the first standard deviation is 0.61
        return make_policy(3, space, FORM, 1.0, torch.Generator().manual_seed(0), min_std=0.9)

    rows, expected = random_rows().numpy(), policy()
    monkeypatch.setattr(Tensor, "cpu", Tensor.clone)  # as on a GPU
    found = policy()
    first, second = (each.sample(rows, np.random.default_rng(1)) for each in (expected, found))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("space", SPACES)
def test_without_a_bound_the_parameters_stay(space: Space[object]) -> None:
    policy = policy_for(space)
    before = policy.parameters.to_numpy()
    policy.bound_std()
    np.testing.assert_array_equal(policy.parameters.to_numpy(), before)


def test_probabilities_are_the_distributions() -> None:
    policy, rows = policy_for(THREE_ACTIONS), random_rows()
    expected = torch.stack(
        [policy.distribution(rows).log_prob(torch.full((6,), action), None).exp() for action in range(3)], 1
    )
    np.testing.assert_allclose(policy.probabilities(rows.numpy()), expected, rtol=1e-5)


def test_continuous_actions_have_no_probabilities() -> None:
    with pytest.raises(ValueError, match="continuous actions have densities, not probabilities"):
        policy_for(TWO_COMPONENTS).probabilities(random_rows().numpy())


@pytest.mark.parametrize("space", SPACES)
def test_what_is_asked_for_again_is_not_computed_again_and_a_policy_that_moved_is(
    space: Space[object],
) -> None:
    policy, rows = policy_for(space), random_rows()
    before = policy.distribution(rows)
    assert policy.distribution(rows) is before
    policy.parameters.values.add_(0.1)
    after = policy.distribution(rows)
    assert float(mean_divergence(before, after, torch.full((6,), 1.0 / 6.0))) > 0.0
    # neither for equal parameters nor for equal rows that are others is anything taken over
    torch.testing.assert_close(policy.distribution(rows.clone()).entropy(), after.entropy())
    policy.parameters.values.sub_(0.1)
    torch.testing.assert_close(policy.distribution(rows).entropy(), before.entropy())
