"""One trial: an agent learns a task under a curriculum's limits, and the results go to files.

Independent of Ray and MLflow. All of a trial's state (agent, optimisers, multipliers, teacher, environments,
generators, counters, partial episodes) is in one tree. So a trial that was killed and resumed gives the same
bytes as an uninterrupted one.

The steps of an update: collect T steps in each environment; call ``agent.update(rollout, episode costs,
step)`` with the curriculum's step; append the finished episodes and the update's row; call
``teacher.step(state, report)`` for the next step of the curriculum. After the budget B the phase is
deployment: the limits are d_d, the noise is 0, and the teacher is not called any more. The agent continues
learning. At the end the final policy is evaluated without learning.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from recrl.agents.agent import (
    Agent,
    DiscretePolicy,
    FinalPolicy,
    final_policy,
    learns_rewarded_entropy,
)
from recrl.agents.collection import Collector, FinishedEpisode, episode_costs
from recrl.agents.evaluation import PolicyKind, evaluate
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CurriculumStep, EpisodeStats, Floats, Phase
from recrl.environments.finite.finite_cmdp import FiniteVectorEnv
from recrl.environments.registry import make_vector
from recrl.environments.vector import CMDPVectorEnv
from recrl.orchestrator.errors import USERS_ERRORS, described
from recrl.orchestrator.files.trial_files import HARD_LANDING, POLICY_NOISE
from recrl.orchestrator.files.trial_writer import TrialWriter
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.trial.agent_answers import checked_metrics, checked_noise
from recrl.orchestrator.trial.rollout_check import check_rollout
from recrl.orchestrator.trial.torch_settings import require_float32
from recrl.teachers.registry import find_teacher
from recrl.teachers.teacher import AnswerCheck, ProgressReport, Teacher, TeacherState

LOGGED_UPDATES = 50
"""Approximate number of log lines of a trial."""
LANDING_FRACTION = 0.1
"""Fraction of d_t - d_d by which the last training limit may exceed d_d without an event.

