"""Parts of one sweep, run in several places, as the sweep that they make together.

A grid's trials may be shared out with ``launch --only``, or a sweep may have to go on where the folder of its
first trials is not. Each place exports what it has (``recrl.analysis.data.export``); here the parts are
joined. Trials are the same if their specs are, whatever the parts are called.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import TRIAL
from recrl.analysis.data.sweep_data import ROWS, Sweep, TrialFacts, assemble, is_made_again
from recrl.orchestrator.spec import TrialState

OUTCOMES = ("phases", "evaluations")  # the frames that every source has unrounded
NAMED = 3  # trials that a note names, at most


def merge(parts: Sequence[Sweep]) -> Sweep:
    """All trials of some sweeps, each once, as the part has it that got furthest with it.

    A damaged trial is less far than any other, a complete one further; then its steps count, then whether it
    was begun; of equals the first part is taken. Two parts can have completed a trial with different
    outcomes, as other machines and versions round differently; then a note says so.

    Args:
        parts: at least one. The first gives the name and the grid file; its trials come first, then those
            that only others have.
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
    notes = [note for part in parts for note in part.notes if not is_made_again(note)]
    if len({part.grid for part in parts if part.grid}) > 1:
        notes.append("the parts have different grid files; the first part's is kept")
    return assemble(
        parts[0].name,
        [trials[number][trial_id] for trial_id, number in taken.items()],
        {name: _taken(parts, name, taken) for name in ROWS},
        grid=next((part.grid for part in parts if part.grid), ""),
        notes=[*notes, *_disagreements(parts, having)],
    )


def _reached(trial: TrialFacts) -> tuple[bool, bool, int, bool]:
    return (
        trial.status is not TrialState.DAMAGED,
        trial.status is TrialState.COMPLETE,
        trial.env_steps,
        trial.status is not TrialState.WAITING,
    )


def _taken(parts: Sequence[Sweep], name: str, taken: Mapping[str, int]) -> pd.DataFrame:
    """A frame's rows of the trials, each from the part that it is taken from."""
    positions = {trial_id: position for position, trial_id in enumerate(taken)}
    kept = []
    for number, part in enumerate(parts):
        rows = part.rows(name)
        ids = np.array([trial.spec.trial_id for trial in part.facts], dtype=object)[rows[TRIAL].to_numpy()]
        rows = rows.assign(**{TRIAL: [positions[trial_id] for trial_id in ids]})
        rows = rows[[taken[trial_id] == number for trial_id in ids]]
        if len(rows):  # empty frames have no types of their own
            kept.append(rows)
    return pd.concat(kept, ignore_index=True) if kept else pd.DataFrame()


def _disagreements(parts: Sequence[Sweep], having: Mapping[str, Sequence[int]]) -> list[str]:
    """A sentence on trials that several parts completed, and not alike."""
    outcomes = [_outcomes(part) for part in parts]
    differing = [
        trial_id
        for trial_id, numbers in having.items()
        if len({outcomes[number][trial_id] for number in numbers if trial_id in outcomes[number]}) > 1
    ]
    if not differing:
        return []
    titles = {trial.spec.trial_id: trial.spec.title for part in parts for trial in part.facts}
    named = ", ".join(titles[trial_id] for trial_id in differing[:NAMED])
    more = f" and {len(differing) - NAMED} more" if len(differing) > NAMED else ""
    return [
        f"completed in several parts with different episodes, as machines or versions differ; the first "
        f"part's are taken: {named}{more}"
    ]


def _outcomes(part: Sweep) -> dict[str, str]:
    """What the episodes of each complete trial came to, as text, by the trial's id."""
    texts = {position: "" for position, trial in enumerate(part.facts) if trial.status is TrialState.COMPLETE}
    for name in OUTCOMES:
        for key, rows in part.rows(name).groupby(TRIAL):
            position = cast(int, key)
            if position in texts:
                texts[position] += rows.drop(columns=TRIAL).dropna(axis=1, how="all").to_csv(index=False)
    return {part.facts[position].spec.trial_id: text for position, text in texts.items()}
