"""Warnings about trials: a curriculum without effect or with a hard landing, too few steps, endless tasks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from recrl.orchestrator.spec import TrialSpec
from recrl.teachers.registry import is_known_control

HARD_LANDING, POLICY_NOISE = "hard landing", "policy noise"  # events
NAMED = 5  # trials in a sentence, at most


def landed_hard(spec: TrialSpec, events: Iterable[str]) -> bool:
    """Return whether deployment began far above d_d, although the curriculum is no control.

    Args:
        spec: the trial.
        events: the names of its events.
    """
    return HARD_LANDING in events and not is_known_control(spec.method.name)


def no_curriculum_sentence(titles: Sequence[str]) -> str:
    """Return the warning about trials whose measured d_t is not above d_d; empty for none."""
    what = "the measured d_t is not above d_d, so the limit is d_d after the measurement"
    return _warning(what, titles, "give a finite train_limits above d_d")


def hard_landing_sentence(titles: Sequence[str]) -> str:
    """Return the warning about trials that ``landed_hard``; empty for none."""
    what = "hard landing, the limit was still far above d_d when deployment began"
    return _warning(
        what, titles, "give the curriculum more steps or a smaller d_t, or dynamic a smaller window"
    )


def no_deployment_sentence(specs: Sequence[TrialSpec]) -> str:
    """Return the warning about trials without an update in the deployment phase; empty for none."""
    what = "the deployment phase is shorter than an update, so that no update learns under d_d"
    short = [spec for spec in specs if spec.lacks_deployment]
    if not short:
        return ""
    rounding = 0.5  # of deploy_steps
    times = max(math.ceil(spec.steps_per_update / (spec.deploy_steps - rounding)) for spec in short)
    remedy = f"take {times} times the total_steps or a larger deploy_fraction"
    return _warning(what, [spec.title for spec in short], remedy)


def unknown_horizon_sentence(tasks: Sequence[str]) -> str:
    """Return the warning about tasks that do not say how long an episode may be; empty for none."""
    what = "unknown horizon, and an episode that never ends gives no result"
    return _warning(
        what,
        tasks,
        "let step return truncated=True, and give the environment an attribute horizon, or TimeLimit",
    )


def _warning(what: str, titles: Sequence[str], remedy: str) -> str:
    """Return a warning that names the first trials; empty for none."""
    more = f" and {len(titles) - NAMED} more" if len(titles) > NAMED else ""
    return f"{what}: {', '.join(titles[:NAMED])}{more}; {remedy}" if titles else ""
