"""Architecture of an agent's networks: layers, activation and initial weights, or a network of the user's."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# Initialise one weight matrix [in, out] in place; biases start at 0.
Initialiser = Callable[[Tensor, torch.Generator], None]


def orthogonal(weight: Tensor, generator: torch.Generator) -> None:
    """Orthogonal with gain sqrt 2 (Saxe et al. 2014), the usual choice of on-policy learners."""
    torch.nn.init.orthogonal_(weight, gain=math.sqrt(2.0), generator=generator)


def xavier(weight: Tensor, generator: torch.Generator) -> None:
    """Uniform within sqrt(6 / (in + out)) (Glorot and Bengio 2010), as safety-starter-agents."""
    torch.nn.init.xavier_uniform_(weight, generator=generator)


INITIALISERS: dict[str, Initialiser] = {"orthogonal": orthogonal, "xavier": xavier}


@dataclass(frozen=True)
class NetworkArchitecture:
    """Architecture of an agent's networks.

    Attributes:
        hidden_sizes: widths of the hidden layers.
        initialiser: draws each weight matrix.
        activation: between the layers; a key of ``ACTIVATIONS`` in ``module_stack``.
        factory: makes a user's network from the numbers of inputs and outputs; then the other attributes have
            no effect. None for the standard perceptron.
    """

    hidden_sizes: tuple[int, ...]
    initialiser: Initialiser
    activation: str = "tanh"
    factory: Callable[[int, int], torch.nn.Module] | None = None
