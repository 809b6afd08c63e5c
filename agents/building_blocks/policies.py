"""Stochastic policies: a network with a categorical or a diagonal Gaussian head.

Acting uses NumPy, on a CPU on the parameters' own memory: at 16 observations PyTorch's overhead exceeds the
arithmetic. Learning uses PyTorch, also for the old policy's probabilities at the start of an update. So the
ratio of an unchanged policy is exactly 1.

Notation: U rows, B observations, n observation components, A actions, m action components, P parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any
from weakref import ref

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Discrete
from torch import Tensor

from recrl.agents.building_blocks.distributions import Categorical, Distribution, Gaussian
from recrl.agents.building_blocks.learning_batch import find_repeated
from recrl.agents.building_blocks.noise_scales import matching_log_std, matching_scale, off_greedy_mass
from recrl.agents.networks.architecture import NetworkArchitecture
from recrl.agents.networks.network_stack import make_stack
from recrl.agents.networks.tanh_stack import Scratch, TanhStack, blocks
from recrl.agents.spaces import action_size
from recrl.environments.cmdp import Floats

# Usual initial log standard deviation of a Gaussian policy whose actions are within [-1, 1], also that of
# safety-starter-agents.
INITIAL_LOG_STD = -0.5
# float32: a log_std that was raised to its bound is this close to it.
ROUNDING_OF_LOG_STD = 1e-6
# Noise 1 would make a tempered Gaussian infinitely wide; this bound makes it a thousand times wider.
SMALLEST_TEMPERING = 1e-3


class StochasticPolicy:
    """The policy pi(a | s): categorical for Discrete actions, diagonal Gaussian for Box.

    The Gaussian's actions are in half ranges from the middle of the task's
    (``recrl.agents.spaces.action_range``). Its log_std does not depend on the state; it is the last m of the
    parameters.

    Args:
        num_observations: n.
        action_space: of one environment.
        architecture: of the network.
        last_scale: factor on the last layer's initial weights; small means nearly uniform or zero-mean.
        generator: the initialisation's randomness.
        min_std: lower bound of a Gaussian's standard deviations, in half ranges; of m > 2 actions it is
            times sqrt(2 / m).

    Attributes:
        action_space: of one environment.
        parameters: all of them, in one block.
        stack: the network.
        is_categorical: whether actions are Discrete.
    """

    def __init__(
        self,
        num_observations: int,
        action_space: gymnasium.Space[Any],
        architecture: NetworkArchitecture,
        last_scale: float,
        generator: torch.Generator,
        *,
        min_std: float = 0.0,
    ) -> None:
        num_outputs = action_size(action_space)
        self.action_space = action_space
        self.is_categorical = isinstance(action_space, Discrete)
        self.parameters, self.stack = make_stack(
            architecture,
            1,
            num_observations,
            num_outputs,
            last_scale=last_scale,
            generator=generator,
            role="policy",
            others=[] if self.is_categorical else [(num_outputs,)],
        )
        if not self.is_categorical:
            self.log_std.fill_(INITIAL_LOG_STD)
        least = min_std * min(1.0, (2.0 / num_outputs) ** 0.5)
        self._least_log_std = None if self.is_categorical or least == 0.0 else math.log(least)
        self.bound_std()
        self._acting = self.parameters.values.cpu()  # on a CPU the parameters themselves
        acting = [piece.numpy() for piece in self.parameters.pieces(self._acting)]
        self._acting_log_std = acting[-1]
        self._layers = (
            [layer[0] for layer in acting[: len(self.stack.layers)]]
            if isinstance(self.stack, TanhStack)
            else None
        )
        self._scratch: list[Scratch] = []
        self._latest: _Latest | None = None

    def publish(self) -> None:
        """Copy changed parameters for acting; on a CPU acting shares them."""
        self._acting.copy_(self.parameters.values)

    @property
    def log_std(self) -> Tensor:
        """The Gaussian's log standard deviations, [m]."""
        return self.parameters.tensors[-1]

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

    def sample(
        self, observations: npt.NDArray[np.float32], generator: np.random.Generator
    ) -> npt.NDArray[Any]:
        """Sample actions for B observations [B, n]: int64 [B] by inversion, or float32 [B, m]."""
        outputs = self.outputs(observations)
        if not self.is_categorical:
            spread = np.exp(self._acting_log_std)
            outputs += spread * generator.standard_normal(outputs.shape, dtype=np.float32)
            return outputs
        cumulative = np.exp(outputs - outputs.max(axis=1, keepdims=True), dtype=np.float64).cumsum(axis=1)
        thresholds = generator.random(len(outputs)) * cumulative[:, -1]
        # A threshold may round up to the whole mass: then the last action is taken.
        actions: npt.NDArray[np.int64] = (cumulative[:, :-1] <= thresholds[:, None]).sum(axis=1)
        return actions

    def mode(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
        """Return the most likely actions at B observations [B, n]: int64 [B] or float32 [B, m]."""
        outputs = self.outputs(observations)
        return outputs.argmax(axis=1) if self.is_categorical else outputs

    def probabilities(self, observations: npt.NDArray[np.float32]) -> Floats:
        """pi(a | s) at B observations [B, n], float64 [B, A].

        Raises:
            ValueError: actions are continuous.
        """
        if not self.is_categorical:
            raise ValueError("continuous actions have densities, not probabilities")
        outputs = self.outputs(observations).astype(np.float64)
        masses = np.exp(outputs - outputs.max(axis=1, keepdims=True))
        probabilities: Floats = masses / masses.sum(axis=1, keepdims=True)
        return probabilities

    def distribution(self, rows: Tensor) -> Distribution:
        """Return the action distributions at U rows, [U, n]; not differentiable, see ``evaluate``.

        The last result is cached: after a line search, the accepted policy is not evaluated again for the
        metrics.
        """
        latest = self._latest
        if latest is None or not latest.is_of(rows, self.parameters.values):
            kept = self.log_std.clone()  # the policy will change
            distribution = self.head(self.stack.outputs(rows)[0], kept)
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
        leaves = [outputs]
        if not self.is_categorical:
            leaves.append(self.log_std.clone().requires_grad_())
        return PolicyEvaluation(self, activations, leaves, self.head(outputs, leaves[-1]))

    def head(self, outputs: Tensor, log_std: Tensor) -> Distribution:
        """Return the distributions of outputs, [U, A] or [U, m]; only a Gaussian has a log_std."""
        if self.is_categorical:
            return Categorical(torch.log_softmax(outputs, dim=1))
        return Gaussian(outputs, log_std)

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
        if self.is_categorical:
            return self._soften(noise, observations, form)
        return self._widen(noise, form)

    def bound_std(self) -> None:
        """Raise a Gaussian's standard deviations to their lower bound.

        With two actions or more, the noise then has a mean squared length of at least 2 min_std^2 squared
        half ranges, however many there are.
        """
        if self._least_log_std is not None:
            self.log_std.clamp_(min=self._least_log_std)

    def hold_bounded_std(self, gradients: Tensor, ascents: Tensor) -> None:
        """Set the derivatives by a log_std to 0 if it is at its bound and an ascent would lower it.

        A step that such derivatives lead would spend its KL on what ``bound_std`` takes back.

        Args:
            gradients: of any functions, [j, P]; changed in place.
            ascents: the directions in which the step is to go, [i, P].
        """
        if self._least_log_std is None:
            return
        num = self.log_std.numel()
        at_bound = self.log_std <= self._least_log_std + ROUNDING_OF_LOG_STD
        held = at_bound & (ascents[:, -num:] < 0.0).any(dim=0)
        gradients[:, -num:].masked_fill_(held, 0.0)

    def _soften(self, noise: float, observations: npt.NDArray[np.float32], form: str) -> dict[str, float]:
        distinct = find_repeated(observations)
        weights = np.full(len(observations), 1.0 / len(observations))
        if distinct is not None:  # on a tabular task a sixteenth of the rows
            first, row = distinct
            observations, weights = observations[first], np.bincount(row) / len(observations)
        logits = self.outputs(observations).astype(np.float64)
        scale = 1.0 - noise if form == "temperature" else matching_scale(logits, weights, noise)
        self.stack.scale(torch.tensor(scale))
        return {
            "noise_scale": scale,
            "randomness_before": off_greedy_mass(logits, weights),
            "randomness_after": off_greedy_mass(scale * logits, weights),
        }

    def _widen(self, noise: float, form: str) -> dict[str, float]:
        before = self._acting_log_std.astype(np.float64)
        if form == "temperature":
            after = before - np.log(max(1.0 - noise, SMALLEST_TEMPERING))
        else:
            after = matching_log_std(before, noise)
        self.log_std.copy_(torch.as_tensor(after))
        mean_before, mean_after = float(np.exp(before).mean()), float(np.exp(after).mean())
        return {
            "noise_scale": mean_after / mean_before,
            "randomness_before": mean_before,
            "randomness_after": mean_after,
        }


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
        if len(slopes) > 1:
            self.policy.parameters.gradients[-1].copy_(slopes[1])
        return self.policy.parameters.gradient


class FisherMetric:
    """The metric of the trust region: the Hessian of the mean KL at the present parameters, plus damping.

    H v = J^T F J v + damping v, with J the Jacobian of the network's outputs and F the Fisher metric on
    them, averaged over the samples. At the parameters that collected the samples this *is* the Hessian of the
    mean KL: the missing term is proportional to the gradient of the KL, which is 0 there. A product takes one
    forward and one backward sweep, a third of the time of double differentiation.

    Args:
        policy: at the parameters of the metric; they must not change while it is used.
        rows: the distinct observations, [U, n].
        observation_weights: fraction of the samples at each row, [U], summing to 1.
        damping: multiple of the identity added, at least 0.
    """

    def __init__(
        self, policy: StochasticPolicy, rows: Tensor, observation_weights: Tensor, damping: float
    ) -> None:
        self._policy = policy
        self._damping = damping
        self._blocks: list[tuple[list[Tensor], Distribution, Tensor]] = []
        for block in blocks(len(rows)):
            activations = policy.stack.activations(rows[block], Scratch())
            distribution = policy.head(activations[-1][0], policy.log_std)
            self._blocks.append((activations, distribution, observation_weights[block, None]))

    def __call__(self, vector: Tensor) -> Tensor:
        """Return H times a vector of parameter changes, [P] -> [P]; overwrites the gradient block."""
        stack, parameters = self._policy.stack, self._policy.parameters
        change = parameters.pieces(vector)
        for number, (activations, distribution, weights) in enumerate(self._blocks):
            moved = stack.output_change(activations, change)[0]
            stack.pull_back(activations, (weights * distribution.fisher(moved))[None], add=number > 0)
        if not self._policy.is_categorical:
            parameters.gradients[-1].copy_(2.0 * change[-1])  # the Fisher metric of log_std is 2
        return parameters.gradient + self._damping * vector
