"""Checks of a saved state of environments, entry by entry, before it is loaded.

A state comes from a file or from another process, and compiled code uses its indices without a check. So each
array must have the shape and the dtype that the environments need, and its numbers must lie within bounds.

A state has the identity of its task: name, horizon and number of costs. States of older versions have none,
and of these the task is not compared.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import CMDPSpec

IDENTITY = "identity"


def identity(cmdp: CMDPSpec) -> dict[str, Any]:
    """Return the identity of a task, an entry ``IDENTITY`` of a state."""
    return {"task": cmdp.name, "horizon": cmdp.horizon, "num_costs": cmdp.num_costs}


@dataclass(frozen=True)
class SavedState:
    """A state, or a part of it, that checks each entry when it is read.

    Every method raises a ValueError if the entry is missing or wrong, with the source and the path.

    Attributes:
        source: where the state is from, for errors; for example ``CarGoal2: saved state``.
        tree: the state, as ``state_dict`` returned it.
        path: place of this part in the whole state, for errors; empty, or ending with a dot.
    """

    source: str
    tree: Any
    path: str = ""

    def entry(self, name: str | int) -> Any:
        """Return an entry without a check of its value."""
        if not isinstance(self.tree, Mapping):
            raise ValueError(
                f"{self.source}: {self.path.removesuffix('.') or 'it'} must be a dict, got {_kind(self.tree)}"
            )
        if name not in self.tree:
            raise self.error(name, "is missing")
        return self.tree[name]

    def part(self, name: str) -> SavedState:
        """Return the dict of this name."""
        return SavedState(self.source, self.entry(name), f"{self.path}{name}.")

    def array(
        self,
        name: str | int,
        like: npt.NDArray[Any],
        *,
        least: float = -math.inf,
        most: float = math.inf,
    ) -> npt.NDArray[Any]:
        """Return a copy of an array, which is finite.

        Args:
            name: of the entry.
            like: an array of the required shape and dtype.
            least: lower bound of its numbers.
            most: upper bound of its numbers.
        """
        found = self.entry(name)
        if (
            not isinstance(found, np.ndarray)
            or found.shape != like.shape
            or not np.can_cast(found.dtype, like.dtype, "safe")
        ):
            raise self.error(name, f"must be {_kind(like)}, got {_kind(found)}")
        bad = found[~(np.isfinite(found) & (found >= least) & (found <= most))]
        if bad.size:
            bounds = "finite" if math.isinf(least) else f"from {least} to {most}"
            raise self.error(name, f"must have numbers that are {bounds}, got {bad.flat[0]}")
        return np.array(found, like.dtype)

    def arrays(
        self, name: str, number: int, *, shape: tuple[int, ...], dtype: npt.DTypeLike | None
    ) -> list[npt.NDArray[Any]]:
        """Return a copy of the array of each of ``number`` environments, [T, *shape] with any T."""
        self.check_number(name, number)
        parts = SavedState(self.source, dict(enumerate(self.entry(name))), f"{self.path}{name}.")
        return [
            parts.array(index, np.empty((*np.shape(part)[:1], *shape), dtype))
            for index, part in parts.tree.items()
        ]

    def whole_numbers(self, name: str, number: int, *, most: int) -> list[int]:
        """Return the number of each of ``number`` environments, from 0 to ``most``."""
        self.check_number(name, number)
        found = list(self.entry(name))
        for index, each in enumerate(found):
            if not isinstance(each, int | np.integer) or isinstance(each, bool) or not 0 <= each <= most:
                raise self.error(f"{name}.{index}", f"must be a whole number from 0 to {most}, got {each!r}")
        return list(map(int, found))

    def generators(self, name: str, number: int) -> list[np.random.Generator]:
        """Return the generators of ``number`` environments, from the states of their bit generators."""
        self.check_number(name, number)
        return [self._generator(f"{name}.{index}", found) for index, found in enumerate(self.entry(name))]

    def generator(self, name: str) -> np.random.Generator:
        """Return the generator that all environments share, from the state of its bit generator."""
        return self._generator(name, self.entry(name))

    def _generator(self, name: str, saved: Any) -> np.random.Generator:
        generator = np.random.Generator(np.random.PCG64(0))
        try:
            generator.bit_generator.state = saved
        except (KeyError, OverflowError, TypeError, ValueError) as error:
            raise self.error(name, f"must be the state of a PCG64 ({error})") from error
        return generator

    def check_number(self, name: str, number: int) -> None:
        """Check that a list or an array has an entry for each of ``number`` environments."""
        found = self.entry(name)
        listed = isinstance(found, Sequence) and not isinstance(found, str)
        if not listed and not (isinstance(found, np.ndarray) and found.ndim):
            raise self.error(name, f"must be a list or an array, got {_kind(found)}")
        if len(found) != number:
            raise self.error(name, f"must be of {number} environments, got {len(found)}")

    def check_identity(self, cmdp: CMDPSpec) -> None:
        """Check that the state is of this task, horizon and number of costs; a state may have no identity."""
        if not isinstance(self.tree, Mapping) or IDENTITY not in self.tree:
            return
        saved = self.part(IDENTITY)
        for name, expected in identity(cmdp).items():
            if saved.entry(name) != expected:
                raise saved.error(name, f"must be {expected!r}, got {saved.entry(name)!r}")

    def error(self, name: str | int, problem: str) -> ValueError:
        """Return an error about an entry."""
        return ValueError(f"{self.source}: {self.path}{name} {problem}")


def _kind(value: Any) -> str:
    """Describe a value for an error."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype} of shape {value.shape}"
    return type(value).__name__
