"""The private names of Ray that recrl uses, because Ray has no public switch for what they do.

Ray may change them in any release. So ``pyproject.toml`` bounds Ray's version, a missing name is a sentence
that says which versions to install, and ``tests/orchestrator/test_ray_private_api.py`` says what to do when a
new Ray is to be allowed.
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

NEWEST = (2, 60)  # Ray that these names were checked with
RANGE = "ray[tune]>=2.48,<2.61"
NAMES = (
    "parameter.RayParams",
    "ray_constants.ENABLE_RAY_CLUSTER",
    "services.ConsolePopen",
    "worker._worker_logs_enabled",
)
# Processes that ``ray start`` can leave out and ``ray.init`` cannot: one copies the workers' output to the
# driver, which does not want it (trials have logs), the other asks for machines where there are none.
LEFT_OUT: Mapping[str, Any] = {"include_log_monitor": False, "no_monitor": True}

logger = logging.getLogger("recrl.sweep")


def require_known_ray() -> None:
    """Check that Ray has the names used here; warn where it is newer than they were checked with.

    Raises:
        ClusterError: it lacks one.
    """
    missing = [name for name in NAMES if not hasattr(*_place(name))]
    if missing:
        raise ClusterError(
            f"Ray {ray.__version__} has no ray._private.{missing[0]}, which recrl uses; install a version "
            f"that it was tested with: pip install '{RANGE}'"
        )
    if tuple(map(int, ray.__version__.split(".")[:2])) > NEWEST:
        logger.warning("Ray %s is newer than recrl was tested with: %s", ray.__version__, RANGE)


def quiet_driver() -> None:
    """Keep Ray from printing a paragraph about every dead process."""
    setattr(*_place("worker._worker_logs_enabled"), False)


@contextmanager
def own_sessions() -> Iterator[None]:
    """Start Ray's processes in sessions of their own, so that Ctrl-C reaches the driver alone.

    They still end with this process, however it ends: Ray asks the kernel for that.
    """
    popen = getattr(*_place("services.ConsolePopen"))
    with _replaced("services.ConsolePopen", partial(popen, start_new_session=True)):
        yield


@contextmanager
def fewer_processes() -> Iterator[None]:
    """Start no process of LEFT_OUT; where a cluster is there already, none is started anyhow."""
    whole = getattr(*_place("parameter.RayParams"))
    known = inspect.signature(whole).parameters
    fewer = partial(whole, **{name: value for name, value in LEFT_OUT.items() if name in known})
    with _replaced("parameter.RayParams", fewer):
        yield


@contextmanager
def at_loopback() -> Iterator[None]:
    """Let Ray's services listen at this machine's own address only.

    Where Ray is told such an address it takes the machine's outer one instead, unless it believes that there
    can be no cluster on this system.
    """
    with _replaced("ray_constants.ENABLE_RAY_CLUSTER", False):
        yield


@contextmanager
def _replaced(name: str, value: object) -> Iterator[None]:
    """Replace a private name of Ray for a while."""
    module, attribute = _place(name)
    before = getattr(module, attribute)
    setattr(module, attribute, value)
    try:
        yield
    finally:
        setattr(module, attribute, before)


def _place(name: str) -> tuple[Any, str]:
    """Return the module below ``ray._private`` and the name in it."""
    module, _, attribute = name.partition(".")
    return getattr(ray._private, module, None), attribute
