"""Whether the services that a Ray cluster hangs on are still there.

Ray itself does not say it: with a dead node service (raylet) Tune waits for ever; with a dead head service
(GCS) Ray ends the whole process after a minute, in C++. So a thread of this process connects to both now and
then. A service that takes a connection counts as alive: one that hangs is left to Ray's own checks.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ray

from recrl.orchestrator.background import beside
from recrl.orchestrator.errors import ClusterError
from recrl.orchestrator.exit_codes import ExitCode

LOOK_SECONDS = 3.0  # between two looks
CONNECT_SECONDS = 2.0
OWN_PATIENCE_SECONDS = 5.0  # nobody starts a service of a cluster of ours again
OTHERS_PATIENCE_SECONDS = 40.0  # below the minute after which Ray ends a process without a head service
LEAVE_SECONDS = 10.0  # that a launch may take to come to its end after that

TOKEN_VARIABLE = "RAY_AUTH_TOKEN_PATH"
TOKEN = "token"  # in the folder of a local cluster
RAY_FOLDER = "ray"  # beside it
SERVICES = ("ray::", "raylet", "gcs_server")  # what Ray's processes are called, or begin with

logger = logging.getLogger("recrl.sweep")


@dataclass(frozen=True)
class Service:
    """One of Ray's services.

    Attributes:
        name: what people call it.
        host: the address that it listens at.
        port: its port.
    """

    name: str
    host: str
    port: int

    def is_there(self) -> bool:
        """Whether something takes a connection there."""
        try:
            socket.create_connection((self.host, self.port), timeout=CONNECT_SECONDS).close()
        except OSError:
            return False
        return True

    @property
    def patience(self) -> float:
        """For how many seconds it may be away."""
        return OWN_PATIENCE_SECONDS if self.host.startswith("127.") else OTHERS_PATIENCE_SECONDS

    @property
    def obituary(self) -> str:
        """What is said of its end."""
        return (
            f"Ray's {self.name} at {self.host}:{self.port} has died; nothing that was saved is lost, "
            "and the same launch goes on"
        )


class LostServices:
    """What a launch asks whether its cluster still works.

    Attributes:
        problem: a sentence about the service that is gone, or empty.
    """

    def __init__(self) -> None:
        self.problem = ""
        self._services: tuple[Service, ...] = ()

    def check(self) -> None:
        """Raise if a service is gone.

        Raises:
            ClusterError: it is.
        """
        if self.problem:
            raise ClusterError(self.problem)

    def any_is_gone(self) -> bool:
        """Whether a service takes no connection right now."""
        return not all(service.is_there() for service in self._services)

    @contextmanager
    def watched(self, cluster: AbstractContextManager[None]) -> Iterator[None]:
        """Look after a cluster's services for as long as it is used, and see to it that it can be left.

        Without its services Ray may keep a thread of this process for ever. So a launch that has not left the
        cluster ``LEAVE_SECONDS`` after they died is ended, like one that was killed: the files allow it.

        Args:
            cluster: the connection to it.
        """
        with beside(self._look, name="Ray's services"), cluster:
            self._services = _services()
            try:
                yield
            finally:
                self._services = ()  # from now on they may end

    def _look(self, over: threading.Event) -> None:
        seen: dict[Service, float] = {}
        while not self.problem and not over.wait(LOOK_SECONDS):
            for service in self._services:
                if service.is_there():
                    seen[service] = time.monotonic()
                elif time.monotonic() - seen.setdefault(service, time.monotonic()) > service.patience:
                    self.problem = service.obituary
        if self.problem and not over.wait(LEAVE_SECONDS):
            logger.error("%s", self.problem)
            if token := os.environ.get(TOKEN_VARIABLE):
                end_processes(Path(token).parent)
            os._exit(ExitCode.CANNOT_RUN)


def end_processes(folder: Path) -> None:
    """Kill the processes of a local cluster that are still there: Ray's agents outlive a killed driver.

    They are known by the logs that they have open, which lie in the cluster's own folder.

    Args:
        folder: that folder.
    """
    for descriptors in Path("/proc").glob("[0-9]*/fd"):
        number = int(descriptors.parent.name)
        with suppress(OSError):
            name = (descriptors.parent / "comm").read_text()
            if name.startswith(SERVICES) and any(
                _is_below(it, folder / RAY_FOLDER) for it in descriptors.iterdir()
            ):
                os.kill(number, signal.SIGKILL)


def _is_below(link: Path, folder: Path) -> bool:
    with suppress(OSError):
        return os.readlink(link).startswith(f"{folder}/")
    return False


def _services() -> tuple[Service, ...]:
    """The head service, and the node service of this machine, of the cluster that this process uses."""
    context = ray.get_runtime_context()
    nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    here = next(node for node in nodes if node["NodeID"] == context.get_node_id())
    host, _, port = context.gcs_address.rpartition(":")
    return (
        Service("head service (GCS)", host, int(port)),
        Service("node service (raylet)", here["NodeManagerAddress"], here["NodeManagerPort"]),
    )
