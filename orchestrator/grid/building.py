"""Checks of a grid that build its parts: environments, and the user's own agents and curricula."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from recrl.agents.agent import learns_rewarded_entropy
from recrl.agents.registry import AGENTS, make_agent
from recrl.environments.cmdp import CMDPSpec
from recrl.environments.gymnasium_adapter import SyncCMDPVectorEnv
from recrl.environments.registry import TASKS, make_vector
from recrl.orchestrator.errors import USERS_ERRORS, described, described_with_place
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.curriculum_questions import ask_through
from recrl.orchestrator.grid.problem_list import TASK_MARK
from recrl.orchestrator.located_yaml import YamlPath
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.teachers.registry import TEACHERS, find_teacher, make_teacher
from recrl.teachers.static import StaticTeacher
from recrl.teachers.teacher import AnswerCheck

logger = logging.getLogger("recrl.sweep")

PLAIN_AGENT = Choice("ppo-lag")
CHECKED_STEPS = 16  # of a user's environment
EPISODE_SECONDS = 2.0  # at most, of its first episode
NO_CURRICULUM, NO_LIMITS = Choice("none"), Choice("unconstrained")


class BuildError(Exception):
    """A part of a grid cannot be built; the text is one sentence."""


def cmdp_of(task: Choice) -> CMDPSpec:
    """Return the task's CMDP, by building one environment; a user's environment also takes some steps.

    Raises:
        BuildError: it cannot be built, fails in its first episode, does not begin anew with a reset, or has
            an episode longer than its horizon.
    """
    try:
        envs = make_vector(task.name, 1, options=task.options)
    except USERS_ERRORS as error:
        raise BuildError(f"{task.name} cannot be built: {described_with_place(error)}") from error
    try:
        if isinstance(envs, SyncCMDPVectorEnv):  # a user's environment
            _try_out(task.name, envs)
    finally:
        try:
            envs.close()
        except USERS_ERRORS as error:  # in a trial it is only logged
            logger.warning("%s raised an error when it was closed: %s", task.name, described(error))
    return envs.cmdp


def _try_out(name: str, envs: SyncCMDPVectorEnv) -> None:
    """Take some steps, and repeat those of the last episode after another reset.

    A wrapper that learns from observations or rewards would give other numbers. Then later episodes are not
    those that a new environment has, with which a trial is resumed and its policy is evaluated.
    """
    try:
        envs.reset(seed=0)
        envs.action_space.seed(0)
        for _ in range(CHECKED_STEPS):
            envs.step(envs.action_space.sample())
    except USERS_ERRORS as error:
        raise BuildError(f"{name} fails in its first steps: {described_with_place(error)}") from error
    try:
        envs.load_state_dict(envs.state_dict())
    except USERS_ERRORS as error:
        raise BuildError(f"{name} does not begin anew with a reset: {described_with_place(error)}") from error
    try:
        ends = _ends_in_time(envs)
    except USERS_ERRORS as error:
        raise BuildError(f"{name} fails in its first episode: {described_with_place(error)}") from error
    if not ends:
        raise BuildError(
            f"{name} declares a horizon of {envs.cmdp.horizon} steps, but its first episode is longer; "
            "let step return truncated=True there, or correct the attribute horizon"
        )


def _ends_in_time(envs: SyncCMDPVectorEnv) -> bool:
    """Whether an episode ends within the declared horizon, as far as ``EPISODE_SECONDS`` show."""
    if envs.cmdp.horizon is None:
        return True
    envs.reset(seed=0)
    end = time.monotonic() + EPISODE_SECONDS
    for _ in range(envs.cmdp.horizon):
        _, _, terminated, truncated, _ = envs.step(envs.action_space.sample())
        if terminated[0] or truncated[0] or time.monotonic() > end:
            return True
    return False


def build_own(grid: GridSpec, cmdps: Mapping[str, CMDPSpec]) -> Iterator[tuple[YamlPath, str, str]]:
    """Build the user's own agents, networks and curricula on each task that they meet, and rehearse them.

    The user's own tasks are rehearsed with ``ppo-lag`` without a curriculum, agents without a curriculum
    and without limits, and curricula with ``ppo-lag``; see ``recrl.orchestrator.trial.rehearsal``.

    Args:
        grid: the grid.
        cmdps: of its tasks, by label.

    Yields:
        Of each that fails: its place, a sentence with ``TASK_MARK``, and the task's label.
    """
    trials = grid.trials()
    tasks = {it.task.label: it for it in trials if _is_own_task(it.task)}
    agents = {(it.task.label, it.agent.label): it for it in trials if _is_own_agent(it.agent)}
    methods = {(it.task.label, it.method.label): it for it in trials if it.method.name not in TEACHERS}
    task_labels = [cell.task.label for cell in grid.tasks]
    agent_labels = [agent.label for agent in grid.agents]
    method_labels = [method.label for method in grid.methods]
    rewarding = {
        (it.task.label, it.agent.label): it.method.label
        for it in trials
        if find_teacher(it.method.name).rewards_entropy
    }
    failed = set()
    for task, spec in tasks.items():
        if mistake := _mistake(replace(spec, agent=PLAIN_AGENT, method=NO_CURRICULUM)):
            failed.add(task)
            yield ("tasks", task_labels.index(task)), f"{TASK_MARK} {mistake}", task
    for (task, label), spec in agents.items():
        method = rewarding.get((task, label), "")
        if mistake := _agents_mistake(
            spec, cmdps[task], rewards_entropy=method, is_rehearsed=task not in failed
        ):
            yield ("agents", agent_labels.index(label)), f"{label} {mistake}", task
    for (task, label), spec in methods.items():
        if mistake := _curriculums_mistake(spec, cmdps[task], is_rehearsed=task not in failed):
            yield ("methods", method_labels.index(label)), f"{label} {mistake}", task


def _agents_mistake(spec: TrialSpec, cmdp: CMDPSpec, *, rewards_entropy: str, is_rehearsed: bool) -> str:
    """Return what is wrong with a trial's agent, or nothing.

    Args:
        spec: the trial.
        cmdp: of its task.
        rewards_entropy: a method that the agent meets and that rewards entropy, or empty.
        is_rehearsed: whether to train it for a few updates.
    """
    try:
        agent = make_agent(spec.agent.name, cmdp, spec.agent.options, np.random.SeedSequence(0))
    except USERS_ERRORS as error:
        return f"cannot be built on {TASK_MARK}: {described_with_place(error)}"
    if rewards_entropy and not learns_rewarded_entropy(agent):
        return (
            f"on {TASK_MARK} cannot learn a rewarded entropy, which the method {rewards_entropy} needs; give "
            "it the attribute learns_rewarded_entropy = True, use another method, or exclude the pair"
        )
    if not is_rehearsed:
        return ""
    if mistake := _mistake(replace(spec, method=NO_CURRICULUM)):
        return f"on {TASK_MARK} {mistake}"
    if mistake := _mistake(replace(spec, method=NO_LIMITS)):
        return f"on {TASK_MARK} without limits {mistake}"
    return ""


def _curriculums_mistake(spec: TrialSpec, cmdp: CMDPSpec, *, is_rehearsed: bool) -> str:
    """Return what is wrong with a trial's curriculum, or nothing."""
    try:
        _check_start(spec, cmdp)
    except USERS_ERRORS as error:
        return f"cannot be started on {TASK_MARK}: {described_with_place(error)}"
    try:
        ask_through(spec, cmdp)
    except USERS_ERRORS as error:
        return f"fails in training on {TASK_MARK}: {described_with_place(error)}"
    mistake = _mistake(replace(spec, agent=PLAIN_AGENT)) if is_rehearsed else ""
    return f"on {TASK_MARK} {mistake}" if mistake else ""


