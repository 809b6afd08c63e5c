"""Ask a curriculum of the user's own for the steps of a whole training phase, with made-up episodes.

A few updates of a trial show little of a curriculum: no episode may end in them, and its last steps do not
come. No training is needed to see these. Mean costs begin above the training limits and end below those of
deployment; they are real numbers, also where a task counts.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from recrl.environments.cmdp import CMDPSpec, CostLimits, EpisodeStats, Phase
from recrl.orchestrator.spec import TrialSpec
from recrl.teachers.registry import find_teacher, make_teacher
from recrl.teachers.static import StaticTeacher
from recrl.teachers.teacher import AnswerCheck, ProgressReport, TeacherState

MOST_UPDATES = 200  # asked about, of those of the training phase
MOST_SECONDS = 3.0  # then only about the last one
EPISODES = 2  # made up for an update; for every third there are none
FIRST_COST, LAST_COST = 1.5, 0.5  # mean, as multiples of d_t and of d_d


def ask_through(spec: TrialSpec, cmdp: CMDPSpec) -> None:
    """Check a curriculum's answers from the start to the last that a trial would ask for.

    Args:
        spec: the trial.
        cmdp: of its task.

    Raises:
        TypeError: an answer has another form, or has what its TeacherKind does not declare.
        ValueError: a limit rises or is out of range, or the same question has two answers.
        Exception: it raises one.
    """
    d_t = _finite(spec.train_limits, spec.deploy_limits)
    is_of_clock = isinstance(make_teacher(spec.teacher), StaticTeacher)  # its decay is checked from d_t on
    asked = replace(spec.teacher, train_limits=d_t) if is_of_clock else spec.teacher
    teacher, kind, label = make_teacher(asked), find_teacher(spec.method.name), spec.method.label
    check = AnswerCheck(label, cmdp.cost_names, asked.train_limits, asked.deploy_limits)
    step, state = check.checked(teacher.start())
    kind.require_declared(step, None, curriculum=label)
    given = _text(state)
    for made_up in _reports(spec, d_t, cmdp.horizon):
        ended = (replace(it, limits=step.limits, noise=step.policy_noise) for it in made_up.episodes)
        report, before = replace(made_up, episodes=tuple(ended)), step
        step, after = check.checked(teacher.step(state, report), before=before.limits, update=report.update)
        kind.require_declared(step, before, curriculum=label)
        if _text(state) != given:
            raise ValueError(f"curriculum {label}: step must not change the state that it is given")
        state, given = after, _text(after)
        again = check.checked(teacher.step(state, report), before=before.limits, update=report.update)
        if (again[0], _text(again[1])) != (step, given):
            raise ValueError(
                f"curriculum {label}: asked again about the same update, it answers otherwise; answer a "
                "report that the state has seen from the state alone, see "
                "recrl.teachers.teacher.already_seen"
            )


def _finite(train_limits: CostLimits, deploy_limits: CostLimits) -> CostLimits:
    """Return d_t, with a number above d_d for each that is yet to be measured."""
    pairs = zip(train_limits, deploy_limits, strict=True)
    return CostLimits(tuple(train if math.isfinite(train) else 2.0 * d + 1.0 for train, d in pairs))


def _reports(spec: TrialSpec, train_limits: CostLimits, horizon: int | None) -> Iterator[ProgressReport]:
    """Make up reports with consecutive numbers; a trial enters deployment after its last training update.

    Args:
        spec: the trial.
        train_limits: d_t, finite, [k].
        horizon: most steps of an episode; None if unknown.
    """
    generator, end = np.random.default_rng(0), time.monotonic() + MOST_SECONDS
    index = number = 0  # of episodes and reports so far
    last = spec.train_updates - 1
    for update in np.linspace(1, last, min(last, MOST_UPDATES), dtype=int).tolist():
        if time.monotonic() > end and update != last:
            continue
        number += 1
        late, end_step = update / last, update * spec.steps_per_update
        length = min(horizon or spec.rollout_steps, update * spec.rollout_steps)
        mean = (1.0 - late) * FIRST_COST * train_limits.array + late * LAST_COST * spec.deploy_limits.array
        episodes = tuple(
            EpisodeStats(
                index=index + i,
                phase=Phase.TRAINING,
                end_step=end_step,
                length=length,
                episode_return=float(generator.normal()),
                costs=tuple((mean * generator.uniform(0.5, 1.5)).tolist()),
                limits=train_limits,
                noise=0.0,
                begin_step=end_step - length * spec.num_envs,
            )
            for i in range(EPISODES if number % 3 else 0)
        )
        index += len(episodes)
        yield ProgressReport(number, end_step, episodes)


def _text(state: TeacherState) -> str:
    return json.dumps(dict(state), sort_keys=True)
