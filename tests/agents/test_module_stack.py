"""Networks of the user's own do what the standard perceptron does, and say what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from recrl.agents.collection import Collector, episode_costs
from recrl.agents.errors import NetworkError
from recrl.agents.networks.architecture import orthogonal
from recrl.agents.networks.flat_parameters import FlatParameters
from recrl.agents.networks.module_stack import ModuleStack, checked_module
from recrl.agents.networks.tanh_stack import TanhStack
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.plugins import UntrustedNameError, refuse_import_paths
from recrl.environments.registry import make_vector
from recrl.orchestrator.files.checkpoint_format import decode, encode

SIZES, NETWORKS, ROWS = (3, 5, 4, 2), 2, 7
AGENTS = ["ppo-lag", "cpo", "focops", "trpo-lag", "pcpo"]
OWN = {"network": f"{__name__}:with_layer_norm"}


def with_layer_norm(num_inputs: int, num_outputs: int) -> nn.Module:
    """A user's network."""
    return nn.Sequential(nn.Linear(num_inputs, 8), nn.LayerNorm(8), nn.SiLU(), nn.Linear(8, num_outputs))


class Both:
    """The same networks as a ``TanhStack`` and as modules."""

    def __init__(self) -> None:
        self.fast_block = FlatParameters(TanhStack.shapes(NETWORKS, SIZES))
        self.fast = TanhStack(self.fast_block, len(SIZES) - 1)
        self.fast.initialise(orthogonal, 1.0, torch.Generator().manual_seed(0))
        self.fast_block.values.add_(0.1 * torch.randn(len(self.fast_block.values)))
        modules = [self.module(number) for number in range(NETWORKS)]
        self.block = FlatParameters(ModuleStack.shapes(modules))
        self.stack = ModuleStack(modules, self.block)
        self.stack.initialise()

    def module(self, number: int) -> nn.Module:
        layers: list[nn.Module] = []
        for weight, bias in zip(self.fast.weights, self.fast.biases, strict=True):
            layer = nn.Linear(*weight.shape[1:])
            layer.weight.data, layer.bias.data = weight[number].T.clone(), bias[number, 0].clone()
            layers += [layer, nn.Tanh()]
        return nn.Sequential(*layers[:-1])

    def as_modules(self, pieces: list[Tensor]) -> list[Tensor]:
        """Pieces of the perceptrons' block in the order of the modules' parameters."""
        ordered = [
            part
            for number in range(NETWORKS)
            for piece in pieces
            for part in (piece[number, :-1].T, piece[number, -1])
        ]
        return ordered


@pytest.fixture
def both() -> Both:
    torch.manual_seed(1)
    return Both()


def test_outputs_and_derivatives_are_those_of_the_standard_perceptron(both: Both) -> None:
    rows, slope = torch.randn(ROWS, SIZES[0]), torch.randn(NETWORKS, ROWS, SIZES[-1])
    ours, theirs = both.fast.activations(rows), both.stack.activations(rows)
    torch.testing.assert_close(theirs[-1], ours[-1])
    torch.testing.assert_close(both.stack.outputs(rows), both.fast.outputs(rows))
    for add in (False, True):
        both.fast.pull_back(ours, slope, add=add)
        both.stack.pull_back(theirs, slope, add=add)
        torch.testing.assert_close(both.block.gradients, both.as_modules(both.fast_block.gradients))
    change = [torch.randn(tensor.shape) for tensor in both.fast_block.tensors]
    torch.testing.assert_close(
        both.stack.output_change(theirs, both.as_modules(change)), both.fast.output_change(ours, change)
    )


def test_scaling_changes_the_last_layer(both: Both) -> None:
    rows = torch.randn(ROWS, SIZES[0])
    before = both.stack.outputs(rows)
    both.stack.scale(torch.tensor([2.0, 0.5]))
    torch.testing.assert_close(both.stack.outputs(rows), before * torch.tensor([2.0, 0.5])[:, None, None])
    first = both.fast_block.tensors[0]
    torch.testing.assert_close(both.block.tensors[0], first[0, :-1].T)