def _mistake(spec: TrialSpec) -> str:
    """Rehearse a trial; return what is wrong, or nothing."""
    from recrl.orchestrator.trial.rehearsal import (  # noqa: PLC0415  (imports torch)
        PolicyError,
        RestartError,
        rehearse,
    )

    try:
        rehearse(spec)
    except RestartError as error:
        return f"does not continue exactly after a restart from a checkpoint: {error}"
    except PolicyError as error:
        return f"can learn, but {error}"
    except USERS_ERRORS as error:
        return f"fails in its first updates: {described_with_place(error)}"
    return ""


def _check_start(spec: TrialSpec, cmdp: CMDPSpec) -> None:
    """Check the first step of a trial's curriculum, and its state."""
    check = AnswerCheck(spec.method.label, cmdp.cost_names, spec.train_limits, spec.deploy_limits)
    teacher = make_teacher(spec.teacher)
    _, state = check.checked(teacher.start())
    measures = isinstance(teacher, StaticTeacher) and state.get("start_limits", ()) is None
    if measures and not find_teacher(spec.method.name).measures_start:
        raise TypeError(
            "it will measure the infinite train_limits, so its TeacherKind must have measures_start=True; or "
            "give StaticTeacher start_fraction=0"
        )


def _is_own_task(task: Choice) -> bool:
    return task.name not in TASKS or task.name == "gymnasium"


def _is_own_agent(agent: Choice) -> bool:
    return agent.name not in AGENTS or isinstance(agent.options.get("network"), str)
