"""The first updates of a trial, in a temporary folder: does the user's code work and resume exactly?"""

from __future__ import annotations

import tempfile
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from recrl.orchestrator.errors import USERS_ERRORS, described
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.trial.trial import Trial
from recrl.teachers.registry import make_teacher

UPDATES_BEFORE, UPDATES_AFTER = 2, 3  # the restart; the last update is in the deployment phase
MOST_ENVIRONMENTS, MOST_STEPS = 2, 16
REMEDY = "what changes must be in the saved state; reset(seed=...) and the actions must determine an episode"
OF_THE_CLOCK = ["time", "collect_seconds", "update_seconds"]


class RestartError(Exception):
    """A trial that was resumed from a checkpoint fails, or differs from the same one without interruption."""


def rehearse(spec: TrialSpec) -> None:
    """Run the beginning of a small copy of a trial twice: without interruption, and with a restart.

    Args:
        spec: of the trial; environments, steps and updates are fewer.

    Raises:
        RestartError: the second one fails or differs.
        Exception: the first one fails.
    """
    num_envs, steps = min(spec.num_envs, MOST_ENVIRONMENTS), min(spec.rollout_steps, MOST_STEPS)
    small = replace(
        spec,
        num_envs=num_envs,
        rollout_steps=steps,
        train_steps=(UPDATES_BEFORE + UPDATES_AFTER - 1) * num_envs * steps,
        deploy_steps=num_envs * steps,
        evaluation_episodes=0,
    )
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with tempfile.TemporaryDirectory(prefix="recrl-") as scratch:
            whole = _updates(small, Path(scratch) / "whole", restart=False)
            try:
                resumed = _updates(small, Path(scratch) / "resumed", restart=True)
            except USERS_ERRORS as error:
                raise RestartError(f"{described(error)}; {REMEDY}") from error
    finally:
        torch.set_num_threads(threads)
    for name in whole.columns.drop(OF_THE_CLOCK):
        without, after = (rows[name].iloc[UPDATES_BEFORE:].to_numpy() for rows in (whole, resumed))
        if not np.array_equal(without, after, equal_nan=without.dtype.kind == "f"):
            raise RestartError(f"{name} is {after.tolist()} and not {without.tolist()}; {REMEDY}")


def _updates(spec: TrialSpec, folder: Path, *, restart: bool) -> pd.DataFrame:
    """Return a row per update."""
    store = TrialStore(folder / spec.folder_name)
    parts = [UPDATES_BEFORE, UPDATES_AFTER] if restart else [UPDATES_BEFORE + UPDATES_AFTER]
    for updates in parts:
        with closing(Trial(spec, store.begin(spec), make_teacher(spec.teacher))) as trial:
            for _ in range(updates):
                trial.advance()
            trial.save()
    return store.updates()
