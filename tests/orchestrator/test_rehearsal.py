"""The user's own parts are tried before a launch: do they work, and do they resume exactly?"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from recrl.orchestrator.errors import GridError
from recrl.orchestrator.grid import curriculum_questions
from recrl.orchestrator.grid.checking import parse_grid

OWN = '''\
import gymnasium
import numpy as np
from pydantic import BaseModel, Field, computed_field, model_validator

from recrl.agents.algorithms.ppo import make_ppo
from recrl.agents.learning.actor_critic import fresh_agent
from recrl.agents.learning.gradient_ascent import FirstOrderRule
from recrl.agents.registry import AGENTS, AgentEntry
from recrl.agents.shared_options import AscentConfig
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.teachers.registry import TeacherKind
from recrl.teachers.static import StaticTeacher


class Room(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(2, np.float32), 1.0, False, self.steps == 7, {"cost": float(action)}


class Wandering(Room):
    """No observation repeats."""

    def step(self, action):
        _, *rest = super().step(action)
        return self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32), *rest


class Unseeded(Room):
    def reset(self, *, seed=None, options=None):
        _, info = super().reset(seed=seed)
        return np.random.default_rng().uniform(-1.0, 1.0, 2).astype(np.float32), info


class Worn(Room):
    """Its rewards depend on the number of past episodes, like those of a wrapper that learns a scale."""

    episodes = 0

    def reset(self, *, seed=None, options=None):
        self.episodes += 1
        return super().reset(seed=seed)

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, 1.0 / self.episodes, *rest


class Broken(Room):
    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, info if self.steps < 5 else {}


class Endless(Room):
    horizon = 10

    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, False, info


class Late(Endless):
    horizon = 30

    def step(self, action):
        observation, reward, *_, info = super().step(action)
        if self.steps > 20:
            raise OverflowError("too late")
        return observation, reward, False, False, info


class NoOptions(BaseModel, extra="forbid"):
    pass


class Inner(BaseModel, extra="allow"):
    size: float = 1.0


class Loose(BaseModel):
    power: float = 1.0
    inner: Inner = Inner()

    @computed_field
    @property
    def squared(self) -> float:
        return self.power**2


class Strict(Loose, extra="forbid"):
    pass


class Renamed(BaseModel):
    step_size: float = Field(1.0, alias="stepSize")


class Shorthand(BaseModel):
    """Its keys are not its fields, and it sets a field itself."""

    low: float = 0.0
    high: float = 1.0
    width: float = 1.0
    tags: set[str] = {"speed", "height", "torque", "angle", "energy"}

    @model_validator(mode="before")
    @classmethod
    def _of_range(cls, data):
        data = dict(data)
        low, high = data.pop("range", (data.get("low", 0.0), data.get("high", 1.0)))
        return {**data, "low": low, "high": high}

    @model_validator(mode="after")
    def _with_width(self):
        self.width = self.high - self.low
        return self


class Wrapped:
    def __init__(self, agent):
        self.agent, self.count = agent, 0

    def __getattr__(self, name):
        return getattr(self.agent, name)

    def update(self, rollout, costs, step):
        self.count += 1
        return {**self.agent.update(rollout, costs, step), "count": self.count}


class Infinite(Wrapped):
    def update(self, rollout, costs, step):
        return {**self.agent.update(rollout, costs, step), "reach": float("inf")}


class OddName(Wrapped):
    def update(self, rollout, costs, step):
        return {**self.agent.update(rollout, costs, step), "we ird,name": 1.0}


class Silent(Wrapped):
    """Keeps its count for itself; no metric shows it."""

    def update(self, rollout, costs, step):
        self.count += 1
        return self.agent.update(rollout, costs, step)

    def state_dict(self):
        return {**self.agent.state_dict(), "hidden": self.count}


class Limited(Wrapped):
    def update(self, rollout, costs, step):
        return {**self.agent.update(rollout, costs, step), "whole": int(step.limits.values[0])}


class Falling(Wrapped):
    def update(self, rollout, costs, step):
        np.reshape(rollout.rewards, (0, 7))


class NoMode(Wrapped):
    def update(self, rollout, costs, step):
        return self.agent.update(rollout, costs, step)

    def final_policy(self):
        return None


class NoNoise(NoMode):
    def final_policy(self):
        return self.agent.final_policy()

    def add_noise(self, noise, observations):
        raise NotImplementedError


class OddNoise(NoNoise):
    def add_noise(self, noise, observations):
        return {"update": 1.0}


class Listed(NoNoise):
    def state_dict(self):
        return [self.agent.state_dict()]

    def load_state_dict(self, state):
        self.agent.load_state_dict(state[0])


class NoEntropy(Wrapped):
    learns_rewarded_entropy = False


class Reordered(NoMode):
    """Right, but the keys of its state change places."""

    def final_policy(self):
        return self.agent.final_policy()

    def state_dict(self):
        self.flip = not getattr(self, "flip", False)
        extra = {"a": 1, "b": 2} if self.flip else {"b": 2, "a": 1}
        return {**self.agent.state_dict(), "extra": extra}


class NoRestore(Wrapped):
    def load_state_dict(self, state):
        raise KeyError("count")


def entry(kind):
    config = AGENTS["ppo"].config
    make = lambda cmdp, options, seed: kind(make_ppo(cmdp, config.model_validate({}), seed))
    return AgentEntry(kind.__name__, NoOptions, lambda cmdp, options, seed: make(cmdp, options, seed))


COUNTER, INFINITE, ODD_NAME, NO_RESTORE = map(entry, (Wrapped, Infinite, OddName, NoRestore))
SILENT, LIMITED, NO_MODE = map(entry, (Silent, Limited, NoMode))
NO_NOISE, LISTED, REORDERED, ODD_NOISE = map(entry, (NoNoise, Listed, Reordered, OddNoise))
NO_ENTROPY = entry(NoEntropy)
FALLING = entry(Falling)


class WholeBatch(FirstOrderRule):
    """Takes the advantages of the whole batch for each of its parts."""

    def improve(self, policy, experience, generator):
        advantages = experience.batch.per_pair(experience.advantages[:, 0])
        return self.ascend(policy, experience, lambda part: lambda _, ratios: ratios @ advantages, generator)


class ByPart(WholeBatch):
    def improve(self, policy, experience, generator):
        def objective(part):
            advantages = part.batch.per_pair(experience.advantages[:, 0])
            return lambda _, ratios: ratios @ advantages

        return self.ascend(policy, experience, objective, generator)


class LargeMinibatches(AscentConfig):
    minibatch_size: int = Field(256, ge=32)


def ascending(rule, config=AscentConfig):
    make = lambda cmdp, options, seed: fresh_agent(cmdp, options, seed, lambda it: rule(options, it))
    return AgentEntry(rule.__name__, config, make)


WHOLE_BATCH, BY_PART = map(ascending, (WholeBatch, ByPart))
LARGE = ascending(ByPart, LargeMinibatches)


class Staircase:
    """Keeps its step in itself."""

    def __init__(self, spec):
        self.spec, self.at = spec, 0

    def start(self):
        return CurriculumStep(CostLimits((5.0,))), {"update": 0}

    def step(self, state, report):
        self.at += 1
        return CurriculumStep(CostLimits((5.0 - 0.1 * self.at,))), {"update": report.update}


class Remembering(Staircase):
    """Answers a report again, but not after a restart."""

    def step(self, state, report):
        if report.update > state["update"]:
            self.at += 1
        return CurriculumStep(CostLimits((5.0 - 0.01 * self.at,))), {"update": report.update}


class Changing(Staircase):
    def step(self, state, report):
        state["update"] = report.update
        return CurriculumStep(CostLimits((5.0,))), state


class Misspelt(Staircase):
    """Wrong only where an episode has ended."""

    def step(self, state, report):
        costs = [episode.cost for episode in report.episodes]
        return CurriculumStep(CostLimits((5.0,))), {"update": report.update}


class Measuring(Staircase):
    def step(self, state, report):
        limits = CostLimits((5.0,))
        return CurriculumStep(limits, start_limits=limits), {"update": report.update}


class LateLow(Staircase):
    """Wrong only at the end of the training phase."""

    def step(self, state, report):
        limit = 5.0 if report.env_steps < 0.9 * self.spec.train_steps else 0.5
        return CurriculumStep(CostLimits((limit,))), {"update": report.update}


class Unclamped(Staircase):
    """Right up to the last question of a trial; one update later it would be below d_d."""

    def step(self, state, report):
        return self.at_fraction(report, report.env_steps / self.spec.train_steps)

    def start(self):
        return CurriculumStep(self.spec.train_limits), {"update": 0}

    def at_fraction(self, report, p):
        pairs = zip(self.spec.train_limits, self.spec.deploy_limits)
        limits = tuple((1.0 - p) * high + p * low if high < np.inf else high for high, low in pairs)
        return CurriculumStep(CostLimits(limits)), {"update": report.update, "mean": float("nan")}


class Hyperbolic(Unclamped):
    """Divides by the steps that remain."""

    def step(self, state, report):
        left = self.spec.train_steps - report.env_steps
        return self.at_fraction(report, 1.0 - min(1.0, left / (report.env_steps / left)))


class Counting(Unclamped):
    """Refuses gaps in the numbers of episodes, and episodes that cannot be."""

    def start(self):
        return CurriculumStep(self.spec.train_limits), {"update": 0, "seen": 0, "at": 0}

    def step(self, state, report):
        if report.update == state["update"]:
            return CurriculumStep(self.spec.train_limits), state
        assert report.update == state["update"] + 1 and report.env_steps > state["at"]
        for number, episode in enumerate(report.episodes, state["seen"]):
            assert episode.index == number
        for episode in report.episodes:
            assert 0 <= episode.begin_step < episode.end_step <= report.env_steps
            assert episode.limits == self.spec.train_limits and min(episode.costs) >= 0.0
        seen = state["seen"] + len(report.episodes)
        return CurriculumStep(self.spec.train_limits), {
            "update": report.update, "seen": seen, "at": report.env_steps
        }


class TooLow(Staircase):
    def step(self, state, report):
        return CurriculumStep(CostLimits((0.5,))), {"update": report.update}


class Long(TooLow):
    """Needs the whole trial's budget."""

    def __init__(self, spec):
        super().__init__(spec)
        assert spec.train_steps > 5_000

    def step(self, state, report):
        return CurriculumStep(CostLimits((4.0,))), {"update": report.update}


