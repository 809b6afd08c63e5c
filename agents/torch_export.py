"""A trained policy as a ``torch.nn.Module`` of its own, for ``torch.export`` and ONNX."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from recrl.agents.learning.policies import StochasticPolicy
from recrl.agents.observation_features import CLIP, Encoder


class PolicyModule(nn.Module):
    """Maps observations, float32 [B, n], to logits [B, A] or, for continuous actions, means [B, m].

    The encoding and the normalisation of observations are part of it. The deterministic action is the index
    of the largest logit, or the mean, clipped to the task's bounds.

    Args:
        encoder: the agent's.
        policy: the agent's; its parameters are copied.

    Attributes:
        log_std: log standard deviations of continuous actions, [m]; empty for discrete ones.
    """

    log_std: Tensor
    _lidar: Tensor
    _rates: Tensor
    _normalise: Tensor
    _mean: Tensor
    _spread: Tensor

    def __init__(self, encoder: Encoder, policy: StochasticPolicy) -> None:
        super().__init__()
        constants = encoder.constants()
        for name, values in constants.items():
            self.register_buffer(f"_{name}", torch.as_tensor(values).clone())
        self._num_scales, self._is_normalised = len(constants["rates"]), len(constants["mean"]) > 0
        log_std = torch.empty(0) if policy.is_categorical else policy.log_std.detach().cpu().clone()
        self.register_buffer("log_std", log_std)
        self._network = policy.stack.to_module()

    def forward(self, observations: Tensor) -> Tensor:
        """The parameters of the action distribution."""
        seen = [observations]
        if self._is_normalised:
            standardised = (observations.double() - self._mean) / self._spread
            seen = [torch.where(self._normalise, standardised.clamp(-CLIP, CLIP).float(), observations)]
        if self._num_scales:
            values = observations[:, self._lidar]
            seen += [torch.exp((values - 1.0) * rate) * (values > 0.0) for rate in self._rates]
        outputs: Tensor = self._network(torch.cat(seen, dim=1))
        return outputs
