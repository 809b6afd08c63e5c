"""What every teacher promises, over all of them and over agents of any behaviour."""

import json
import math
import pickle
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import cycle, pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats, Phase
from recrl.teachers.registry import TEACHERS, make_teacher
from recrl.teachers.teacher import AnswerCheck, ProgressReport, TeacherSpec, TeacherState

# Every teacher under its defaults, and the dynamic one also where its settings lead elsewhere.
VARIANTS: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in TEACHERS),
    ("linear", {"start_fraction": 0.1}),
    ("dynamic", {"window": 1, "return_tolerance": 1.0, "cost_tolerance": 1.0}),
    ("dynamic", {"window": 2, "start_fraction": 0.0}),
    ("dynamic", {"preset": "paper", "window": 2, "return_tolerance": 0.5}),
]
CONTRACT = settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
TRAIN_STEPS = 100


@dataclass(frozen=True)
class History:
    """What a trial was set up with and what its agent did."""

    train_limits: CostLimits
    deploy_limits: CostLimits
    reports: tuple[ProgressReport, ...]

    def specs(self, *, static_only: bool = False) -> list[TeacherSpec]:
        """A teacher of every variant for this trial."""
        return [
            TeacherSpec(name, options, self.train_limits, self.deploy_limits, TRAIN_STEPS)
            for name, options in VARIANTS
            if not (static_only and name == "dynamic")
        ]

    def of_dimension(self, i: int) -> "History":
        """The same trial, had it known but one of its costs."""
        return History(
            CostLimits((self.train_limits[i],)),
            CostLimits((self.deploy_limits[i],)),
            tuple(
                replace(
                    report,
                    episodes=tuple(
                        replace(episode, costs=(episode.costs[i],)) for episode in report.episodes
                    ),
                )
                for report in self.reports
            ),
        )


@st.composite
def histories(draw: st.DrawFn) -> History:
    """Trials of up to three costs, with anything between 0 and 4 episodes an update, to beyond B."""
    num_costs = draw(st.integers(1, 3))
    deploy = [draw(st.sampled_from([0.0, 0.1, 5.0, 25.0])) for _ in range(num_costs)]
    train = [limit + draw(st.sampled_from([0.0, 0.3, 20.0, math.inf])) for limit in deploy]
    cost = st.one_of(st.sampled_from([0.0, 0.1, 5.0]), st.floats(0.0, 60.0))
    episode_return = st.one_of(st.sampled_from([0.0, -20.0, 9.5]), st.floats(-50.0, 50.0))
    reports = []
    env_steps = 0
    for update in range(1, draw(st.integers(2, 12)) + 1):
        env_steps += draw(st.sampled_from([1, 10, 25]))
        episodes = tuple(
            EpisodeStats(
                index=b,
                phase=Phase.TRAINING,
                end_step=env_steps,
                length=1,
                episode_return=draw(episode_return),
                costs=tuple(draw(cost) for _ in range(num_costs)),
                limits=CostLimits(tuple(train)),
                noise=0.0,
            )
            for b in range(draw(st.integers(0, 4)))
        )
        reports.append(ProgressReport(update, env_steps, episodes))
    return History(CostLimits(tuple(train)), CostLimits(tuple(deploy)), tuple(reports))


def played(
    spec: TeacherSpec, reports: tuple[ProgressReport, ...]
) -> list[tuple[CurriculumStep, TeacherState]]:
    """All answers of a teacher, the first before any report."""
    teacher = make_teacher(spec)
    answers = [teacher.start()]
    for report in reports:
        answers.append(teacher.step(answers[-1][1], report))
    return answers


@CONTRACT
@given(histories())
def test_a_report_reaches_another_process_as_it_is(history: History) -> None:
    for report in history.reports:
        assert pickle.loads(pickle.dumps(report)) == report  # noqa: S301  (our own bytes)


@CONTRACT
@given(history=histories())
def test_limits_never_rise(history: History) -> None:
    for spec in history.specs():
        for (before, _), (after, _) in pairwise(played(spec, history.reports)):
            assert all(new <= old for new, old in zip(after.limits, before.limits, strict=True))


@CONTRACT
@given(history=histories())
def test_every_answer_passes_the_trials_checks(history: History) -> None:
    names = ["a", "b", "c"][: len(history.train_limits)]
    for spec in history.specs():
        check = AnswerCheck(spec.name, names, spec.train_limits, spec.deploy_limits)
        before = None
        for update, answer in enumerate(played(spec, history.reports)):
            step, _ = check.checked(answer, before=before, update=update)
            before = step.limits


@CONTRACT
@given(history=histories())
def test_limits_stay_between_d_d_and_d_t(history: History) -> None:
    for spec in history.specs():
        unlimited = CostLimits.unlimited(len(spec.train_limits))
        highest = unlimited if spec.name == "unconstrained" else spec.train_limits
        for step, _ in played(spec, history.reports):
            start = step.start_limits or unlimited
            ordered = zip(spec.deploy_limits, step.limits, start, strict=True)
            assert all(deploy <= limit <= first for deploy, limit, first in ordered)
            measured = zip(step.limits, highest, strict=True)
            assert all(limit <= train for limit, train in measured)


