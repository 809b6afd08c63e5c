"""The dynamic curriculum: the cost limit follows the agent (CLiC_D, Algorithm 2 of the paper).

The teacher compares the agent's last two windows. Once return and costs have stopped changing, an agent
that keeps its limit is given a lower one, and an agent that does not is stuck: its policy gets noise.

Where Algorithm 2 is silent or goes wrong, and what is done here; the preset ``paper`` is the pseudocode to
the letter wherever it is defined.

- *Clock.* The agent learns once per policy update, so it is judged once per update, over windows of whole
  updates (``windows``). With one episode an update this is Algorithm 2's clock.
- *Enough episodes* (``window_grows``). The ratio of two noisy means passes the test of line 5 by chance: with
  8 episodes a window, frozen policies of Safety Gym did in up to 59% of the cases. So a window takes in more
  updates until the standard errors of its means are within the tolerances, and until then nothing is decided.
  The tolerances are of the mean or of the episodes' standard deviation, whichever is more, so that 100
  episodes always are enough.
- *Zero and negative means* (line 5). |new / old - 1| divides by zero for an agent that has become perfectly
  safe, and it would wait for ever. |new - old| <= eps max(|old|, floor) is the same test where that is
  defined, and 0 against 0 has converged. The floor keeps small means from being compared by their noise.
- *Nothing finished.* A window without an episode says nothing: hold.
- *Adherence* (line 6). An agent at its optimum has a mean cost a little above its limit as often as below,
  or always (whoever must cross five tiles of river and slips once in a while costs 5.004), and C <= d would
  kick it for ever. C may exceed d by as much as line 5 lets equal costs differ, or by its standard error.
- *The step* (line 7). B - b counts episodes, b being the one about to be played, but a limit moves only once
  per window, so that the limits stay far above d_d. Counted in windows that are left, the steps add up to the
  whole way. The last two are not counted: so long an agent may need to settle after a large step, and it
  would meet d_d only at B.
- *Which limits a window was played under.* The newer window lies wholly after the last change (line 4); the
  older one may lie before it, so that an agent who follows each change at once is not made to wait twice.
- *last_change* is reset when limits or policy have changed. Line 11 also resets it when nothing has, that
  is, whenever the agent has converged: a limit that is d_d already, or noise of 0, then delays the next
  test by a window (``clock_reset``).
- *Noise* (line 9) is a disturbance of the teacher's own making: costs jump, and take updates to come back. If
  the next window is compared with the one before the noise, two windows with the same jump in them look
  converged and above the limit, and noise follows noise at the pace of the windows for ever. Both windows
  lie after the last noise.
- *Limits never rise.* With the tolerance C may lie above d: the step is taken from min(C, d).
- *Infinite limits.* C <= d holds, and line 7 takes d from infinity to about C: nothing goes wrong. But the
  start may be measured instead (``start_fraction``), and then nothing is judged until it is known.
- *Several costs* (lines 5 to 7 say "for all i"). One cost that is still moving, or that cannot be kept,
  would hold the limits of all the others at d_t. Each limit goes its own way: it falls when the return and
  its own cost have converged and its own limit is kept; the policy gets noise when any converged cost is
  above its limit. A step in one dimension makes the others wait for one window, and noise for two.
- *The end.* At B the limits are d_d whatever the agent does, and there is no noise.

Line 7 is kept as it is: an agent whose converged cost is below d_d is given d_d at once.

Notation: d limits in force, d_t training limits, d_d deployment limits, B the training budget in environment
steps, b an episode, C-bar and r-bar the mean episode cost and return of a window, W a window's size, k the
number of costs, eps_r, eps_c, eps_pi the paper's settings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.teachers.dynamic_options import DynamicConfig
from recrl.teachers.start import StartMeasurement
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState, already_seen, progress
from recrl.teachers.windows import WindowStatistics, extend, last_two_windows


def has_converged(new: float, old: float, *, tolerance: float, floor: float) -> bool:
    """Whether a mean has stopped changing: abs(new - old) <= eps max(abs(old), floor).

    Algorithm 2, line 5, abs(new / old - 1) <= eps, made sound for means that are or nearly are zero.

    Args:
        new: mean over the last window.
        old: mean over the window before, of any sign.
        tolerance: eps_r or eps_c.
        floor: at least 0, in the unit of the means.

    >>> has_converged(-21.0, -20.0, tolerance=0.1, floor=0.0)
    True
    >>> has_converged(0.0, 0.0, tolerance=0.1, floor=0.0)
    True
    """
    return abs(new - old) <= tolerance * max(abs(old), floor)


def keeps_limit(cost: float, limit: float, *, tolerance: float) -> bool:
    """Whether the policy adheres to a limit: C-bar <= d + tolerance (Algorithm 2, line 6, has none).

    A mean of equal numbers may differ from them in the last digits, so equality is up to 1e-9.
    """
    return cost <= limit + tolerance or math.isclose(cost, limit, rel_tol=1e-9)


def next_limit(limit: float, cost: float, deploy_limit: float, *, remaining: int) -> float:
    """The limit after one that was kept: d <- max(d_d, C - (C - d_d) / n) with C = min(C-bar, d).

    Algorithm 2, line 7, where C-bar <= d. Written d_d + (C - d_d)(1 - 1 / n), which is the same and is d_d
    exactly when n = 1.

    Args:
        limit: d, possibly infinite.
        cost: C-bar, at least 0.
        deploy_limit: d_d, finite.
        remaining: n, the steps that are left; less than 1 counts as 1.

    >>> next_limit(math.inf, 65.0, 5.0, remaining=6)
    55.0
    """
    if limit <= deploy_limit:
        return deploy_limit
    start = min(cost, limit)
    return max(deploy_limit, deploy_limit + (start - deploy_limit) * (1.0 - 1.0 / max(1, remaining)))


def decide(
    old: WindowStatistics,
    new: WindowStatistics,
    *,
    limits: CostLimits,
    deploy_limits: CostLimits,
    remaining: int,
    config: DynamicConfig,
) -> CurriculumStep:
    """Lines 5 to 10 of Algorithm 2: the next step.

    Args:
        old: the window before the last.
        new: the last window, wholly after the last change.
        limits: d in force, [k].
        deploy_limits: d_d, [k].
        remaining: n of ``next_limit``.
        config: the settings.
    """
    if old.episodes == 0 or new.episodes == 0:
        return CurriculumStep(limits)
    converged = _converged(old, new, config)
    kept = _kept(new, limits, config)
    if config.dimensions == "joint":
        kept = [all(kept)] * len(limits)
    is_stuck = any(settled and not keeps for settled, keeps in zip(converged, kept, strict=True))
    lowered = tuple(
        next_limit(limit, cost, deploy, remaining=remaining) if settled and keeps else limit
        for limit, cost, deploy, settled, keeps in zip(
            limits, new.mean_costs, deploy_limits, converged, kept, strict=True
        )
    )
    return CurriculumStep(CostLimits(lowered), config.policy_noise if is_stuck else 0.0)


def _converged(old: WindowStatistics, new: WindowStatistics, config: DynamicConfig) -> list[bool]:
    """Whether the return and the cost of each dimension have converged (line 5), [k].

    Never where a window has no episode. Jointly, none has before all have.
    """
    if old.episodes == 0 or new.episodes == 0:
        return [False] * len(new.mean_costs)
    return_floor, cost_floors = _floors(old, config)
    return_converged = has_converged(
        new.mean_return, old.mean_return, tolerance=config.return_tolerance, floor=return_floor
    )
    converged = [
        return_converged and has_converged(cost, before, tolerance=config.cost_tolerance, floor=floor)
        for cost, before, floor in zip(new.mean_costs, old.mean_costs, cost_floors, strict=True)
    ]
    return [all(converged)] * len(converged) if config.dimensions == "joint" else converged


def _floors(window: WindowStatistics, config: DynamicConfig) -> tuple[float, tuple[float, ...]]:
    """What a mean return and mean costs at least count as in a comparison: the floor, or the spread."""
    if not config.window_grows:
        return config.return_floor, (config.cost_floor,) * len(window.mean_costs)
    cost_floors = tuple(max(spread, config.cost_floor) for spread in window.cost_spreads)
    return max(window.return_spread, config.return_floor), cost_floors


def is_precise(window: WindowStatistics, config: DynamicConfig) -> bool:
    """Whether a window's means are known to within what equal means may differ by.

    s <= eps max(|mean|, floor, standard deviation), s the standard error of the return and of each cost. With
    eps = 0.1 a hundred episodes are always enough.
    """
    if window.episodes == 0:
        return False
    return_floor, cost_floors = _floors(window, config)
    root = math.sqrt(window.episodes)
    return_scale = max(abs(window.mean_return), return_floor)
    return window.return_spread <= config.return_tolerance * return_scale * root and all(
        spread <= config.cost_tolerance * max(cost, floor) * root
        for spread, cost, floor in zip(window.cost_spreads, window.mean_costs, cost_floors, strict=True)
    )


def _kept(new: WindowStatistics, limits: CostLimits, config: DynamicConfig) -> list[bool]:
    """Whether each limit is kept, [k]."""
    return [
        keeps_limit(cost, limit, tolerance=_tolerance(limit, error, config))
        for cost, limit, error in zip(new.mean_costs, limits, new.standard_errors, strict=True)
    ]


def _tolerance(limit: float, standard_error: float, config: DynamicConfig) -> float:
    """By how much a mean cost may exceed its limit."""
    match config.adherence_tolerance:
        case "none":
            return 0.0
        case "standard_error":
            return standard_error
        case "relative":
            return max(standard_error, config.cost_tolerance * max(limit, config.cost_floor))


def steps_left(
    last: WindowStatistics, *, env_steps: int, train_steps: int, unit: Literal["windows", "episodes"]
) -> int:
    """How many steps of ``next_limit`` the training budget has room for, at the pace of the last window.

    B is given in environment steps; how many episodes it holds is known only afterwards. The last window
    took some steps and finished some episodes, so what is left holds (B - env steps) / steps such windows,
    and as many times its episodes. Rounded down. The last two windows are not counted. Of the episodes the
    next one is not counted: Algorithm 2 judges before it plays episode b, when b - 1 are played and
    B - b + 1 are left.

    >>> last = WindowStatistics(1000, episodes=8, mean_return=0.0, mean_costs=(0.0,), cost_scatter=(0.0,))
    >>> [steps_left(last, env_steps=5500, train_steps=10000, unit=unit) for unit in ("windows", "episodes")]
    [2, 35]
    """
    steps = train_steps - env_steps
    if unit == "episodes":
        return steps * last.episodes // max(1, last.env_steps) - 1
    return steps // max(1, last.env_steps) - 2


class DynamicTeacher:
    """The dynamic curriculum as a function of its state.

    Its state holds ``update``, ``env_steps``, ``limits`` [k], ``policy_noise``, ``last_change`` (updates or
    episodes since limits or policy were changed, in the unit of W), ``history`` (``WindowStatistics`` of each
    update of the last two windows, as far as they are comparable) and the keys of ``StartMeasurement``.

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
            last_change=0,
            history=(),
            start=self.measurement.begin(),
        )
        return CurriculumStep.from_json(state), state

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``."""
        if already_seen(state, report):
            return CurriculumStep.from_json(state), state
        start = self.measurement.advance(state, report)
        history = self._history(state, report)
        last_change = state["last_change"] + (
            len(report.episodes) if self.config.window_unit == "episodes" else 1
        )
        before = CostLimits.from_json(state["limits"])
        limits = CostLimits(tuple(map(min, before, self.measurement.limits(start))))
        is_due = False  # line 4
        if progress(report.env_steps, self.spec.train_steps) >= 1.0:
            step, history = CurriculumStep(self.spec.deploy_limits), ()
        elif start["start_limits"] is None or limits != before or last_change < self.config.window:
            step = CurriculumStep(limits)
        else:
            is_due = True
            step = self._decide(limits, history, report.env_steps, last_change)
        has_changed = step.limits != before or step.policy_noise > 0.0
        if is_due and self.config.clock_reset == "convergence":
            has_changed = has_changed or self._has_converged(history, last_change)
        if step.policy_noise > 0.0 and self.config.windows_after_noise == 2:
            history = ()
        next_state = _state(
            update=report.update,
            env_steps=report.env_steps,
            step=step,
            last_change=0 if has_changed else last_change,
            history=history,
            start=start,
        )
        return CurriculumStep.from_json(next_state), next_state

    def _history(self, state: TeacherState, report: ProgressReport) -> tuple[WindowStatistics, ...]:
        """The updates of the last two windows, or all of them as long as they are fewer."""
        latest = WindowStatistics.of_update(
            report.episodes,
            env_steps=report.env_steps - state["env_steps"],
            num_costs=len(self.spec.train_limits),
        )
        unit = self.config.window_unit
        history = extend(
            [WindowStatistics.from_json(statistics) for statistics in state["history"]], latest, unit=unit
        )
        needed = [self._last_two(history, group) for group in self._groups]
        if any(windows is None for windows in needed):
            return history
        return history[-max(len(windows[0]) + len(windows[1]) for windows in needed if windows) :]

    @property
    def _groups(self) -> tuple[tuple[int, ...], ...]:
        """The costs that are judged together: all, or where windows grow each limit on its own."""
        costs = tuple(range(len(self.spec.train_limits)))
        if self.config.window_grows and self.config.dimensions == "separate":
            return tuple((index,) for index in costs)
        return (costs,)

    def _last_two(
        self, history: Sequence[WindowStatistics], group: tuple[int, ...]
    ) -> tuple[tuple[WindowStatistics, ...], tuple[WindowStatistics, ...]] | None:
        """The updates of the last two windows for a group of costs, or None as long as there are too few."""
        config = self.config
        return last_two_windows(
            history,
            config.window,
            unit=config.window_unit,
            is_enough=(lambda window: is_precise(window.of_costs(group), config))
            if config.window_grows
            else None,
        )

    def _is_due(self, newest: Sequence[WindowStatistics], last_change: int) -> bool:
        """Whether a newest window lies wholly after the last change (line 4)."""
        in_episodes = self.config.window_unit == "episodes"
        length = sum(each.episodes for each in newest) if in_episodes else len(newest)
        return not self.config.window_grows or last_change >= length

    def _windows(
        self, history: Sequence[WindowStatistics], group: tuple[int, ...], last_change: int
    ) -> tuple[WindowStatistics, WindowStatistics] | None:
        """The last two windows of a group of costs, each pooled; None if they are too few or too old."""
        windows = self._last_two(history, group)
        if windows is None or not self._is_due(windows[1], last_change):
            return None
        old, new = (WindowStatistics.pooled(window).of_costs(group) for window in windows)
        return old, new

    def _has_converged(self, history: Sequence[WindowStatistics], last_change: int) -> bool:
        """Whether line 11 is reached: the test of line 5 holds in some dimension, or jointly."""
        groups = (self._windows(history, group, last_change) for group in self._groups)
        return any(any(_converged(*windows, self.config)) for windows in groups if windows is not None)

    def _decide(
        self, limits: CostLimits, history: Sequence[WindowStatistics], env_steps: int, last_change: int
    ) -> CurriculumStep:
        """The next step once W has passed since the last change."""
        values, noise = list(limits), 0.0
        for group in self._groups:
            windows = self._windows(history, group, last_change)
            if windows is None:
                continue
            old, new = windows
            step = decide(
                old,
                new,
                limits=CostLimits(tuple(limits[index] for index in group)),
                deploy_limits=CostLimits(tuple(self.spec.deploy_limits[index] for index in group)),
                remaining=steps_left(
                    new, env_steps=env_steps, train_steps=self.spec.train_steps, unit=self.config.remaining
                ),
                config=self.config,
            )
            noise = max(noise, step.policy_noise)
            for index, value in zip(group, step.limits, strict=True):
                values[index] = value
        return CurriculumStep(CostLimits(tuple(values)), noise)


def _state(
    *,
    update: int,
    env_steps: int,
    step: CurriculumStep,
    last_change: int,
    history: Sequence[WindowStatistics],
    start: dict[str, Any],
) -> dict[str, Any]:
    """A state as JSON."""
    return {
        "update": update,
        "env_steps": env_steps,
        "limits": step.limits.to_json(),
        "policy_noise": step.policy_noise,
        "last_change": last_change,
        "history": [statistics.to_json() for statistics in history],
        **start,
    }