def of_no_known_end(num_inputs: int, num_outputs: int) -> nn.Module:
    """A network whose last layer is not found: it is followed by a factor."""
    return Ended(with_layer_norm(num_inputs, num_outputs))


class Ended(nn.Module):
    def __init__(self, layers: nn.Module) -> None:
        super().__init__()
        self.layers = layers

    def forward(self, rows: Tensor) -> Tensor:
        outputs: Tensor = self.layers(rows)
        return outputs


def with_one_layer_twice(num_inputs: int, num_outputs: int) -> nn.Module:
    """The scale of its last layer is that of its first one."""
    layer = nn.Linear(num_inputs, num_outputs)
    return nn.Sequential(layer, nn.Tanh(), layer)


@pytest.mark.parametrize("factory", [of_no_known_end, with_one_layer_twice])
def test_a_factor_scales_other_networks_and_is_learnt(factory: Callable[[int, int], nn.Module]) -> None:
    torch.manual_seed(2)
    modules = [factory(3, 3) for _ in range(2)]
    block = FlatParameters(ModuleStack.shapes(modules))
    stack = ModuleStack(modules, block)
    stack.initialise()
    rows, slope = torch.randn(ROWS, 3), torch.randn(2, ROWS, 3)
    before = stack.outputs(rows)
    stack.scale(torch.tensor([2.0, 0.0]))
    torch.testing.assert_close(stack.outputs(rows), before * torch.tensor([2.0, 0.0])[:, None, None])
    stack.pull_back(stack.activations(rows), slope)
    torch.testing.assert_close(block.gradients[-1], (before * slope).sum(dim=(1, 2)))
    change = torch.zeros_like(block.values)
    change[-2:] = torch.tensor([3.0, 4.0])
    moved = stack.output_change(stack.activations(rows), block.pieces(change))
    torch.testing.assert_close(moved, before * torch.tensor([3.0, 4.0])[:, None, None])
    torch.testing.assert_close(stack.to_module()(rows), 2.0 * before[0])


@pytest.mark.parametrize("noise_form", ["match-mixture", "temperature"])
@pytest.mark.parametrize(
    "options",
    [{"activation": "tanh"}, {"activation": "relu"}, OWN, {"network": f"{__name__}:of_no_known_end"}],
    ids=["tanh", "relu", "own", "no-known-end"],
)
def test_a_policy_that_noise_made_uniform_learns_again(options: dict[str, Any], noise_form: str) -> None:
    environments = make_vector("two-state", 8)
    settings = {"noise_form": noise_form, "critic_steps": 5, "critic_passes": 1, **options}
    agent = make_agent("ppo-lag", environments.cmdp, settings, np.random.SeedSequence(7))
    collector, generator = Collector(environments, num_steps=20), np.random.default_rng(2)
    collector.reset(seed=1)
    rollout, _ = collector.collect(agent, generator)
    agent.add_noise(1.0, rollout.observations.reshape(-1, rollout.observations.shape[-1]))
    entropies = []
    for _ in range(30):
        rollout, episodes = collector.collect(agent, generator)
        metrics = agent.update(rollout, episode_costs(episodes, 1), CurriculumStep(CostLimits((1e6,))))
        entropies.append(metrics["entropy"])
    assert entropies[0] == pytest.approx(np.log(2.0), abs=0.02)
    assert entropies[-1] < 0.5


def trained(agent: str, task: str, options: dict[str, Any], *, updates: int = 3) -> Any:
    environments = make_vector(task, 4)
    learner = make_agent(agent, environments.cmdp, {"critic_steps": 5, **options}, np.random.SeedSequence(7))
    collector, generator = Collector(environments, num_steps=20), np.random.default_rng(2)
    collector.reset(seed=1)
    for _ in range(updates):
        rollout, episodes = collector.collect(learner, generator)
        learner.update(rollout, episode_costs(episodes, 1), CurriculumStep(CostLimits((1.0,))))
    return learner


