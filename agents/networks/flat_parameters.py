"""Parameters of networks in one flat vector, and Adam on it.

All parameters are views into one contiguous vector, and so are their gradients. Adam is then a handful of
operations on two vectors, a trust-region step is ``parameters += step``, and a checkpoint is a single array.

Notation: P parameters.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.optim.adam import adam


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


class Adam:
    """Adam on one flat block, with its state in the saved order.

    It is PyTorch's functional Adam with the defaults of ``torch.optim.Adam``. That class imports PyTorch's
    compiler, which takes time and memory in every process.

    Args:
        parameters: the block to optimise.
        learning_rate: above 0.
    """

    def __init__(self, parameters: FlatParameters, learning_rate: float) -> None:
        self._parameters = parameters
        self._learning_rate = learning_rate
        self._first_moment = torch.zeros_like(parameters.values)
        self._second_moment = torch.zeros_like(parameters.values)
        self._steps = torch.tensor(0.0, device="cpu")

    def step(self) -> None:
        """Take a step of descent along the block's gradient."""
        with torch.no_grad():
            adam(
                [self._parameters.values],
                [self._parameters.gradient],
                [self._first_moment],
                [self._second_moment],
                [],
                [self._steps],
                foreach=False,
                amsgrad=False,
                beta1=0.9,
                beta2=0.999,
                lr=self._learning_rate,
                weight_decay=0.0,
                eps=1e-8,
                maximize=False,
            )

    def state_dict(self) -> dict[str, Any]:
        """Return both moments, [P], and the number of steps taken."""
        return {
            "first_moment": self._parameters.to_numpy(self._first_moment),
            "second_moment": self._parameters.to_numpy(self._second_moment),
            "steps": int(self._steps),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._parameters.load(np.asarray(state["first_moment"]), self._first_moment)
        self._parameters.load(np.asarray(state["second_moment"]), self._second_moment)
        self._steps.fill_(int(state["steps"]))
