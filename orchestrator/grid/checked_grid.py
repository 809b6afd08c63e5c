"""A checked grid and its trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.grid.file_models import Exclusion, Resources, Run
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.orchestrator.trial_warnings import (
    no_deployment_sentence,
    short_deployment_sentence,
    short_training_sentence,
    unknown_horizon_sentence,
    unrelaxed_sentence,
)


@dataclass(frozen=True)
class TaskCell:
    """A task with its resolved limits and rollout length.

    Attributes:
        task: the CMDP.
        train_limits: d_t, [k].
        deploy_limits: d_d, [k].
        rollout_steps: T.
        horizon: most steps of an episode; None if unknown.
    """

    task: Choice
    train_limits: CostLimits
    deploy_limits: CostLimits
    rollout_steps: int
    horizon: int | None


@dataclass(frozen=True)
class GridSpec:
    """A checked grid with all defaults.

    Attributes:
        name: the sweep's name.
        tasks: the CMDPs with their limits.
        agents: the agents.
        methods: the curricula.
        seeds: at least one, all different.
        run: length and width of every trial.
        resources: of a trial.
        exclude: trials to leave out of the product.
        text: the original file.
    """

    name: str
    tasks: tuple[TaskCell, ...]
    agents: tuple[Choice, ...]
    methods: tuple[Choice, ...]
    seeds: tuple[int, ...]
    run: Run
    resources: Resources
    exclude: tuple[Exclusion, ...]
    text: bytes

    def trials(self) -> tuple[TrialSpec, ...]:
        """Return the trials, in their starting order."""
        cells = product(self.seeds, self.tasks, self.agents, self.methods)
        specs = (self._trial(*cell) for cell in cells)
        return tuple(spec for spec in specs if not any(rule.matches(spec) for rule in self.exclude))

    def warnings(self, specs: Sequence[TrialSpec]) -> list[str]:
        """Return sentences on tasks of unknown horizon, too few steps, and curricula that relax nothing.

        Args:
            specs: the trials that are to run.
        """
        horizons = {cell.task.label: cell.horizon for cell in self.tasks}
        sentences = (
            unknown_horizon_sentence([task for task, horizon in horizons.items() if horizon is None]),
            short_training_sentence(specs, horizons),
            short_deployment_sentence(specs),
            no_deployment_sentence(specs),
            unrelaxed_sentence(specs),
        )
        return [*filter(None, sentences)]

    def _trial(self, seed: int, cell: TaskCell, agent: Choice, method: Choice) -> TrialSpec:
        deploy_steps = round(self.run.total_steps * self.run.deploy_fraction)
        return TrialSpec(
            task=cell.task,
            agent=agent,
            method=method,
            train_limits=cell.train_limits,
            deploy_limits=cell.deploy_limits,
            train_steps=self.run.total_steps - deploy_steps,
            deploy_steps=deploy_steps,
            num_envs=self.run.num_envs,
            rollout_steps=cell.rollout_steps,
            evaluation_episodes=self.run.evaluation_episodes,
            seed=seed,
        )