class NoStep:
    def __init__(self, spec):
        pass

    def start(self):
        return CurriculumStep(CostLimits((5.0,))), {"update": 0}


def too_low_later(p, train_limit, deploy_limit):
    return train_limit if p < 0.5 else 0.5


def rising(p, train_limit, deploy_limit):
    return deploy_limit + (train_limit - deploy_limit) * abs(1.0 - 2.0 * p)


def straight(p, train_limit, deploy_limit):
    return p * deploy_limit + (1.0 - p) * train_limit


def as_text(p, train_limit, deploy_limit):
    return str(train_limit)


def decaying(decay, measures_start=True):
    make = lambda spec: StaticTeacher(spec, decay=decay)
    return TeacherKind(decay.__name__, NoOptions, make, measures_start=measures_start)


KINDS = (Staircase, TooLow, NoStep, Long, Remembering, Changing, Misspelt, Measuring, LateLow)
STAIRCASE, TOO_LOW, NO_STEP, LONG, REMEMBERING, CHANGING, MISSPELT, MEASURING, LATE = (
    TeacherKind(kind.__name__, NoOptions, kind) for kind in KINDS
)
UNCLAMPED, HYPERBOLIC, COUNTING = (
    TeacherKind(kind.__name__, NoOptions, kind) for kind in (Unclamped, Hyperbolic, Counting)
)
TOO_LOW_LATER, RISING, STRAIGHT, AS_TEXT = map(decaying, (too_low_later, rising, straight, as_text))
UNDECLARED = decaying(straight, measures_start=False)
LOOSE, STRICT, RENAMED, SHORTHAND = (
    TeacherKind(kind.__name__, kind, lambda spec: StaticTeacher(spec, decay=straight), measures_start=True)
    for kind in (Loose, Strict, Renamed, Shorthand)
)


