"""``status``, ``check``, ``stop`` and ``logs``: progress of a sweep, and logs of its trials."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable

from rich.console import Console

from recrl.orchestrator.cli import display
from recrl.orchestrator.cli.output import print_table, say, short
from recrl.orchestrator.cli.plan import say_other_code
from recrl.orchestrator.cli.requests import CheckRequest, LogsRequest, StatusRequest, StopRequest
from recrl.orchestrator.cli.sweeps import command_line, listed_trials, open_place, open_store
from recrl.orchestrator.counting import counted
from recrl.orchestrator.errors import RecrlError, StorageError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.launch_plan import make_plan
from recrl.orchestrator.run_sweep import REQUEST_SECONDS
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.sweep_progress import (
    DisplayStatus,
    SweepProgress,
    TrialProgress,
    display_status,
    progress,
    shown_record,
)
from recrl.orchestrator.trial_warnings import (
    hard_landing_sentence,
    landed_hard,
    no_curriculum_sentence,
)

REPEAT_SECONDS = 5.0  # from a request to stop to its repetition


def run_status(request: StatusRequest, console: Console) -> ExitCode:
    """Print the progress of a sweep, from its files."""
    store = open_store(request)
    specs = store.specs()
    now = progress(specs, store)
    if not request.brief:
        print_table(display.status_table(now), console)
        say(console, "")
    say(console, f"{store.name}: {display.status_sentence(now)}")
    say_failures(now, store, console)
    for problem in store.damages():
        say(console, f"damaged: {problem}")
    say_other_code(make_plan(specs, store), console)
    _warn_of_curricula(now, store, console)
    return ExitCode.OK


def _warn_of_curricula(now: SweepProgress, store: SweepStore, console: Console) -> None:
    """Print the warnings about curricula that had no effect or ended far above d_d."""
    none = [it.spec.title for it in now.trials if it.spec.is_no_curriculum(it.record.start_limits)]
    hard = []
    for trial in now.trials:
        if trial.record.status is TrialStatus.DAMAGED:  # it is printed above
            continue
        try:
            if landed_hard(trial.spec, _events(trial, store)):
                hard.append(trial.spec.title)
        except StorageError as error:
            say(console, f"damaged: {trial.spec.title}: {error}")
    for sentence in filter(None, (no_curriculum_sentence(none), hard_landing_sentence(hard))):
        say(console, f"warning: {sentence}")


def _events(trial: TrialProgress, store: SweepStore) -> list[str]:
    """Return the names of the events of a trial in its deployment phase."""
    if trial.record.env_steps < trial.spec.train_steps:
        return []
    return [str(event.get("event")) for event in store.trial(trial.spec).events()]


def run_check(request: CheckRequest, console: Console) -> ExitCode:
    """Check every file of a sweep against its committed digest; print a line for each damaged one."""
    store = open_store(request)
    problems = [f"{store.name}: {problem}" for problem in store.damages()]
    specs = listed_trials(store)
    problems += [f"{spec.title}: {it}" for spec in specs for it in store.trial(spec).damages()]
    listed = {spec.folder_name for spec in specs}
    orphans = [trial for trial in store.trials() if trial.folder.name not in listed]
    problems += [f"{trial.title}: {problem}" for trial in orphans for problem in trial.damages()]
    for problem in problems:
        say(console, problem)
    trials = len(listed | {trial.folder.name for trial in orphans})
    say(
        console,
        f"{store.name}: {counted(trials, 'trial')} checked, {len(problems) or 'no'} wrong "
        f"file{'' if len(problems) == 1 else 's'}",
    )
    if problems and store.storage_path.exists():
        if not any(map(_is_lost, store.trials())):
            say(console, "the folder is only a local copy: delete it, and it is fetched again")
    elif problems:
        say(
            console, "launch continues damaged trials from their intact files; complete ones: --rerun-damaged"
        )
    return ExitCode.TRIALS_FAILED if problems else ExitCode.OK


def _is_lost(trial: TrialStore) -> bool:
    """Whether the object store has nothing of a trial that can be used, so that its copy must be kept."""
    try:
        return trial.stored_record().status is TrialStatus.DAMAGED
    except StorageError:
        return False


def run_stop(request: StopRequest, console: Console) -> ExitCode:
    """Ask the launch that runs a sweep to save its trials and end, and wait until it has."""
    place = open_place(request)
    store = place.store
    still_runs = place.request_stop()
    if not still_runs():
        say(console, f"{store.name}: no launch runs this sweep")
        return ExitCode.OK
    say(console, f"{store.name}: its trials save their state")
    if _runs_for(REPEAT_SECONDS, still_runs):
        _runs_for(math.inf, place.request_stop())  # a launch that has just begun deletes earlier requests
    place.refresh()
    say(console, f"{store.name}: {display.status_sentence(progress(store.specs(), store))}")
    return ExitCode.OK


def _runs_for(seconds: float, still_runs: Callable[[], bool]) -> bool:
    """Wait for the end of a launch, but not longer than some seconds; return whether it runs after that."""
    end = time.monotonic() + seconds
    while running := still_runs():
        if time.monotonic() >= end:
            break
        time.sleep(REQUEST_SECONDS)
    return running


def run_logs(request: LogsRequest, console: Console) -> ExitCode:
    """Print a trial's log, or the path of its folder."""
    place = open_place(request)
    store, text = place.store, " ".join(request.trial)
    if request.folder:
        say(console, str(short(_trial(store, text).folder)))
        return ExitCode.OK
    with contextlib.ExitStack() as following:
        if request.follow:
            if not store.is_locked():
                following.enter_context(place.kept_up_to_date(threading.Event()))
            _wait_for_start(store, text, console)
        trial = _trial(store, text)
        for line in display.lines_of(trial, may_grow=lambda: request.follow and _runs(store, trial)):
            say(console, line)
    return ExitCode.OK


