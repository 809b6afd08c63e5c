"""Remarks on the validity of a sweep's numbers: damage, other code or devices, ineffective curricula."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from recrl.analysis.data.labels import BASELINE, KEY, listed
from recrl.analysis.data.sweep_data import Sweep, TrialFacts
from recrl.orchestrator.files.trial_files import HARD_LANDING
from recrl.orchestrator.provenance.code_changes import InstalledCode, compare, library_versions
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.trial_warnings import (
    NAMED,
    hard_landing_sentence,
    landed_hard,
    missing_modules_sentence,
    no_curriculum_sentence,
    other_code_sentence,
)

_Ran = Mapping[str, set[str]]  # digests of code, or versions, by the name of the package


def damages(sweep: Sweep) -> list[str]:
    """Return a sentence for each damaged trial, whose data are not in the data frames."""
    return [f"{it.spec.title}: {it.error}" for it in sweep.facts if it.status is TrialStatus.DAMAGED]


def doubts(sweep: Sweep) -> list[str]:
    """Return sentences on code, libraries and devices that differ, and on ineffective curricula."""
    installed = InstalledCode()
    ran = [(it.status, compare(attempts_with_code(it), it.spec, installed)) for it in sweep.facts]
    other = other_code_sentence(ran)
    if other and sweep.folder is None:
        other += ", in a sweep's own folder"
    missing = missing_modules_sentence(code.missing for _, code in ran)
    mixed = (mixed_code_sentence(sweep), mixed_versions_sentence(sweep), mixed_devices_sentence(sweep))
    return [*filter(None, (other, missing, *mixed)), *curriculum_warnings(sweep)]


def mixed_code_sentence(sweep: Sweep) -> str:
    """Name cells whose seeds are averaged, or that are compared with none, but ran different code.

    The code of a trial is that of its last attempt: recrl's, and that of each plug-in. Trials without a
    record of it do not count.

    Returns:
        One sentence; empty if there are no such cells.
    """
    where = _where_different(_ran_by_cell(sweep, lambda known: [known[-1]["code"]]))
    remedy = "in a sweep's own folder, launch --rerun-changed makes it that of the installed version"
    return f"the code that trials ran differs {where}; {remedy}" if where else ""


def mixed_versions_sentence(sweep: Sweep) -> str:
    """Name cells as ``mixed_code_sentence`` does, whose trials ran with different versions of libraries.

    All attempts of a trial count, because each of them learnt a part of its policy.
    """
    return _mixed_sentence(sweep, "versions of libraries differ", library_versions)


def mixed_devices_sentence(sweep: Sweep) -> str:
    """Name cells as ``mixed_versions_sentence`` does, whose trials learnt on a processor and on a GPU.

    Cells with GPUs of several kinds are named, too. Kinds of processors do not count.
    """
    return _mixed_sentence(sweep, "devices differ", _device)


def _device(attempt: Mapping[str, Any]) -> dict[str, str]:
    """Return what an attempt learnt on, as one entry; none if there is no record of it."""
    return {"learnt on": str(attempt["device"])} if "device" in attempt else {}


def _mixed_sentence(
    sweep: Sweep, what: str, of_attempt: Callable[[Mapping[str, Any]], Mapping[str, str]]
) -> str:
    """Say where attempts differ in something, and in which values; empty if they do not.

    Args:
        sweep: the sweep.
        what: the beginning of the sentence.
        of_attempt: the values by name.
    """
    ran = _ran_by_cell(sweep, lambda known: map(of_attempt, known))
    where = _where_different(ran)
    if not where:
        return ""
    found: _Ran = functools.reduce(_joined, ran.values(), {})
    different = [f"{name} {', '.join(sorted(of))}" for name, of in sorted(found.items()) if len(of) > 1]
    return f"{what} {where}, so a difference may come from them: {'; '.join(different)}"


def _ran_by_cell(
    sweep: Sweep, of_attempts: Callable[[list[dict[str, Any]]], Iterable[Mapping[str, Any]]]
) -> dict[tuple[str, str, str], _Ran]:
    """Return what the trials of each cell ran: by name, all digests or versions.

    Args:
        sweep: the sweep.
        of_attempts: digests or versions by name, from the attempts of one trial, at least one.
    """
    cells: dict[tuple[str, str, str], _Ran] = {}
    for group, trial in zip(sweep.groups, sweep.facts, strict=True):
        if known := attempts_with_code(trial):
            for found in of_attempts(known):
                of_trial = {name: {str(value)} for name, value in found.items()}
                cells[group] = _joined(cells.get(group, {}), of_trial)
    return cells


def _where_different(cells: Mapping[tuple[str, str, str], _Ran]) -> str:
    """Name cells whose trials ran different things; empty if there are none."""
    averaged = [group for group, found in cells.items() if _is_mixed(found)]
    compared = []
    for (task, agent, method), found in cells.items():
        baseline = cells.get((task, agent, BASELINE), {})
        if not _is_mixed(found) and not _is_mixed(baseline) and _is_mixed(_joined(found, baseline)):
            compared.append((task, agent, method))
    parts = [
        *([f"between seeds that are averaged ({_cells(averaged)})"] if averaged else []),
        *([f"between {BASELINE} and curricula compared with it ({_cells(compared)})"] if compared else []),
    ]
    return " and ".join(parts)


def _joined(one: _Ran, other: _Ran) -> _Ran:
    return {name: one.get(name, set()) | other.get(name, set()) for name in {**one, **other}}


def _is_mixed(ran: _Ran) -> bool:
    return any(len(values) > 1 for values in ran.values())


def _cells(groups: Sequence[tuple[str, str, str]]) -> str:
    return listed([" ".join(group) for group in groups], NAMED)


def curriculum_warnings(sweep: Sweep) -> list[str]:
    """Sentences on curricula that had no effect or ended far above d_d."""
    flags = curriculum_flags(sweep)
    sentences = (
        no_curriculum_sentence(_titles(flags, "no_curriculum")),
        hard_landing_sentence(_titles(flags, "hard_landing")),
    )
    return [sentence for sentence in sentences if sentence]


def curriculum_flags(sweep: Sweep) -> pd.DataFrame:
    """Say of each trial whether its curriculum had no effect or ended far above d_d.

    Returns:
        KEY, no_curriculum, hard_landing: a row a trial, in the order of the frame ``trials``.
    """
    facts = {it.spec.trial_id: it for it in sweep.facts}
    landed = sweep.events.loc[sweep.events["event"] == HARD_LANDING, list(KEY)]
    keys = set(landed.itertuples(index=False, name=None))
    flags = sweep.trials[list(KEY)].copy()
    trials = [facts[trial_id] for trial_id in sweep.trials["trial_id"]]
    flags["no_curriculum"] = [it.spec.is_no_curriculum(it.start_limits) for it in trials]
    flags["hard_landing"] = [
        landed_hard(it.spec, [HARD_LANDING] if key in keys else [])
        for it, key in zip(trials, flags[list(KEY)].itertuples(index=False, name=None), strict=True)
    ]
    return flags


def _titles(flags: pd.DataFrame, flag: str) -> list[str]:
    """The trials that have a flag, as people call them."""
    return [f"{it.task} {it.agent} {it.method} seed {it.seed}" for it in flags[flags[flag]].itertuples()]


def attempts_with_code(trial: TrialFacts) -> list[dict[str, Any]]:
    """Return the provenance of the attempts that recorded their code."""
    return [it for it in trial.attempts if isinstance(it.get("code"), dict)]
