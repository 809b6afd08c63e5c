"""Conjugate gradients and the line search."""

import numpy as np
import pytest
import torch

from recrl.agents.networks.flat_parameters import FlatParameters
from recrl.agents.trust_region.conjugate_gradient import conjugate_gradient
from recrl.agents.trust_region.line_search import backtrack


def test_conjugate_gradients_solve_a_system_in_as_many_steps_as_it_has_unknowns() -> None:
    root = torch.randn(6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matrix = root @ root.T + torch.eye(6)
    target = torch.arange(1.0, 7.0, dtype=torch.float64)
    found = conjugate_gradient(lambda vector: matrix @ vector, target, iterations=6)
    np.testing.assert_allclose(found.numpy(), np.linalg.solve(matrix.numpy(), target.numpy()), rtol=1e-6)


def test_conjugate_gradients_of_nothing_are_nothing() -> None:
    found = conjugate_gradient(lambda vector: 2.0 * vector, torch.zeros(3), iterations=10)
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


def test_where_nothing_is_acceptable_the_old_parameters_stand() -> None:
    parameters = parameters_at(1.0)
    assert backtrack(parameters, torch.tensor([8.0]), lambda: False, ratio=0.5, tries=5) is None
    assert parameters.values.item() == 1.0
