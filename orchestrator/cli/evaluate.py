"""``evaluate``: evaluate and film the policies of trials without learning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console

from recrl.orchestrator.cli.output import say, short, show
from recrl.orchestrator.cli.requests import EvaluateRequest
from recrl.orchestrator.cli.sweeps import command_line, listed_trials, open_store
from recrl.orchestrator.counting import counted
from recrl.orchestrator.errors import RecrlError, StorageError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.only_selection import parse_only, select
from recrl.orchestrator.provenance.code_changes import InstalledCode, compare_files
from recrl.orchestrator.tracking.client import tracking_uri
from recrl.orchestrator.tracking.export_file import write_in_own_process
from recrl.orchestrator.tracking.mlflow_sync import last_report, sync, without_export
from recrl.orchestrator.trial_warnings import code_warnings

if TYPE_CHECKING:
    from recrl.agents.evaluation import PolicyKind
    from recrl.orchestrator.trial.saved_policy import SavedEvaluation, SavedTrial
    from recrl.orchestrator.trial.videos import VideoFormat

DEFAULT_EPISODES = 100  # episodes, for trials without an evaluation of their own


def run_evaluate(request: EvaluateRequest, console: Console) -> ExitCode:
    """Evaluate the policies of trials for whole episodes, and film them on request."""
    from recrl.agents.evaluation import PolicyKind  # noqa: PLC0415  (imports gymnasium)
    from recrl.orchestrator.trial.videos import VideoFormat  # noqa: PLC0415

    store = open_store(request, checkpoints=True)
    chosen, orphans = _chosen(store, request)
    kinds = tuple(PolicyKind) if request.policy == "both" else (PolicyKind(request.policy),)
    evaluated, left_out = _evaluate(chosen, kinds, request)
    if not evaluated:
        raise left_out[0]
    _show(evaluated, console)
    for reason in left_out:
        say(console, f"left out   {reason}")
    if orphans:
        say(console, f"left out   {_no_longer(orphans)}")
    trials = [saved for saved, _ in evaluated]
    _warn_of_other_code(trials, console)
    missing_videos = 0
    if request.video:
        video_format = VideoFormat(request.video)
        missing_videos = sum(_film(saved, kinds, video_format, request.seed, console) for saved in trials)
    _tell_mlflow(store, request, console)
    return ExitCode.TRIALS_FAILED if left_out or missing_videos else ExitCode.OK


def _evaluate(
    chosen: Sequence[TrialStore], kinds: Sequence[PolicyKind], request: EvaluateRequest
) -> tuple[list[tuple[SavedTrial, SavedEvaluation]], list[RecrlError]]:
    """Return the trials that can be evaluated with their evaluations, and why others cannot."""
    from recrl.orchestrator.trial.saved_policy import SavedTrial  # noqa: PLC0415  (imports torch)

    evaluated, left_out = [], []
    for trial in chosen:
        try:
            trial.require_whole()
            saved = SavedTrial.load(trial)
            num_episodes = request.episodes or saved.spec.evaluation_episodes or DEFAULT_EPISODES
            evaluation = saved.evaluate(kinds, num_episodes=num_episodes, seed=request.seed)
        except RecrlError as error:
            left_out.append(error)
        else:
            evaluated.append((saved, evaluation))
    return evaluated, left_out


def _show(evaluated: Sequence[tuple[SavedTrial, SavedEvaluation]], console: Console) -> None:
    """Print a table of the evaluations, and their files."""
    import pandas as pd  # noqa: PLC0415

    from recrl.orchestrator.trial.saved_policy import summary  # noqa: PLC0415  (imports torch)

    show(pd.DataFrame([row for saved, it in evaluated for row in summary(it.rows, saved)]), console)
    say(
        console,
        "Means and standard errors. d_d: deployment limits; within: episodes in which no cost exceeded them.",
    )
    for _, evaluation in evaluated:
        say(console, f"Episodes   {short(evaluation.path)}")
        if evaluation.earlier:
            say(console, f"Replaced   the earlier evaluation with this seed, now {short(evaluation.earlier)}")


def _warn_of_other_code(evaluated: Sequence[SavedTrial], console: Console) -> None:
    """Print the numbers of trials that ran other code or libraries than now, or code that is not found."""
    installed = InstalledCode()
    ran = [
        (saved.store.record().status, compare_files(saved.store, saved.spec, installed))
        for saved in evaluated
    ]
    for sentence in code_warnings(ran):
        say(console, f"warning: {sentence}")
    if any(code.differs or code.versions for _, code in ran):
        say(console, "These evaluations use the code and the libraries that are installed now.")


def _film(
    saved: SavedTrial,
    kinds: Sequence[PolicyKind],
    video_format: VideoFormat,
    seed: int | None,
    console: Console,
) -> int:
    """Film a trial's policies, and print the places; return how many films failed, which stop no other."""
    failed = 0
    for kind in kinds:
        try:
            video = saved.film(kind, video_format, seed=seed)
        except RecrlError as error:
            say(console, f"no video   {error}")
            failed += 1
        else:
            say(console, f"Video      {short(video)}")
    return failed


def _chosen(store: SweepStore, request: EvaluateRequest) -> tuple[list[TrialStore], int]:
    """Return the trials on disk by the beginning of their names and by ``--only``.

    Trials that the last launch's grid no longer has are left out unless they are named. Their task, agent,
    curriculum and seed may be those of a trial of the grid. The second value is their number.
    """
    text = " ".join(request.trial)
    found = store.find(text)
    if text and not found:
        raise RecrlError(
            f"{store.name}: no trials on disk begin with {text!r}; see {command_line('status', store)}"
        )
    only = parse_only(request.only)
    specs, damaged = [], set()
    for trial in found:
        try:
            specs.append(trial.spec)
        except StorageError:
            damaged.add(trial.folder.name)
    kept = {spec.folder_name for spec in select(specs, only)} | (set() if only else damaged)
    chosen = [trial for trial in found if trial.folder.name in kept]
    listed = {spec.folder_name for spec in listed_trials(store)}
    in_grid = [trial for trial in chosen if text or not listed or trial.folder.name in listed]
    orphans = len(chosen) - len(in_grid)
    if not in_grid and orphans:
        raise RecrlError(f"{store.name}: {_no_longer(orphans)}")
    if not in_grid:
        raise RecrlError(f"{store.name}: no trials on disk; see {command_line('status', store)}")
    return in_grid, orphans


def _no_longer(orphans: int) -> str:
    """Say how many trials are left out, and how to evaluate them."""
    return f"{counted(orphans, 'trial')} no longer in the grid; to evaluate one of them, name it by its id"


def _tell_mlflow(store: SweepStore, request: EvaluateRequest, console: Console) -> None:
    """Bring MLflow up to date, if it has the sweep."""
    uri = tracking_uri(store, request.tracking_uri)
    if last_report(store, uri) is None:
        return
    report = sync(store, uri, write_export=write_in_own_process)
    if report.remark:
        say(console, f"MLflow     {without_export(report.remark)}")
    if not report.is_up_to_date:
        later = command_line("sync", store, request.tracking_uri)
        say(console, f"MLflow     is not up to date ({report.problem}); later: {later}")
