"""How much of what a trust-region step promises to do to a cost it does to samples that did not choose it.

    OMP_NUM_THREADS=1 python tests/benchmarks/held_out.py [--tasks CarGoal2 rivergrid-1b] [--updates 50]

A ``cpo`` with ``cross_fitting`` learns, 8 environments an update on Safety Gym and 16 on RiverGrid, as in
our grids. Before each of its updates the cost's steepest descent in the trust region is found from one half
of the environments, and the policy is moved along it and back. What the step promises, by its linear model,
is put beside what it does to the cost surrogate on the samples that chose it, and on the other half, each in
cost per episode; and the same, as a share, for the reward's steepest ascent. Means over the updates and both
halves, with standard errors over the updates. The last column is what ``cross_fitting`` makes of it: the
share of the promise that is kept.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from recrl.agents.algorithms.cpo import ConstrainedPolicyOptimisation, LocalModel, solve_against
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.config import CPOConfig
from recrl.agents.constraints.cross_fitting import halves
from recrl.agents.experience import Experience
from recrl.agents.learning.actor_critic import PolicyRule, fresh_student
from recrl.agents.learning.advantages import reward_spread
from recrl.agents.learning.policies import StochasticPolicy
from recrl.environments.cmdp import Floats
from recrl.environments.registry import make_vector

SETTINGS: dict[str, tuple[int, int, float, dict[str, Any]]] = {
    "CarGoal2": (8, 1000, 25.0, {"out_of_range": "clip"}),
    "CarGoal2, 32,000 samples": (32, 1000, 25.0, {"out_of_range": "clip"}),
    "rivergrid-1b": (16, 200, 1.0, {}),
}
"""Environments, steps of each in an update, limit, options of the task."""
CONFIG = CPOConfig()


@dataclass
class Judged:
    """``cpo``'s rule, and what its samples promise and confirm before each update."""

    rule: PolicyRule
    promises: list[Floats] = field(default_factory=list)

    @property
    def parts(self) -> Any:
        """Those of the rule."""
        return self.rule.parts

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Try each half's directions, then do as the rule does."""
        if experience.constraints.known:
            self.promises.append(self._promise(policy, experience, generator))
        return self.rule.improve(policy, experience, generator)

    def _promise(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> Floats:
        """Of the reward and the cost: promised, on the same half, on the other; means over halves, [2, 3]."""
        centred = experience.advantages - experience.advantages.mean(axis=0)
        centred[:, 0] /= -reward_spread(centred)  # of the reward, too, the descent is then what is wanted
        signs = halves(len(centred), experience.num_envs)
        models = [
            LocalModel(policy, experience, centred * (2.0 * (signs == sign))[:, None]) for sign in (1.0, -1.0)
        ]
        metric = models[0].metric(CONFIG, generator)
        here = policy.parameters.values.clone()
        found = np.zeros((2, 3))
        for own, other in (models, models[::-1]):
            solved, gram = solve_against(metric, own.gradients(), CONFIG)
            for signal in range(2):
                promised = float(np.sqrt(2.0 * CONFIG.target_kl * gram[signal, signal]))
                step = solved[signal] * (promised / gram[signal, signal])
                torch.sub(here, step, out=policy.parameters.values)
                after = [model.measure()[0][signal] - model.start()[signal] for model in (own, other)]
                found[signal] += 0.5 * np.array([promised, -after[0], -after[1]])
        policy.parameters.values.copy_(here)
        return found


def measure(name: str, updates: int) -> str:
    """One line of the table."""
    num_envs, num_steps, limit, options = SETTINGS[name]
    environments = make_vector(name.split(",", maxsplit=1)[0], num_envs, options=options)
    judged: list[Judged] = []

    def make_rule(_: StochasticPolicy) -> PolicyRule:
        judged.append(Judged(ConstrainedPolicyOptimisation(CPOConfig(cross_fitting=True), num_costs=1)))
        return judged[0]

    student = fresh_student(environments.cmdp, CONFIG, np.random.SeedSequence(0), make_rule)
    collector = Collector(environments, num_steps=num_steps)
    collector.reset(seed=0)
    generator = np.random.default_rng(0)
    shares, lengths = [], []
    for _ in range(updates):
        rollout, episodes = collector.collect(student, generator)
        metrics = student.update(rollout, episode_costs(episodes, 1), np.array([limit]))
        if episodes:
            shares.append(metrics["kept_share_0"])
            lengths.append(rollout.rewards.size / len(episodes))
    found = np.array(judged[0].promises)
    costs = found[:, 1] * np.array(lengths)[:, None]
    means, errors = costs.mean(axis=0), costs.std(axis=0, ddof=1) / np.sqrt(len(costs))
    reward = found[:, 0].mean(axis=0)
    cells = [f"{mean:.2f} ± {error:.2f}" for mean, error in zip(means, errors, strict=True)]
    cells += [f"{reward[2] / reward[0]:.3f}", f"{np.median(shares):.3f}"]
    return f"| {name} | {num_envs * num_steps:,} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=list(SETTINGS), choices=list(SETTINGS))
    parser.add_argument("--updates", type=int, default=50)
    arguments = parser.parse_args()
    print(f"{arguments.updates} updates of cpo; fall of the cost per episode, KL {CONFIG.target_kl:g}\n")
    print(
        "| task | samples | promised | on the same half | on the other half "
        "| the same for the reward, other half / promised | kept share, median |"
    )
    print("|---|---|---|---|---|---|---|")
    for name in arguments.tasks:
        print(measure(name, arguments.updates), flush=True)


if __name__ == "__main__":
    main()
