"""Conjugate gradients and the line search."""

import math

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from recrl.agents.algorithms.own_options import TRPOConfig
from recrl.agents.building_blocks.policy_families import GaussianPolicy
from recrl.agents.networks.architecture import NetworkArchitecture, orthogonal
from recrl.agents.networks.flat_parameters import FlatParameters
from recrl.agents.trust_region.conjugate_gradient import conjugate_gradient
from recrl.agents.trust_region.line_search import backtrack, line_search


def test_conjugate_gradients_solve_a_system_in_as_many_steps_as_it_has_unknowns() -> None:
    root = torch.randn(6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matrix = root @ root.T + torch.eye(6)
    target = torch.arange(1.0, 7.0, dtype=torch.float64)
    found = conjugate_gradient(lambda vector: matrix @ vector, target, iterations=6)
    np.testing.assert_allclose(found.numpy(), np.linalg.solve(matrix.numpy(), target.numpy()), rtol=1e-6)


def test_conjugate_gradients_of_nothing_are_nothing() -> None:
    found = conjugate_gradient(lambda vector: 2.0 * vector, torch.zeros(3), iterations=10)
    assert found.tolist() == [0.0, 0.0, 0.0]


def test_conjugate_gradients_of_a_metric_that_is_0_give_no_step() -> None:
    found = conjugate_gradient(torch.zeros_like, torch.ones(3), iterations=10)
    assert found.tolist() == [0.0, 0.0, 0.0]


def test_conjugate_gradients_bear_a_saturated_policys_tiny_gradients() -> None:
    matrix = torch.diag(torch.tensor([1.0, 2.0, 4.0]))
    found = conjugate_gradient(lambda vector: matrix @ vector, torch.full((3,), 1e-14), iterations=10)
    assert (found * 1e14).tolist() == pytest.approx([1.0, 0.5, 0.25], rel=1e-5)


def parameters_at(value: float) -> FlatParameters:
    parameters = FlatParameters([(1,)])
    parameters.values.fill_(value)
    return parameters


def test_the_longest_acceptable_step_is_taken() -> None:
    parameters = parameters_at(1.0)
    shortened = backtrack(
        parameters, torch.tensor([8.0]), lambda: parameters.values.item() <= 4.0, ratio=0.5, tries=5
    )
    assert shortened == 2
    assert parameters.values.item() == pytest.approx(3.0)


def test_a_step_is_projected_before_it_is_checked() -> None:
    parameters, checked = parameters_at(1.0), []

    def project() -> None:
        parameters.values.clamp_(min=-5.0)

    def is_acceptable() -> bool:
        checked.append(parameters.values.item())
        return len(checked) == 2

    shortened = backtrack(
        parameters,
        torch.tensor([-8.0]),
        is_acceptable,
        ratio=0.5,
        tries=5,
        project=project,
    )
    assert (shortened, checked, parameters.values.item()) == (1, [-5.0, -3.0], -3.0)


def test_the_line_search_checks_policies_with_their_standard_deviations_at_the_bound() -> None:
    policy = GaussianPolicy(
        3, Box(-1.0, 1.0, (2,)), NetworkArchitecture((4,), orthogonal), 1.0, torch.Generator(), min_std=0.5
    )
    step, checked = torch.zeros_like(policy.parameters.values), []
    step[-2:] = torch.tensor([-9.0, 0.25])

    def is_acceptable() -> bool:
        checked.append(policy.log_std.exp().tolist())
        return True

    line_search(policy, step, is_acceptable, TRPOConfig())
    assert checked == [pytest.approx([0.5, math.exp(-0.25)])]


def test_where_nothing_is_acceptable_the_old_parameters_stand() -> None:
    parameters = parameters_at(1.0)
    assert backtrack(parameters, torch.tensor([8.0]), lambda: False, ratio=0.5, tries=5) is None
    assert parameters.values.item() == 1.0
