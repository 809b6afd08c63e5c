"""Users' networks: any ``torch.nn.Module``, differentiated by PyTorch.

``ModuleStack`` has the same methods for modules as ``TanhStack`` for the standard perceptron. Policies,
critics, trust regions and checkpoints work with both. The parameters of all modules are views into one flat
block.

Notation: C networks, U rows, n inputs, P parameters.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.func import functional_call

from recrl.agents.errors import NetworkError
from recrl.agents.networks.flat_parameters import FlatParameters
from recrl.agents.networks.tanh_stack import blocks

# (inputs n, outputs) -> a module that maps float32 rows, [U, n], to [U, outputs].
ModuleFactory = Callable[[int, int], nn.Module]

ACTIVATIONS: Mapping[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "relu": nn.ReLU,
    "silu": nn.SiLU,
    "tanh": nn.Tanh,
}


def perceptron(
    hidden_sizes: Sequence[int],
    activation: str,
    initialiser: Callable[[Tensor, torch.Generator], None],
    last_scale: float,
) -> Callable[[torch.Generator], ModuleFactory]:
    """Return a factory of multi-layer perceptrons with an activation between the layers.

    Args:
        hidden_sizes: widths of the hidden layers.
        activation: a key of ``ACTIVATIONS``.
        initialiser: draws each weight matrix, [in, out]; biases start at 0.
        last_scale: factor on the last layer's initial weights.
    """

    def seeded(generator: torch.Generator) -> ModuleFactory:
        def make(num_inputs: int, num_outputs: int) -> nn.Module:
            layers: list[nn.Module] = []
            sizes = (num_inputs, *hidden_sizes, num_outputs)
            for inputs, outputs in itertools.pairwise(sizes):
                layer = nn.Linear(inputs, outputs)
                drawn = torch.empty(inputs, outputs)
                initialiser(drawn, generator)
                layer.weight.data = drawn.T.contiguous()
                nn.init.zeros_(layer.bias)
                layers += [layer, ACTIVATIONS[activation]()]
            layer.weight.data.mul_(last_scale)
            return nn.Sequential(*layers[:-1])

        return make

    return seeded


class ModuleStack:
    """C separate modules of one kind.

    ``scale`` makes policies more random and rescales critics. It multiplies the weights of the last layer, if
    that is a linear one at the end of an ``nn.Sequential``. Any other module is followed by a factor, 1 at
    first. The factor is learnt: noise of 1 multiplies it by 0, and it must be able to grow again.

    Args:
        modules: C of them, without buffers, in evaluation mode.
        parameters: the block; the first tensors, with the shapes of ``shapes``, are used.
    """

    def __init__(self, modules: Sequence[nn.Module], parameters: FlatParameters) -> None:
        self._modules = modules
        self._names = [[name for name, _ in module.named_parameters()] for module in modules]
        self._last_layer = _last_layer(modules[0])
        num_tensors = sum(map(len, self._names))
        self._values = self._per_module(parameters.tensors)
        self._factors = None if self._last_layer else parameters.tensors[num_tensors]
        self._used = num_tensors + (self._factors is not None)
        self._places = parameters.gradients[: self._used]
        self._leaves = parameters.tensors[: self._used]

    @classmethod
    def shapes(cls, modules: Sequence[nn.Module]) -> list[tuple[int, ...]]:
        """The shapes of all parameters, module by module, then of the C factors, if there are any."""
        shapes = [tuple(each.shape) for module in modules for each in module.parameters()]
        return shapes if _last_layer(modules[0]) else [*shapes, (len(modules),)]

    def initialise(self) -> None:
        """Copy the modules' own initial parameters into the block; start with factors of 1."""
        for module, values in zip(self._modules, self._values, strict=True):
            for name, value in module.named_parameters():
                values[name].copy_(value.detach())
        if self._factors is not None:
            self._factors.fill_(1.0)

    def to_module(self) -> nn.Module:
        """Return a copy of the first network, with its factor if it has one."""
        module = copy.deepcopy(self._modules[0])
        with torch.no_grad():
            for name, value in module.named_parameters():
                value.copy_(self._values[0][name])
        return module if self._factors is None else _Scaled(module, self._factors[0].detach().cpu().clone())

    def scale(self, factors: Tensor) -> None:
        """Multiply each network's outputs by a factor, [C] or a scalar."""
        if self._factors is not None:
            self._factors.mul_(factors)
            return
        for values, factor in zip(self._values, factors.expand(len(self._modules)), strict=True):
            for name in self._last_layer:
                values[name].mul_(factor)

    def outputs(self, rows: Tensor) -> Tensor:
        """The outputs of every network, [C, U, out]; rows are [U, n]."""
        with torch.no_grad():
            parts = [self._forward(rows[block], self._values) for block in blocks(len(rows))]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)

    def activations(self, rows: Tensor, scratch: object = None) -> list[Tensor]:
        """Return the rows, the outputs with their graph, and the outputs alone, [C, U, out]."""
        del scratch
        with torch.enable_grad(), self._differentiable():
            outputs = self._forward(rows, self._values)
        return [rows, outputs, outputs.detach()]

    def output_change(self, activations: Sequence[Tensor], change: Sequence[Tensor]) -> Tensor:
        """The derivative of the outputs along a change of the parameters, [C, U, out].

        J v is the derivative by u of (J^T u) . v: two backward sweeps (Pearlmutter 1994 needs one forward).
        """
        tangents = list(change[: self._used])
        slope = torch.zeros_like(activations[-1], requires_grad=True)
        with torch.enable_grad(), self._differentiable():
            back = torch.autograd.grad(
                activations[1],
                self._leaves,
                slope,
                retain_graph=True,
                create_graph=True,
                materialize_grads=True,
            )
            moved: Tensor = torch.autograd.grad(back, slope, tangents)[0]
        return moved

    def pull_back(self, activations: Sequence[Tensor], slope: Tensor, *, add: bool = False) -> None:
        """Write the derivative of a loss by the parameters to the gradient block.

        Args:
            activations: the result of ``activations`` at the present parameters.
            slope: dL / d outputs, [C, U, out].
            add: add to the gradient block instead of replacing it.
        """
        with self._differentiable():
            found = torch.autograd.grad(
                activations[1], self._leaves, slope, retain_graph=True, materialize_grads=True
            )
        for place, gradient in zip(self._places, found, strict=True):
            place.add_(gradient) if add else place.copy_(gradient)

    def _forward(self, rows: Tensor, parameters: Sequence[Mapping[str, Tensor]]) -> Tensor:
        outputs = [
            functional_call(module, dict(values), (rows,))
            for module, values in zip(self._modules, parameters, strict=True)
        ]
        stacked = torch.stack(outputs)
        return stacked if self._factors is None else stacked * self._factors[:, None, None]

    @contextmanager
    def _differentiable(self) -> Iterator[None]:
        """Let views of the block require gradients only while a graph is made: optimisers write to them."""
        for leaf in self._leaves:
            leaf.requires_grad_(True)
        try:
            yield
        finally:
            for leaf in self._leaves:
                leaf.requires_grad_(False)

    def _per_module(self, tensors: Sequence[Tensor]) -> list[dict[str, Tensor]]:
        """The first tensors of a block by module and name."""
        rest = iter(tensors)
        return [{name: next(rest) for name in names} for names in self._names]


