"""A trained policy as a ``torch.nn.Module`` of its own, for ``torch.export`` and ONNX."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.policy_families import GaussianPolicy
from recrl.agents.observation_features import CLIP, Encoder
from recrl.agents.spaces import action_range


class PolicyModule(nn.Module):
    """Maps observations, float32 [B, n], to logits [B, A] or, for continuous actions, means [B, m].

    Means and standard deviations are in the task's units.

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
    _middle: Tensor
    _half: Tensor

    def __init__(self, encoder: Encoder, policy: StochasticPolicy) -> None:
        super().__init__()
        constants = encoder.constants()
        for name, values in constants.items():
            self.register_buffer(f"_{name}", torch.as_tensor(values).clone())
        self._num_scales, self._is_normalised = len(constants["rates"]), len(constants["mean"]) > 0
        self._is_continuous = isinstance(policy, GaussianPolicy)
        log_std, middle, half = (torch.empty(0),) * 3
        if isinstance(policy, GaussianPolicy):
            middle, half = (torch.as_tensor(values).float() for values in action_range(policy.action_space))
            log_std = policy.log_std.detach().cpu() + half.log()
        for name, tensor in (("log_std", log_std), ("_middle", middle), ("_half", half)):
            self.register_buffer(name, tensor)
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
        return self._middle + self._half * outputs if self._is_continuous else outputs
