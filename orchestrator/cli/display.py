"""Plans and progress as text and tables for a terminal."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.counting import counted
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.launch_plan import Estimate, Plan, PlannedAction
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.sweep_progress import DisplayStatus, SweepProgress, TrialProgress

TERMINAL_SECONDS = 1.0
LINE_SECONDS = 10.0
LOG_SECONDS = 0.5
SHOWN_RUNNING = 8
WRAPPED = ("verdict", "summary")  # columns of sentences, wrapped on a narrow terminal

UNREAD = (PlannedAction.REPAIR, PlannedAction.DAMAGED)  # how far their intact files reach is not known yet
_STYLES = {
    "complete": "green",
    "running": "cyan",
    "failed": "bold red",
    "damaged": "bold red",
    "repair": "yellow",
    "rerun": "yellow",
    "interrupted": "yellow",
    "retry": "yellow",
    "resume": "yellow",
}


def plan_table(plan: Plan) -> Table:
    """Return a table of all trials and their planned actions."""
    table = _table("trial", "seed", "action", "done", "id")
    for trial in plan.trials:
        done = 0 if trial.action is PlannedAction.RERUN else trial.record.env_steps
        fraction = 1.0 if trial.action is PlannedAction.COMPLETE else done / trial.spec.total_steps
        table.add_row(
            f"{trial.spec.task.label} {trial.spec.agent.label} {trial.spec.method.label}",
            str(trial.spec.seed),
            _styled(trial.action),
            "?" if trial.action in UNREAD else f"{min(1.0, fraction):.0%}",
            trial.spec.trial_id,
        )
    return table


def plan_sentence(plan: Plan) -> str:
    """Summarise a plan: ``20 trials: 12 new, 3 to resume, 5 complete``."""
    words = {
        PlannedAction.NEW: "new",
        PlannedAction.RESUME: "to resume",
        PlannedAction.RETRY: "to try again",
        PlannedAction.REPAIR: "damaged, to continue from the intact files",
        PlannedAction.RERUN: "to run again on the present code",
        PlannedAction.COMPLETE: "complete",
        PlannedAction.FAILED: "failed",
        PlannedAction.DAMAGED: "damaged",
    }
    parts = [f"{number} {words[action]}" for action, number in plan.counts.items() if number]
    return f"{counted(len(plan.trials), 'trial')}: {', '.join(parts)}"


def update_counts(specs: Iterable[TrialSpec]) -> Iterator[str]:
    """Say how many updates trials have, and how many under d_d: a sentence for tasks with equal numbers."""
    tasks: dict[tuple[int, int], dict[str, None]] = {}
    for spec in specs:
        tasks.setdefault((spec.num_updates, spec.deploy_updates), {})[spec.task.label] = None
    for (updates, deployed), names in tasks.items():
        of_tasks = f"{', '.join(names)}: " if len(tasks) > 1 else ""
        number = counted(updates, "policy update")
        yield f"{of_tasks}a trial has {number}, {deployed} of them in the deployment phase under d_d"


def estimate_sentence(estimate: Estimate, where: str) -> str:
    """Summarise an estimate: ``about 4 min with 2 trials at once, about 1.9 GB, 8 min of CPU time``."""
    if not estimate.concurrent:
        return "nothing to do"
    memory = f"about {estimate.gigabytes:.1f} GB of memory"
    at_once = f"{counted(estimate.concurrent, 'trial')} at once {where}"
    if estimate.wall_seconds is None or estimate.cpu_seconds is None:
        names = ", ".join(dict.fromkeys(estimate.unknown))
        return f"time unknown until a first trial has run ({names}); {at_once}, {memory}"
    cpu = f"{duration(estimate.cpu_seconds)} of CPU time"
    return f"about {duration(estimate.wall_seconds)} with {at_once}, {memory}, {cpu}"


def status_table(progress: SweepProgress) -> Table:
    """Return a table of all trials and their status."""
    table = _table("trial", "seed", "status", "done", "steps/s", "CPU", "tries", "id")
    for trial in progress.trials:
        running = trial.status is DisplayStatus.RUNNING
        table.add_row(
            f"{trial.spec.task.label} {trial.spec.agent.label} {trial.spec.method.label}",
            str(trial.spec.seed),
            _styled(trial.status),
            f"{trial.fraction:.0%}",
            f"{trial.record.steps_per_second:,.0f}" if running else "",
            duration(trial.record.cpu_seconds) if trial.record.cpu_seconds else "",
            str(trial.record.attempt) if trial.record.attempt else "",
            trial.spec.trial_id,
        )
    return table


def status_sentence(progress: SweepProgress) -> str:
    """Summarise progress: ``12 of 20 complete, 2 running, 6 waiting, 0 failed; 61%; 22,400 steps/s; ...``."""
    counts = progress.counts
    parts = [
        f"{counts[DisplayStatus.COMPLETE]} of {len(progress.trials)} complete",
        f"{counts[DisplayStatus.RUNNING]} running",
        f"{counts[DisplayStatus.WAITING]} waiting",
        f"{counts[DisplayStatus.FAILED]} failed",
    ]
    parts += [
        f"{counts[status]} {status}"
        for status in (DisplayStatus.STOPPED, DisplayStatus.INTERRUPTED, DisplayStatus.DAMAGED)
        if counts[status]
    ]
    sentence = ", ".join(parts)
    if progress.is_complete:
        return sentence
    sentence += f"; {progress.fraction:.0%}"
    if progress.seconds_left is not None:
        sentence += f"; {progress.steps_per_second:,.0f} steps/s; {duration(progress.seconds_left)} left"
    return sentence


def failures(trials: Iterable[TrialProgress], folder_of: Callable[[TrialProgress], str]) -> Iterator[str]:
    """Describe every trial with an error: its name, the error, and the place of its log and traceback."""
    for trial in trials:
        yield f"{trial.status}: {trial.spec.title}: {trial.record.error or 'no reason was recorded'}"
        what = "its files" if trial.status is DisplayStatus.DAMAGED else "log and traceback"
        yield f"        {what}: {folder_of(trial)}"


def damages_of_plan(plan: Plan) -> Iterator[str]:
    """Describe every damaged trial, with the damage and the remedy."""
    for trial in plan.trials:
        if trial.record.status is TrialStatus.DAMAGED:
            yield f"damaged: {trial.spec.title}: {trial.record.error}"


def lines_of(trial: TrialStore, *, may_grow: Callable[[], bool]) -> Iterator[str]:
    """Yield the lines of a trial's log.

    Args:
        trial: on disk.
        may_grow: returns whether to wait for new lines.
    """
    offset, rest = 0, b""
    while True:
        waits = may_grow()
        with suppress(FileNotFoundError), trial.log_path.open("rb") as file:
            if file.seek(0, os.SEEK_END) < offset:  # another log: the trial was begun anew
                offset, rest = 0, b""
            file.seek(offset)
            *lines, rest = (rest + file.read()).split(b"\n")
            offset = file.tell()
            yield from (line.decode(errors="replace") for line in lines)
        if not waits:
            break
        time.sleep(LOG_SECONDS)
    if rest:
        yield rest.decode(errors="replace")


def duration(seconds: float) -> str:
    """Format a time in its two largest units.

    >>> duration(0.4), duration(103), duration(7260), duration(200_000)
    ('1 s', '1 min 43 s', '2 h 1 min', '2 d 7 h')
    """
    whole = max(1, round(seconds))
    for size, unit, smaller, smaller_unit in (
        (86_400, "d", 3_600, "h"),
        (3_600, "h", 60, "min"),
        (60, "min", 1, "s"),
    ):
        if whole >= size:
            rest = whole % size // smaller
            return f"{whole // size} {unit} {rest} {smaller_unit}" if rest else f"{whole // size} {unit}"
    return f"{whole} s"


@contextmanager
def live_progress(ask: Callable[[], SweepProgress], console: Console) -> Iterator[None]:
    """Show the progress until the end of the ``with`` block.

    On a terminal it updates in place every second. Otherwise it prints a line every ten seconds, if anything
    has changed.

    Args:
        ask: reads the progress from the files.
        console: where to show it.
    """
    show = _show_in_place if console.is_terminal else _show_lines
    with background_thread(partial(show, ask, console), name="progress"):
        yield


def _show_in_place(ask: Callable[[], SweepProgress], console: Console, done: threading.Event) -> None:
    with Live(console=console, auto_refresh=False, transient=True) as live:
        while True:
            began = time.monotonic()
            live.update(_picture(ask()), refresh=True)
            # reading the files of a very large sweep must not take much of the time
            if done.wait(max(TERMINAL_SECONDS, 20.0 * (time.monotonic() - began))):
                return


def _show_lines(ask: Callable[[], SweepProgress], console: Console, done: threading.Event) -> None:
    last = ""
    while not done.wait(LINE_SECONDS):
        sentence = status_sentence(ask())
        if sentence != last:
            console.print(sentence, highlight=False, soft_wrap=True)
        last = sentence


def _picture(progress: SweepProgress) -> RenderableType:
    rows: list[RenderableType] = [
        Text(status_sentence(progress)),
        ProgressBar(total=1.0, completed=progress.fraction, width=60),
    ]
    running = progress.with_status(DisplayStatus.RUNNING)
    table = Table.grid(padding=(0, 2))
    for trial in running[:SHOWN_RUNNING]:
        speed = f"{trial.record.steps_per_second:,.0f} steps/s" if trial.record.steps_per_second else ""
        table.add_row("  " + trial.spec.title, f"{trial.fraction:.0%}", speed)
    if len(running) > SHOWN_RUNNING:
        table.add_row(f"  and {len(running) - SHOWN_RUNNING} more")
    return Group(*rows, table)


def text_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """A table of finished text; where it does not fit, the columns WRAPPED are wrapped."""
    table = _table(*columns)
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def folded_table(columns: Sequence[str], rows: Iterable[Sequence[str]], *, width: int) -> Table:
    """A table of finished text with folded cells, so that it fits a width in characters."""
    table = Table(box=None, header_style="bold", pad_edge=False, width=width, padding=(0, 2, 0, 0))
    for index, column in enumerate(columns):
        table.add_column(column, overflow="fold", no_wrap=index == 0, ratio=None if index < 3 else 1)
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def _table(*columns: str) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for column in columns:
        right = column in ("seed", "done", "steps/s", "CPU", "tries")
        table.add_column(column, justify="right" if right else "left", no_wrap=column not in WRAPPED)
    return table


def _styled(word: str) -> Text:
    return Text(str(word), style=_STYLES.get(str(word), ""))
