"""Merge parts of a sweep that ran in several places; take a part of a sweep.

A grid's trials may be divided with ``launch --only``, or a sweep may continue without the folder of its first
trials. Each place makes an export (``recrl.analysis.data.export``); here they are joined. Trials are the same
if their specs are, independent of the parts' names.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import TRIAL, listed
from recrl.analysis.data.sweep_data import ROWS, Sweep, TrialFacts, assemble
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.spec import TrialSpec, TrialStatus

OUTCOMES = ("phases", "evaluations")  # data frames that every source has unrounded
NAMED = 3  # largest number of trials in a note


def merge(parts: Sequence[Sweep], *, finished_only: bool = False) -> Sweep:
    """Return all trials of some sweeps, each once, from the part with the most progress.

    Damaged trials rank below all others, complete ones above. Then the steps count, then whether the trial
    was begun; among equals the first part is used. Two parts may have completed a trial with different
    outcomes, because machines and versions round differently. Then there is a note.

    Args:
        parts: at least one. The first gives the name and the grid file; its trials come first, then the
            trials of other parts.
        finished_only: leave out trials that are waiting or running. Failed ones stay: they count in verdicts.

    Raises:
        RecrlError: only finished trials are wanted, and there are none.
    """
    trials = [{trial.spec.trial_id: trial for trial in part.facts} for part in parts]
    having: dict[str, list[int]] = {}
    for number, of_part in enumerate(trials):
        for trial_id in of_part:
            having.setdefault(trial_id, []).append(number)
    taken = {
        trial_id: max(numbers, key=lambda number: _reached(trials[number][trial_id]))
        for trial_id, numbers in having.items()
    }
    if finished_only:
        taken = {
            trial_id: number
            for trial_id, number in taken.items()
            if trials[number][trial_id].status not in (TrialStatus.WAITING, TrialStatus.RUNNING)
        }
        if not taken:
            raise RecrlError(f"none of the {len(having)} trials is finished")
    notes = [note for part in parts for note in part.notes]
    if len({part.grid for part in parts if part.grid}) > 1:
        notes.append("the parts have different grid files; the first part's is kept")
    return _assembled(parts, taken, notes=[*notes, *_disagreements(parts, having)])


def part_of(sweep: Sweep, specs: Iterable[TrialSpec]) -> Sweep:
    """Return a sweep with only some of its trials.

    Args:
        sweep: has all of them.
        specs: of the trials.
    """
    part = _assembled([sweep], {spec.trial_id: 0 for spec in specs}, notes=sweep.notes)
    return replace(part, folder=sweep.folder)


def _assembled(parts: Sequence[Sweep], taken: Mapping[str, int], *, notes: Sequence[str]) -> Sweep:
    """Return a sweep of some trials.

    Args:
        parts: the first gives the name.
        taken: the position of the part that each trial is taken from, by the trial's id.
        notes: of the sweep.
    """
    facts = [{trial.spec.trial_id: trial for trial in part.facts} for part in parts]
    return assemble(
        parts[0].name,
        [facts[number][trial_id] for trial_id, number in taken.items()],
        {name: _taken(parts, name, taken) for name in ROWS},
        grid=next((part.grid for part in parts if part.grid), ""),
        notes=notes,
    )


def _reached(trial: TrialFacts) -> tuple[bool, bool, int, bool]:
    return (
        trial.status is not TrialStatus.DAMAGED,
        trial.status is TrialStatus.COMPLETE,
        trial.env_steps,
        trial.status is not TrialStatus.WAITING,
    )


def _taken(parts: Sequence[Sweep], name: str, taken: Mapping[str, int]) -> pd.DataFrame:
    """Return a data frame's rows of the trials, each from its part."""
    positions = {trial_id: position for position, trial_id in enumerate(taken)}
    kept = []
    for number, part in enumerate(parts):
        rows = part.rows(name)
        ids = np.array([trial.spec.trial_id for trial in part.facts], dtype=object)[rows[TRIAL].to_numpy()]
        is_taken = np.array([taken.get(trial_id) == number for trial_id in ids], dtype=bool)
        rows = rows[is_taken].assign(**{TRIAL: [positions[trial_id] for trial_id in ids[is_taken]]})
        if len(rows):  # empty data frames have no column types
            kept.append(rows)
    return pd.concat(kept, ignore_index=True) if kept else pd.DataFrame()


def _disagreements(parts: Sequence[Sweep], having: Mapping[str, Sequence[int]]) -> list[str]:
    """Describe trials that several parts completed with different outcomes."""
    outcomes = [_outcomes(part) for part in parts]
    differing = [
        trial_id
        for trial_id, numbers in having.items()
        if len({outcomes[number][trial_id] for number in numbers if trial_id in outcomes[number]}) > 1
    ]
    if not differing:
        return []
    titles = {trial.spec.trial_id: trial.spec.title for part in parts for trial in part.facts}
    return [
        f"completed in several parts with different episodes, as machines or versions differ; the first "
        f"part's are taken: {listed([titles[trial_id] for trial_id in differing], NAMED)}"
    ]


def _outcomes(part: Sweep) -> dict[str, str]:
    """Return the outcomes of the episodes of each complete trial, as text, by the trial's id."""
    texts = {
        position: "" for position, trial in enumerate(part.facts) if trial.status is TrialStatus.COMPLETE
    }
    for name in OUTCOMES:
        for key, rows in part.rows(name).groupby(TRIAL):
            position = cast(int, key)
            if position in texts:
                texts[position] += rows.drop(columns=TRIAL).dropna(axis=1, how="all").to_csv(index=False)
    return {part.facts[position].spec.trial_id: text for position, text in texts.items()}
