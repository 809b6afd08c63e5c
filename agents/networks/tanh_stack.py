"""Tanh multi-layer perceptrons with explicit derivatives: the fast implementation of a network stack.

C networks of one shape are evaluated as one batched product: 1 + k critics take hardly more time than one.
With small networks and few rows the number of calls determines the time of an update. With many rows the
activations determine its memory, so rows are evaluated in blocks.

A layer's biases are the last row of its weights, and its inputs end in a column of ones. Separate biases
would need two more sweeps over memory of the size of the activations. Such sweeps take most of the time
besides the products.

Notation: C networks, U rows, n inputs, P parameters.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from recrl.agents.networks.architecture import Initialiser
from recrl.agents.networks.flat_parameters import FlatParameters

# Rows evaluated at once: this number, or more if there would otherwise be more than MOST_BLOCKS blocks. Only
# one block's activations are in memory, but each block reads all weights and adds to the whole gradient. So
# 30,000 rows of 256 units take an eighth longer in 30 blocks than in four.
BLOCK_ROWS, MOST_BLOCKS = 1024, 4
# Rows of activations begin at multiples of this number of floats, where products are fastest.
ALIGNMENT = 16
# Products with at most this number of columns are faster multiplied as rows.
FEW_COLUMNS = 8

# Compute (1 - h^2) slope in one sweep over memory, to ``grad_input``; no public function does.
tanh_backward = torch.ops.aten.tanh_backward.grad_input


def add_product(into: Tensor, left: Tensor, right: Tensor, *, keep: bool) -> None:
    """Write left^T right, [C, i, o], to memory, or add it.

    A few columns (o is 1 for critics, the size of an action for policies) are multiplied as the rows
    right^T left: MKL takes two to three times as long for columns.

    Args:
        into: [C, i, o].
        left: [C, U, i].
        right: [C, U, o].
        keep: whether to add instead of replacing.
    """
    if right.shape[2] <= FEW_COLUMNS:
        product = torch.bmm(right.transpose(1, 2), left).transpose(1, 2)
        into.add_(product) if keep else into.copy_(product)
    elif keep:
        into.baddbmm_(left.transpose(1, 2), right)
    else:
        torch.bmm(left.transpose(1, 2), right, out=into)


def pull_through(slope: Tensor, weight: Tensor, out: Tensor) -> Tensor:
    """Write slope weight^T, [C, U, i], to ``out``; an outer product if there is one output.

    Args:
        slope: [C, U, o].
        weight: [C, i, o].
        out: [C, U, i].
    """
    transposed = weight.transpose(1, 2)
    product = torch.mul if slope.shape[2] == 1 else torch.bmm
    return product(slope, transposed, out=out)


def blocks(num_rows: int) -> list[slice]:
    """Return consecutive slices of ``num_rows``: of ``BLOCK_ROWS`` each, or ``MOST_BLOCKS`` longer ones."""
    size = max(BLOCK_ROWS, math.ceil(num_rows / MOST_BLOCKS))
    return [slice(start, start + size) for start in range(0, max(num_rows, 1), size)]


class Scratch:
    """Reusable memory.

    Allocating some megabytes takes as long as a product that fills them. A place is used either by ``tensor``
    or by ``inputs``.
    """

    def __init__(self) -> None:
        self._buffers: dict[int, Tensor] = {}
        self._views: dict[int, Tensor] = {}

    def tensor(self, place: int, shape: tuple[int, ...]) -> Tensor:
        """Return uninitialised memory; it overwrites the previous tensor of the same place."""
        view = self._views.get(place)
        if view is None or view.shape != shape:
            view = self._views[place] = self._memory(place, math.prod(shape)).view(shape)
        return view

    def inputs(self, place: int, num_networks: int, num_rows: int, width: int) -> Tensor:
        """Return memory for a layer's inputs, [C, U, width + 1]; only the last column is set, to ones."""
        view = self._views.get(place)
        if view is None or view.shape != (num_networks, num_rows, width + 1):
            length = math.ceil((width + 1) / ALIGNMENT) * ALIGNMENT
            memory = self._memory(place, num_networks * num_rows * length)
            view = self._views[place] = memory.view(num_networks, num_rows, length)[..., : width + 1]
            view[..., width] = 1.0
        return view

    def _memory(self, place: int, size: int) -> Tensor:
        buffer = self._buffers.get(place)
        if buffer is None or buffer.numel() < size:
            buffer = self._buffers[place] = torch.empty(size)
        return buffer[:size]


