"""What the tests of a trial's files write into them: a trial of two-state, its episodes and checkpoints."""

from __future__ import annotations

from typing import Any

import numpy as np

from recrl.environments.cmdp import CostLimits, EpisodeStats, Phase
from recrl.orchestrator.spec import Choice, TrialSpec

SPEC = TrialSpec(
    task=Choice("two-state"),
    agent=Choice("ppo-lag"),
    method=Choice("none"),
    train_limits=CostLimits.unlimited(1),
    deploy_limits=CostLimits((5.0,)),
    train_steps=95,
    deploy_steps=5,
    num_envs=1,
    rollout_steps=10,
    evaluation_episodes=0,
    seed=0,
)


def episode(index: int) -> EpisodeStats:
    return EpisodeStats(
        index=index,
        phase=Phase.TRAINING,
        end_step=10 * index,
        length=10,
        episode_return=0.1 * index,
        costs=(1.0 / 3.0,),
        limits=CostLimits.unlimited(1),
        noise=0.0,
    )


def tree(update: int) -> dict[str, Any]:
    """A checkpoint's contents."""
    return {"update": update, "env_steps": 10 * update, "weights": np.full(3, update, dtype=np.float32)}
