"""Private names of Ray that recrl uses, because Ray has no public setting for their purpose.

Ray may change them in any release. So ``pyproject.toml`` bounds Ray's version, and the error for a missing
name lists the versions to install. ``tests/orchestrator/test_ray_private_api.py`` describes how to allow a
new version.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import ray

from recrl.orchestrator.errors import ClusterError

NEWEST = (2, 60)  # version of Ray that these names were checked with
RANGE = "ray[tune]>=2.59,<2.61"
NAMES = (
    "parameter.RayParams",
    "ray_constants.ENABLE_RAY_CLUSTER",
    "services.ConsolePopen",
    "worker._worker_logs_enabled",
)
# Processes that ``ray start`` can omit and ``ray.init`` cannot. One copies the workers' output to the driver,
# which does not need it (trials have logs). The other requests machines from an autoscaler.
LEFT_OUT: Mapping[str, Any] = {"include_log_monitor": False, "no_monitor": True}

logger = logging.getLogger("recrl.sweep")


def require_known_ray() -> None:
    """Check that Ray has the names used here; warn if it is newer than the checked version.

    Raises:
        ClusterError: a name is missing.
    """
    missing = [name for name in NAMES if not hasattr(*_owner_of(name))]
    if missing:
        raise ClusterError(
            f"Ray {ray.__version__} has no ray._private.{missing[0]}, which recrl uses; install a version "
            f"that it was tested with: pip install '{RANGE}'"
        )
    if tuple(map(int, ray.__version__.split(".")[:2])) > NEWEST:
        logger.warning("Ray %s is newer than the tested versions: %s", ray.__version__, RANGE)


def quiet_driver() -> None:
    """Keep Ray from printing a paragraph about every dead process."""
    setattr(*_owner_of("worker._worker_logs_enabled"), False)


@contextmanager
def own_sessions() -> Iterator[None]:
    """Start Ray's processes in sessions of their own, so that Ctrl-C reaches the driver only.

    They still end with this process, because Ray requests that from the kernel.
    """
    popen = getattr(*_owner_of("services.ConsolePopen"))
    with _replaced("services.ConsolePopen", partial(popen, start_new_session=True)):
        yield


@contextmanager
def fewer_processes() -> Iterator[None]:
    """Do not start the processes of LEFT_OUT; an existing cluster starts none anyway."""
    whole = getattr(*_owner_of("parameter.RayParams"))
    known = inspect.signature(whole).parameters
    fewer = partial(whole, **{name: value for name, value in LEFT_OUT.items() if name in known})
    with _replaced("parameter.RayParams", fewer):
        yield


@contextmanager
def at_loopback() -> Iterator[None]:
    """Let Ray's services listen at the loopback address only.

    Ray replaces a loopback address by the machine's outer one, unless clusters are disabled on the system.
    """
    with _replaced("ray_constants.ENABLE_RAY_CLUSTER", False):
        yield


@contextmanager
def _replaced(name: str, value: object) -> Iterator[None]:
    """Replace a private name of Ray until the end of the context."""
    module, attribute = _owner_of(name)
    before = getattr(module, attribute)
    setattr(module, attribute, value)
    try:
        yield
    finally:
        setattr(module, attribute, before)


def _owner_of(name: str) -> tuple[Any, str]:
    """Return the module below ``ray._private`` and the name in it."""
    module, _, attribute = name.partition(".")
    return getattr(ray._private, module, None), attribute