class TanhStack:
    """C separate multi-layer perceptrons with tanh between the layers and a linear last one.

    The derivatives are explicit: forward along a change of the parameters (``output_change``) and backward
    (``pull_back``). For networks this small the overhead of automatic differentiation would exceed the
    arithmetic.

    Args:
        parameters: the block; the first ``num_layers`` tensors, with the shapes of ``shapes``, are used.
        num_layers: linear layers of each network.

    Attributes:
        layers: weights over biases, [C, in + 1, out], layer by layer.
        weights: the rows of ``layers`` with weights, [C, in, out].
        biases: the last rows, [C, 1, out].
    """

    def __init__(self, parameters: FlatParameters, num_layers: int) -> None:
        self.layers = parameters.tensors[:num_layers]
        self.weights = [layer[:, :-1] for layer in self.layers]
        self.biases = [layer[:, -1:] for layer in self.layers]
        self._slopes = parameters.gradients[:num_layers]
        self._scratch = Scratch()
        self._slope_scratch = Scratch()

    @staticmethod
    def shapes(num_networks: int, sizes: Sequence[int]) -> list[tuple[int, ...]]:
        """The shapes of weights over biases, [C, in + 1, out], layer by layer.

        Args:
            num_networks: C.
            sizes: widths from the inputs to the outputs.
        """
        return [(num_networks, inputs + 1, outputs) for inputs, outputs in itertools.pairwise(sizes)]

    def initialise(self, initialiser: Initialiser, last_scale: float, generator: torch.Generator) -> None:
        """Draw all weights; scale the last layer's by ``last_scale``; set the biases to 0."""
        for weight, bias in zip(self.weights, self.biases, strict=True):
            for network in weight:
                drawn = torch.empty(network.shape, device="cpu")  # equal weights on every device
                initialiser(drawn, generator)
                network.copy_(drawn)
            bias.zero_()
        self.weights[-1].mul_(last_scale)

    def to_module(self) -> torch.nn.Module:
        """Return a copy of the first network."""
        layers: list[torch.nn.Module] = []
        for weight, bias in zip(self.weights, self.biases, strict=True):
            layer = torch.nn.Linear(weight.shape[1], weight.shape[2])
            layer.weight.data = weight[0].T.cpu().clone().contiguous()
            layer.bias.data = bias[0, 0].cpu().clone()
            layers += [layer, torch.nn.Tanh()]
        return torch.nn.Sequential(*layers[:-1])

    def scale(self, factors: Tensor) -> None:
        """Multiply each network's outputs by a factor, [C] or a scalar."""
        self.layers[-1].mul_(factors.reshape(-1, 1, 1))

    def outputs(self, rows: Tensor) -> Tensor:
        """The outputs of every network, [C, U, out], block by block; rows are [U, n]."""
        outputs = [self.activations(rows[block])[-1] for block in blocks(len(rows))]
        return outputs[0] if len(outputs) == 1 else torch.cat(outputs, dim=1)

    def activations(self, rows: Tensor, scratch: Scratch | None = None) -> list[Tensor]:
        """The inputs of every layer, each [C, U, in + 1] with ones at the end, then the outputs, [C, U, out].

        Args:
            rows: [U, n], one block.
            scratch: memory for the inputs of layers; None for the stack's own, which the next evaluation
                without ``scratch`` overwrites.
        """
        scratch = scratch or self._scratch
        num_networks, (num_rows, width) = len(self.layers[0]), rows.shape
        inputs = scratch.inputs(0, 1, num_rows, width)
        inputs[0, :, :-1] = rows
        kept = [inputs.expand(num_networks, -1, -1)]
        for place, layer in enumerate(self.layers[:-1], start=1):
            inputs = scratch.inputs(place, num_networks, num_rows, layer.shape[2])
            torch.bmm(kept[-1], layer, out=inputs[..., :-1]).tanh_()
            kept.append(inputs)
        kept.append(torch.bmm(kept[-1], self.layers[-1]))
        return kept

    def output_change(self, activations: Sequence[Tensor], change: Sequence[Tensor]) -> Tensor:
        """The derivative of the outputs along a change of the parameters: J times the change.

        d h_{l+1} = (1 - h_{l+1}^2) (d h_l W_l + h_l dW_l + d b_l), from d h_0 = 0.

        Args:
            activations: the result of ``activations`` at the present parameters.
            change: dW over db of every layer in order, each of its layer's shape.

        Returns:
            [C, U, out].
        """
        memory = [
            self._slope_scratch.tensor(layer, (*inputs.shape[:2], inputs.shape[2] - 1))
            for layer, inputs in enumerate(activations[1:-1], start=1)
        ] + [torch.empty_like(activations[-1])]
        moved = torch.bmm(activations[0], change[0], out=memory[0])
        for layer in range(1, len(self.layers)):
            tanh_backward(moved, activations[layer][..., :-1], grad_input=moved)
            moved = torch.bmm(moved, self.weights[layer], out=memory[layer])
            moved.baddbmm_(activations[layer], change[layer])
        return moved

    def pull_back(self, activations: Sequence[Tensor], slope: Tensor, *, add: bool = False) -> None:
        """Write the derivative of a loss by the parameters, J^T slope, to the gradient block.

        dL/dW_l = h_l^T s_l,  dL/db_l = sum over rows of s_l,  s_{l-1} = (1 - h_l^2) (s_l W_l^T).

        Args:
            activations: the result of ``activations`` at the present parameters.
            slope: dL / d outputs, [C, U, out].
            add: add to the gradient block, as for the second and later blocks of rows, instead of replacing
                it.
        """
        for layer in range(len(self.layers) - 1, -1, -1):
            add_product(self._slopes[layer], activations[layer], slope, keep=add)
            if layer > 0:
                hidden = activations[layer][..., :-1]
                memory = self._slope_scratch.tensor(layer, tuple(hidden.shape))
                slope = pull_through(slope, self.weights[layer], out=memory)
                tanh_backward(slope, hidden, grad_input=slope)