It is a fraction of d_d, or of 1, where that is larger."""

logger = logging.getLogger("recrl.trial")


@dataclass(frozen=True)
class TrialSeeds:
    """Independent seeds of a trial's randomness, all derived from its seed.

    Attributes:
        environment: of the training environments.
        agent: of the agent's initial parameters.
        exploration: of the actions in training.
        evaluation: of the evaluation's environments and actions.
    """

    environment: np.random.SeedSequence
    agent: np.random.SeedSequence
    exploration: np.random.SeedSequence
    evaluation: np.random.SeedSequence

    @classmethod
    def of(cls, spec: TrialSpec) -> Self:
        """Return the seeds of a trial; they depend only on its seed, not on task, agent or method."""
        return cls(*np.random.SeedSequence(spec.seed).spawn(4))


class Trial:
    """A trial in memory, advanced one policy update at a time.

    Attributes:
        spec: of the trial.
        update: policy updates done.
        env_steps: environment steps taken, over all environments.
    """

    def __init__(self, spec: TrialSpec, writer: TrialWriter, teacher: Teacher) -> None:
        """Start the trial, or continue it exactly from its newest intact checkpoint."""
        self.spec = spec
        self._writer = writer
        self._teacher = teacher
        self._curriculum = find_teacher(spec.method.name)
        seeds = TrialSeeds.of(spec)
        self._evaluation_seed = seeds.evaluation
        self._generator = np.random.default_rng(seeds.exploration)
        with ExitStack() as on_error:
            self._environments = make_vector(spec.task.name, spec.num_envs, options=spec.task.options)
            on_error.callback(self.close)
            self._cmdp = self._environments.cmdp
            self._agent: Agent = make_agent(spec.agent.name, self._cmdp, spec.agent.options, seeds.agent)
            require_float32()
            self._collector = Collector(self._environments, num_steps=spec.rollout_steps, staggered=True)
            self._start_or_continue(seeds)
            on_error.pop_all()

    def _start_or_continue(self, seeds: TrialSeeds) -> None:
        tree = self._writer.restore()
        if tree is None:
            self._collector.reset(seed=int(seeds.environment.generate_state(1)[0]))
            self.update = self.env_steps = self._episodes = 0
            self._step, self._teacher_state = self._checked(self._teacher.start(), before=None)
            logger.info("started: %s", self.spec.title)
        else:
            self._load(tree)
            logger.info("resumed after update %d, %d environment steps", self.update, self.env_steps)

    @property
    def cost_names(self) -> tuple[str, ...]:
        """The names of the task's costs."""
        return self._cmdp.cost_names

    @property
    def phase(self) -> Phase:
        """The phase of the next update."""
        return Phase.TRAINING if self.env_steps < self.spec.train_steps else Phase.DEPLOYMENT

    @property
    def learned(self) -> bool:
        """Whether all updates are done; only the evaluation remains."""
        return self.update >= self.spec.num_updates

    def advance(self) -> None:
        """Do one policy update: collect, record, learn, call the teacher."""
        phase, step = self.phase, self._step
        clock = time.process_time()
        rollout, finished = self._collector.collect(self._agent, self._generator)
        check_rollout(rollout, self.spec.task.label)
        collect_seconds, clock = time.process_time() - clock, time.process_time()
        episodes = self._number(finished, phase, step)
        self.env_steps += self.spec.steps_per_update
        costs = episode_costs(finished, self._cmdp.num_costs)
        metrics = self._agent.update(rollout, costs, step)
        self.update += 1
        for episode in episodes:
            self._writer.append_episode(episode)
        row = {
            "update": self.update,
            "phase": phase,
            "end_step": self.env_steps,
            "episodes": len(episodes),
            "episode_return": _mean([episode.episode_return for episode in episodes]),
            "noise": step.policy_noise,
            "time": round(time.time(), 3),
            "collect_seconds": round(collect_seconds, 6),
            "update_seconds": round(time.process_time() - clock, 6),
            **{f"cost_{i}": _mean(costs[:, i]) for i in range(self._cmdp.num_costs)},
            **{f"limit_{i}": limit for i, limit in enumerate(step.limits)},
            **self._entropy_coefficient(step),
        }
        self._writer.append_update({**row, **checked_metrics(self.spec.agent.label, metrics, row)})
        if self.update % max(1, self.spec.num_updates // LOGGED_UPDATES) == 0 or self.learned:
            logger.info("%s", self._log_line(row), extra={"progress": self.update / self.spec.num_updates})
        self._next_step(episodes, rollout.observations)

    def close(self) -> None:
        """Close the environments."""
        close(self._environments)

    def save(self) -> None:
        """Commit everything up to the last update, with a checkpoint."""
        self._writer.commit(
            self._state_dict(),
            update=self.update,
            env_steps=self.env_steps,
            start_limits=self._step.to_json()["start_limits"],
        )

    def evaluate(self, should_stop: Callable[[], bool]) -> None:
        """Evaluate the final policy, stochastic and deterministic; write the results and its table.

        Environments and generators are new and seeded from the trial's seed. The state of training does not
        change, and all methods of a seed are evaluated on the same environment stream.

        Args:
            should_stop: called between steps; once true, nothing is written and ``StoppedError`` is raised.
        """
        spec, policy = self.spec, final_policy(self._agent)
        logger.info("evaluation of the final policy: %d episodes of each kind", spec.evaluation_episodes)
        rows = evaluation_rows(
            policy,
            spec,
            tuple(PolicyKind),
            num_episodes=spec.evaluation_episodes,
            seed=self._evaluation_seed,
            should_stop=should_stop,
        )
        if rows:
            self._writer.write_evaluation(rows)
        if table := policy_table(policy, self._environments):
            self._writer.write_policy(table)

    def _number(
        self, finished: Sequence[FinishedEpisode], phase: Phase, step: CurriculumStep
    ) -> tuple[EpisodeStats, ...]:
        """Return the finished episodes of a rollout, with their index and step in the trial."""
        episodes = tuple(
            EpisodeStats(
                index=self._episodes + offset,
                phase=phase,
                end_step=self.env_steps + (episode.step + 1) * self.spec.num_envs,
                length=episode.length,
                episode_return=episode.episode_return,
                costs=episode.costs,
                limits=step.limits,
                noise=step.policy_noise,
                begin_step=self.env_steps + (episode.step + 1 - episode.length) * self.spec.num_envs,
            )
            for offset, episode in enumerate(finished)
        )
        self._episodes += len(episodes)
        return episodes

    def _next_step(self, episodes: tuple[EpisodeStats, ...], observations: Any) -> None:
        """Call the teacher, or enter deployment; add the policy noise of the next step."""
        if self.phase is Phase.DEPLOYMENT:
            if not self.learned:
                self._warn_of_hard_landing()
            self._step = self._step.in_deployment(self.spec.deploy_limits)
            return
        before = self._step
        report = ProgressReport(update=self.update, env_steps=self.env_steps, episodes=episodes)
        answer = self._teacher.step(self._teacher_state, report)
        self._step, self._teacher_state = self._checked(answer, before=before)
        if self._step.start_limits is not None and self._step.start_limits != before.start_limits:
            limits = self._step.start_limits.to_json()
            self._event("start limits measured", limits=limits)
            if self.spec.is_no_curriculum(limits):
                self._event("the curriculum is none", limits=limits)
        if self._step.policy_noise > 0.0:
            flat = observations.reshape(-1, observations.shape[-1])
            done = checked_noise(self.spec.agent.label, self._agent.add_noise(self._step.policy_noise, flat))
            self._event(POLICY_NOISE, policy_noise=self._step.policy_noise, **done)

    def _checked(
        self, answer: object, *, before: CurriculumStep | None
    ) -> tuple[CurriculumStep, TeacherState]:
        """Check the curriculum's answer; ``before`` is the step before it, None at the start."""
        label = self.spec.method.label
        check = AnswerCheck(label, self._cmdp.cost_names, self.spec.train_limits, self.spec.deploy_limits)
        step, state = check.checked(answer, before=before.limits if before else None, update=self.update)
        self._curriculum.require_declared(step, before, curriculum=label)
        if step.rewards_entropy and not learns_rewarded_entropy(self._agent):
            raise TypeError(
                f"method {self.spec.method.name} rewards entropy, which agent {self.spec.agent.name} does "
                "not support; choose another of the two"
            )
        return step, state

    def _entropy_coefficient(self, step: CurriculumStep) -> dict[str, float]:
        """Return the column of the entropy coefficient; empty if the curriculum never rewards entropy."""
        return (
            {"entropy_coefficient": step.entropy_coefficient or 0.0}
            if self._curriculum.rewards_entropy
            else {}
        )

    def _warn_of_hard_landing(self) -> None:
        """Record an event if deployment begins far below the last limits, unless under a control."""
        if self._curriculum.is_control:
            return
        before, after = self._step.limits, self.spec.deploy_limits
        start = self._step.start_limits or self.spec.train_limits
        if any(
            late - final > LANDING_FRACTION * max(first - final if math.isfinite(first) else 0.0, final, 1.0)
            for first, late, final in zip(start, before, after, strict=True)
        ):
            self._event(HARD_LANDING, limits=before.to_json(), deploy_limits=after.to_json())

    def _log_line(self, row: Mapping[str, Any]) -> str:
        """Format return and costs of an update as a log line."""
        head = f"update {self.update} of {self.spec.num_updates}, {row['phase']}:"
        if not row["episodes"]:
            return f"{head} no episode ended"
        costs = [
            f"{name} {row[f'cost_{i}']:.2f} of limit {row[f'limit_{i}']:.2f}"
            for i, name in enumerate(self._cmdp.cost_names)
        ]
        return f"{head} return {row['episode_return']:.2f}, {', '.join(costs)}"

    def _event(self, name: str, **details: Any) -> None:
        event = {"update": self.update, "end_step": self.env_steps, "event": name, **details}
        self._writer.append_event(event)
        values = ", ".join(f"{key} {value}" for key, value in details.items())
        logger.info("update %d: %s%s", self.update, name, f" ({values})" if values else "")

    def _state_dict(self) -> dict[str, Any]:
        return {
            "update": self.update,
            "env_steps": self.env_steps,
            "episodes": self._episodes,
            "curriculum_step": self._step.to_json(),
            "teacher": dict(self._teacher_state),
            "agent": self._agent.state_dict(),
            "environments": self._environments.state_dict(),
            "collector": self._collector.state_dict(),
            "generator": self._generator.bit_generator.state,
        }

    def _load(self, tree: dict[str, Any]) -> None:
        self.update = tree["update"]
        self.env_steps = tree["env_steps"]
        self._episodes = tree["episodes"]
        self._step = CurriculumStep.from_json(tree["curriculum_step"])
        self._teacher_state = tree["teacher"]
        self._agent.load_state_dict(tree["agent"])
        self._environments.load_state_dict(tree["environments"])
        self._collector.load_state_dict(tree["collector"])
        self._generator.bit_generator.state = tree["generator"]


@contextmanager
def open_environments(spec: TrialSpec, num_envs: int) -> Iterator[CMDPVectorEnv]:
    """Make environments of a trial's task; close them at the end."""
    environments = make_vector(spec.task.name, num_envs, options=spec.task.options)
    try:
        yield environments
    finally:
        close(environments)


def close(environments: CMDPVectorEnv) -> None:
    """Close environments; an error is logged, because all results are there already."""
    try:
        environments.close()
    except USERS_ERRORS as error:
        logger.warning("the environments raised an error when they were closed: %s", described(error))


def evaluation_rows(
    actor: FinalPolicy,
    spec: TrialSpec,
    kinds: Sequence[PolicyKind],
    *,
    num_episodes: int,
    seed: np.random.SeedSequence,
    should_stop: Callable[[], bool] = lambda: False,
) -> list[dict[str, Any]]:
    """Evaluate a policy on new environments of a trial; return one row of ``evaluation.csv`` per episode.

    Args:
        actor: chooses the actions.
        spec: the trial.
        kinds: stochastic, deterministic or both, each evaluated on the same environment stream.
        num_episodes: of each, at least 0. If they are fewer than the trial's environments, only as many
            environments are made as there are episodes.
        seed: of the environments and of the policy's randomness.
        should_stop: called between steps; once true, ``StoppedError`` is raised.
    """
    rows = []
    num_envs = max(1, min(spec.num_envs, num_episodes))
    for kind in kinds:
        with open_environments(spec, num_envs) as environments:
            episodes = evaluate(
                actor,
                environments,
                kind,
                num_episodes=num_episodes,
                seed=seed,
                should_stop=should_stop,
            )
        rows += [
            {
                "policy": kind,
                "index": index,
                "length": episode.length,
                "episode_return": episode.episode_return,
                **{f"cost_{i}": cost for i, cost in enumerate(episode.costs)},
            }
            for index, episode in enumerate(episodes)
        ]
    return rows


def policy_table(policy: FinalPolicy, environments: CMDPVectorEnv) -> list[dict[str, float]]:
    """Return pi(a | s), one row per state, ``action_j`` the probability of action j.

    It is empty if the task is not finite, or the policy has no action probabilities.
    """
    if not isinstance(environments, FiniteVectorEnv) or not isinstance(policy, DiscretePolicy):
        return []
    probabilities = policy.action_probabilities(environments.observations)
    return [{f"action_{j}": float(share) for j, share in enumerate(row)} for row in probabilities]


def _mean(values: Sequence[float] | Floats) -> float:
    """Return the mean, or NaN of nothing."""
    return float(np.mean(values)) if len(values) else float("nan")
