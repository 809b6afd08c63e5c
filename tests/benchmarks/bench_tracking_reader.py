"""How long figures wait for MLflow: a large sweep from a sqlite store, or from a server, to frames.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.bench_tracking_reader [--trials 1000] [--updates 300]
    ... --server

A store is made with as many runs and points as are asked for, with the columns, artifacts and sums of real
trials and random numbers; rows are written to MLflow's tables directly, as MLflow itself would take half an
hour. Then ``recrl.analysis.data.from_mlflow.load`` reads it in a fresh process. The aim: 1,000 runs x 300
points, each with all metrics of a trial, within 10 seconds on two cores, imports counted.

With ``--server`` an MLflow server of one process stands before that store and hands out the artifacts as
well. At first it has the sweep's snapshot as the mirror would have left it, of all runs but one; then none,
as one that an older version wrote to. One number more: the CPU seconds of the server.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
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

from recrl.environments.cmdp import Floats, Phase
from recrl.orchestrator.files.store import SweepStore
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.tracking.mlflow_sync import PHASES_TAG, PROGRESS_TAG, SPEC_TAG, sync, tracking_uri
from recrl.orchestrator.tracking.snapshot import (
    AT_THE_END,
    BEFORE_METRICS,
    FROM_THE_BEGINNING,
    SNAPSHOT_FOLDER,
    SNAPSHOT_TAG,
    Announcement,
    HeldRun,
    Snapshot,
)
from recrl.orchestrator.tracking.ui import open_ui
from tests.benchmarks.bench_tracking import STEPS_PER_UPDATE, STUDENT_METRICS, children_cpu, write_sweep

PORT = 5714
NUM_METRICS = len(STUDENT_METRICS) + 9  # three in each phase, and three of the curriculum and the speed
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


def fill(store: SweepStore, *, trials: int, updates: int) -> tuple[int, Snapshot]:
    """Put runs into the store's database that are like its only one.

    Returns:
        The number of points, and the snapshot of the new runs.
    """
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
    folder = Path(urlparse(template[1]).path)
    _write_artifacts(folder, generator)  # all runs have the same
    held, metrics, tables = [], list[str](), []
    phases = json.dumps([{"phase": phase.value, **SUMS} for phase in Phase])
    database.execute("UPDATE tags SET value = ? WHERE key = ?", (phases, PHASES_TAG))
    for seed in range(1, trials):
        spec = TrialSpec.from_json({**model.to_json(), "seed": seed})
        run = f"{seed:032x}"
        database.execute(
            f"INSERT INTO runs (run_uuid, {others}) SELECT ?, {others} FROM runs WHERE run_uuid = ?",
            (run, template[0]),
        )
        progress = {"update": updates, "env_steps": updates * STEPS_PER_UPDATE, "cpu_seconds": 1.0}
        told = {SPEC_TAG: json.dumps(spec.to_json()), PROGRESS_TAG: json.dumps(progress)}
        database.executemany(
            "INSERT INTO tags (key, value, run_uuid) VALUES (?, ?, ?)",
            [(key, told.get(key, value), run) for key, value in tags],
        )
        rows = list(_points(run, spec, updates, generator))
        points += len(rows)
        held.append(HeldRun(run_id=run, attempt=1, update=updates, complete=True))
        tables.append(_table(seed - 1, rows, metrics))
        database.executemany(INSERT.format(table="metrics"), rows)
        latest = {row[0]: row for row in rows}
        database.executemany(INSERT.format(table="latest_metrics"), latest.values())
    database.commit()
    database.close()
    texts = {name: [(folder / name).read_text()] * len(held) for name in (*FROM_THE_BEGINNING, *AT_THE_END)}
    return points, Snapshot(tuple(held), tuple(metrics), np.concatenate(tables), texts)


def _table(position: int, rows: Sequence[tuple[str, float, int, str, int]], metrics: list[str]) -> Floats:
    """The points of a run as a snapshot has them; ``metrics`` grows by those that are new."""
    metrics += [key for key in dict.fromkeys(row[0] for row in rows) if key not in metrics]
    steps = {step: index for index, step in enumerate(dict.fromkeys(row[4] for row in rows))}
    table = np.full((len(steps), BEFORE_METRICS + NUM_METRICS), np.nan)
    for key, value, milliseconds, _, step in rows:
        table[steps[step], :BEFORE_METRICS] = position, step, milliseconds
        table[steps[step], BEFORE_METRICS + metrics.index(key)] = value
    return table


def behind_a_server(store: SweepStore, snapshot: Snapshot | None) -> int:
    """Leave the store as if all had been sent to a server; returns the bytes of the snapshot, if any."""
    database = sqlite3.connect(store.mlflow_database)
    (run_id,) = database.execute(
        "SELECT run_uuid FROM tags WHERE key = 'recrl.kind' AND value = 'sweep'"
    ).fetchone()
    database.execute("DELETE FROM tags WHERE key = ?", (SNAPSHOT_TAG,))
    data = b""
    if snapshot is not None:
        data = snapshot.pack()
        folder = store.mlflow_artifacts / run_id / "artifacts" / SNAPSHOT_FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "a.zip").write_bytes(data)
        told = Announcement(
            name="a.zip",
            size=len(data),
            sha256=hashlib.sha256(data).hexdigest(),
            trials=len(snapshot.runs),
            updates=sum(run.update for run in snapshot.runs),
        )
        tag = (SNAPSHOT_TAG, told.model_dump_json(), run_id)
        database.execute("INSERT INTO tags (key, value, run_uuid) VALUES (?, ?, ?)", tag)
    place = (store.mlflow_artifacts.as_uri(), "mlflow-artifacts:")
    database.execute("UPDATE runs SET artifact_uri = replace(artifact_uri, ?, ?)", place)
    database.commit()
    database.close()
    return len(data)


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
    parser.add_argument("--server", action="store_true", help="read through an MLflow server")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        store = write_sweep(Path(folder), trials=1, updates=arguments.updates)
        uri = tracking_uri(store, None)
        assert sync(store, uri).is_up_to_date
        start = time.monotonic()
        points, snapshot = fill(store, trials=arguments.trials, updates=arguments.updates)
        print(f"{points:,} points made in {time.monotonic() - start:.0f} s")
        print(f"{store.mlflow_database.stat().st_size / 2**20:,.0f} MiB", flush=True)
        if not arguments.server:
            read(uri)
            return
        for told in (snapshot, None):
            size = behind_a_server(store, told)
            print(f"a server, snapshot of {size / 2**20:.1f} MiB:", flush=True)
            ui = open_ui(store, uri, port=PORT)
            try:
                read(f"http://127.0.0.1:{PORT}", times=2 if told else 1)
            finally:
                before = children_cpu()
                ui.close()
                print(f"the server: {children_cpu() - before:.1f} CPU s, its start counted", flush=True)


def read(uri: str, *, times: int = 2) -> None:
    """Read the sweep, each time in a fresh process, which is not in the mirror's haste."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("MLFLOW_")}
    for which in ("first", "second")[:times]:
        start = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-c", READ, uri], check=True, stdout=subprocess.PIPE, text=True, env=environment
        )
        trials, rows, imports, loading, cpu = map(float, done.stdout.split())
        wall = time.monotonic() - start
        print(
            f"{which}: {trials:.0f} trials, {rows:.0f} updates: {wall:.1f} s in all, imports "
            f"{imports:.1f}, frames {loading:.1f}, CPU {cpu:.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
