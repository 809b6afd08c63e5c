"""How long figures wait for MLflow: a large sweep from a sqlite store to frames.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.bench_tracking_reader [--trials 1000] [--updates 300]

A store is made with as many runs and points as are asked for, with the columns, artifacts and sums of real
trials and random numbers; rows are written to MLflow's tables directly, as MLflow itself would take half an
hour. Then ``recrl.analysis.tracked.load`` reads it in a fresh process. The aim: 1,000 runs x 300 points, each
with all metrics of a trial, within 10 seconds on two cores, imports counted.
"""

from __future__ import annotations

import argparse
import json
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import urlparse

import numpy as np
import pandas as pd

from recrl.environments.cmdp import Phase
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.store import SweepStore
from recrl.orchestrator.tracking import PHASES_TAG, PROGRESS_TAG, SPEC_TAG, sync, tracking_uri
from tests.benchmarks.bench_tracking import STEPS_PER_UPDATE, STUDENT_METRICS, write_sweep

INSERT = "INSERT INTO {table} (key, value, timestamp, run_uuid, step, is_nan) VALUES (?, ?, ?, ?, ?, 0)"
SUMS = {
    **{"episodes": 4560, "steps": 912_000, "episode_return": 1.5, "episode_return_std": 0.25},
    **{"cost_0": 4.5, "cost_0_std": 0.5, "cost_0_total": 20_520.0, "excess_0_total": 12.0},
}
READ = """
import sys, time
start = time.monotonic()
from recrl.analysis import tracked
imported = time.monotonic()
sweep = tracked.load(sys.argv[1])
end = time.monotonic()
print(len(sweep.trials), len(sweep.updates), imported - start, end - imported, time.process_time())
"""


def fill(store: SweepStore, *, trials: int, updates: int) -> int:
    """Put runs into the store's database that are like its only one; returns the number of points."""
    database = sqlite3.connect(store.mlflow_database)
    (model,) = (trial.spec for trial in store.trials())
    template = database.execute(
        "SELECT run_uuid, artifact_uri FROM runs WHERE run_uuid IN "
        "(SELECT run_uuid FROM tags WHERE key = 'recrl.trial_id')"
    ).fetchone()
    columns = [row[1] for row in database.execute("PRAGMA table_info(runs)")]
    others = ", ".join(name for name in columns if name != "run_uuid")
    tags = database.execute("SELECT key, value FROM tags WHERE run_uuid = ?", template[:1]).fetchall()
    generator, points = np.random.default_rng(0), 0
    _write_artifacts(Path(urlparse(template[1]).path), generator)  # all runs have the same
    phases = json.dumps([{"phase": phase.value, **SUMS} for phase in Phase])
    database.execute("UPDATE tags SET value = ? WHERE key = ?", (phases, PHASES_TAG))
    for seed in range(1, trials):
        spec = TrialSpec.from_json({**model.to_json(), "seed": seed})
        run = f"{seed:032x}"
        database.execute(
            f"INSERT INTO runs (run_uuid, {others}) SELECT ?, {others} FROM runs WHERE run_uuid = ?",
            (run, template[0]),
        )
        told = {
            SPEC_TAG: json.dumps(spec.to_json()),
            PROGRESS_TAG: json.dumps({"env_steps": updates * STEPS_PER_UPDATE, "cpu_seconds": 1.0}),
        }
        database.executemany(
            "INSERT INTO tags (key, value, run_uuid) VALUES (?, ?, ?)",
            [(key, told.get(key, value), run) for key, value in tags],
        )
        rows = list(_points(run, spec, updates, generator))
        points += len(rows)
        database.executemany(INSERT.format(table="metrics"), rows)
        latest = {row[0]: row for row in rows}
        database.executemany(INSERT.format(table="latest_metrics"), latest.values())
    database.commit()
    database.close()
    return points


def _write_artifacts(folder: Path, generator: np.random.Generator) -> None:
    """Final policy, evaluation and events, as large as those of a trial on RiverGrid."""
    episodes = pd.DataFrame(generator.random((200, 2)), columns=["episode_return", "cost_0"])
    episodes.insert(0, "policy", np.repeat(["stochastic", "deterministic"], 100))
    episodes.insert(1, "index", np.tile(np.arange(100), 2))
    episodes.insert(2, "length", 200)
    episodes.to_csv(folder / "evaluation.csv", index=False)
    policy = pd.DataFrame(generator.random((400, 3)), columns=[f"action_{j}" for j in range(3)])
    policy.to_csv(folder / "policy.csv", index=False)
    event = {"update": 3, "end_step": 3 * STEPS_PER_UPDATE, "event": "policy noise"}
    (folder / "events.jsonl").write_text(10 * f"{json.dumps(event)}\n")
    (folder / "provenance.json").write_text('{"commit": "0"}\n')


def _points(
    run: str, spec: TrialSpec, updates: int, generator: np.random.Generator
) -> Iterator[tuple[str, float, int, str, int]]:
    names = ["return", "cost_0", "episodes"]
    for update in range(1, updates + 1):
        step = update * STEPS_PER_UPDATE
        section = "train" if step <= spec.train_steps else "deploy"
        keys = [f"{section}/{name}" for name in names]
        keys += ["curriculum/limit_0", "curriculum/noise", "perf/steps_per_second"]
        keys += [f"student/{name}" for name in STUDENT_METRICS]
        for key, value in zip(keys, generator.random(len(keys)).tolist(), strict=True):
            yield key, value, 1_700_000_000_000 + 50 * update, run, step


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--updates", type=int, default=300)
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        store = write_sweep(Path(folder), trials=1, updates=arguments.updates)
        uri = tracking_uri(store, None)
        assert sync(store, uri).is_up_to_date
        start = time.monotonic()
        points = fill(store, trials=arguments.trials, updates=arguments.updates)
        print(f"{points:,} points made in {time.monotonic() - start:.0f} s")
        print(f"{store.mlflow_database.stat().st_size / 2**20:,.0f} MiB")
        for which in ("first", "second"):
            start = time.monotonic()
            done = subprocess.run(
                [sys.executable, "-c", READ, uri], check=True, capture_output=True, text=True
            )
            trials, rows, imports, loading, cpu = map(float, done.stdout.split())
            wall = time.monotonic() - start
            print(
                f"{which}: {trials:.0f} trials, {rows:.0f} updates: {wall:.1f} s in all, imports "
                f"{imports:.1f}, frames {loading:.1f}, CPU {cpu:.1f}"
            )


if __name__ == "__main__":
    main()
