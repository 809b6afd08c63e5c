"""Measure the speed of a trial on this machine by running a short part of it."""

from __future__ import annotations

import tempfile
import time
from contextlib import closing

from recrl.orchestrator.errors import USERS_ERRORS, RecrlError, described
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.trial.torch_settings import torch_settings
from recrl.orchestrator.trial.trial import Trial
from recrl.teachers.registry import make_teacher

MEASURED_SECONDS = 1.0


def measured_speed(spec: TrialSpec, *, seconds: float = MEASURED_SECONDS) -> float:
    """Return a trial's environment steps per CPU second, collecting and learning together.

    It runs in a temporary folder. The first update does not count, because it compiles and fills caches,
    unless it takes the whole time.

    Args:
        spec: the trial.
        seconds: approximate CPU time of the measurement; at least one update.

    Raises:
        RecrlError: the task or the agent raised an error.
    """
    try:
        with torch_settings(), scratch_folder(tempfile.gettempdir()) as scratch:
            store = TrialStore(scratch / spec.folder_name)
            with closing(Trial(spec, store.begin(spec), make_teacher(spec.teacher))) as trial:
                return _speed(trial, seconds)
    except RecrlError:
        raise
    except USERS_ERRORS as error:
        raise RecrlError(f"{spec.title}: cannot be measured: {described(error)}") from error


def _speed(trial: Trial, seconds: float) -> float:
    began = time.process_time()
    trial.advance()
    took = time.process_time() - began
    first = trial.env_steps
    if took >= seconds or trial.learned:
        return first / max(took, 1e-9)
    began = time.process_time()
    while not trial.learned and time.process_time() - began < seconds:
        trial.advance()
    return (trial.env_steps - first) / max(time.process_time() - began, 1e-9)
