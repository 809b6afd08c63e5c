"""A checked grid, and the trials that it is made of."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.grid.grid_file import (
    Exclusion,
    Resources,
    Run,
)
from recrl.orchestrator.spec import Choice, TrialSpec


@dataclass(frozen=True)
class TaskCell:
    """A task with everything about it resolved.

    Attributes:
        task: the CMDP.
        train_limits: d_t, [k].
        deploy_limits: d_d, [k].
        rollout_steps: T.
    """

    task: Choice
    train_limits: CostLimits
    deploy_limits: CostLimits
    rollout_steps: int


@dataclass(frozen=True)
class GridSpec:
    """A checked grid, every default filled in.

    Attributes:
        name: the sweep's name.
        tasks: the CMDPs with their limits.
        agents: the agents.
        methods: the teachers.
        seeds: at least one, all different.
        run: how long and how wide every trial runs.
        resources: what a trial occupies.
        exclude: what to leave out of the product.
        text: the file as it was given.
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
        """The trials, in the order in which they are to start."""
        cells = product(self.seeds, self.tasks, self.agents, self.methods)
        specs = (self._trial(*cell) for cell in cells)
        return tuple(spec for spec in specs if not any(rule.matches(spec) for rule in self.exclude))

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
