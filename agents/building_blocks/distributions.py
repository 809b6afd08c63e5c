"""Action distributions of a batch of observations: categorical and diagonal Gaussian.

Each has log-probabilities, the Kullback-Leibler divergence from another distribution, the entropy, and the
Fisher metric on the network's outputs. The Fisher metric is the Hessian of that divergence at equal
distributions.

Notation: U unique observations, D unique pairs (of row and action; every sample is one if nothing
repeats), A actions, m action components.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Categorical:
    """Probabilities of A actions at U rows.

    Attributes:
        log_probs: normalised, [U, A].
    """

    log_probs: Tensor

    def log_prob(self, actions: Tensor, rows: Tensor | None) -> Tensor:
        """The log-probability log pi(a | s) of D unique pairs, [D].

        Args:
            actions: int64 [D].
            rows: the row of each pair, int64 [D], or None if pair i was taken at row i.
        """
        num_rows, num_actions = self.log_probs.shape
        if rows is None:
            rows = torch.arange(num_rows, device=actions.device)
        return torch.take(self.log_probs, rows * num_actions + actions)

    def at(self, rows: Tensor) -> Categorical:
        """Return the distribution at some rows only, int64 [V]."""
        return Categorical(self.log_probs[rows])

    def divergence(self, other: Categorical) -> Tensor:
        """KL(self || other) = sum_a p_a (log p_a - log q_a) at each row, [U]."""
        return (self.log_probs.exp() * (self.log_probs - other.log_probs)).sum(1)

    def entropy(self) -> Tensor:
        """-sum_a p_a log p_a at each row, [U]."""
        return -(self.log_probs.exp() * self.log_probs).sum(1)

    def fisher(self, change: Tensor) -> Tensor:
        """(diag(p) - p p^T) times a change of the logits, [U, A] -> [U, A]."""
        probabilities = self.log_probs.exp()
        return probabilities * (change - (probabilities * change).sum(1, keepdim=True))


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Independent normal action components with one spread for all rows.

    Attributes:
        mean: [U, m].
        log_std: natural logarithm of the standard deviations, [m].
    """

    mean: Tensor
    log_std: Tensor

    def log_prob(self, actions: Tensor, rows: Tensor | None) -> Tensor:
        """The log-probability log pi(a | s) of D unique pairs, [D].

        log pi = sum_j -((a_j - mu_j) / sigma_j)^2 / 2 - log sigma_j - log(2 pi) / 2.

        Args:
            actions: [D, m].
            rows: the row of each pair, int64 [D], or None if pair i was taken at row i.
        """
        mean = self.mean if rows is None else self.mean[rows]
        standardised = (actions - mean) * torch.exp(-self.log_std)
        constant = self.log_std.sum() + 0.5 * math.log(2.0 * math.pi) * len(self.log_std)
        return -0.5 * standardised.square().sum(1) - constant

    def at(self, rows: Tensor) -> Gaussian:
        """Return the distribution at some rows only, int64 [V]."""
        return Gaussian(self.mean[rows], self.log_std)

    def divergence(self, other: Gaussian) -> Tensor:
        """KL(self || other) at each row, summed over the action components, [U].

        sum_j log(sigma'_j / sigma_j) + (sigma_j^2 + (mu_j - mu'_j)^2) / (2 sigma'_j^2) - 1/2, primes for
        ``other``.
        """
        difference = (self.mean - other.mean).square()
        variance = torch.exp(2.0 * self.log_std)
        precision = torch.exp(-2.0 * other.log_std)
        return (other.log_std - self.log_std + 0.5 * ((variance + difference) * precision - 1.0)).sum(1)

    def entropy(self) -> Tensor:
        """sum_j log sigma_j + log(2 pi e) / 2 at each row, [U]."""
        each = self.log_std.sum() + 0.5 * math.log(2.0 * math.pi * math.e) * len(self.log_std)
        return each.expand(len(self.mean))

    def fisher(self, change: Tensor) -> Tensor:
        """Return a change of the means divided by the variances, [U, m] -> [U, m].

        The Fisher metric of log_std is 2 per component.
        """
        return change * torch.exp(-2.0 * self.log_std)


Distribution = Categorical | Gaussian


def mean_divergence(old: Distribution, new: Distribution, observation_weights: Tensor) -> Tensor:
    """KL(old || new) averaged over the samples, a scalar.

    Args:
        old: the policy that collected the samples.
        new: of the same family.
        observation_weights: fraction of the samples at each row, [U], summing to 1.
    """
    assert type(old) is type(new)
    return torch.dot(observation_weights, old.divergence(new))  # type: ignore[arg-type]