def _last_layer(module: nn.Module) -> list[str]:
    """The names of the parameters that scale a module's outputs, if its last layer is linear; else none."""
    own = dict(module.named_parameters())
    prefix, last = "", module
    while isinstance(last, nn.Sequential) and len(last):
        prefix, last = f"{prefix}{len(last) - 1}.", last[-1]
    names = [prefix + name for name, _ in last.named_parameters()]
    # A layer that occurs twice has its parameters under its first name only: scaling them would change both.
    return names if type(last) is nn.Linear and own.keys() >= set(names) else []


class _Scaled(nn.Module):
    """A module whose outputs are multiplied by a factor."""

    factor: Tensor

    def __init__(self, module: nn.Module, factor: Tensor) -> None:
        super().__init__()
        self.module = module
        self.register_buffer("factor", factor)

    def forward(self, rows: Tensor) -> Tensor:
        outputs: Tensor = self.module(rows) * self.factor
        return outputs


def checked_module(factory: ModuleFactory, num_inputs: int, num_outputs: int, *, role: str) -> nn.Module:
    """Make a network and test it on two rows.

    Args:
        factory: the user's, or ``perceptron``'s.
        num_inputs: n.
        num_outputs: actions, action components, or 1.
        role: of the network, for errors: ``policy`` or ``critic``.

    Raises:
        NetworkError: it is no module, has buffers, no parameters or frozen ones, fails, returns another
            shape or type, or its rows depend on one another.
    """
    name = getattr(factory, "__qualname__", "the network's factory")
    try:
        module = factory(num_inputs, num_outputs)
    except Exception as error:
        raise NetworkError(f"{name}({num_inputs}, {num_outputs}) failed: {error}") from error
    if not isinstance(module, nn.Module):
        raise NetworkError(f"the network's factory returned a {type(module).__name__}, not a torch.nn.Module")
    module.eval()
    names = [name for name, _ in module.named_buffers()]
    if names:
        raise NetworkError(
            f"the network has buffers ({', '.join(names)}), which are not learnt: use layers without "
            "running statistics, such as LayerNorm instead of BatchNorm"
        )
    if not list(module.parameters()):
        raise NetworkError("the network has no parameters: give it a layer that is learnt")
    frozen = [name for name, parameter in module.named_parameters() if not parameter.requires_grad]
    if frozen:
        raise NetworkError(
            f"the network has frozen parameters ({', '.join(frozen)}), and all parameters are learnt: "
            "compute what is fixed in a wrapper of the environment"
        )
    rows = torch.linspace(-1.0, 1.0, 2 * num_inputs).reshape(2, num_inputs)
    try:
        with torch.no_grad():
            outputs, alone = module(rows), module(rows[1:])
    except Exception as error:
        raise NetworkError(f"the network of {name} failed on float32 [2, {num_inputs}]: {error}") from error
    if not isinstance(outputs, Tensor) or outputs.shape != (2, num_outputs) or outputs.dtype != torch.float32:
        found = f"{outputs.dtype} {list(outputs.shape)}" if isinstance(outputs, Tensor) else type(outputs)
        raise NetworkError(
            f"the network{f' of the {role}' if role else ''} maps 2 rows of {num_inputs} numbers to {found}: "
            f"it must return float32 [2, {num_outputs}]"
        )
    if not torch.allclose(outputs[1:], alone, rtol=1e-3, atol=1e-5):
        raise NetworkError(
            "the network's output for a row depends on the other rows: rows are separate observations, in "
            "any order"
        )
    return module
