"""Networks of a policy or of critics, by the agent's options: the fast perceptron, or modules."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from recrl.agents.networks.architecture import NetworkArchitecture
from recrl.agents.networks.flat_parameters import FlatParameters
from recrl.agents.networks.module_stack import ModuleStack, checked_module, perceptron
from recrl.agents.networks.tanh_stack import Scratch, TanhStack


class Stack(Protocol):
    """C networks of one kind whose parameters are views into one block; see ``TanhStack``."""

    def scale(self, factors: Tensor) -> None:
        """Multiply each network's outputs by a factor, [C] or a scalar."""
        ...

    def to_module(self) -> nn.Module:
        """Return a copy of the first network."""
        ...

    def outputs(self, rows: Tensor) -> Tensor:
        """The outputs of every network, [C, U, out]; rows are [U, n]."""
        ...

    def activations(self, rows: Tensor, scratch: Scratch | None = None) -> list[Tensor]:
        """Return the data for differentiating, for one block of rows; the outputs, [C, U, out], come last."""
        ...

    def output_change(self, activations: Sequence[Tensor], change: Sequence[Tensor]) -> Tensor:
        """Return the derivative of the outputs along a change of the parameters, [C, U, out].

        Args:
            activations: of one block of U rows, from ``activations``.
            change: of each parameter, in its shape, as from ``FlatParameters.pieces``.
        """
        ...

    def pull_back(self, activations: Sequence[Tensor], slope: Tensor, *, add: bool = False) -> None:
        """Write the derivative of a loss by the parameters to the gradient block.

        Args:
            activations: of one block of U rows, from ``activations``.
            slope: derivative of the loss by the outputs, [C, U, out].
            add: whether to add to the gradient block instead of overwriting it.
        """
        ...


def make_stack(
    architecture: NetworkArchitecture,
    num_networks: int,
    num_inputs: int,
    num_outputs: int,
    *,
    last_scale: float,
    generator: torch.Generator,
    role: str,
    others: Sequence[tuple[int, ...]] = (),
) -> tuple[FlatParameters, Stack]:
    """Make C networks with their parameters.

    Args:
        architecture: their architecture.
        num_networks: C.
        num_inputs: n.
        num_outputs: of each.
        last_scale: factor on the initial weights of the last layer; a user's network keeps its own.
        generator: the initialisation's randomness.
        role: of the networks, for errors: ``policy`` or ``critic``.
        others: shapes of further parameters at the end of the block.

    Raises:
        NetworkError: a user's network does not meet the requirements.
    """
    if architecture.factory is None and architecture.activation == "tanh":
        sizes = (num_inputs, *architecture.hidden_sizes, num_outputs)
        parameters = FlatParameters([*TanhStack.shapes(num_networks, sizes), *others])
        stack = TanhStack(parameters, len(sizes) - 1)
        stack.initialise(architecture.initialiser, last_scale, generator)
        return parameters, stack
    standard = perceptron(
        architecture.hidden_sizes, architecture.activation, architecture.initialiser, last_scale
    )
    factory = architecture.factory or standard(generator)
    # On the CPU, so that a GPU begins with the same values. A user's module draws from the global generator.
    with torch.device("cpu"), torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(2**31, (1,), generator=generator)))
        modules = [checked_module(factory, num_inputs, num_outputs, role=role) for _ in range(num_networks)]
    parameters = FlatParameters([*ModuleStack.shapes(modules), *others])
    of_modules = ModuleStack(modules, parameters)
    of_modules.initialise()
    return parameters, of_modules
