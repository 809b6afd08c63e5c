"""Compiled functions do without a place to be kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from recrl.environments.simulation.machine_code import kept


def test_where_nothing_can_be_kept_functions_are_compiled_all_the_same() -> None:
    def compiler(*, cache: bool = False) -> Callable[[Any], str]:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: f"compiled {function.__name__}"

    def step() -> None: ...

    assert kept(compiler, step) == "compiled step"
