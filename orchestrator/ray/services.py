"""Watch the services that a Ray cluster depends on.

Ray does not report their death. With a dead node service (raylet) Tune waits without end; with a dead head
service (GCS) Ray ends the whole process after a minute, in C++. So a thread of this process regularly
connects to both. A service that accepts a connection counts as alive; Ray itself checks for hanging services.
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

from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.errors import ClusterError
from recrl.orchestrator.exit_codes import ExitCode

SERVICE_CHECK_SECONDS = 3.0  # between two checks
CONNECT_SECONDS = 2.0
OWN_PATIENCE_SECONDS = 5.0  # services of recrl's own cluster are not restarted
OTHERS_PATIENCE_SECONDS = 40.0  # below the minute after which Ray ends a process without a head service
LEAVE_SECONDS = 10.0  # time for a launch to finish afterwards

RAY_FOLDER = "ray"  # in the folder of a local cluster
SERVICES = ("ray::", "raylet", "gcs_server")  # names of Ray's processes, or their beginnings

logger = logging.getLogger("recrl.sweep")


@dataclass(frozen=True)
class Service:
    """One of Ray's services.

    Attributes:
        name: for messages.
        host: its address.
        port: its port.
    """

    name: str
    host: str
    port: int

    def is_there(self) -> bool:
        """Whether it accepts a connection."""
        try:
            socket.create_connection((self.host, self.port), timeout=CONNECT_SECONDS).close()
        except OSError:
            return False
        return True

    @property
    def patience(self) -> float:
        """Seconds for which it may be unreachable."""
        return OWN_PATIENCE_SECONDS if self.host.startswith("127.") else OTHERS_PATIENCE_SECONDS

    @property
    def message(self) -> str:
        """Describe its end."""
        return (
            f"Ray's {self.name} at {self.host}:{self.port} has died; nothing that was saved is "
            "lost, and the same launch continues"
        )


class LostServices:
    """State of a cluster's services, for the launch.

    Attributes:
        problem: a sentence about a dead service, or empty.
    """

    def __init__(self) -> None:
        self.problem = ""
        self._services: tuple[Service, ...] = ()
        self._folder: Path | None = None

    def check(self) -> None:
        """Raise an error if a service has died.

        Raises:
            ClusterError: a service has died.
        """
        if self.problem:
            raise ClusterError(self.problem)

    def any_is_gone(self) -> bool:
        """Whether a service accepts no connection at the moment."""
        return not all(service.is_there() for service in self._services)

    @contextmanager
    def watched(self, cluster: AbstractContextManager[Path | None]) -> Iterator[None]:
        """Watch a cluster's services until the end of the context, and make sure that it can be left.

        Without its services Ray may block a thread of this process without end. So a launch that has not left
        the cluster ``LEAVE_SECONDS`` after their death is ended, like a killed launch; the files remain
        valid.

        Args:
            cluster: the connection to it; gives the folder of a local cluster.
        """
        with background_thread(self._look, name="Ray's services"), cluster as self._folder:
            self._services = _services()
            try:
                yield
            finally:
                self._services = ()  # from now on they may end

    def _look(self, over: threading.Event) -> None:
        seen: dict[Service, float] = {}
        while not self.problem and not over.wait(SERVICE_CHECK_SECONDS):
            for service in self._services:
                if service.is_there():
                    seen[service] = time.monotonic()
                elif time.monotonic() - seen.setdefault(service, time.monotonic()) > service.patience:
                    self.problem = service.message
        if self.problem and not over.wait(LEAVE_SECONDS):
            logger.error("%s", self.problem)
            if self._folder is not None:
                end_processes(self._folder)
            os._exit(ExitCode.CANNOT_RUN)


def end_processes(folder: Path) -> None:
    """Kill the remaining processes of a local cluster: Ray's agents outlive a killed driver.

    They are identified by their open logs, which are in the cluster's own folder.

    Args:
        folder: the cluster's folder.
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
    """Return the head service, and this machine's node service, of the connected cluster."""
    context = ray.get_runtime_context()
    nodes: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    here = next(node for node in nodes if node["NodeID"] == context.get_node_id())
    host, _, port = context.gcs_address.rpartition(":")
    return (
        Service("head service (GCS)", host, int(port)),
        Service("node service (raylet)", here["NodeManagerAddress"], here["NodeManagerPort"]),
    )
