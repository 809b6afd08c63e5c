"""A curriculum in a closed loop with a simulated agent."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats, Phase
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState

# An episode of a simulated agent, (return, costs), from the step and the update's index.
Agent = Callable[[CurriculumStep, int], tuple[float, tuple[float, ...]]]


@dataclass(frozen=True)
class Run:
    """What a teacher did: limits and noise after each update, and its last state."""

    limits: list[tuple[float, ...]]
    noise: list[float]
    state: TeacherState


def play(
    agent: Agent,
    *,
    train: tuple[float, ...],
    deploy: tuple[float, ...],
    updates: int,
    episodes: Callable[[CurriculumStep], int] = lambda step: 16,
    **options: Any,
) -> Run:
    """A closed loop over a budget of ``updates`` updates, of one environment step each."""
    teacher = make_teacher(
        TeacherSpec("dynamic", options, CostLimits(train), CostLimits(deploy), train_steps=updates)
    )
    step, state = teacher.start()
    run = Run([], [], state)
    for update in range(1, updates + 1):
        finished = []
        for b in range(episodes(step)):
            episode_return, costs = agent(step, update)
            finished.append(
                EpisodeStats(b, Phase.TRAINING, update, 1, episode_return, costs, step.limits, 0.0)
            )
        step, state = teacher.step(state, ProgressReport(update, update, tuple(finished)))
        run.limits.append(step.limits.values)
        run.noise.append(step.policy_noise)
    return Run(run.limits, run.noise, state)


def obedient(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
    """An ideal agent: its costs are at the limits at once."""
    return 9.5, step.limits.values


def recovering() -> Agent:
    """An agent that costs 5.9 at first, and 9, 8, 7, 6, 5, 5, 5 ... after each noise."""
    last_noise: list[int] = []

    def settles(step: CurriculumStep, update: int) -> tuple[float, tuple[float, ...]]:
        if step.policy_noise > 0.0 and update not in last_noise:
            last_noise.append(update)
        return 9.5, (max(5.0, 9.0 - (update - last_noise[-1])) if last_noise else 5.9,)

    return settles


def noises(agent: Agent, *, updates: int, **options: Any) -> list[int]:
    """After which updates an agent gets noise, under a limit of 5, with two episodes per update."""
    run = play(agent, train=(5.0,), deploy=(5.0,), updates=updates, episodes=lambda step: 2, **options)
    return [update for update, noise in enumerate(run.noise, start=1) if noise > 0.0]