@CONTRACT
@given(history=histories())
def test_limits_are_d_d_without_noise_from_the_end_of_the_budget_on(history: History) -> None:
    last = history.reports[-1]
    end = ProgressReport(last.update + 1, max(TRAIN_STEPS, last.env_steps + 1), last.episodes)
    reports = (*history.reports, end)
    for spec in history.specs():
        for report, (step, _) in zip(reports, played(spec, reports)[1:], strict=True):
            if report.env_steps >= TRAIN_STEPS:
                assert (step.limits, step.policy_noise) == (history.deploy_limits, 0.0)
                assert not step.rewards_entropy


@CONTRACT
@given(history=histories())
def test_a_step_changes_nothing_but_its_answer(history: History) -> None:
    for spec in history.specs():
        teacher = make_teacher(spec)
        _, state = teacher.start()
        for report in history.reports:
            before = deepcopy(state)
            answer = teacher.step(state, report)
            assert state == before
            assert teacher.step(state, report) == answer
            state = answer[1]


@CONTRACT
@given(history=histories())
def test_the_same_update_again_gets_the_same_answer(history: History) -> None:
    for spec in history.specs():
        teacher = make_teacher(spec)
        _, state = teacher.start()
        for report in history.reports:
            step, state = teacher.step(state, report)
            assert teacher.step(state, report) == (step, state)
            assert teacher.step(state, replace(report, episodes=())) == (step, state)


@CONTRACT
@given(history=histories(), data=st.data())
def test_a_resumed_teacher_goes_on_as_if_uninterrupted(history: History, data: st.DataObject) -> None:
    cut = data.draw(st.integers(0, len(history.reports)))
    for spec in history.specs():
        answers = played(spec, history.reports)
        state = answers[cut][1]
        teacher = make_teacher(spec)
        for report, uninterrupted in zip(history.reports[cut:], answers[cut + 1 :], strict=True):
            restored = json.loads(json.dumps(state, allow_nan=False))
            assert restored == state
            step, state = teacher.step(restored, report)
            assert (step, state) == uninterrupted


@CONTRACT
@given(history=histories())
def test_one_teacher_shared_by_two_trials_answers_each_as_its_own(history: History) -> None:
    halved = tuple(
        replace(
            report,
            episodes=tuple(
                replace(episode, costs=tuple(cost / 2 for cost in episode.costs))
                for episode in report.episodes
            ),
        )
        for report in history.reports
    )
    for spec in history.specs():
        shared = make_teacher(spec)
        first, second = shared.start(), shared.start()
        own_first, own_second = played(spec, history.reports), played(spec, halved)
        for update, (one, other) in enumerate(zip(history.reports, halved, strict=True), start=1):
            first, second = shared.step(first[1], one), shared.step(second[1], other)
            assert (first, second) == (own_first[update], own_second[update])


@CONTRACT
@given(history=histories())
def test_the_order_in_which_environments_finish_does_not_matter(history: History) -> None:
    backwards = tuple(replace(report, episodes=report.episodes[::-1]) for report in history.reports)
    for spec in history.specs():
        assert played(spec, backwards) == played(spec, history.reports)


@CONTRACT
@given(history=histories())
def test_a_static_limit_depends_on_its_own_dimension_only(history: History) -> None:
    for i in range(len(history.train_limits)):
        alone = history.of_dimension(i)
        for spec, own in zip(history.specs(static_only=True), alone.specs(static_only=True), strict=True):
            together = [step.limits[i] for step, _ in played(spec, history.reports)]
            assert together == [step.limits[0] for step, _ in played(own, alone.reports)]


@CONTRACT
@given(
    options=st.sampled_from(
        [options for name, options in VARIANTS if name == "dynamic" and "preset" not in options]
    ),
    deploy=st.sampled_from([0.0, 1.0, 40.0]),
    other_train=st.sampled_from([math.inf, 50.0, 0.0]),
    other_costs=st.lists(st.sampled_from([0.0, 3.0, 40.0]), min_size=1, max_size=12),
)
def test_no_dimension_keeps_an_obedient_one_from_d_d(
    options: dict[str, Any], deploy: float, other_train: float, other_costs: list[float]
) -> None:
    """A dimension always costs what it may; what the other costs, over and over again, is arbitrary."""
    limits = CostLimits((50.0, other_train)), CostLimits((deploy, 0.0))
    teacher = make_teacher(TeacherSpec("dynamic", options, *limits, TRAIN_STEPS))
    step, state = teacher.start()
    for update, other in zip(range(1, TRAIN_STEPS), cycle(other_costs), strict=False):
        costs = (step.limits[0], other)
        episode = EpisodeStats(update, Phase.TRAINING, update, 1, 9.5, costs, step.limits, 0.0)
        step, state = teacher.step(state, ProgressReport(update, update, (episode,)))
    assert step.limits[0] == deploy


