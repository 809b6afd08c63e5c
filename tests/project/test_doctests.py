"""Every example in a docstring runs."""

import doctest
import importlib
import pkgutil

import pytest

PACKAGES = ("orchestrator", "agents", "environments", "teachers", "analysis")
MODULES = [
    module.name
    for package in PACKAGES
    for module in pkgutil.walk_packages(
        importlib.import_module(f"recrl.{package}").__path__, prefix=f"recrl.{package}."
    )
] + ["recrl._train_and_launch", "recrl._results", "recrl._tasks"]


def test_modules_of_subpackages_are_found_too() -> None:
    assert "recrl.environments.velocity.velocity_batch" in MODULES


@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    assert doctest.testmod(importlib.import_module(name)).failed == 0
