"""The teacher service under many trials at once: how long an answer takes, and that none is lost or doubled.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_teacher_load.py [--trials 1000] [--updates 30]

Fake trials: threads of a few worker processes, each of which asks the service for one step after the other
with 30 finished episodes, as a trial does, but trains nothing. First without pause, which says how many
questions a second the service answers; then with a pause between questions as long as a policy update takes,
which says how long a trial waits, and the same with the service killed midway. Every trial's lessons and
final state are then compared with those of a teacher that was asked in this process.

Beside it, what else grows with the number of trials at once: the driver's look at every trial's heartbeat.
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import ray

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats, Phase
from recrl.orchestrator.files.sweep_store import SILENCE_SECONDS, SweepStore
from recrl.orchestrator.ray.clusters import local_cluster
from recrl.orchestrator.ray.hang_watchdog import look_seconds
from recrl.orchestrator.ray.teacher_service import RayTeacher, find_teacher_service, start_teacher_service
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState

PROCESSES = 4
EPISODES = 30
LENGTH = 1000
SERVICE = "load"


@dataclass(frozen=True)
class Walk:
    """What a fake trial saw: its lessons, the state at the end, and how long each question took."""

    lessons: tuple[CurriculumStep, ...]
    state: TeacherState
    seconds: tuple[float, ...]


def teacher_spec(updates: int) -> TeacherSpec:
    limits = CostLimits((65.0,)), CostLimits((5.0,))
    return TeacherSpec("dynamic", {"window": 3}, *limits, train_steps=EPISODES * LENGTH * updates)


def reports(trial: int, updates: int) -> list[ProgressReport]:
    """A trial's episodes, drawn from its number."""
    generator = np.random.default_rng(trial)
    return [
        ProgressReport(
            update=update,
            env_steps=EPISODES * LENGTH * update,
            episodes=tuple(
                EpisodeStats(
                    index=EPISODES * (update - 1) + episode,
                    phase=Phase.TRAINING,
                    end_step=EPISODES * LENGTH * (update - 1) + LENGTH * (episode + 1),
                    length=LENGTH,
                    episode_return=float(returned),
                    costs=(float(cost),),
                    limits=CostLimits((65.0,)),
                    noise=0.0,
                )
                for episode, (returned, cost) in enumerate(
                    zip(
                        generator.normal(10.0, 1.0, EPISODES),
                        generator.gamma(20.0, 1.0, EPISODES),
                        strict=True,
                    )
                )
            ),
        )
        for update in range(1, updates + 1)
    ]


def walk(teacher: Any, trial: int, updates: int, pause: float) -> Walk:
    """Ask for a whole trial's lessons, with pauses between a half and one and a half times ``pause``."""
    told = reports(trial, updates)
    waits = np.random.default_rng([trial, 1]).uniform(0.5, 1.5, updates) * pause
    step, state = teacher.start()
    lessons, seconds = [step], []
    for report, wait in zip(told, waits, strict=True):
        time.sleep(wait)
        before = time.perf_counter()
        step, state = teacher.step(state, report)
        seconds.append(time.perf_counter() - before)
        lessons.append(step)
    return Walk(tuple(lessons), state, tuple(seconds))


@ray.remote
def fake_trials(trials: Sequence[int], updates: int, pause: float) -> list[Walk]:
    """Many trials in the threads of one process."""
    service = find_teacher_service(SERVICE)

    def one(trial: int) -> Walk:
        return walk(RayTeacher(teacher_spec(updates), service), trial, updates, pause)

    with ThreadPoolExecutor(len(trials)) as threads:
        return list(threads.map(one, trials))


def cpu_seconds(service: Any) -> float:
    return float(ray.get(service.__ray_call__.remote(lambda _: time.process_time())))


def kill_service(service: Any) -> None:
    pid = ray.get(service.__ray_call__.remote(lambda _: os.getpid()))
    assert isinstance(pid, int)
    os.kill(pid, signal.SIGKILL)