@pytest.mark.parametrize("agent", AGENTS)
@pytest.mark.parametrize("task", ["two-state", "continuous-bandit"])
@pytest.mark.parametrize("options", [{"activation": "relu", "hidden_sizes": [8]}, OWN], ids=["relu", "own"])
def test_agents_learn_with_other_networks_and_resume_exactly(
    agent: str, task: str, options: dict[str, Any]
) -> None:
    once, again = (trained(agent, task, options) for _ in range(2))
    state = once.state_dict()
    np.testing.assert_array_equal(state["policy"], again.state_dict()["policy"])
    fresh = trained(agent, task, options, updates=0)
    assert not np.array_equal(fresh.state_dict()["policy"], state["policy"])
    fresh.load_state_dict(decode(encode(state), source="memory"))
    collector, generator = Collector(make_vector(task, 4), num_steps=20), np.random.default_rng(3)
    collector.reset(seed=2)
    for _ in range(2):
        rollout, episodes = collector.collect(once, generator)
        costs, step = episode_costs(episodes, 1), CurriculumStep(CostLimits((1.0,)))
        assert repr(fresh.update(rollout, costs, step)) == repr(once.update(rollout, costs, step))
    for part in ("policy", "critics"):
        np.testing.assert_array_equal(fresh.state_dict()[part], once.state_dict()[part])
    noisy = once.add_noise(0.5, rollout.observations[0])
    assert noisy["randomness_after"] >= noisy["randomness_before"]


def no_module(num_inputs: int, num_outputs: int) -> Any:
    return num_inputs + num_outputs


def of_another_shape(num_inputs: int, num_outputs: int) -> nn.Module:
    return nn.Linear(num_inputs, num_outputs + 1)


def with_statistics(num_inputs: int, num_outputs: int) -> nn.Module:
    return nn.Sequential(nn.BatchNorm1d(num_inputs), nn.Linear(num_inputs, num_outputs))


class _Mixed(nn.Linear):
    def forward(self, rows: Tensor) -> Tensor:
        return super().forward(rows.cumsum(dim=0))


def mixed_rows(num_inputs: int, num_outputs: int) -> nn.Module:
    return _Mixed(num_inputs, num_outputs)


def with_a_frozen_layer(num_inputs: int, num_outputs: int) -> nn.Module:
    return nn.Sequential(nn.Linear(num_inputs, 4).requires_grad_(False), nn.Linear(4, num_outputs))


@pytest.mark.parametrize(
    ("factory", "sentence"),
    [
        (with_a_frozen_layer, r"the network has frozen parameters \(0.weight, 0.bias\), and all"),
        (no_module, "the network's factory returned a int, not a torch.nn.Module"),
        (of_another_shape, r"to torch.float32 \[2, 3\]: it must return float32 \[2, 2\]"),
        (with_statistics, "the network has buffers .*use layers without running statistics"),
        (lambda _, __: nn.Identity(), "the network has no parameters: give it a layer that is learnt"),
        (lambda _, outputs: nn.Linear(99, outputs), r"failed on float32 \[2, 4\]"),
        (lambda only: nn.Linear(only, 2), r"\(4, 2\) failed"),
        (mixed_rows, "depends on the other rows"),
    ],
)
def test_what_is_wrong_with_a_network_is_said(factory: Callable[[int, int], Any], sentence: str) -> None:
    with pytest.raises(NetworkError, match=sentence):
        checked_module(factory, 4, 2, role="policy")


@pytest.mark.parametrize("role", ["policy", "critic"])
def test_a_wrong_shape_says_of_which_network(role: str) -> None:
    with pytest.raises(NetworkError, match=rf"^the network of the {role} maps 2 rows of 4 numbers to "):
        checked_module(of_another_shape, 4, 2, role=role)


def test_a_file_of_somebody_else_runs_no_network() -> None:
    with refuse_import_paths(), pytest.raises(UntrustedNameError):
        trained("ppo-lag", "two-state", {"network": "os:system"}, updates=0)
