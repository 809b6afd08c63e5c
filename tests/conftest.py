"""Sweeps that nobody trained, for the tests of whatever reads files: made-up numbers, real writers."""

from __future__ import annotations

import math
import os
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: a trial's sums do not depend on the machine
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
import pytest
from hypothesis import settings

from recrl.analysis.data.sweep_data import Sweep, load
from recrl.environments.cmdp import CostLimits, EpisodeStats, Phase
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_writer import TrialWriter
from recrl.orchestrator.spec import Choice, TrialSpec, TrialStatus
from recrl.orchestrator.tracking.client import tracking_uri
from recrl.orchestrator.tracking.mlflow_sync import sync

if TYPE_CHECKING:
    from matplotlib.figure import Figure

settings.register_profile("recrl", deadline=None)  # a loaded machine is no failure
settings.load_profile("recrl")

# They take a minute or more each, and begin first: at the end one process would wait for the other.
SLOW_FILES = ("test_docs_commands.py", "test_ray_services.py", "test_ray_executor.py", "test_learning.py")

STEPS_PER_UPDATE = 400
FIRST_COST = 100.0
# How the made-up agents end: return and cost without a curriculum, and with one.
STUCK, SOLVED = (-15.0, 0.5), (8.0, 4.8)


@dataclass(frozen=True)
class MadeUpSweep:
    """What to write: a trial for every task, agent, method and seed.

    Attributes:
        tasks: label of each, all of them the task ``two-state``, the optimum of which is known.
        num_costs: k; above 1 the task is ``two-state-2``.
        horizon: of the tasks.
        updates: policy updates of a trial; the last 5% at least one, are the deployment phase.
        unfinished: titles of trials that are left running after half of their updates.
        failed: titles of trials that failed there.
        missing: titles of trials that were never started.
    """

    tasks: Sequence[str] = ("river-a", "river-b")
    agents: Sequence[str] = ("ppo-lag", "cpo")
    methods: Sequence[str] = ("none", "linear", "cosine", "exponential", "dynamic")
    seeds: int = 3
    num_costs: int = 1
    horizon: int = 10
    deploy_limit: float = 5.0
    updates: int = 40
    unfinished: Sequence[str] = field(default=())
    failed: Sequence[str] = field(default=())
    missing: Sequence[str] = field(default=())

    def spec(self, task: str, agent: str, method: str, seed: int) -> TrialSpec:
        """One cell."""
        total = self.updates * STEPS_PER_UPDATE
        deploy = max(1, round(0.05 * self.updates)) * STEPS_PER_UPDATE
        return TrialSpec(
            task=Choice(
                "two-state" if self.num_costs == 1 else "two-state-2", {"horizon": self.horizon}, task
            ),
            agent=Choice(agent),
            method=Choice(method),
            train_limits=CostLimits((FIRST_COST,) * self.num_costs),
            deploy_limits=CostLimits((self.deploy_limit,) * self.num_costs),
            train_steps=total - deploy,
            deploy_steps=deploy,
            num_envs=4,
            rollout_steps=STEPS_PER_UPDATE // 4,
            evaluation_episodes=10,
            seed=seed,
        )

    def write(self, root: Path, name: str = "made-up") -> SweepStore:
        """Write it with the real writers; a sweep that is there already gets more trials."""
        store = SweepStore(root, name)
        cells = product(self.tasks, self.agents, self.methods, range(self.seeds))
        specs = [spec for spec in (self.spec(*cell) for cell in cells) if spec.title not in self.missing]
        for spec in specs:
            self._write_trial(store, spec)
        known = store.specs() if store.specs_path.exists() else []
        store.write_info({"name": name, "created": 1.7e9, "launched": 1.7e9})
        store.write_specs([*known, *(spec for spec in specs if spec not in known)])
        return store

    def _write_trial(self, store: SweepStore, spec: TrialSpec) -> None:
        writer = store.trial(spec).begin(spec)
        stopped = spec.title in self.unfinished or spec.title in self.failed
        generator = np.random.default_rng([spec.seed, len(spec.title)])
        updates = self.updates // 2 if stopped else self.updates
        last = _write_updates(writer, spec, updates, generator)
        if stopped:
            writer.commit({}, update=updates, env_steps=updates * STEPS_PER_UPDATE)
            if spec.title in self.failed:
                writer.close(TrialStatus.FAILED, error="ValueError: the river froze", traceback="...")
            return
        writer.write_evaluation(
            [
                {"policy": policy, "index": index, "length": 20, "episode_return": last[0]}
                | {f"cost_{i}": last[1] for i in range(self.num_costs)}
                for policy in ("stochastic", "deterministic")
                for index in range(spec.evaluation_episodes)
            ]
        )
        writer.commit({}, update=updates, env_steps=updates * STEPS_PER_UPDATE)
        writer.close(TrialStatus.COMPLETE)


