"""Networks differentiated by hand against PyTorch's automatic differentiation, and Adam against PyTorch's."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from recrl.agents.building_blocks.critics import Critics
from recrl.agents.networks import tanh_stack
from recrl.agents.networks.architecture import INITIALISERS, NetworkArchitecture, orthogonal, xavier
from recrl.agents.networks.flat_parameters import Adam, FlatParameters
from recrl.agents.networks.tanh_stack import FEW_COLUMNS, TanhStack

# One layer wider than what add_product multiplies as rows, the others not.
SIZES = (3, FEW_COLUMNS + 2, 4, 2)


def stack_of(num_networks: int, seed: int = 0) -> tuple[FlatParameters, TanhStack]:
    parameters = FlatParameters(TanhStack.shapes(num_networks, SIZES))
    stack = TanhStack(parameters, len(SIZES) - 1)
    stack.initialise(orthogonal, 1.0, torch.Generator().manual_seed(seed))
    generator = torch.Generator().manual_seed(seed + 1)
    for bias in stack.biases:
        bias.normal_(generator=generator)
    return parameters, stack


def random_rows(count: int = 7, size: int = 3) -> Tensor:
    return torch.randn(count, size, generator=torch.Generator().manual_seed(5))


def one_by_one(flat: Tensor, parameters: FlatParameters, rows: Tensor) -> Tensor:
    """The outputs of each network evaluated on its own, as a differentiable function of all parameters."""
    tensors = parameters.pieces(flat)
    outputs = []
    for network in range(len(tensors[0])):
        hidden = rows
        for layer, tensor in enumerate(tensors):
            hidden = hidden @ tensor[network, :-1] + tensor[network, -1]
            if layer < len(tensors) - 1:
                hidden = torch.tanh(hidden)
        outputs.append(hidden)
    return torch.stack(outputs)


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("num_networks", [1, 3])
def test_a_stack_is_its_networks_evaluated_one_by_one(num_networks: int) -> None:
    parameters, stack = stack_of(num_networks)
    rows = random_rows()
    torch.testing.assert_close(stack.activations(rows)[-1], one_by_one(parameters.values, parameters, rows))


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("num_networks", [1, 3])
def test_both_products_with_the_jacobian_are_automatic_differentiations(num_networks: int) -> None:
    parameters, stack = stack_of(num_networks)
    rows = random_rows()
    change = torch.randn(len(parameters.values), generator=torch.Generator().manual_seed(2))
    slope = torch.randn(num_networks, 7, 2, generator=torch.Generator().manual_seed(3))
    jacobian = torch.autograd.functional.jacobian(  # type: ignore[no-untyped-call]
        lambda flat: one_by_one(flat, parameters, rows), parameters.values
    )
    activations = stack.activations(rows)
    moved = stack.output_change(activations, parameters.pieces(change))
    torch.testing.assert_close(moved, jacobian @ change)
    stack.pull_back(activations, slope)
    torch.testing.assert_close(parameters.gradient, torch.einsum("cuo,cuop->p", slope, jacobian))


@pytest.mark.usefixtures("double_precision")
def test_the_critics_gradient_is_that_of_their_weighted_squared_errors() -> None:
    critics = Critics(3, 1, NetworkArchitecture((5, 4), xavier), torch.Generator().manual_seed(0))
    rows = random_rows()
    weights = torch.arange(1.0, 8.0) / 28.0
    targets = torch.randn(2, 7, generator=torch.Generator().manual_seed(1))
    flat = critics.parameters.values.clone().requires_grad_()
    values = one_by_one(flat, critics.parameters, rows)[..., 0]
    expected = ((values - targets).square() * weights).sum(dim=1)
    losses = critics.differentiate(rows, weights, targets)
    torch.testing.assert_close(losses, expected.detach())
    torch.testing.assert_close(critics.parameters.gradient, torch.autograd.grad(expected.sum(), flat)[0])


def test_adam_is_pytorchs() -> None:
    parameters, _ = stack_of(2)
    reference = torch.nn.Parameter(parameters.values.clone())
    expected, ours = torch.optim.Adam([reference], lr=0.01, foreach=False), Adam(parameters, 0.01)
    generator = torch.Generator().manual_seed(0)
    for _ in range(30):
        gradient = torch.randn(len(reference), generator=generator)
        reference.grad = gradient.clone()
        parameters.gradient.copy_(gradient)
        expected.step()
        ours.step()
    assert torch.equal(parameters.values, reference.detach())


def test_adam_does_not_import_pytorchs_compiler() -> None:
    code = (
        "import sys; from recrl.agents.networks.flat_parameters import Adam, FlatParameters; "
        "Adam(FlatParameters([(2, 3)]), 0.1).step(); sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("name", INITIALISERS)
def test_the_generator_alone_decides_the_weights(name: str) -> None:
    weights = [torch.empty(4, 6) for _ in range(3)]
    for weight, seed in zip(weights, (1, 1, 2), strict=True):
        INITIALISERS[name](weight, torch.Generator().manual_seed(seed))
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_orthogonal_weights_have_gain_root_two() -> None:
    weight = torch.empty(4, 6)
    orthogonal(weight, torch.Generator().manual_seed(0))
    torch.testing.assert_close(weight @ weight.T, 2.0 * torch.eye(4))


def test_xavier_weights_are_uniform_within_their_bound() -> None:
    weight = torch.empty(200, 100)
    xavier(weight, torch.Generator().manual_seed(0))
    bound = (6.0 / 300.0) ** 0.5
    assert float(weight.abs().max()) <= bound
    assert float(weight.std()) == pytest.approx(bound / 3.0**0.5, rel=0.02)


def test_parameters_of_another_network_are_refused() -> None:
    parameters, _ = stack_of(1)
    message = "the saved network has 3 parameters, this one 94: was it built with other options\\?"
    with pytest.raises(ValueError, match=message):
        parameters.load(np.zeros(3, dtype=np.float32))


@pytest.mark.usefixtures("double_precision")
def test_many_rows_in_blocks_are_all_rows_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    critics = Critics(
        3, 1, NetworkArchitecture((FEW_COLUMNS + 2, 4), xavier), torch.Generator().manual_seed(0)
    )
    rows, targets = random_rows(23), torch.randn(2, 23, generator=torch.Generator().manual_seed(1))
    weights = torch.full((23,), 1.0 / 23.0)
    found = []
    for size in (23, 5):
        monkeypatch.setattr(tanh_stack, "BLOCK_ROWS", size)
        losses = critics.differentiate(rows, weights, targets)
        values = torch.from_numpy(critics.values(rows))
        found.append(torch.cat([losses, critics.parameters.gradient.clone(), values.ravel()]))
    torch.testing.assert_close(found[0], found[1])


def test_blocks_cover_all_rows() -> None:
    for count, lengths in ((1, [1]), (1024, [1024]), (1300, [1024, 276]), (9000, [2250] * 4)):
        rows = list(range(count))
        parts = [rows[block] for block in tanh_stack.blocks(count)]
        assert [len(part) for part in parts] == lengths
        assert [row for part in parts for row in part] == rows
    assert len(tanh_stack.blocks(0)) == 1


def test_saved_are_layer_by_layer_the_weights_of_all_networks_then_their_biases() -> None:
    parameters, stack = stack_of(2)
    pairs = zip(stack.weights, stack.biases, strict=True)
    expected = np.concatenate([tensor.reshape(-1).numpy() for pair in pairs for tensor in pair])
    assert parameters.to_numpy().tobytes() == expected.tobytes()
    other, _ = stack_of(2, seed=7)
    other.load(parameters.to_numpy())
    assert torch.equal(other.values, parameters.values)


def test_a_restored_adam_goes_on_with_the_same_steps() -> None:
    parameters, _ = stack_of(2)
    optimiser = Adam(parameters, 0.01)
    parameters.gradient.normal_(generator=torch.Generator().manual_seed(0))
    optimiser.step()
    other, _ = stack_of(2, seed=7)
    resumed = Adam(other, 0.01)
    other.load(parameters.to_numpy())
    resumed.load_state_dict(optimiser.state_dict())
    other.gradient.copy_(parameters.gradient)
    for adam in (optimiser, resumed):
        adam.step()
    assert torch.equal(other.values, parameters.values)
