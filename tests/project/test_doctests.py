"""Every example in a docstring runs."""

import doctest
import importlib
import importlib.util
import pkgutil
from pathlib import Path

import pytest

PACKAGES = ("orchestrator", "agents", "environments", "teachers", "analysis")
MODULES = [
    module.name
    for package in PACKAGES
    for module in pkgutil.walk_packages(
        importlib.import_module(f"recrl.{package}").__path__, prefix=f"recrl.{package}."
    )
] + ["recrl._train_and_launch", "recrl._results", "recrl._tasks"]


def has_examples(name: str) -> bool:
    """Whether the source of a module holds an example; nothing is imported to know it."""
    spec = importlib.util.find_spec(name)
    assert spec is not None
    assert spec.origin is not None
    return ">>> " in Path(spec.origin).read_text(encoding="utf-8")


def test_modules_of_subpackages_are_found_too() -> None:
    assert "recrl.environments.velocity.velocity_batch" in MODULES


def test_every_module_can_be_imported() -> None:
    for name in MODULES:
        importlib.import_module(name)


@pytest.mark.parametrize("name", [name for name in MODULES if has_examples(name)])
def test_examples(name: str) -> None:
    results = doctest.testmod(importlib.import_module(name))
    assert results.failed == 0
