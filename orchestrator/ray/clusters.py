"""Start a Ray cluster on this machine, or connect to an existing one."""

from __future__ import annotations

import logging
import os
import secrets
import socket
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import ray

from recrl.orchestrator.errors import ClusterError, RecrlError, first_line
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.provenance.own_package import copy_package
from recrl.orchestrator.ray.private_api import (
    RANGE,
    at_loopback,
    fewer_processes,
    own_sessions,
    quiet_driver,
    require_known_ray,
)
from recrl.orchestrator.ray.process_state import environment, own_signal_handlers
from recrl.orchestrator.ray.services import (
    RAY_FOLDER,
    end_processes,
)

CONNECT_SECONDS = 5.0
CONNECT_TRIES = 3
OBJECT_STORE_BYTES = 80 * 2**20  # Ray requires 75 MiB at least; recrl stores nothing of that size
ADDRESS_VARIABLE = "RAY_ADDRESS"
MISMATCH = "Version mismatch"  # in Ray's error, if this process has another Ray or Python than the cluster
MODE_VARIABLE = "RAY_AUTH_MODE"
TOKEN_VARIABLE = "RAY_AUTH_TOKEN_PATH"
TOKEN = "token"  # in the cluster's folder
PREFIX = "recrl-ray-"  # only the next cluster removes such a folder: it ends the processes first
LONGEST_SOCKET_FOLDER = 40  # characters: a socket's path may have 107, of which Ray takes up to 67

QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_AIR_NEW_OUTPUT": "0",  # the new output prints at verbosity 0, the old one does not
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # the stop event is the only way to stop
    "TUNE_GLOBAL_CHECKPOINT_S": "1e9",  # Tune's own state is never restored
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
    "TUNE_WARN_THRESHOLD_S": "60",
}
WORKER = {
    "OMP_NUM_THREADS": "1",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
}

# Ray's processes poll up to ten times a second. Recrl's own cluster has one machine, no large objects and no
# reader of metrics; none of these settings affects the detection of dead processes. They are set in Ray's
# environment, where a version that does not know one ignores it.
SELDOM: Mapping[str, int] = {
    "enable_metrics_collection": 0,
    "gcs_pull_resource_loads_period_milliseconds": 10_000,  # for an autoscaler
    "kill_idle_workers_interval_ms": 1_000,
    "local_fs_monitor_interval_ms": 10_000,  # before objects are spilled to disk
    "memory_monitor_refresh_ms": 2_000,
    "object_manager_timer_freq_ms": 1_000,
    "prestart_worker_first_driver": 0,  # an idle worker wakes a hundred times a second
    "raylet_check_gc_period_milliseconds": 10_000,
}
LOOPBACK = "127.0.0.1"

logger = logging.getLogger("recrl.sweep")


@contextmanager
def local_cluster(num_cpus: int) -> Iterator[Path]:
    """Start a Ray cluster on this machine until the end of the context, closed to other users.

    Its services listen at the loopback address and require a token, so that neither other machines nor other
    users can use them. Ray's own folder is open to all users of the machine. It lies in a folder that only
    this user can read, with the token.

    Args:
        num_cpus: number of cores, at least 1.

    Yields:
        The cluster's folder.

    Raises:
        ClusterError: Ray does not start, or starts without a token.
    """
    with scratch_folder(_short_folder(), prefix=PREFIX, before_removal=end_processes) as folder:
        token_path = folder / TOKEN
        with open(os.open(token_path, os.O_CREAT | os.O_WRONLY, 0o600), "w") as file:
            file.write(_token())
        seldom = {f"RAY_{name}": str(value) for name, value in SELDOM.items()}
        with environment(QUIET | WORKER | seldom | {TOKEN_VARIABLE: str(token_path)}):
            for name in (MODE_VARIABLE, "RAY_AUTH_TOKEN", ADDRESS_VARIABLE):
                os.environ.pop(name, None)  # Ray uses the mode only if it is set before Ray starts
            with (
                _leaving_no_process(folder),
                at_loopback(),
                _connection(
                    "cannot start Ray on this machine",
                    hint="",
                    address="local",
                    num_cpus=num_cpus,
                    _node_ip_address=LOOPBACK,
                    include_dashboard=False,
                    object_store_memory=OBJECT_STORE_BYTES,
                    _temp_dir=str(folder / RAY_FOLDER),
                ),
            ):
                if os.environ.get(MODE_VARIABLE) != "token":
                    raise ClusterError(
                        f"Ray {ray.__version__} started without a token, so other users could "
                        f"use it; install a version that requires one: pip install '{RANGE}'"
                    )
                yield folder