def _wait_for_start(store: SweepStore, text: str, console: Console) -> None:
    """Wait until a matching trial has begun, as long as a launch runs that may begin it."""
    is_said = False
    begun = (DisplayStatus.RUNNING, DisplayStatus.COMPLETE, DisplayStatus.FAILED, DisplayStatus.DAMAGED)
    while store.is_locked() and not any(_status(store, it) in begun for it in _meant(store, text)):
        if not is_said:
            say(console, f"{store.name}: waiting for {f'a trial {text!r}' if text else 'a trial'} to start")
        is_said = True
        time.sleep(display.LOG_SECONDS)


def _meant(store: SweepStore, text: str) -> list[TrialStore]:
    """Return the trials on disk that match a text; the running ones if there is none."""
    found = store.find(text)
    if text:
        return found
    return [trial for trial in found if _runs(store, trial)]


def _runs(store: SweepStore, trial: TrialStore) -> bool:
    return _status(store, trial) is DisplayStatus.RUNNING


def _status(store: SweepStore, trial: TrialStore) -> DisplayStatus:
    return display_status(shown_record(trial), now=time.time(), silence_seconds=store.silence_seconds)


def _trial(store: SweepStore, text: str) -> TrialStore:
    """Return the one trial on disk that matches a text."""
    found = _meant(store, text)
    if len(found) == 1:
        return found[0]
    titles = [f"{trial.trial_id} {trial.title}" for trial in found[:10]]
    more = f" and {len(found) - 10} more" if len(found) > 10 else ""
    named = f"give one, by its id or title: {', '.join(titles)}{more}"
    which = named if found else f"see {command_line('status', store)}"
    what = f"trials on disk begin with {text!r}" if text else "trials are running"
    raise RecrlError(f"{store.name}: {len(found) or 'no'} {what}; {which}")


def say_failures(now: SweepProgress, store: SweepStore, console: Console) -> None:
    """Print the trials with errors, the errors, and the places of their logs."""

    def folder_of(trial: TrialProgress) -> str:
        return str(short(store.trial(trial.spec).folder))

    broken = [
        *now.with_status(DisplayStatus.FAILED, DisplayStatus.DAMAGED),
        *(t for t in now.with_status(DisplayStatus.STOPPED) if t.record.error),
    ]
    for line in display.failures(broken, folder_of):
        say(console, line)
