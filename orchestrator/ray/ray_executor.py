"""Trials on Ray: Tune assigns them to worker processes on one or many machines.

Tune is a scheduler that may die. Every run is a new Tune experiment over the given specs (never
``Tuner.restore``). A Tune trial is one recrl trial, which starts from its own newest checkpoint. Tune is
informed only of its end; all results are in the files.

Failures:

- A worker or its node dies: Tune starts the trial again, up to ``max_failures`` times.
- A trial's code raises: it is FAILED in its files and not tried again.
- The driver dies: its workers die, too.
- A trial hangs: its heartbeat stops, and its process is ended (``hang_watchdog``), as in the first case.

A signal to the launch and its process group (Ctrl-C, ``timeout``) reaches the driver only. Ray's processes
have sessions of their own, and run until the trials are saved.

Assumes that every node sees the results folder under the same path, or reaches the object store of the
trials, and has the same recrl. On an existing cluster every node is checked for both before the first trial.
Leaves out growing with an elastic cluster beyond ``max_concurrent``.
"""

from __future__ import annotations

import json
import logging
import secrets
import tempfile
import threading
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import ray
from ray import tune
from ray.tune.search import BasicVariantGenerator

from recrl.orchestrator.capacity import usable_cores
from recrl.orchestrator.errors import ClusterError
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.files.stop_file import StopSignal
from recrl.orchestrator.files.trial_writer import COMMIT_SECONDS
from recrl.orchestrator.grid.file_models import Resources
from recrl.orchestrator.ray.clusters import QUIET, WORKER, existing_cluster, local_cluster
from recrl.orchestrator.ray.hang_watchdog import HangWatchdog
from recrl.orchestrator.ray.nodes import check_gpus, check_nodes, trials_that_fit
from recrl.orchestrator.ray.process_state import environment, own_signal_handlers
from recrl.orchestrator.ray.services import LostServices
from recrl.orchestrator.ray.teacher_service import start_teacher_service
from recrl.orchestrator.ray.tune_callbacks import DriverWatch, StopWhenIdle
from recrl.orchestrator.ray.tune_trial import TuneTrial
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.sweep_place import SweepPlace

logger = logging.getLogger("recrl.sweep")


@dataclass(frozen=True)
class RayExecutor:
    """``Executor`` that runs trials in parallel on Ray.

    Attributes:
        address: an existing cluster (``auto``, ``host:port``); None for one on this machine, with all cores
            that this process may use.
        ship_package: whether to send recrl itself to that cluster's nodes.
        resources: of the grid. Without a ``max_concurrent`` as many trials run as fit at the start.
        max_failures: largest number of restarts after the death of a trial's process, at least 0.
        commit_seconds: wall seconds between a trial's checkpoints, above 0.
    """

    address: str | None = None
    ship_package: bool = False
    resources: Resources = field(default_factory=Resources)
    max_failures: int = 3
    commit_seconds: float = COMMIT_SECONDS

    def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
        """See ``Executor.run``. Uses the Ray cluster that this process is connected to, if any.

        Raises:
            ClusterError: Ray cannot be started or reached, lacks the resources of a trial, or has nodes that
                differ from this one.
        """
        if not specs or stop.is_set():
            return
        lost = LostServices()
        with (
            environment(QUIET | WORKER),
            lost.watched(self._cluster()),
            place.new_stop_signal() as stop_signal,
        ):
            if self.address:
                check_nodes(stop_signal.place, stop_signal.uri)
            if self.resources.gpus_per_trial:
                check_gpus()
            queue = BasicVariantGenerator(max_concurrent=min(len(specs), self._slots()))
            watchdog = HangWatchdog(place, self.silence_of(place))
            watch = DriverWatch(
                place, queue, stop=stop, stop_signal=stop_signal, watchdog=watchdog, lost=lost
            )
            self._run_on_cluster(specs, place, stop_signal, queue, watch)

    def silence_of(self, place: SweepPlace) -> float:
        """Return the wall seconds without a heartbeat after which a trial of a place counts as hanging."""
        return max(self.resources.silence_seconds, place.shortest_silence_seconds)

    def _cluster(self) -> AbstractContextManager[Path | None]:
        if ray.is_initialized():
            return nullcontext()
        if self.address:
            return existing_cluster(self.address, ship_package=self.ship_package)
        return local_cluster(usable_cores())

    def _run_on_cluster(
        self,
        specs: Sequence[TrialSpec],
        place: SweepPlace,
        stop_signal: StopSignal,
        queue: BasicVariantGenerator,
        watch: DriverWatch,
    ) -> None:
        service_name = f"teacher-{secrets.token_hex(8)}" if self.resources.teacher == "service" else ""
        service = start_teacher_service(service_name) if service_name else None
        parameters = {
            "spec": tune.grid_search([json.dumps(spec.to_json()) for spec in specs]),
            "sweep": str(place.store.folder),
            "storage": place.uri,
            "stop_signal": stop_signal.place,
            "teacher_service": service_name,
            "commit_seconds": self.commit_seconds,
        }
        with scratch_folder(tempfile.gettempdir()) as scratch, own_signal_handlers():
            self._tuner(parameters, queue, watch, scratch).fit()
        del service  # Ray ends an actor without a reference

    def _tuner(
        self, parameters: dict[str, Any], queue: BasicVariantGenerator, watch: DriverWatch, scratch: Path
    ) -> tune.Tuner:
        return tune.Tuner(
            tune.with_resources(TuneTrial, wanted(self.resources)),
            param_space=parameters,
            tune_config=tune.TuneConfig(
                search_alg=queue,
                reuse_actors=True,
                trial_name_creator=_tune_trial_id,
                trial_dirname_creator=_tune_trial_id,
            ),
            run_config=tune.RunConfig(
                storage_path=str(scratch),
                name="sweep",
                verbose=0,
                callbacks=[watch],
                stop=StopWhenIdle(watch),
                failure_config=tune.FailureConfig(max_failures=self.max_failures),
                checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
            ),
        )

    def _slots(self) -> int:
        """Return the number of parallel trials."""
        asked, most = wanted(self.resources), self.resources.max_concurrent
        slots = trials_that_fit(asked)
        if self.address:  # an existing cluster may grow
            if not slots:
                logger.warning("no node has room for a trial (%s) yet; they wait", _amounts(asked))
            return most or max(1, slots)
        if slots < 1:
            resources: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
            there = {name: resources.get(name, 0.0) for name in asked}
            raise ClusterError(
                f"a trial asks for {_amounts(asked)}, this cluster has {_amounts(there)}; "
                "lower cpus_per_trial, gpus_per_trial or custom_per_trial in the grid's resources, or add "
                "machines"
            )
        return min(slots, most or slots)


def room_on_cluster(address: str, resources: Resources) -> int:
    """Return how many trials an existing cluster can run in parallel, at least 0.

    Args:
        address: see ``existing_cluster``.
        resources: of a trial.

    Raises:
        ClusterError: it cannot be reached.
    """
    with environment(QUIET | WORKER), existing_cluster(address):
        return trials_that_fit(wanted(resources))


def wanted(resources: Resources) -> dict[str, float]:
    """Return the resources of one trial, by Ray's names."""
    return {"CPU": resources.cpus_per_trial, "GPU": resources.gpus_per_trial, **resources.custom_per_trial}


def _tune_trial_id(trial: Any) -> str:
    return str(trial.trial_id)


def _amounts(resources: Mapping[str, float]) -> str:
    """Format amounts: ``1 CPU, 0 GPU``."""
    return ", ".join(f"{amount:g} {name}" for name, amount in resources.items())
