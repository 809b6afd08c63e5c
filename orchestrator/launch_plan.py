"""The plan of a launch: what it would do with each trial, with estimates of time and memory.

The plan alone decides which trials run: a launch executes it, ``recrl-sweep plan`` prints it.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

from recrl.orchestrator.counting import counted
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.only_selection import select
from recrl.orchestrator.provenance.code_changes import CodeComparison, InstalledCode, compare_files
from recrl.orchestrator.spec import Choice, TrialSpec, TrialStatus
from recrl.orchestrator.trial_warnings import code_warnings

# Proportional set size of a trial's process with torch, and of Ray's daemons with the driver and the MLflow
# sync; rounded up from readings with Ray 2.60 and torch 2.13. A task's own buffers are additional.
GIGABYTES_PER_TRIAL = 0.35
GIGABYTES_AROUND = 1.2


class PlannedAction(StrEnum):
    """Action of a launch for a trial."""

    NEW = "new"
    RESUME = "resume"
    RETRY = "retry"
    REPAIR = "repair"  # damaged; continues from the intact files
    RERUN = "rerun"  # from the beginning, because its code has changed, or an earlier launch began with it
    COMPLETE = "complete"
    FAILED = "failed"
    DAMAGED = "damaged"

    @property
    def is_to_do(self) -> bool:
        """Whether a launch would run the trial."""
        return self in (
            PlannedAction.NEW,
            PlannedAction.RESUME,
            PlannedAction.RETRY,
            PlannedAction.REPAIR,
            PlannedAction.RERUN,
        )


@dataclass(frozen=True)
class TrialSelection:
    """The trials of a grid that a launch runs.

    Attributes:
        only: the selected trials, see ``only_selection.select``; all by default.
        retry_failed: whether failed trials are tried again.
        rerun_damaged: whether damaged trials that were complete or failed are run again; other damaged ones
            always are.
        rerun_changed: whether trials that ran other code than is installed now are run again.
    """

    only: Mapping[str, Sequence[str]] = field(default_factory=dict)
    retry_failed: bool = False
    rerun_damaged: bool = False
    rerun_changed: bool = False

    @property
    def reruns(self) -> bool:
        """Whether trials that are complete or have failed may run again from their beginning."""
        return self.rerun_damaged or self.rerun_changed


@dataclass(frozen=True)
class PlannedTrial:
    """One trial of the grid and its files.

    Attributes:
        spec: the trial.
        action: the planned action.
        record: from its files.
        code: what its attempts ran, compared with what is installed now.
    """

    spec: TrialSpec
    action: PlannedAction
    record: TrialRecord
    code: CodeComparison = field(default_factory=CodeComparison)

    @property
    def steps_left(self) -> int:
        """Environment steps that a launch would still take, at most."""
        done = self.record.env_steps if self.action in (PlannedAction.RESUME, PlannedAction.RETRY) else 0
        return max(0, self.spec.total_steps - done) if self.action.is_to_do else 0


@dataclass(frozen=True)
class Plan:
    """Plan of a launch.

    Attributes:
        trials: the chosen trials of the grid, in their order.
        orphans: trials on disk that the grid no longer contains; they are not touched.
    """

    trials: tuple[PlannedTrial, ...]
    orphans: tuple[TrialStore, ...]

    @property
    def to_do(self) -> tuple[TrialSpec, ...]:
        """Return the trials to run, in order."""
        return tuple(trial.spec for trial in self.trials if trial.action.is_to_do)

    def with_action(self, action: PlannedAction) -> tuple[PlannedTrial, ...]:
        """Return the trials with this action."""
        return tuple(trial for trial in self.trials if trial.action is action)

    @property
    def other_code(self) -> tuple[PlannedTrial, ...]:
        """Return the trials that ran other code than is installed now and are not run again."""
        return tuple(it for it in self.trials if it.code.differs and it.action is not PlannedAction.RERUN)

    @property
    def code_warnings(self) -> list[str]:
        """Sentences on the code of the trials that are not run again.

        Other versions of libraries are named only if something is to do, because else nothing is mixed.
        """
        kept = [it for it in self.trials if it.action is not PlannedAction.RERUN]
        if self.to_do:
            return code_warnings([(it.record.status, it.code) for it in kept])
        return code_warnings([(it.record.status, replace(it.code, versions=frozenset())) for it in kept])

    @property
    def left_out_sentence(self) -> str:
        """Sentence on the trials that the grid no longer has; empty for none."""
        if not self.orphans:
            return ""
        number = counted(len(self.orphans), "trial")
        return f"no longer in the grid: {number}, kept on disk and left out of results"

    @property
    def counts(self) -> Mapping[PlannedAction, int]:
        """Number of trials by planned action."""
        found = Counter(trial.action for trial in self.trials)
        return {action: found[action] for action in PlannedAction}


@dataclass(frozen=True)
class Estimate:
    """Estimated resources of a plan.

    Attributes:
        cpu_seconds: of all trials that are left, or None if no trial of some task and agent has run.
        concurrent: number of parallel trials.
        gigabytes: main memory while they run.
        unknown: the tasks and agents without a measured speed, as ``task agent``.
    """

    cpu_seconds: float | None
    concurrent: int
    gigabytes: float
    unknown: tuple[str, ...]

    @property
    def wall_seconds(self) -> float | None:
        """With ``concurrent`` parallel trials; None if unknown."""
        return None if self.cpu_seconds is None else self.cpu_seconds / max(1, self.concurrent)


def make_plan(specs: Sequence[TrialSpec], store: SweepStore, selection: TrialSelection | None = None) -> Plan:
    """Make a plan by comparing the grid's trials with the files.

    Args:
        specs: the trials of the grid, all of them.
        store: of the sweep; need not exist.
        selection: the trials to run; by default all that are neither complete nor failed. With
            ``rerun_damaged`` every file is read and its digest checked.

    Raises:
        RecrlError: ``only`` matches no trial of the grid.
    """
    selection = selection or TrialSelection()
    wanted = {spec.folder_name for spec in specs}
    trials, installed = [], InstalledCode()
    for spec in select(specs, selection.only):
        trial = store.trial(spec)
        record = trial.verified_record() if selection.rerun_damaged else trial.record()
        code = compare_files(trial, spec, installed)
        must_rerun = trial.rerun_has_begun or (selection.rerun_changed and code.differs)
        action = PlannedAction.RERUN if must_rerun else _planned_action(record, selection)
        trials.append(PlannedTrial(spec, action, record, code))
    orphans = tuple(trial for trial in store.trials() if trial.folder.name not in wanted)
    return Plan(tuple(trials), orphans)


def estimate(plan: Plan, *, concurrent: int, speeds: Mapping[str, float] | None = None) -> Estimate:
    """Estimate time from the speed of earlier trials, and memory from that of a trial's process.

    A speed is measured in environment steps per CPU second, for each task and agent with their options.

    Args:
        plan: the plan.
        concurrent: number of parallel trials, at least 1.
        speeds: measured speeds by ``kind_of``, in environment steps per CPU second, for kinds that have not
            run yet.
    """
    measured = speeds or {}
    steps: defaultdict[str, int] = defaultdict(int)
    seconds: defaultdict[str, float] = defaultdict(float)
    for trial in plan.trials:
        if trial.record.cpu_seconds > 0.0:
            steps[kind_of(trial.spec)] += trial.record.env_steps
            seconds[kind_of(trial.spec)] += trial.record.cpu_seconds
    cpu_seconds, unknown = 0.0, {}
    for trial in plan.trials:
        if not trial.steps_left:
            continue
        kind = kind_of(trial.spec)
        if steps[kind] > 0:
            cpu_seconds += trial.steps_left * seconds[kind] / steps[kind]
        elif kind in measured:
            cpu_seconds += trial.steps_left / measured[kind]
        else:
            unknown[kind] = f"{trial.spec.task.label} {trial.spec.agent.label}"
    running = min(concurrent, len(plan.to_do))
    return Estimate(
        cpu_seconds=None if unknown else cpu_seconds,
        concurrent=running,
        gigabytes=GIGABYTES_AROUND + running * GIGABYTES_PER_TRIAL if running else 0.0,
        unknown=tuple(unknown.values()),
    )


def unmeasured(plan: Plan) -> tuple[TrialSpec, ...]:
    """Return one trial to do of each kind of which no trial has taken a step."""
    timed = (it for it in plan.trials if it.record.cpu_seconds > 0.0 and it.record.env_steps > 0)
    known = {kind_of(trial.spec) for trial in timed}
    kinds = {kind_of(spec): spec for spec in reversed(plan.to_do)}
    return tuple(spec for kind, spec in reversed(kinds.items()) if kind not in known)


def _planned_action(record: TrialRecord, selection: TrialSelection) -> PlannedAction:
    """Return the action for a trial that need not run again from its beginning.

    A complete trial is left alone, a failed one unless ``retry_failed`` is set. A damaged trial that had not
    ended is repaired. A damaged trial that had ended, or whose format is another version's, is left
    alone; with ``rerun_damaged`` it is repaired, except while its files cannot be read. Others begin or
    continue.
    """
    match record.status:
        case TrialStatus.COMPLETE:
            return PlannedAction.COMPLETE
        case TrialStatus.FAILED:
            return PlannedAction.RETRY if selection.retry_failed else PlannedAction.FAILED
        case TrialStatus.DAMAGED:
            may_rerun = selection.rerun_damaged and not record.is_unreadable
            is_left_alone = record.is_left_alone and not may_rerun
            return PlannedAction.DAMAGED if is_left_alone else PlannedAction.REPAIR
        case TrialStatus.WAITING | TrialStatus.RUNNING:
            return PlannedAction.RESUME if record.attempt else PlannedAction.NEW


def kind_of(spec: TrialSpec) -> str:
    """Return the key of trials with about equal speed: task, agent, environments and steps of a rollout."""
    kind: tuple[Choice | int, ...] = (spec.task, spec.agent, spec.num_envs, spec.rollout_steps)
    return repr(kind)
