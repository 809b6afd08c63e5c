"""The metric of a trust region: how much a change of the parameters changes the policy.

Notation: U rows, n observation components, P parameters.
"""

from __future__ import annotations

from torch import Tensor

from recrl.agents.building_blocks.distributions import Distribution
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.networks.tanh_stack import Scratch, blocks


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
            distribution = policy.head(activations[-1][0], policy.spreads_of(policy.parameters.tensors))
            self._blocks.append((activations, distribution, observation_weights[block, None]))

    def __call__(self, vector: Tensor) -> Tensor:
        """Return H times a vector of parameter changes, [P] -> [P]; overwrites the gradient block."""
        stack, parameters = self._policy.stack, self._policy.parameters
        change = parameters.pieces(vector)
        for number, (activations, distribution, weights) in enumerate(self._blocks):
            moved = stack.output_change(activations, change)[0]
            stack.pull_back(activations, (weights * distribution.fisher(moved))[None], add=number > 0)
        spreads = map(self._policy.spreads_of, (parameters.gradients, change))
        for gradient, log_std_change in zip(*spreads, strict=True):
            gradient.copy_(2.0 * log_std_change)  # a Gaussian has one, with the metric 2
        return parameters.gradient + self._damping * vector
