"""The dynamic curriculum: the cost limit follows the agent (CLiC_D, Algorithm 2 of the paper).

The curriculum compares the agent's last two windows. It decides once return and costs have converged. An
agent that keeps its limit gets a lower one. An agent that does not is stuck, and its policy gets noise.

The list below has the gaps and faults of Algorithm 2, and their solutions here. The preset ``paper`` is the
literal pseudocode wherever it is defined.

- *Clock.* The agent learns once per policy update, so the curriculum decides once per update, over windows of
  whole updates (``windows``). With one episode per update this is Algorithm 2's clock.
- *Enough episodes* (``window_grows``). With few episodes chance decides the test of line 5, whether the
  policy changes or not. With 8 episodes per window, constant policies of Safety Gym, which have converged,
  passed it in at most 59% of the cases. So a window includes more updates until the standard errors of its
  means are within the tolerances. Until then there is no decision. The tolerances are relative to the mean or
  to the episodes' standard deviation, whichever is larger, so that 100 episodes are always enough. A window
  has at least ten episodes (``LEAST_EPISODES``): two or three agree by chance, and one has no standard error.
- *A constant policy need not pass at once.* If both means have the standard error s, their difference has
  sqrt(2) s. So a quantity of a constant policy passes with probability erf(tolerance / (2 s)). That is 52% at
  s = tolerance, the least precision of a decision, and 84% at half of it. Return and cost must both pass,
  which is less likely. The test is repeated after each update, over windows that move on.
- *Zero and negative means* (line 5). For an agent without costs, |new / old - 1| divides by zero, and the
  agent would wait without end. Here the test is |new - old| <= eps max(|old|, floor). It is the same if old
  is large, and 0 after 0 has converged. The floor avoids comparing small means by their noise. With
  ``window_grows`` the standard deviation of the older window is a floor, too.
- *No finished episode.* A window without an episode gives no information: the limits do not change.
- *Adherence* (line 6). The mean cost of an agent at its optimum is a little above its limit as often as
  below, or always: an agent that must cross five tiles of river and sometimes slips costs 5.004. C <= d would
  add noise again and again. So C may exceed d by the change that line 5 tolerates, or by its standard error.
- *The step* (line 7). B - b counts episodes, b being the next one, but a limit changes only once per window,
  so the limits would stay far above d_d. With the remaining windows as the divisor, the steps reach d_d. The
  last two windows are not counted: the agent may need them to converge after a large step. Otherwise it would
  reach d_d only at B.
- *Limits of a window.* The newer window lies entirely after the last change (line 4). The older one may lie
  before it, so an agent that follows each change immediately need not wait twice.
- *Episodes that began before a change.* Policy updates may be short and episodes long. With 64 steps an
  update, an episode of 1,000 steps spans 16 updates, and the first window after a change has only episodes
  that began before it: they may look converged and above the new limit. So no episode counts that ends within
  the duration of the longest one after a change. If all that began after the change did count, the first ones
  to end would be the short ones, which are often the cheap ones. The next decision comes later by that
  duration, so the remaining budget has fewer steps of line 7. A window has only the environment steps in
  which episodes count, so that its number of episodes per step is right (``overlapping_episodes``).
- *last_change* is reset when limits or policy have changed. Line 11 also resets it when neither has, that is,
  whenever the agent has converged. With a limit of d_d or noise of 0 that delays the next test by a window
  (``clock_reset``).
- *Noise* (line 9) is a disturbance that the curriculum itself makes: costs jump, and recover over several
  updates. Two windows after the noise may look converged and above the limit, because both contain the jump.
  Then noise would follow noise at every window. So both windows must lie after the last noise.
- *Limits never rise.* With the tolerance C may lie above d: the step starts from min(C, d).
- *Infinite limits.* C <= d holds, and line 7 takes d from infinity to about C, which is correct. But the
  start may be measured instead (``start_fraction``); then there is no decision until it is known.
- *Several costs* (lines 5 to 7 say "for all i"). One cost that has not converged, or cannot be kept, would
  keep all other limits at d_t. Here each limit is separate. It falls when the return and its own cost have
  converged and its own limit is kept. With ``window_grows`` each cost has windows and a clock of its own. A
  cost that scatters needs longer windows. If every step of another limit began them anew, they would never
  be complete. The policy gets noise when any converged cost is above its limit. Noise begins all windows
  anew, so it waits until each cost has two of them at once.
- *The end.* At B the limits are d_d in any case, and there is no noise.

Line 7 is used as it is: an agent whose converged cost is below d_d gets d_d immediately. The functions of
``recrl.teachers.dynamic_rules`` make the decisions of lines 5 to 10.

Notation: d limits in force, d_t training limits, d_d deployment limits, B the training budget in environment
steps, b an episode; C-bar and r-bar the mean episode cost and return of a window, W a window's size; k the
number of costs, eps_r, eps_c, eps_pi the paper's settings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats
from recrl.teachers.dynamic_options import DynamicConfig
from recrl.teachers.dynamic_rules import decide, is_precise, steps_left, which_converged
from recrl.teachers.start_limits import StartMeasurement
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState, already_seen, progress
from recrl.teachers.windows import WindowStatistics, extend, last_two_windows


@dataclass(frozen=True)
class _GroupState:
    """What a curriculum knows of a group of costs with common windows.

    Attributes:
        last_change: updates or episodes since the group's limits or the policy were changed.
        changed_at: environment steps then.
        history: statistics of each comparable update of the last two windows, with the group's costs only.
    """

    last_change: int = 0
    changed_at: int = 0
    history: tuple[WindowStatistics, ...] = ()

    def to_json(self) -> dict[str, Any]:
        history = [statistics.to_json() for statistics in self.history]
        return {"last_change": self.last_change, "changed_at": self.changed_at, "history": history}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> _GroupState:
        history = tuple(WindowStatistics.from_json(statistics) for statistics in values["history"])
        return cls(int(values["last_change"]), int(values.get("changed_at", 0)), history)


class DynamicTeacher:
    """The dynamic curriculum as a function of its state.

    Its state holds ``update``, ``env_steps``, ``limits`` [k], ``policy_noise``; ``longest`` (duration of the
    longest episode so far, environment steps over all environments); ``groups`` (``_GroupState`` of each
    group of costs with common windows) and the keys of ``StartMeasurement``.

    Args:
        spec: d_t, d_d, B and the options of ``DynamicConfig``.
    """

    def __init__(self, spec: TeacherSpec) -> None:
        self.spec = spec
        self.config = DynamicConfig.model_validate(dict(spec.options))
        self.measurement = StartMeasurement(spec, self.config.start_fraction)
        costs = tuple(range(len(spec.train_limits)))
        is_separate = self.config.window_grows and self.config.dimensions == "separate"
        self._groups = tuple((index,) for index in costs) if is_separate else (costs,)

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.start``."""
        state = _state(
            update=0,
            env_steps=0,
            step=CurriculumStep(self.spec.train_limits),
            longest=0,
            groups=[_GroupState()] * len(self._groups),
            start=self.measurement.begin(),
        )
        return CurriculumStep.from_json(state), state

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``."""
        if already_seen(state, report):
            return CurriculumStep.from_json(state), state
        start = self.measurement.advance(state, report)
        longest = max([state.get("longest", 0), *map(_duration, report.episodes)])
        groups = [
            self._extended(each, costs, report, env_steps=state["env_steps"], longest=longest)
            for each, costs in zip(self._group_states(state), self._groups, strict=True)
        ]
        before = CostLimits.from_json(state["limits"])
        limits = CostLimits(tuple(map(min, before, self.measurement.limits(start))))
        is_due = [False] * len(groups)  # line 4
        if progress(report.env_steps, self.spec.train_steps) >= 1.0:
            step = CurriculumStep(self.spec.deploy_limits)
            groups = [replace(each, history=()) for each in groups]
        elif start["start_limits"] is None or limits != before:
            step = CurriculumStep(limits)
        else:
            is_due = [each.last_change >= self.config.window for each in groups]
            step = self._decide(limits, groups, is_due, env_steps=report.env_steps, longest=longest)
        next_state = _state(
            update=report.update,
            env_steps=report.env_steps,
            step=step,
            longest=longest,
            groups=[
                self._after(step, before, costs, each, is_due=due, env_steps=report.env_steps)
                for costs, each, due in zip(self._groups, groups, is_due, strict=True)
            ],
            start=start,
        )
        return CurriculumStep.from_json(next_state), next_state

    def _group_states(self, state: TeacherState) -> list[_GroupState]:
        """Return the state of each group; in a state of an earlier version all costs share one."""
        if "groups" in state:
            return [_GroupState.from_json(values) for values in state["groups"]]
        shared = _GroupState.from_json(state)
        return [
            replace(shared, history=tuple(statistics.of_costs(costs) for statistics in shared.history))
            for costs in self._groups
        ]

    def _extended(
        self,
        group: _GroupState,
        costs: tuple[int, ...],
        report: ProgressReport,
        *,
        env_steps: int,
        longest: int,
    ) -> _GroupState:
        """Return a group's state with one more update, and no more updates than two windows need."""
        counted, begin = report.episodes, env_steps
        if self.config.overlapping_episodes == "ignore":
            first = group.changed_at + longest
            counted = tuple(it for it in counted if it.end_step >= first)
            begin = min(max(env_steps, first), report.env_steps)
        latest = WindowStatistics.of_update(
            counted, env_steps=report.env_steps - begin, num_costs=len(self.spec.train_limits)
        )
        unit = self.config.window_unit
        history = extend(group.history, latest.of_costs(costs), unit=unit)
        if windows := self._last_two(history):
            history = history[-len(windows[0]) - len(windows[1]) :]
        last_change = group.last_change + (len(counted) if unit == "episodes" else 1)
        return replace(group, last_change=last_change, history=history)

    def _after(
        self,
        step: CurriculumStep,
        before: CostLimits,
        costs: tuple[int, ...],
        group: _GroupState,
        *,
        is_due: bool,
        env_steps: int,
    ) -> _GroupState:
        """Return a group's state after a step: a change of its limits, or noise, restarts its clock."""
        is_noisy = step.policy_noise > 0.0
        has_changed = is_noisy or any(step.limits[index] != before[index] for index in costs)
        if is_due and self.config.clock_reset == "convergence":
            windows = self._windows(group)
            has_changed = has_changed or (windows is not None and any(which_converged(*windows, self.config)))
        if not has_changed:
            return group
        history = () if is_noisy and self.config.windows_after_noise == 2 else group.history
        return _GroupState(last_change=0, changed_at=env_steps, history=history)

    def _last_two(
        self, history: Sequence[WindowStatistics]
    ) -> tuple[tuple[WindowStatistics, ...], tuple[WindowStatistics, ...]] | None:
        """Return the updates of the last two windows, or None if there are too few."""
        config = self.config
        is_enough = (lambda window: is_precise(window, config)) if config.window_grows else None
        return last_two_windows(history, config.window, unit=config.window_unit, is_enough=is_enough)

    def _windows(self, group: _GroupState) -> tuple[WindowStatistics, WindowStatistics] | None:
        """Return the last two windows of a group, each pooled; None if there are too few updates.

        It is also None until the newer one lies entirely after the last change (line 4).
        """
        windows = self._last_two(group.history)
        if windows is None:
            return None
        in_episodes = self.config.window_unit == "episodes"
        length = sum(each.episodes for each in windows[1]) if in_episodes else len(windows[1])
        if self.config.window_grows and group.last_change < length:
            return None
        return WindowStatistics.pooled(windows[0]), WindowStatistics.pooled(windows[1])

    def _decide(
        self,
        limits: CostLimits,
        groups: Sequence[_GroupState],
        is_due: Sequence[bool],
        *,
        env_steps: int,
        longest: int,
    ) -> CurriculumStep:
        """Return the next step; noise begins the windows of all groups anew, so it waits for the last one."""
        values, noise, has_windows = list(limits), 0.0, True
        for costs, group, due in zip(self._groups, groups, is_due, strict=True):
            windows = self._windows(group) if due else None
            if windows is None:
                has_windows = False
                continue
            step = decide(
                *windows,
                limits=CostLimits(tuple(limits[index] for index in costs)),
                deploy_limits=CostLimits(tuple(self.spec.deploy_limits[index] for index in costs)),
                remaining=steps_left(
                    windows[1],
                    env_steps=env_steps,
                    train_steps=self.spec.train_steps,
                    unit=self.config.remaining,
                    duration=longest if self.config.overlapping_episodes == "ignore" else 0,
                ),
                config=self.config,
            )
            noise = max(noise, step.policy_noise)
            for index, value in zip(costs, step.limits, strict=True):
                values[index] = value
        return CurriculumStep(CostLimits(tuple(values)), noise if has_windows else 0.0)


def _duration(episode: EpisodeStats) -> int:
    """Return the duration of an episode in environment steps over all environments; 0 if unknown."""
    return 0 if episode.begin_step is None else episode.end_step - episode.begin_step


def _state(
    *,
    update: int,
    env_steps: int,
    step: CurriculumStep,
    longest: int,
    groups: Sequence[_GroupState],
    start: dict[str, Any],
) -> dict[str, Any]:
    """Return a state as JSON."""
    return {
        "update": update,
        "env_steps": env_steps,
        "limits": step.limits.to_json(),
        "policy_noise": step.policy_noise,
        "longest": longest,
        "groups": [group.to_json() for group in groups],
        **start,
    }
