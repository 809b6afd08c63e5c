"""What showing a sweep in MLflow costs beside training it.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_tracking.py [--trials 20] [--updates 300]

The MLflow sync process is run over a made-up, finished sweep. Its CPU seconds are counted, so a busy
machine matters little. The aim: below 5% of the CPU time of the trials themselves.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from recrl.environments.cmdp import CostLimits, Phase
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.spec import Choice, TrialSpec, TrialStatus
from recrl.orchestrator.tracking.background_sync import start_sync
from recrl.orchestrator.tracking.client import tracking_uri
from recrl.orchestrator.tracking.mlflow_sync import last_report

STEPS_PER_UPDATE = 3200
AGENT_METRICS = (
    *("kl", "entropy", "clip_fraction", "policy_steps", "multiplier_0", "cost_gap_0", "surrogate_reward"),
    *("surrogate_cost_0", "value_loss_reward", "value_loss_cost_0", "cost_advantage_max_0", "case"),
)


def write_sweep(root: Path, *, trials: int, updates: int) -> SweepStore:
    """Finished trials with the columns of a real one, and random numbers."""
    store = SweepStore(root, "bench")
    generator = np.random.default_rng(0)
    for seed in range(trials):
        spec = TrialSpec(
            task=Choice("rivergrid-1a"),
            agent=Choice("ppo-lag"),
            method=Choice("linear"),
            train_limits=CostLimits((65.0,)),
            deploy_limits=CostLimits((5.0,)),
            train_steps=updates * STEPS_PER_UPDATE * 19 // 20,
            deploy_steps=updates * STEPS_PER_UPDATE // 20,
            num_envs=16,
            rollout_steps=STEPS_PER_UPDATE // 16,
            evaluation_episodes=0,
            seed=seed,
        )
        writer = store.trial(spec).begin(spec)
        for update in range(1, updates + 1):
            step = update * STEPS_PER_UPDATE
            writer.append_update(
                {
                    "update": update,
                    "phase": Phase.TRAINING if step <= spec.train_steps else Phase.DEPLOYMENT,
                    "end_step": step,
                    "episodes": 16,
                    "episode_return": float(generator.normal()),
                    "noise": 0.0,
                    "time": round(1.7e9 + 0.05 * update, 3),
                    "collect_seconds": 0.02,
                    "update_seconds": 0.02,
                    "cost_0": float(generator.gamma(5.0)),
                    "limit_0": 65.0 - 60.0 * update / updates,
                    **{name: float(generator.normal()) for name in AGENT_METRICS},
                }
            )
        writer.commit({}, update=updates, env_steps=updates * STEPS_PER_UPDATE)
        writer.close(TrialStatus.COMPLETE)
    return store


def sync_seconds(store: SweepStore, uri: str) -> tuple[float, float]:
    """CPU and wall seconds of the whole sync process over the sweep as it is."""
    cpu, wall = children_cpu(), time.monotonic()
    if not start_sync(store, uri, interval_seconds=3600.0).stop(timeout=3600.0):
        sys.exit(f"the MLflow sync did not end: {last_report(store, uri)}")
    return children_cpu() - cpu, time.monotonic() - wall


def children_cpu() -> float:
    """CPU seconds of the processes that this one started and waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--updates", type=int, default=300)
    parser.add_argument("--trial-seconds", type=float, default=12.0, help="CPU seconds of a trial itself")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        store = write_sweep(Path(folder), trials=arguments.trials, updates=arguments.updates)
        empty = SweepStore(Path(folder), "empty")
        base, _ = sync_seconds(empty, tracking_uri(empty, None))
        uri = tracking_uri(store, None)
        cpu, wall = sync_seconds(store, uri)
        again, _ = sync_seconds(store, uri)
        size = store.mlflow_database.stat().st_size
    per_trial = (cpu - base) / arguments.trials
    share = cpu / (arguments.trials * arguments.trial_seconds)
    print(f"start, import and a new database   {base:6.2f} CPU s")
    print(
        f"{arguments.trials} trials of {arguments.updates} updates         {cpu:6.2f} CPU s in {wall:.1f} s"
    )
    print(f"a trial                            {per_trial:6.2f} CPU s")
    print(f"the same again, nothing new        {again:6.2f} CPU s")
    print(f"database                           {size / 2**20:6.1f} MiB")
    print(f"share of the trials' own CPU time  {share:6.1%}")


if __name__ == "__main__":
    main()
