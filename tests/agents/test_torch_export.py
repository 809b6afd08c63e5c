"""A policy as a module chooses as the agent does, and can be exported."""

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from recrl.agents.building_blocks.policy_families import GaussianPolicy, make_policy
from recrl.agents.networks.architecture import INITIALISERS, NetworkArchitecture
from recrl.agents.networks.module_stack import perceptron
from recrl.agents.observation_features import Encoder
from recrl.agents.torch_export import PolicyModule
from recrl.environments.cmdp import ObservationComponent

PARTS = (ObservationComponent("speed", 2), ObservationComponent("walls", 3, lidar_range=3.0))
SPACES = (Discrete(4), Box(np.array([-1.0, 10.0], np.float32), np.array([1.0, 20.0], np.float32)))
INITIALISER = INITIALISERS["orthogonal"]


def observations(count: int = 6) -> Any:
    rows = np.random.default_rng(0).uniform(0.0, 1.0, (count, 5)).astype(np.float32)
    rows[0, 2:] = 0.0  # nothing in range
    return rows


@pytest.mark.parametrize("space", SPACES, ids=["discrete", "continuous"])
@pytest.mark.parametrize("own", [False, True], ids=["tanh", "module"])
@pytest.mark.parametrize("normalise", [False, True])
def test_a_module_computes_what_the_agent_does(space: Any, own: bool, normalise: bool) -> None:
    encoder = Encoder(
        5, PARTS, scales=(0.15, 0.4), normalise=np.arange(5) < 2 if normalise else np.zeros(5, np.bool_)
    )
    encoder.learn(observations(50))
    generator = torch.Generator().manual_seed(0)
    factory = perceptron([8], "relu", INITIALISER, last_scale=1.0)(generator) if own else None
    policy = make_policy(
        encoder.size, space, NetworkArchitecture((8, 8), INITIALISER, "tanh", factory), 0.5, generator
    )
    module = PolicyModule(encoder, policy)
    rows = observations()
    inputs = torch.as_tensor(rows)
    expected, log_std = policy.outputs(encoder(rows)), np.empty(0)
    if isinstance(policy, GaussianPolicy):
        expected = [0.0, 15.0] + np.array([1.0, 5.0]) * expected
        log_std = policy.log_std.numpy() + np.log([1.0, 5.0])
    np.testing.assert_allclose(module(inputs).detach().numpy(), expected, rtol=1e-5, atol=1e-6)
    exported = torch.export.export(module, (inputs,), dynamic_shapes=({0: torch.export.Dim("batch")},))
    few = exported.module()(inputs[:3]).detach().numpy()
    np.testing.assert_allclose(few, expected[:3], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(module.log_std, log_std, rtol=1e-6)
    policy.parameters.values.zero_()  # it is a copy
    np.testing.assert_allclose(module(inputs).detach().numpy(), expected, rtol=1e-5, atol=1e-6)
