"""Algorithm 2 of the paper, literally: ``name: dynamic, options: {preset: paper}``.

``Algorithm2Teacher.step`` has the lines of the pseudocode. ``recrl.teachers.dynamic`` is our curriculum, and
says why it differs. A curriculum is asked once per policy update. With one episode per update this is the
paper's clock. Where Algorithm 2 is not defined, or not exactly:

- *Several episodes per update.* ``last_change`` counts them all. A window has W episodes, rounded up to whole
  updates, because the policy is constant within one.
- *Two windows* (line 4). At b = 2 W only 2 W - 1 episodes have run, so the first decision is at b = 2 W + 1.
- *B - b*. The budget is in environment steps, so the remaining episodes are estimated (``episodes_left``).
- *An old mean of 0* (line 5). |new / old - 1| <= eps is written as |new - old| <= eps |old|. So 0 after 0 has
  converged.
- *The end* (line 7). Where B - b is below 1, the new limit is d_d. At B the limits are d_d in any case.
- *Rounding.* C-bar <= d holds up to rounding errors of 1e-9, and the step never raises a limit.
- *Infinite d_t.* The first step of line 7 takes d to about C-bar, unless ``start_fraction`` is above 0. Then
  the start is measured, and there is no decision until it is known.

Notation: d limits in force, d_t training limits, d_d deployment limits, B the training budget in environment
steps, b an episode; r-bar and C-bar the mean episode return and cost of a window, W its episodes; k the
number of costs, eps_r, eps_c, eps_pi the paper's settings.
"""

from __future__ import annotations

from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.teachers.dynamic_options import DynamicConfig
from recrl.teachers.dynamic_rules import has_converged, keeps_limit, next_limit
from recrl.teachers.start_limits import StartMeasurement
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState, already_seen, progress
from recrl.teachers.windows import WindowStatistics, last_two_windows


class Algorithm2Teacher:
    """Algorithm 2 as a function of its state.

    Its state holds ``update``, ``env_steps``, ``limits`` [k], ``policy_noise``; ``last_change`` (episodes
    since line 11); ``history`` (statistics of each update of the last two windows) and the keys of
    ``StartMeasurement``.

    Args:
        spec: d_t, d_d, B and the options of ``DynamicConfig`` with ``preset: paper``.
    """

    def __init__(self, spec: TeacherSpec) -> None:
        self.spec = spec
        self.config = DynamicConfig.model_validate(dict(spec.options))
        self.measurement = StartMeasurement(spec, self.config.start_fraction)

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.start``."""
        state = {  # line 2
            "update": 0,
            "env_steps": 0,
            "limits": self.spec.train_limits.to_json(),
            "policy_noise": 0.0,
            "last_change": 0,
            "history": [],
            **self.measurement.begin(),
        }
        return CurriculumStep.from_json(state), state

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        """See ``Teacher.step``."""
        if already_seen(state, report):
            return CurriculumStep.from_json(state), state
        start = self.measurement.advance(state, report)
        history, last_change = _executed(state, report)  # lines 14 and 15
        window = self.config.window
        windows = last_two_windows(history, 1, is_enough=lambda updates: updates.episodes >= window)
        if windows is not None:
            history = (*windows[0], *windows[1])

        before = CostLimits.from_json(state["limits"])
        limits, noise = CostLimits(tuple(map(min, before, self.measurement.limits(start)))), 0.0
        if progress(report.env_steps, self.spec.train_steps) >= 1.0:
            limits, history = self.spec.deploy_limits, ()
        elif limits != before:  # the start is measured
            last_change = 0
        elif start["start_limits"] is not None and windows is not None and last_change >= window:  # line 4
            old, new = map(WindowStatistics.pooled, windows)
            if self._has_converged(old, new):  # line 5
                if _adheres(new, limits):  # line 6
                    limits = self._lowered(limits, new, env_steps=report.env_steps)  # line 7
                else:  # line 8
                    noise = self.config.policy_noise  # line 9
                last_change = 0  # line 11
        next_state = {
            "update": report.update,
            "env_steps": report.env_steps,
            "limits": limits.to_json(),
            "policy_noise": noise,
            "last_change": last_change,
            "history": [statistics.to_json() for statistics in history],
            **start,
        }
        return CurriculumStep.from_json(next_state), next_state

    def _has_converged(self, old: WindowStatistics, new: WindowStatistics) -> bool:
        """Line 5: |r_new / r_old - 1| <= eps_r, and for all i |C_new / C_old - 1| <= eps_c."""
        eps_r, eps_c = self.config.return_tolerance, self.config.cost_tolerance
        return has_converged(new.mean_return, old.mean_return, tolerance=eps_r, floor=0.0) and all(
            has_converged(cost, before, tolerance=eps_c, floor=0.0)
            for cost, before in zip(new.mean_costs, old.mean_costs, strict=True)
        )

    def _lowered(self, limits: CostLimits, new: WindowStatistics, *, env_steps: int) -> CostLimits:
        """Line 7: for all i, d := max(d_d, C-bar - (C-bar - d_d) / (B - b))."""
        remaining = episodes_left(new, env_steps=env_steps, train_steps=self.spec.train_steps)
        each = zip(limits, new.mean_costs, self.spec.deploy_limits, strict=True)
        return CostLimits(tuple(next_limit(d, cost, d_d, remaining=remaining) for d, cost, d_d in each))


def _adheres(new: WindowStatistics, limits: CostLimits) -> bool:
    """Line 6: for all i, C-bar <= d."""
    return all(keeps_limit(cost, d, tolerance=0.0) for cost, d in zip(new.mean_costs, limits, strict=True))


def _executed(state: TeacherState, report: ProgressReport) -> tuple[tuple[WindowStatistics, ...], int]:
    """Lines 14 and 15: return the history with one more update, and ``last_change`` with its episodes.

    The steps of an update without episodes are added to the next one with some. So a history is never longer
    than its number of episodes.
    """
    history = tuple(map(WindowStatistics.from_json, state["history"]))
    latest = WindowStatistics.of_update(
        report.episodes,
        env_steps=report.env_steps - state["env_steps"],
        num_costs=len(state["limits"]),
    )
    if history and history[-1].episodes == 0:
        history, latest = history[:-1], WindowStatistics.pooled([history[-1], latest])
    return (*history, latest), state["last_change"] + len(report.episodes)


def episodes_left(last: WindowStatistics, *, env_steps: int, train_steps: int) -> int:
    """Return an estimate of B - b, the episodes after the next one, at the pace of the last window.

    Algorithm 2 decides before it runs episode b, when B - b + 1 episodes remain.

    Args:
        last: the last window.
        env_steps: taken so far.
        train_steps: B.

    >>> last = WindowStatistics(1000, episodes=8, mean_return=0.0, mean_costs=(0.0,), cost_scatter=(0.0,))
    >>> episodes_left(last, env_steps=5500, train_steps=10000)
    35
    """
    return (train_steps - env_steps) * last.episodes // max(1, last.env_steps) - 1
