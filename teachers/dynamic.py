"""The dynamic curriculum: the cost limit follows the agent (CLiC_D, Algorithm 2 of the paper).

The curriculum compares the agent's last two windows. It decides once return and costs have converged. An
agent that keeps its limit gets a lower one. An agent that does not is stuck, and its policy gets noise.

The list below has the gaps and faults of Algorithm 2, and their solutions here. With the preset ``paper`` the
literal pseudocode runs instead (``recrl.teachers.algorithm_2``).

- *Clock.* The agent learns once per policy update, so the curriculum decides once per update, over windows of
  whole updates (``windows``). With one episode per update this is Algorithm 2's clock.
- *Enough episodes.* With few episodes chance decides the test of line 5, whether the policy changes or not.
  With 8 episodes per window, constant policies of Safety Gym, which have converged, passed it in at most 59%
  of the cases. So a window includes more updates until the standard errors of its means are within the
  tolerances. Until then there is no decision. The tolerances are relative to the mean or to the episodes'
  standard deviation, whichever is larger, so that 100 episodes are always enough. A window has at least ten
  episodes (``LEAST_EPISODES``): two or three agree by chance, one has no standard error, and without any
  there is no mean.
- *A constant policy need not pass at once.* If both means have the standard error s, their difference has
  sqrt(2) s. So a quantity of a constant policy passes with probability erf(tolerance / (2 s)). That is 52% at
  s = tolerance, the least precision of a decision, and 84% at half of it. Return and cost must both pass,
  which is less likely. The test is repeated after each update, over windows that move on.
- *Zero and negative means* (line 5). For an agent without costs, |new / old - 1| divides by zero, and the
  agent would wait without end. Here the test is |new - old| <= eps max(|old|, floor). It is the same if old
  is large, and 0 after 0 has converged. The floor avoids comparing small means by their noise. The standard
  deviation of the older window is a floor, too.
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
  which episodes count, so that its number of episodes per step is right.
- *last_change* is reset when limits or policy have changed. Line 11 also resets it when neither has, that is,
  whenever the agent has converged. With a limit of d_d or noise of 0 that delays the next test by a window.
- *Noise* (line 9) is a disturbance that the curriculum itself makes: costs jump, and recover over several
  updates. Two windows after the noise may look converged and above the limit, because both contain the jump.
  Then noise would follow noise at every window. So both windows must lie after the last noise.
- *Limits never rise.* With the tolerance C may lie above d: the step starts from min(C, d).
- *Infinite limits.* C <= d holds, and line 7 takes d from infinity to about C, which is correct. But the
  start may be measured instead (``start_fraction``); then there is no decision until it is known.
- *Several costs* (lines 5 to 7 say "for all i"). One cost that has not converged, or cannot be kept, would
  keep all other limits at d_t. Here each limit is separate. It falls when the return and its own cost have
  converged and its own limit is kept. Each cost has windows and a clock of its own. A cost that scatters
  needs longer windows. If every step of another limit began them anew, they would never be complete. The
  policy gets noise when any converged cost is above its limit. Noise begins all windows anew, so it waits
  until each cost has two of them at once.
- *The end.* At B the limits are d_d in any case, and there is no noise.

Line 7 is used as it is: an agent whose converged cost is below d_d gets d_d immediately. The functions of
``recrl.teachers.dynamic_rules`` make the decisions of lines 5 to 10.

Notation: d limits in force, d_t training limits, d_d deployment limits, B the training budget in environment
steps, b an episode; C the mean episode cost of a window, W its updates; k the number of costs, eps the
paper's tolerances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats
from recrl.teachers.dynamic_options import DynamicConfig
from recrl.teachers.dynamic_rules import decide, is_precise, steps_left
from recrl.teachers.start_limits import StartMeasurement
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState, already_seen, progress
from recrl.teachers.windows import WindowStatistics, last_two_windows


@dataclass(frozen=True)
class _CostState:
    """What a curriculum knows of one cost.

    Attributes:
        last_change: updates since the cost's limit or the policy was changed.
        changed_at: environment steps then.
        history: statistics of each comparable update of the last two windows, with this cost only.
    """

    last_change: int = 0
    changed_at: int = 0
    history: tuple[WindowStatistics, ...] = ()

    def to_json(self) -> dict[str, Any]:
        history = [statistics.to_json() for statistics in self.history]
        return {"last_change": self.last_change, "changed_at": self.changed_at, "history": history}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> _CostState:
        history = tuple(WindowStatistics.from_json(statistics) for statistics in values["history"])
        return cls(int(values["last_change"]), int(values["changed_at"]), history)


class DynamicTeacher:
    """The dynamic curriculum as a function of its state.

    Its state holds ``update``, ``env_steps``, ``limits`` [k], ``policy_noise``; ``longest`` (duration of the
    longest episode so far, environment steps over all environments); ``costs`` (``_CostState`` of each cost,
    [k]) and the keys of ``StartMeasurement``.

    Args:
        spec: d_t, d_d, B and the options of ``DynamicConfig``.
    """

    def __init__(self, spec: TeacherSpec) -> None:
        self.spec = spec
        self.config = DynamicConfig.model_validate(dict(spec.options))
        self.measurement = StartMeasurement(spec, self.config.start_fraction)

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.start``."""
        state = _state(
            update=0,
            env_steps=0,
            step=CurriculumStep(self.spec.train_limits),
            longest=0,
            costs=[_CostState()] * len(self.spec.train_limits),
            start=self.measurement.begin(),
        )
        return CurriculumStep.from_json(state), state

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``."""
        if already_seen(state, report):
            return CurriculumStep.from_json(state), state
        start = self.measurement.advance(state, report)
        longest = max([state["longest"], *map(_duration, report.episodes)])
        costs = [
            self._extended(each, index, report, env_steps=state["env_steps"], longest=longest)
            for index, each in enumerate(map(_CostState.from_json, state["costs"]))
        ]
        before = CostLimits.from_json(state["limits"])
        limits = CostLimits(tuple(map(min, before, self.measurement.limits(start))))
        if progress(report.env_steps, self.spec.train_steps) >= 1.0:
            step = CurriculumStep(self.spec.deploy_limits)
            costs = [replace(each, history=()) for each in costs]
        elif start["start_limits"] is None or limits != before:
            step = CurriculumStep(limits)
        else:
            step = self._decide(limits, costs, env_steps=report.env_steps, longest=longest)
        next_state = _state(
            update=report.update,
            env_steps=report.env_steps,
            step=step,
            longest=longest,
            costs=[
                _after(step, each, has_changed=new != old, env_steps=report.env_steps)
                for each, old, new in zip(costs, before, step.limits, strict=True)
            ],
            start=start,
        )
        return CurriculumStep.from_json(next_state), next_state

    def _extended(
        self, cost: _CostState, index: int, report: ProgressReport, *, env_steps: int, longest: int
    ) -> _CostState:
        """Return a cost's state with one more update, and no more updates than two windows need."""
        first = cost.changed_at + longest
        counted = [episode for episode in report.episodes if episode.end_step >= first]
        begin = min(max(env_steps, first), report.env_steps)
        latest = WindowStatistics.of_update(
            counted, env_steps=report.env_steps - begin, num_costs=len(self.spec.train_limits)
        )
        history = (*cost.history, latest.of_cost(index))
        if windows := self._last_two(history):
            history = (*windows[0], *windows[1])
        return replace(cost, last_change=cost.last_change + 1, history=history)

    def _last_two(
        self, history: Sequence[WindowStatistics]
    ) -> tuple[tuple[WindowStatistics, ...], tuple[WindowStatistics, ...]] | None:
        """Return the updates of the last two windows, or None if there are too few."""
        return last_two_windows(
            history, self.config.window, is_enough=lambda window: is_precise(window, self.config)
        )

    def _decide(
        self, limits: CostLimits, costs: Sequence[_CostState], *, env_steps: int, longest: int
    ) -> CurriculumStep:
        """Return the next step; noise begins the windows of all costs anew, so it waits for the last one."""
        values, noise, all_have_windows = list(limits), 0.0, True
        for index, cost in enumerate(costs):
            windows = self._last_two(cost.history)
            if windows is None or cost.last_change < len(windows[1]):  # line 4
                all_have_windows = False
                continue
            old, new = map(WindowStatistics.pooled, windows)
            values[index], own_noise = decide(
                old,
                new,
                limit=limits[index],
                deploy_limit=self.spec.deploy_limits[index],
                remaining=steps_left(
                    new, env_steps=env_steps, train_steps=self.spec.train_steps, duration=longest
                ),
                config=self.config,
            )
            noise = max(noise, own_noise)
        return CurriculumStep(CostLimits(tuple(values)), noise if all_have_windows else 0.0)


def _after(step: CurriculumStep, cost: _CostState, *, has_changed: bool, env_steps: int) -> _CostState:
    """Return a cost's state after a step: a change of its limit, or noise, restarts its clock."""
    is_noisy = step.policy_noise > 0.0
    if not (is_noisy or has_changed):
        return cost
    return _CostState(last_change=0, changed_at=env_steps, history=() if is_noisy else cost.history)


def _duration(episode: EpisodeStats) -> int:
    """Return the duration of an episode in environment steps over all environments; 0 if unknown."""
    return 0 if episode.begin_step is None else episode.end_step - episode.begin_step


def _state(
    *,
    update: int,
    env_steps: int,
    step: CurriculumStep,
    longest: int,
    costs: Sequence[_CostState],
    start: dict[str, Any],
) -> dict[str, Any]:
    """Return a state as JSON."""
    return {
        "update": update,
        "env_steps": env_steps,
        "limits": step.limits.to_json(),
        "policy_noise": step.policy_noise,
        "longest": longest,
        "costs": [cost.to_json() for cost in costs],
        **start,
    }