def _write_updates(
    writer: TrialWriter, spec: TrialSpec, updates: int, generator: np.random.Generator
) -> tuple[float, float]:
    """Rows of a made-up agent that follows its limit; returns its last return and cost."""
    steps, index, value, cost = STEPS_PER_UPDATE, 0, 0.0, 0.0
    solves = spec.method.label != "none" or spec.seed % 3 == 0
    value_end, cost_end = SOLVED if solves else STUCK
    pace = generator.uniform(0.8, 1.2)
    for update in range(1, updates + 1):
        phase = Phase.TRAINING if (update - 1) * steps < spec.train_steps else Phase.DEPLOYMENT
        progress = min(1.0, (update - 1) * steps / spec.train_steps)
        limit = _limit(spec, 1.0 if phase is Phase.DEPLOYMENT else progress, pace)
        learnt = min(1.0, 2.5 * progress * pace)
        value = -20.0 + learnt * (value_end + 20.0)
        cost = cost_end + (1.0 - learnt) ** 3 * (90.0 - cost_end)
        number = 4 + round(12 * learnt)
        returns = value + generator.normal(0.0, 0.4, number)
        costs = np.maximum(0.0, cost + generator.normal(0.0, 0.05 * cost, (number, len(spec.deploy_limits))))
        limits = CostLimits((limit,) * len(spec.deploy_limits))
        for episode in range(number):
            writer.append_episode(
                EpisodeStats(
                    index=index,
                    phase=phase,
                    end_step=(update - 1) * steps + (episode + 1) * steps // number,
                    length=steps // number,
                    episode_return=round(float(returns[episode]), 3),
                    costs=tuple(round(float(value), 3) for value in costs[episode]),
                    limits=limits,
                    noise=0.0,
                )
            )
            index += 1
        writer.append_update(
            {
                "update": update,
                "phase": phase,
                "end_step": update * steps,
                "episodes": number,
                "episode_return": float(returns.mean()),
                "noise": 0.0,
                "time": 1.7e9 + update,
                "collect_seconds": 0.1,
                "update_seconds": 0.1,
                **{f"cost_{i}": float(costs[:, i].mean()) for i in range(len(limits))},
                **{f"limit_{i}": limit for i in range(len(limits))},
                "multiplier_0": progress,
                "kl": 0.01,
            }
        )
        if spec.method.label == "dynamic" and update % 10 == 0 and phase is Phase.TRAINING:
            writer.append_event({"update": update, "end_step": update * steps, "event": "policy noise"})
    return value, cost


def _limit(spec: TrialSpec, progress: float, pace: float) -> float:
    start, end = FIRST_COST, spec.deploy_limits[0]
    share = {
        "none": 0.0,
        "linear": 1.0 - progress,
        "cosine": (1.0 + math.cos(math.pi * progress)) / 2.0,
        "exponential": (math.exp(-5.0 * progress) - math.exp(-5.0)) / (1.0 - math.exp(-5.0)),
        "dynamic": max(0.0, 1.0 - round(6.0 * progress * pace) / 6.0) if progress < 1.0 else 0.0,
        "step": float(progress < 1.0),
        "unconstrained": math.inf if progress < 1.0 else 0.0,
    }.get(spec.method.label, 0.5 if progress < 1.0 else 0.0)
    return end + share * (start - end)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the tests; pytest calls this."""
    items.sort(key=lambda item: item.path.name not in SLOW_FILES)


@pytest.fixture
def made_up_sweep(tmp_path: Path) -> Callable[..., SweepStore]:
    """A function that writes the sweep of a ``MadeUpSweep`` with these fields."""

    def write(**fields: object) -> SweepStore:
        return MadeUpSweep(**fields).write(tmp_path)  # type: ignore[arg-type]

    return write


@pytest.fixture(scope="session")
def finished_sweep(tmp_path_factory: pytest.TempPathFactory) -> SweepStore:
    """A complete sweep on disk: 2 tasks, 2 agents, 3 methods, 3 seeds."""
    return MadeUpSweep(methods=("none", "linear", "dynamic")).write(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="session")
def finished(finished_sweep: SweepStore) -> Sweep:
    """The frames of ``finished_sweep``."""
    return load(finished_sweep)


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database with MLflow's tables, made once: making it takes MLflow seconds."""
    store = SweepStore(tmp_path_factory.mktemp("empty"), "empty")
    report = sync(store, tracking_uri(store, None))
    assert report.problem == ""
    for pragma in ("", "-wal", "-shm", "-journal"):
        path = Path(f"{store.mlflow_database}{pragma}")
        assert path.exists() == (pragma == "")
    return store.mlflow_database


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str, str], None]:
    """A function that installs a package with one entry point; its module, if any, is in ``tmp_path``."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def write(package: str, group: str, entry_point: str) -> None:
        distribution = tmp_path / f"{package.replace('-', '_')}-1.0.dist-info"
        distribution.mkdir()
        (distribution / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (distribution / "entry_points.txt").write_text(f"[{group}]\n{entry_point}\n")

    return write


@pytest.fixture
def unrendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made but not rendered, which takes a second each: for tests of the files beside them."""

    def write(figure: object, file: BinaryIO, **options: object) -> None:
        file.write(b"not rendered")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", write)


@pytest.fixture
def laid_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are laid out with all their texts, but not written: for tests of whether they can be drawn."""

    def write(figure: Figure, file: BinaryIO, **options: object) -> None:
        figure.draw_without_rendering()
        file.write(b"laid out")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", write)


@pytest.fixture(autouse=True)
def modules_of_one_test(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Forget the modules that a test wrote and imported: another test may write one of the same name."""
    before = set(sys.modules)
    yield
    folder = tmp_path_factory.getbasetemp()
    for name in set(sys.modules) - before:
        file = getattr(sys.modules[name], "__file__", None)
        if file is not None and Path(file).is_relative_to(folder):
            del sys.modules[name]