def bench_service(*, trials: int, updates: int, pause: float, kill: bool) -> None:
    with local_cluster(num_cpus=PROCESSES):
        service = start_teacher_service(SERVICE)
        ray.get(service.start.remote(teacher_spec(updates)))
        began, cpu_before = time.perf_counter(), cpu_seconds(service)
        shares = [list(range(first, trials, PROCESSES)) for first in range(PROCESSES)]
        answers = [fake_trials.remote(share, updates, pause) for share in shares]
        killer = threading.Timer(max(5.0, 0.5 * pause * updates), kill_service, [service])
        if kill:
            killer.start()
        walks = dict(
            pair
            for share, walks in zip(shares, ray.get(answers), strict=True)
            for pair in zip(share, walks, strict=True)
        )
        killer.cancel()
        wall = time.perf_counter() - began
        cpu = cpu_seconds(service) - (0.0 if kill else cpu_before)
    expected = {trial: walk(make_teacher(teacher_spec(updates)), trial, updates, 0.0) for trial in walks}
    same = sum(replace(walks[trial], seconds=()) == replace(expected[trial], seconds=()) for trial in walks)
    changes = sum(old != new for one in walks.values() for old, new in pairwise(one.lessons))
    seconds = np.concatenate([one.seconds for one in walks.values()])
    p50, p99, worst = np.quantile(seconds, [0.5, 0.99, 1.0]) * 1e3
    how = f"{pause:g} s between questions" if pause else "without pause"
    print(
        f"\n{trials} trials, {how}{', the service killed once' if kill else ''}: "
        f"{len(seconds)} questions in {wall:.0f} s"
    )
    print(
        f"  {len(seconds) / wall:.0f} questions/s; "
        f"an answer takes p50 {p50:.1f} ms, p99 {p99:.1f} ms, max {worst:.0f} ms"
    )
    print(
        f"  {same} of {trials} trials got exactly the lessons of a teacher of their own, "
        f"{changes} changes of the step among them"
    )
    if not kill:
        print(f"  the service used {cpu / len(seconds) * 1e3:.2f} ms of a core a question")
    assert same == trials, "an update was lost or doubled"


def bench_heartbeats(trials: int) -> None:
    """The driver reads every running trial's state.json, a few times a minute."""
    spec = TrialSpec(
        task=Choice("two-state"),
        agent=Choice("ppo-lag"),
        method=Choice("linear"),
        train_limits=CostLimits((9.0,)),
        deploy_limits=CostLimits((3.0,)),
        train_steps=400,
        deploy_steps=40,
        num_envs=4,
        rollout_steps=10,
        evaluation_episodes=0,
        seed=0,
    )
    with tempfile.TemporaryDirectory() as folder:
        store = SweepStore(Path(folder), "bench")
        files = [store.trial(replace(spec, seed=seed)) for seed in range(trials)]
        for trial, seed in zip(files, range(trials), strict=True):
            trial.begin(replace(spec, seed=seed))
        before = time.perf_counter()
        for trial in files:
            trial.record()
        seconds = time.perf_counter() - before
        size = sum(trial.state_path.stat().st_size for trial in files) / trials
    pause = look_seconds(SILENCE_SECONDS)
    print(
        f"\n{trials} heartbeats read in {seconds * 1e3:.0f} ms ({size:.0f} bytes each), every "
        f"{pause:g} s: {seconds / pause:.1%} of the driver's time on a local disk"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=1000, help="at once")
    parser.add_argument("--updates", type=int, default=30, help="questions of each")
    given = parser.parse_args()
    print(
        f"{given.trials} fake trials in {PROCESSES} processes, {EPISODES} episodes a question, "
        f"on {os.cpu_count()} cores"
    )
    bench_service(trials=given.trials, updates=min(5, given.updates), pause=0.0, kill=False)
    bench_service(trials=given.trials, updates=given.updates // 3, pause=10.0, kill=False)
    bench_service(trials=given.trials, updates=given.updates // 6, pause=10.0, kill=True)
    bench_service(trials=given.trials // 10, updates=given.updates, pause=1.0, kill=False)
    bench_heartbeats(given.trials)


if __name__ == "__main__":
    main()
