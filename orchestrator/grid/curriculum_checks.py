"""Checks that a trial's curriculum suits its agent's constraint and its task's limits."""

from __future__ import annotations

import math
from collections.abc import Iterator

from recrl.environments.cmdp import CMDPSpec
from recrl.orchestrator.spec import TrialSpec
from recrl.teachers.registry import find_teacher


def unsuitable(trial: TrialSpec, cmdp: CMDPSpec) -> Iterator[tuple[str, str]]:
    """Yield what does not suit: the section of the grid to change, ``agents`` or ``methods``, and a sentence.

    Curricula measure mean costs. An agent that bounds a CVaR compares another value with the same limits.
    The entropy of a Gaussian policy has no bound, although its actions are clipped.

    Args:
        trial: to be checked.
        cmdp: of its task.
    """
    curriculum, method, task = find_teacher(trial.method.name), trial.method.label, trial.task.label
    if trial.agent.options.get("constraint") == "cvar":
        if curriculum.compares_costs:
            yield (
                "agents",
                f"constraint: cvar does not suit the method {method}, which compares mean costs with the "
                "limits; use constraint: mean, or exclude the pair",
            )
        elif curriculum.measures_start and not all(map(math.isfinite, trial.train_limits)):
            yield (
                "agents",
                f"constraint: cvar does not suit the train_limits of {task}, which are measured as mean "
                "costs; give them as numbers, or exclude the pair",
            )
    if curriculum.rewards_entropy and cmdp.has_continuous_actions:
        yield (
            "methods",
            f"{method} rewards the policy's entropy, which has no bound with the continuous actions of "
            f"{task}; use another method, or exclude the pair",
        )
    if trial.method.name == "cooling" and trial.method.options.get("relaxation"):
        names_and_limits = zip(cmdp.cost_names, trial.deploy_limits, trial.train_limits, strict=True)
        never_relaxed = [name for name, deploy, train in names_and_limits if deploy == 0.0 < train]
        if never_relaxed:
            yield (
                "methods",
                f"{method} relaxes a limit in proportion to it, so it never relaxes the deploy_limits of 0 "
                f"of {' and '.join(never_relaxed)} in {task}; use another method, deploy_limits above 0, or "
                "train_limits with a 0 there, and .inf for what is to be measured",
            )