@contextmanager
def existing_cluster(address: str, *, ship_package: bool = False) -> Iterator[None]:
    """Connect to an existing Ray cluster.

    Args:
        address: ``auto`` for the cluster that RAY_ADDRESS names or else that of this machine; or
            ``host:port``.
        ship_package: whether to send recrl itself, without its dependencies, to the nodes.

    Raises:
        RecrlError: the address is Ray Client's.
        ClusterError: there is none, this machine is no node of it, or it refuses our token.
    """
    failure = f"cannot use the Ray cluster at {address}"
    named = os.environ.get(ADDRESS_VARIABLE, "")
    if address == "auto" and named not in ("", "auto", "local"):  # Ray would use it without these checks
        address, failure = named, f"cannot use the Ray cluster of {ADDRESS_VARIABLE}, {named}"
        if "://" in address:
            raise RecrlError(f"{failure}: it must be host:port of a cluster of this machine; or unset it")
    if "://" in address:  # Ray itself advises against Tune with Ray Client
        raise RecrlError(
            f"{failure}: the driver must run on a node of the cluster, not through Ray Client; "
            "launch there with --address auto, or make this machine a node: ray start "
            "--address=<host:port> --num-cpus=0"
        )
    host, _, port = address.rpartition(":")
    if host:  # Ray itself would try for two minutes
        try:
            socket.create_connection((host, int(port)), timeout=CONNECT_SECONDS).close()
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ClusterError(f"{failure}: {reason}; is it running, and is this host:port?") from error
    hint = (
        "; is this machine a node of it (ray start --address=<host:port> --num-cpus=0), and does "
        "it require a token (RAY_AUTH_MODE=token, and the path of its token file in RAY_AUTH_TOKEN_PATH)?"
    )
    with scratch_folder(tempfile.gettempdir()) as scratch:
        runtime_env: dict[str, Any] = {"env_vars": WORKER}
        if ship_package:
            runtime_env["py_modules"] = [str(folder) for folder in copy_package(scratch)]
        with environment({}):
            os.environ.pop(ADDRESS_VARIABLE, None)  # Ray prefers it to the address ``auto``
            with _connection(failure, hint, address=address, runtime_env=runtime_env):
                yield


@contextmanager
def _connection(failure: str, hint: str, **settings: Any) -> Iterator[None]:
    require_known_ray()
    try:
        quiet_driver()
        try:
            _connect(**settings)
        except SystemExit as error:  # Ray's reaction to a SIGTERM during its start; nothing runs yet
            raise KeyboardInterrupt from error
        except Exception as error:
            said = first_line(error)
            same = "; install that Ray and Python here, or start a cluster from docker/ (docker/README.md)"
            raise ClusterError(f"{failure}: {said}{same if MISMATCH in said else hint}") from error
        yield
    finally:
        ray.shutdown()


def _connect(**settings: Any) -> None:
    """Call ``ray.init`` again if a busy machine took longer than the time that Ray allows."""
    for tries_left in range(CONNECT_TRIES - 1, -1, -1):
        try:
            with own_signal_handlers(), own_sessions(), fewer_processes():
                ray.init(log_to_driver=False, logging_level=logging.CRITICAL, **settings)
            return
        except Exception as error:  # Ray raises a bare Exception for a node that starts too slowly
            if tries_left == 0 or "timed out" not in str(error):
                raise
            logger.warning("Ray did not start in time; it is tried again")
            ray.shutdown()


@contextmanager
def _leaving_no_process(folder: Path) -> Iterator[None]:
    """End the processes that Ray leaves behind in a folder: its agents, if its raylet was killed."""
    try:
        yield
    finally:
        end_processes(folder)


@cache
def _token() -> str:
    """Return this process's token for the clusters it starts: Ray reads a process's token only once."""
    return secrets.token_hex(32)


def _short_folder() -> str:
    folder = tempfile.gettempdir()
    return folder if len(folder) <= LONGEST_SOCKET_FOLDER - len(f"/{PREFIX}12345678/{RAY_FOLDER}") else "/tmp"