class Stepping(StaticTeacher):
    """Measures nothing, and has its own start."""

    def start(self):
        return CurriculumStep(self.spec.train_limits), {"update": 0}

    def step(self, state, report):
        return CurriculumStep(self.spec.deploy_limits), {"update": report.update}


STEPPING = TeacherKind("Stepping", NoOptions, lambda spec: Stepping(spec, decay=straight))
'''


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_rehearsed.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)


def problems(
    *,
    task: str = "two-state",
    agents: Sequence[str] = ("cpo",),
    methods: Sequence[str | dict[str, Any]] = ("none",),
    train_limits: str = "5",
    deploy_limits: str = "2",
    total_steps: int = 10_000,
) -> list[str]:
    data = f"""\
name: own
tasks: [{{name: "{task}", deploy_limits: {deploy_limits}, train_limits: {train_limits}}}]
agents: {list(agents)}
methods: {list(methods)}
seeds: 1
run: {{total_steps: {total_steps}}}
"""
    try:
        parse_grid(data.encode(), source="grid.yaml", build=True)
    except GridError as error:
        return list(error.problems)
    return []


def test_what_works_and_resumes_is_right() -> None:
    assert problems(task="own_rehearsed:Room") == []
    assert problems(agents=["own_rehearsed:REORDERED"], methods=["own_rehearsed:LONG"]) == []
    assert (
        problems(task="own_rehearsed:Wandering", agents=["own_rehearsed:BY_PART", "own_rehearsed:LARGE"])
        == []
    )


def test_a_task_whose_episodes_do_not_follow_from_their_seed() -> None:
    (problem,) = problems(task="own_rehearsed:Unseeded", agents=["cpo", "own_rehearsed:COUNTER"])
    assert problem.startswith("grid.yaml:2: tasks.0: own_rehearsed:Unseeded ")
    assert "reset(seed=...)" in problem


def test_a_task_whose_episodes_depend_on_those_before() -> None:
    (problem,) = problems(task="own_rehearsed:Worn")
    assert problem == (
        "grid.yaml:2: tasks.0: own_rehearsed:Worn does not begin anew with a reset: ValueError: "
        "own_rehearsed:Worn: cannot be resumed, because replaying the episode of environment 0 gave other "
        "observations, rewards, costs or ends on the way; reset(seed=...) must determine an episode"
    )


def test_a_task_that_fails_after_its_first_step() -> None:
    (problem,) = problems(task="own_rehearsed:Broken")
    assert problem.startswith("grid.yaml:2: tasks.0: own_rehearsed:Broken fails in its first steps: ")
    assert "cost" in problem


def test_a_task_whose_episode_is_longer_than_its_horizon() -> None:
    (problem,) = problems(task="own_rehearsed:Endless")
    assert problem == (
        "grid.yaml:2: tasks.0: own_rehearsed:Endless declares a horizon of 10 steps, but its first episode "
        "is longer; let step return truncated=True there, or correct the attribute horizon"
    )


def test_a_task_that_fails_later_in_its_first_episode() -> None:
    (problem,) = problems(task="own_rehearsed:Late")
    assert problem.startswith("grid.yaml:2: tasks.0: own_rehearsed:Late fails in its first episode: ")
    assert "OverflowError: too late (own_rehearsed.py, line " in problem


def test_an_error_in_own_code_says_where_it_was_raised() -> None:
    """The place is the last one that is neither in recrl nor installed: not NumPy's below it."""
    (problem,) = problems(agents=["own_rehearsed:FALLING"])
    assert "(own_rehearsed.py, line " in problem
    assert problem.endswith(", in update)")


@pytest.mark.parametrize(
    ("agent", "sentence"),
    [
        (
            "COUNTER",
            "continue exactly after a restart from a checkpoint: count is [1, 2, 3] and not [3, 4, 5]; what ",
        ),
        (
            "SILENT",
            "part 'hidden' of the agent's state differs after 3 more updates; what changes must ",
        ),
        (
            "LIMITED",
            "without limits fails in its first updates: OverflowError: cannot convert float infinity ",
        ),
        ("NO_NOISE", "can learn, but noise cannot be added to its policy: NotImplementedError"),
        ("ODD_NOISE", ": add_noise must not name update; the event has these keys"),
        ("LISTED", "an agent's state_dict must return a dict, got list"),
        (
            "NO_MODE",
            "can learn, but its final policy fails: AttributeError: 'NoneType' object has no attribute 'act'",
        ),
        ("INFINITE", "metric reach must be a finite number or NaN, got inf"),
        (
            "ODD_NAME",
            "letters, digits and _, and not begin with a digit, got 'we ird,name'",
        ),
        ("NO_RESTORE", "after a restart from a checkpoint: KeyError: 'count'; what changes must be in the "),
    ],
)
def test_an_agent(agent: str, sentence: str) -> None:
    (problem,) = problems(agents=[f"own_rehearsed:{agent}"])
    assert problem.startswith(f"grid.yaml:3: agents.0: own_rehearsed:{agent} on two-state ")
    assert sentence in problem


def test_an_agent_that_is_wrong_only_in_minibatches() -> None:
    """A rehearsal has few samples, and yet several minibatches."""
    (problem,) = problems(task="own_rehearsed:Wandering", agents=["own_rehearsed:WHOLE_BATCH"])
    assert (
        "fails in its first updates: RuntimeError: inconsistent tensor size, expected tensor [8]" in problem
    )


def test_an_agent_that_meets_a_curriculum_which_rewards_entropy() -> None:
    (problem,) = problems(agents=["own_rehearsed:NO_ENTROPY"], methods=["none", "cooling"])
    assert problem == (
        "grid.yaml:3: agents.0: own_rehearsed:NO_ENTROPY on two-state cannot learn a rewarded entropy, which "
        "the method cooling needs; give it the attribute learns_rewarded_entropy = True, use another method, "
        "or exclude the pair"
    )


@pytest.mark.parametrize(
    ("curriculum", "sentence"),
    [
        ("STAIRCASE", "asked again about the same update, it answers otherwise; answer a report that the "),
        (
            "REMEMBERING",
            "does not continue exactly after a restart from a checkpoint: ValueError: curriculum ",
        ),
        ("CHANGING", "step must not change the state that it is given"),
        ("MISSPELT", "AttributeError: 'EpisodeStats' object has no attribute 'cost'"),
        (
            "MEASURING",
            "start_limits came after the first step, so its TeacherKind must have measures_start=True",
        ),
        ("LATE", "the limit of wear is 0.5 after update"),
        ("TOO_LOW", "the limit of wear is 0.5 after update 1, below its deploy_limits of 2"),
        (
            "NO_STEP",
            "cannot be started on two-state: TypeError: curriculum own_rehearsed:NO_STEP: make must ",
        ),
    ],
)
def test_a_curriculum(curriculum: str, sentence: str) -> None:
    (problem,) = problems(methods=[f"own_rehearsed:{curriculum}"])
    assert problem.startswith(f"grid.yaml:4: methods.0: own_rehearsed:{curriculum} ")
    assert sentence in problem


@pytest.mark.parametrize("curriculum", ["UNCLAMPED", "HYPERBOLIC", "COUNTING", "LONG", "STRAIGHT"])
@pytest.mark.parametrize("deploy_limits", ["2", "0"])
@pytest.mark.parametrize("total_steps", [10_000, 1_000_000])
def test_a_right_curriculum_is_not_refused(curriculum: str, deploy_limits: str, total_steps: int) -> None:
    assert (
        problems(
            methods=[f"own_rehearsed:{curriculum}"], deploy_limits=deploy_limits, total_steps=total_steps
        )
        == []
    )


@pytest.mark.parametrize(
    ("task", "train_limits", "deploy_limits"),
    [("two-state", "auto", "2"), ("two-state-2", "[9, 9]", "[3, 0]"), ("two-state-2", "auto", "[3, 3]")],
)
def test_a_right_curriculum_may_measure_and_have_several_costs(
    task: str, train_limits: str, deploy_limits: str
) -> None:
    of = partial(problems, task=task, train_limits=train_limits, deploy_limits=deploy_limits)
    assert of(methods=["own_rehearsed:COUNTING"]) == []
    assert of(methods=["own_rehearsed:STRAIGHT"]) == []


def test_a_slow_curriculum_is_asked_for_a_few_seconds_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """But about the last update always."""
    monkeypatch.setattr(curriculum_questions, "MOST_SECONDS", 0.0)
    (problem,) = problems(methods=["own_rehearsed:LATE"])
    assert "the limit of wear is 0.5 after update 1, below its deploy_limits" in problem


@pytest.mark.parametrize(
    ("kind", "options", "sentences"),
    [
        ("LOOSE", {"power": 2, "inner": {"b": 2}}, []),
        ("SHORTHAND", {"range": [1, 2]}, []),
        (
            "SHORTHAND",
            {"wdth": 2},
            ["grid.yaml:4: methods.0.options.wdth: unknown key; did you mean 'width'?"],
        ),
        ("LOOSE", {"pwer": 2}, ["grid.yaml:4: methods.0.options.pwer: unknown key; did you mean 'power'?"]),
    ],
)
def test_an_option_that_a_model_would_ignore(
    kind: str, options: dict[str, Any], sentences: list[str]
) -> None:
    """Nested models and computed fields are the model's own matter."""
    assert problems(methods=[{"name": f"own_rehearsed:{kind}", "options": options}]) == sentences


@pytest.mark.parametrize(
    ("kind", "options", "reason"),
    [
        (
            "RENAMED",
            {"stepSize": 2},
            "it reads other values; a field with an alias needs populate_by_name=True",
        ),
        ("STRICT", {"power": 2}, "squared: Extra inputs are not permitted"),
    ],
)
def test_options_that_cannot_be_read_back(kind: str, options: dict[str, Any], reason: str) -> None:
    (problem,) = problems(methods=[{"name": f"own_rehearsed:{kind}", "options": options}])
    assert f"methods.0.name: 'own_rehearsed:{kind}' cannot be used: TypeError: its model of " in problem
    assert problem.endswith(f"({reason})")


def test_a_decay_that_does_not_declare_its_measurement() -> None:
    (problem,) = problems(methods=["own_rehearsed:UNDECLARED"], train_limits="auto")
    assert problem == (
        "grid.yaml:4: methods.0: own_rehearsed:UNDECLARED cannot be started on two-state: TypeError: it will "
        "measure the infinite train_limits, so its TeacherKind must have measures_start=True; or give "
        "StaticTeacher start_fraction=0"
    )
    assert problems(methods=["own_rehearsed:UNDECLARED"], train_limits="5") == []
    assert problems(methods=["own_rehearsed:STEPPING"], train_limits="auto") == []


@pytest.mark.parametrize(
    ("curriculum", "sentence"),
    [
        ("AS_TEXT", "TypeError: the decay must return a number, got '5.0' at progress"),
        ("TOO_LOW_LATER", "the decay must be between d_d = 2 and d_t = 5, got 0.5 at progress 0.5"),
        ("RISING", "curriculum own_rehearsed:RISING: the limit of wear rose from 2"),
    ],
)
@pytest.mark.parametrize(("train_limits", "total_steps"), [("5", 10_000), ("auto", 10_000), ("5", 1_000_000)])
def test_a_decay_is_checked_up_to_its_end(
    curriculum: str, sentence: str, train_limits: str, total_steps: int
) -> None:
    of = partial(problems, train_limits=train_limits, total_steps=total_steps)
    (problem,) = of(methods=[f"own_rehearsed:{curriculum}"])
    assert f"own_rehearsed:{curriculum} fails in training on two-state: " in problem
    assert sentence in problem
    assert of(methods=["own_rehearsed:STRAIGHT"]) == []
