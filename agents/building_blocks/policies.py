"""Stochastic policies: a network whose outputs are those of a distribution over actions.

``recrl.agents.building_blocks.policy_families`` has the two families, categorical and Gaussian.

Acting uses NumPy, on a CPU on the parameters' own memory: at 16 observations PyTorch's overhead exceeds the
arithmetic. Learning uses PyTorch, also for the old policy's probabilities at the start of an update. So the
ratio of an unchanged policy is exactly 1.

Notation: U rows, B observations, n observation components, A actions, m action components, P parameters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from weakref import ref

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.agents.building_blocks.distributions import Distribution
from recrl.agents.networks.architecture import NetworkArchitecture
from recrl.agents.networks.network_stack import make_stack
from recrl.agents.networks.tanh_stack import Scratch, TanhStack, blocks
from recrl.environments.cmdp import Floats


class StochasticPolicy(ABC):
    """The policy pi(a | s).

    Args:
        num_observations: n.
        num_outputs: of the network: A or m.
        architecture: of the network.
        last_scale: factor on the last layer's initial weights; small means nearly uniform or zero-mean.
        generator: the initialisation's randomness.
        num_spreads: parameters of the distribution that do not depend on the state, the last ones: m log
            standard deviations, or none.

    Attributes:
        parameters: all of them, in one block.
        stack: the network.
    """

    def __init__(
        self,
        num_observations: int,
        num_outputs: int,
        architecture: NetworkArchitecture,
        last_scale: float,
        generator: torch.Generator,
        *,
        num_spreads: int = 0,
    ) -> None:
        self.parameters, self.stack = make_stack(
            architecture,
            1,
            num_observations,
            num_outputs,
            last_scale=last_scale,
            generator=generator,
            role="policy",
            others=[(num_spreads,)] if num_spreads else [],
        )
        self._num_layers = len(self.parameters.tensors) - (num_spreads > 0)
        self._acting = self.parameters.values.cpu()  # on a CPU the parameters themselves
        self._share_for_acting()
        self._scratch: list[Scratch] = []
        self._latest: _Latest | None = None

    def _share_for_acting(self) -> None:
        """Make the NumPy arrays that share memory with the tensors for acting."""
        self._acting_pieces = [piece.numpy() for piece in self.parameters.pieces(self._acting)]
        self._layers = (
            [layer[0] for layer in self._acting_pieces[: self._num_layers]]
            if isinstance(self.stack, TanhStack)
            else None
        )

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the attributes of ``copy.deepcopy``, which separates NumPy arrays from their tensors."""
        self.__dict__.update(state)
        self._share_for_acting()

    @abstractmethod
    def sample(
        self, observations: npt.NDArray[np.float32], generator: np.random.Generator
    ) -> npt.NDArray[Any]:
        """Sample actions for B observations [B, n]: int64 [B], or float32 [B, m]."""

    @abstractmethod
    def mode(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
        """Return the most likely actions at B observations [B, n]: int64 [B] or float32 [B, m]."""

    @abstractmethod
    def probabilities(self, observations: npt.NDArray[np.float32]) -> Floats:
        """pi(a | s) at B observations [B, n], float64 [B, A].

        Raises:
            ValueError: actions are continuous.
        """

    @abstractmethod
    def head(self, outputs: Tensor, spreads: Sequence[Tensor]) -> Distribution:
        """Return the distributions of outputs, [U, A] or [U, m]; ``spreads`` as from ``spreads_of``."""

    @abstractmethod
    def add_noise(self, noise: float, observations: npt.NDArray[np.float32], form: str) -> dict[str, float]:
        """Make the policy more random, once; see ``recrl.agents.building_blocks.noise_scales``.

        Args:
            noise: eps_pi in (0, 1].
            observations: for measuring its randomness, [N, n].
            form: ``match-mixture`` or ``temperature``.

        Returns:
            ``noise_scale``, the factor on the last layer (categorical) or on the mean standard deviation
            (Gaussian). ``randomness_before`` and ``_after``, the mean off-greedy mass or the mean standard
            deviation.
        """

    @abstractmethod
    def bound_std(self) -> None:
        """Raise the standard deviations to their lower bound, if the policy has one."""

    @abstractmethod
    def hold_bounded_std(self, gradients: Tensor, ascents: Tensor) -> None:
        """Set the derivatives by a log_std to 0 if it is at its bound and an ascent would lower it.

        A step that such derivatives lead would spend its KL on what ``bound_std`` takes back.

        Args:
            gradients: of any functions, [j, P]; changed in place.
            ascents: the directions in which the step is to go, [i, P].
        """

    def spreads_of(self, pieces: Sequence[Tensor]) -> Sequence[Tensor]:
        """Return what does not belong to the network: the log_std [m] of a Gaussian, or nothing.

        Args:
            pieces: of the parameters, their gradients or a change of them, as ``FlatParameters`` has them.
        """
        return pieces[self._num_layers :]

    def publish(self) -> None:
        """Copy changed parameters for acting; on a CPU acting shares them."""
        self._acting.copy_(self.parameters.values)

    def outputs(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Logits or means of B observations, [B, n] -> [B, A] or [B, m]; no autograd."""
        outputs: npt.NDArray[np.float32]
        if self._layers is None:
            rows = torch.as_tensor(observations, device=self.parameters.values.device)
            outputs = self.stack.outputs(rows)[0].numpy(force=True)
            return outputs
        hidden = observations
        for layer in self._layers[:-1]:
            hidden = hidden @ layer[:-1]
            hidden += layer[-1]
            np.tanh(hidden, out=hidden)
        outputs = hidden @ self._layers[-1][:-1] + self._layers[-1][-1]
        return outputs

    def distribution(self, rows: Tensor) -> Distribution:
        """Return the action distributions at U rows, [U, n]; not differentiable, see ``evaluate``.

        The last result is cached: after a line search, the accepted policy is not evaluated again for the
        metrics.
        """
        latest = self._latest
        if latest is None or not latest.is_of(rows, self.parameters.values):
            spreads = [spread.clone() for spread in self._spreads]  # the policy will change
            distribution = self.head(self.stack.outputs(rows)[0], spreads)
            self._latest = latest = _Latest(ref(rows), self.parameters.values.clone(), distribution)
        return latest.distribution

    def evaluate(self, rows: Tensor) -> PolicyEvaluation:
        """Return the action distributions at U rows, [U, n], for differentiating a loss."""
        pieces = blocks(len(rows))
        self._scratch += [Scratch() for _ in pieces[len(self._scratch) :]]
        activations = [
            self.stack.activations(rows[block], scratch)
            for block, scratch in zip(pieces, self._scratch, strict=False)
        ]
        outputs = (
            activations[0][-1][0] if len(pieces) == 1 else torch.cat([each[-1][0] for each in activations])
        )
        outputs.requires_grad_()
        spreads = [spread.clone().requires_grad_() for spread in self._spreads]
        return PolicyEvaluation(self, activations, [outputs, *spreads], self.head(outputs, spreads))

    @property
    def _spreads(self) -> Sequence[Tensor]:
        return self.spreads_of(self.parameters.tensors)


@dataclass(frozen=True, eq=False)
class _Latest:
    """Last evaluation of a policy.

    Attributes:
        rows: the observations; a weak reference.
        parameters: a copy, [P].
        distribution: the result.
    """

    rows: ref[Tensor]
    parameters: Tensor
    distribution: Distribution

    def is_of(self, rows: Tensor, parameters: Tensor) -> bool:
        """Whether the result is that of these rows, if unchanged, and parameters."""
        return self.rows() is rows and torch.equal(self.parameters, parameters)


@dataclass(frozen=True, eq=False)
class PolicyEvaluation:
    """Evaluation of a policy at some rows; valid until its parameters change or it is evaluated again.

    PyTorch differentiates from a loss to the network's outputs, so an agent may use any loss of the
    distribution. The network itself is differentiated by its stack.

    Attributes:
        policy: the evaluated policy.
        activations: of its network, block by block of the rows.
        leaves: the outputs, and a Gaussian's log_std; losses are differentiated by them.
        distribution: at the rows; a differentiable function of the leaves.
    """

    policy: StochasticPolicy
    activations: list[list[Tensor]]
    leaves: list[Tensor]
    distribution: Distribution

    def gradient(self, loss: Tensor, *, retain_graph: bool = False) -> Tensor:
        """Return the gradient of a scalar loss by all parameters, [P], a view of the gradient block."""
        slopes = torch.autograd.grad(loss, self.leaves, retain_graph=retain_graph)
        for block, activations in zip(blocks(len(slopes[0])), self.activations, strict=True):
            self.policy.stack.pull_back(activations, slopes[0][None, block], add=block.start > 0)
        parameters = self.policy.parameters
        for gradient, slope in zip(self.policy.spreads_of(parameters.gradients), slopes[1:], strict=True):
            gradient.copy_(slope)
        return parameters.gradient