@pytest.mark.parametrize("name", TEACHERS)
def test_a_gap_in_the_updates_is_an_error(name: str) -> None:
    teacher = make_teacher(TeacherSpec(name, {}, CostLimits((50.0,)), CostLimits((5.0,)), TRAIN_STEPS))
    _, state = teacher.start()
    _, state = teacher.step(state, ProgressReport(1, 10, ()))
    with pytest.raises(ValueError) as error:
        teacher.step(state, ProgressReport(3, 30, ()))
    assert str(error.value) == (
        "this teacher state has seen update 1: the next report must be for update 2, or for 1 again, got 3"
    )


STATE: dict[str, Any] = {"update": 0}
ONE_COST = AnswerCheck("mine", ("cost",), CostLimits((9.0,)), CostLimits((1.0,)))


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (1.5, "curriculum mine: must return a CurriculumStep and its state, a mapping, got float"),
        ((CostLimits((1.0,)), STATE), "a CurriculumStep and its state, a mapping, got CostLimits, dict"),
        ((CurriculumStep(CostLimits((1.0,))), None), "a mapping, got CurriculumStep, NoneType"),
        ((CurriculumStep(CostLimits((1.0, 2.0))), STATE), "a step must have one limit per cost, 1, got 2"),
        (
            (CurriculumStep(CostLimits((1.0,)), start_limits=CostLimits((9.0, 9.0))), STATE),
            "curriculum mine: start_limits must be None or one limit per cost, 1, got 2",
        ),
    ],
)
def test_what_is_wrong_with_a_curriculums_answer_is_said(answer: object, sentence: str) -> None:
    with pytest.raises((TypeError, ValueError), match=sentence):
        ONE_COST.checked(answer)


@pytest.mark.parametrize(
    ("state", "problem"),
    [
        ({"seen": {1}}, "state['seen'] is a set"),
        ({"costs": [[1.0], np.zeros(2)]}, "state['costs'][1] is an ndarray"),
        ({"best": {"mean": np.float32(1.0)}}, "state['best']['mean'] is a float32"),
        ({"rows": (row for row in [1])}, "state['rows'] is a generator"),
        ({"pair": (1, 2)}, "state['pair'] is a tuple"),
        ({"of": {3: 1.0}}, "state['of'] has the key 3, an int, and keys must be text"),
    ],
)
def test_a_state_that_is_no_json_is_said_with_its_path(state: dict[str, Any], problem: str) -> None:
    with pytest.raises(TypeError) as caught:
        ONE_COST.checked((CurriculumStep(CostLimits((1.0,))), state))
    assert str(caught.value) == f"curriculum mine: {problem}; a state holds JSON values only"


def test_a_state_of_json_values_is_right() -> None:
    state = {"update": 3, "costs": [[1.0, math.inf]], "best": None, "of": {"a": True}, "said": "yes"}
    assert ONE_COST.checked((CurriculumStep(CostLimits((1.0,))), state))[1] is state


def test_plain_numbers_are_limits_too() -> None:
    step = CurriculumStep((2.0, 1), start_limits=[5.0, math.inf])  # type: ignore[arg-type]
    assert step.limits == CostLimits((2.0, 1.0))
    assert step.start_limits == CostLimits((5.0, math.inf))
    assert CurriculumStep.from_json(step.to_json()) == step
    check = AnswerCheck("mine", ("fuel", "noise"), CostLimits((5.0, math.inf)), CostLimits((1.0, 1.0)))
    assert check.checked((step, STATE)) == (step, STATE)


INF = math.inf


@pytest.mark.parametrize(
    ("before", "limit", "train", "sentence"),
    [
        (None, 9.0, 9.0, None),
        (None, 5.0, 9.0, None),
        (None, INF, 9.0, None),  # a control without limits
        (9.0, 9.0, 9.0, None),
        (INF, 12.0, INF, None),  # a measured start
        (9.0, 9.0 + 1e-12, 9.0, None),  # rounding
        (9.0, 12.0, 20.0, "the limit of noise rose from 9 to 12 after update 5; limits may only fall"),
        (9.0, INF, INF, "the limit of noise rose from 9 to inf after update 5; limits may only fall"),
        (
            None,
            12.0,
            9.0,
            "the limit of noise is 12 at the start, above its train_limits of 9; limits may only fall",
        ),
        (
            INF,
            12.0,
            9.0,
            "the limit of noise is 12 after update 5, above its train_limits of 9; limits may only fall",
        ),
        (
            9.0,
            0.5,
            9.0,
            "the limit of noise is 0.5 after update 5, below its deploy_limits of 1; limits may only fall to "
            "that",
        ),
    ],
)
def test_a_limit_that_rises_is_an_error_with_its_cost(
    before: float | None, limit: float, train: float, sentence: str | None
) -> None:
    check = AnswerCheck("rising", ("fuel", "noise"), CostLimits((1.0, train)), CostLimits((1.0, 1.0)))
    answer = CurriculumStep(CostLimits((1.0, limit))), STATE
    limits, update = (None, 0) if before is None else (CostLimits((1.0, before)), 5)
    if sentence is None:
        assert check.checked(answer, before=limits, update=update) == answer
        return
    with pytest.raises(ValueError) as caught:
        check.checked(answer, before=limits, update=update)
    assert str(caught.value) == f"curriculum rising: {sentence}"
