"""Warnings about trials: ineffective curricula, too few steps, endless tasks, other code or libraries."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence

from recrl.orchestrator.counting import counted
from recrl.orchestrator.files.trial_files import HARD_LANDING
from recrl.orchestrator.provenance.code_changes import CodeComparison
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.teachers.registry import is_known_control

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
        what,
        titles,
        "give the curriculum more steps or a smaller d_t, dynamic a smaller window, or let a decay of your "
        "own end at d_d",
    )


def short_deployment_sentence(specs: Sequence[TrialSpec]) -> str:
    """Return the warning about curricula whose deployment phase is shorter than an update; empty for none."""
    what = "the deployment phase is shorter than an update, so that no update learns under d_d"
    short = [spec for spec in specs if spec.deploy_steps and not spec.deploy_updates and _is_relaxed(spec)]
    if not short:
        return ""
    rounding = 0.5  # of deploy_steps
    times = max(math.ceil(spec.steps_per_update / (spec.deploy_steps - rounding)) for spec in short)
    remedy = f"take {times} times the total_steps or a larger deploy_fraction"
    return _warning(what, [spec.title for spec in short], remedy)


def no_deployment_sentence(specs: Sequence[TrialSpec]) -> str:
    """Return the warning about curricula without a deployment phase; empty for none."""
    what = "there is no deployment phase, so that perhaps no update learns under d_d"
    lacking = [spec.title for spec in specs if not spec.deploy_steps and _is_relaxed(spec)]
    return _warning(what, lacking, "give a larger deploy_fraction")


def unrelaxed_sentence(specs: Sequence[TrialSpec]) -> str:
    """Return the warning about curricula whose d_t is d_d; empty for none."""
    what = "train_limits equal deploy_limits, so that the limits are d_d from the start"
    unrelaxed = [spec.title for spec in specs if spec.method.name != "none" and not _is_relaxed(spec)]
    return _warning(what, unrelaxed, "give larger train_limits, or auto")


def _is_relaxed(spec: TrialSpec) -> bool:
    """Whether the limits may differ from d_d in the training phase."""
    if spec.method.name == "none":
        return False
    return spec.method.name == "unconstrained" or spec.train_limits != spec.deploy_limits


def short_training_sentence(specs: Sequence[TrialSpec], horizons: Mapping[str, int | None]) -> str:
    """Return the warning about tasks whose training may end before the first episode does; empty for none.

    Args:
        specs: the trials.
        horizons: most steps of an episode of each task, by its label; None if unknown.
    """
    what = "training gives each environment fewer steps than an episode may have, so maybe no episode ends"
    tasks = dict.fromkeys(
        spec.task.label
        for spec in specs
        if spec.train_updates * spec.rollout_steps < (horizons[spec.task.label] or 0)
    )
    return _warning(what, list(tasks), "take more total_steps or fewer num_envs")


def unknown_horizon_sentence(tasks: Sequence[str]) -> str:
    """Return the warning about tasks that do not say how long an episode may be; empty for none."""
    what = "unknown horizon, and an episode that never ends gives no result"
    return _warning(
        what,
        tasks,
        "let step return truncated=True, and give the environment an attribute horizon, or TimeLimit",
    )


def code_warnings(ran: Sequence[tuple[TrialStatus, CodeComparison]]) -> list[str]:
    """Return sentences on trials that ran other code or libraries than now, or code that is not known.

    Args:
        ran: status and comparison of each trial.
    """
    sentences = (
        other_code_sentence(ran),
        missing_modules_sentence(code.missing for _, code in ran),
        other_versions_sentence(code.versions for _, code in ran),
        unreadable_code_sentence(
            [it.unreadable for status, it in ran if it.unreadable and status is not TrialStatus.DAMAGED]
        ),
    )
    return [*filter(None, sentences)]


def other_code_sentence(ran: Iterable[tuple[TrialStatus, CodeComparison]]) -> str:
    """Describe trials that ran other code; empty for none.

    Args:
        ran: status and comparison of each trial.
    """
    changed = [(status, code.changed) for status, code in ran if code.differs]
    complete = sum(status is TrialStatus.COMPLETE for status, _ in changed)
    begun = len(changed) - complete
    parts = []
    if complete:
        parts.append(counted(complete, "complete trial"))
    if begun:
        parts.append(counted(begun, "begun one" if complete else "begun trial"))
    if not parts:
        return ""
    comes, them = ("comes", "it") if len(changed) == 1 else ("come", "them")
    names = ", ".join(sorted(set().union(*(names for _, names in changed))))
    return (
        f"{' and '.join(parts)} {comes} from other code than is installed now (changed: {names}); "
        f"launch --rerun-changed runs {them} again"
    )


def missing_modules_sentence(missing: Iterable[Collection[str]]) -> str:
    """Describe trials whose code could not be compared; empty for none.

    Args:
        missing: ``CodeComparison.missing`` of each trial.
    """
    lacking = [names for names in missing if names]
    if not lacking:
        return ""
    first, *others = sorted(set().union(*lacking))
    subject = f"{first} and {counted(len(others), 'other')} were" if others else f"{first} was"
    return (
        f"the code of {counted(len(lacking), 'trial')} was not checked for changes, because the module "
        f"{subject} not found; start the command in the folder that holds {'them' if others else 'it'}"
    )


def other_versions_sentence(versions: Iterable[Collection[str]]) -> str:
    """Describe trials that ran with other versions of libraries; empty for none.

    Args:
        versions: ``CodeComparison.versions`` of each trial.
    """
    others = [changes for changes in versions if changes]
    if not others:
        return ""
    listed = "; ".join(sorted(set().union(*others)))
    return (
        f"{counted(len(others), 'trial')} ran with other versions of libraries than are installed now "
        f"({listed}); the same settings may give other results"
    )


def unreadable_code_sentence(errors: Sequence[str]) -> str:
    """Describe trials not known to be damaged of which no file says what code they ran; empty for none.

    Args:
        errors: why each file cannot be read.
    """
    if not errors:
        return ""
    first = errors[0] if len(errors) == 1 else f"the first: {errors[0]}"
    return (
        f"the code of {counted(len(errors), 'trial')} was not checked for changes, because the file that "
        f"names it cannot be read ({first})"
    )


def _warning(what: str, titles: Sequence[str], remedy: str) -> str:
    """Return a warning that names the first trials; empty for none."""
    more = f" and {len(titles) - NAMED} more" if len(titles) > NAMED else ""
    return f"{what}: {', '.join(titles[:NAMED])}{more}; {remedy}" if titles else ""
