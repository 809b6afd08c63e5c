"""Tanh multi-layer perceptrons, their parameters in one flat block, and Adam on it.

Every network here is a *stack* of C separate networks of one shape, evaluated as one batched product: 1 + k
critics take hardly more time than one. A policy is a stack of one.

All parameters of a stack are views into one contiguous vector, and so are their gradients. Adam is then a
handful of operations on two vectors, a trust-region step is ``parameters += step``, and a checkpoint is a
single array. With small networks and few rows the number of calls determines the time of an update. With many
rows the activations determine its memory, so rows are evaluated in blocks.

A layer's biases are the last row of its weights, and its inputs end in a column of ones. Separate biases
would need two more sweeps over memory of the size of the activations. Such sweeps take most of the time
besides the products.

Notation: C networks, U rows, n inputs, P parameters.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

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


# Initialise one weight matrix [in, out] in place; biases start at 0.
Initialiser = Callable[[Tensor, torch.Generator], None]


def orthogonal(weight: Tensor, generator: torch.Generator) -> None:
    """Orthogonal with gain sqrt 2 (Saxe et al. 2014), the usual choice of on-policy learners."""
    torch.nn.init.orthogonal_(weight, gain=math.sqrt(2.0), generator=generator)


def xavier(weight: Tensor, generator: torch.Generator) -> None:
    """Uniform within sqrt(6 / (in + out)) (Glorot and Bengio 2010), as safety-starter-agents."""
    torch.nn.init.xavier_uniform_(weight, generator=generator)


INITIALISERS: dict[str, Initialiser] = {"orthogonal": orthogonal, "xavier": xavier}


def blocks(num_rows: int) -> list[slice]:
    """Return consecutive slices of ``num_rows``: of ``BLOCK_ROWS`` each, or ``MOST_BLOCKS`` longer ones."""
    size = max(BLOCK_ROWS, math.ceil(num_rows / MOST_BLOCKS))
    return [slice(start, start + size) for start in range(0, max(num_rows, 1), size)]


@dataclass(frozen=True)
class NetworkForm:
    """Architecture of an agent's networks.

    Attributes:
        hidden_sizes: widths of the hidden layers.
        initialiser: draws each weight matrix.
        activation: between the layers; a key of ``module_stack.ACTIVATIONS``.
        factory: makes a user's network from the numbers of inputs and outputs; with it the other attributes
            are not used. None for the standard perceptron.
    """

    hidden_sizes: tuple[int, ...]
    initialiser: Initialiser
    activation: str = "tanh"
    factory: Callable[[int, int], torch.nn.Module] | None = None


class FlatParameters:
    """Tensors that are views into one vector; their gradients are views into another.

    Args:
        shapes: of the tensors, in order.

    Attributes:
        values: all parameters, float32 [P]; written to in place.
        gradient: of the last loss differentiated, [P]; overwritten by the next.
        tensors: the views into ``values``.
        gradients: the views into ``gradient``.
    """

    def __init__(self, shapes: Sequence[tuple[int, ...]]) -> None:
        sizes = [math.prod(shape) for shape in shapes]
        ends = list(itertools.accumulate(sizes))
        places = list(zip(shapes, sizes, ends, strict=True))
        self.values = torch.zeros(ends[-1])
        self.gradient = torch.zeros(ends[-1])
        self.tensors = [self.values[end - size : end].view(shape) for shape, size, end in places]
        self.gradients = [self.gradient[end - size : end].view(shape) for shape, size, end in places]

    def pieces(self, vector: Tensor) -> list[Tensor]:
        """Return a vector of parameter changes, [P], as views of the parameters' shapes."""
        ends = itertools.accumulate(tensor.numel() for tensor in self.tensors)
        return [
            vector[end - tensor.numel() : end].view(tensor.shape)
            for tensor, end in zip(self.tensors, ends, strict=True)
        ]

    def to_numpy(self, vector: Tensor | None = None) -> npt.NDArray[np.float32]:
        """Return a copy of all parameters, or of a vector like them, in the saved order, [P].

        The order is layer by layer: first the weights of all networks, then their biases.
        """
        pieces = self.pieces(self.values if vector is None else vector)
        parts = [part.reshape(-1) for piece in pieces for part in _saved_parts(piece)]
        return torch.cat(parts).numpy(force=True)

    def load(self, saved: npt.NDArray[np.float32], vector: Tensor | None = None) -> None:
        """Restore a result of ``to_numpy``, [P], as the parameters or into a vector like them.

        Raises:
            ValueError: the network has another size.
        """
        if saved.shape != tuple(self.values.shape):
            raise ValueError(
                f"the saved network has {saved.size} parameters, this one {self.values.numel()}: "
                "was it built with other options?"
            )
        pieces = self.pieces(self.values if vector is None else vector)
        parts = [part for piece in pieces for part in _saved_parts(piece)]
        values = torch.as_tensor(np.array(saved, dtype=np.float32))
        flat = torch.split(values, [part.numel() for part in parts])
        for part, numbers in zip(parts, flat, strict=True):
            part.copy_(numbers.view(part.shape))


def _saved_parts(piece: Tensor) -> list[Tensor]:
    """Return the views of a tensor in the saved order: weights and biases of a layer."""
    return [piece[:, :-1], piece[:, -1:]] if piece.dim() == 3 else [piece]


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


class Adam:
    """Adam (Kingma and Ba 2015, algorithm 1) on one flat block; equals ``torch.optim.Adam``.

    m <- b1 m + (1 - b1) g;  v <- b2 v + (1 - b2) g^2;
    x <- x - rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps).

    PyTorch's takes four times as long per step as these five operations, and its state is more difficult to
    save.

    Args:
        parameters: the block to optimise.
        learning_rate: above 0.
    """

    BETAS = (0.9, 0.999)
    EPSILON = 1e-8

    def __init__(self, parameters: FlatParameters, learning_rate: float) -> None:
        self._parameters = parameters
        self._learning_rate = learning_rate
        self._first_moment = torch.zeros_like(parameters.values)
        self._second_moment = torch.zeros_like(parameters.values)
        self._steps = 0

    def step(self) -> None:
        """Take a step of descent along the block's gradient."""
        gradient = self._parameters.gradient
        self._steps += 1
        self._first_moment.lerp_(gradient, 1.0 - self.BETAS[0])
        self._second_moment.mul_(self.BETAS[1]).addcmul_(gradient, gradient, value=1.0 - self.BETAS[1])
        rate = self._learning_rate / (1.0 - self.BETAS[0] ** self._steps)
        correction = math.sqrt(1.0 - self.BETAS[1] ** self._steps)
        scale = self._second_moment.sqrt().div_(correction).add_(self.EPSILON)
        self._parameters.values.addcdiv_(self._first_moment, scale, value=-rate)

    def state_dict(self) -> dict[str, Any]:
        """Return both moments, [P], and the number of steps taken."""
        return {
            "first_moment": self._parameters.to_numpy(self._first_moment),
            "second_moment": self._parameters.to_numpy(self._second_moment),
            "steps": self._steps,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._parameters.load(np.asarray(state["first_moment"]), self._first_moment)
        self._parameters.load(np.asarray(state["second_moment"]), self._second_moment)
        self._steps = int(state["steps"])
