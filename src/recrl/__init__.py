"""Relaxed Exploration Constrained Reinforcement Learning: curricula, agents, tasks and sweeps.

    import recrl

    training = recrl.train("rivergrid-1b", "ppo-lag", "dynamic", total_steps=200_000, deploy_limits=1)
    training.updates[["end_step", "episode_return", "cost_0", "limit_0"]]
    policy = training.policy

    envs = recrl.make("rivergrid-1b", num_envs=4)
    observations, info = envs.reset(seed=0)
    actions = policy.act(observations, deterministic=True)

    sweep = recrl.launch("demo.yaml")         # or recrl-sweep launch demo.yaml
    sweep = recrl.load_sweep("runs/demo")
    rows = recrl.outcomes(sweep)              # a row a trial and measure

Each name is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recrl._results import Policy, load_policy, load_sweep
    from recrl._tasks import make, make_env
    from recrl._train_and_launch import Training, launch, train, validate
    from recrl.analysis.data.sweep_data import load_episodes
    from recrl.analysis.statistics.comparisons import comparisons, group_comparisons
    from recrl.analysis.statistics.metrics import outcomes
    from recrl.orchestrator.errors import GridError, RecrlError

    __version__: str

__all__ = [
    "GridError",
    "Policy",
    "RecrlError",
    "Training",
    "__version__",
    "comparisons",
    "group_comparisons",
    "launch",
    "load_episodes",
    "load_policy",
    "load_sweep",
    "make",
    "make_env",
    "outcomes",
    "train",
    "validate",
]

_PLACES = {
    "GridError": "recrl.orchestrator.errors",
    "Policy": "recrl._results",
    "RecrlError": "recrl.orchestrator.errors",
    "Training": "recrl._train_and_launch",
    "comparisons": "recrl.analysis.statistics.comparisons",
    "group_comparisons": "recrl.analysis.statistics.comparisons",
    "launch": "recrl._train_and_launch",
    "load_episodes": "recrl.analysis.data.sweep_data",
    "load_policy": "recrl._results",
    "load_sweep": "recrl._results",
    "make": "recrl._tasks",
    "make_env": "recrl._tasks",
    "outcomes": "recrl.analysis.statistics.metrics",
    "train": "recrl._train_and_launch",
    "validate": "recrl._train_and_launch",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("recrl")
    if name not in _PLACES:
        raise AttributeError(f"module 'recrl' has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
