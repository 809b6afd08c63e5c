"""A worker process that gets SIGTERM ends with SystemExit, whatever its trial does with the interruption."""

import os
import signal
from collections.abc import Callable

import pytest

from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.ray.sigterm import noticing_sigterm

Log = Callable[[str], None]


def signalled(log: Log) -> None:
    os.kill(os.getpid(), signal.SIGTERM)
    log("not interrupted")


def swallowing(log: Log) -> None:
    try:
        signalled(log)
    except SystemExit:
        log("swallowed")
        signalled(log)  # only the first signal interrupts


def replacing(log: Log) -> None:
    try:
        signalled(log)
    except SystemExit as error:
        raise StorageError("the object store is down") from error


@pytest.mark.parametrize(
    ("body", "expected"),
    [(signalled, []), (swallowing, ["swallowed", "not interrupted"]), (replacing, [])],
)
def test_sigterm_is_noticed_whatever_the_body_does_with_it(
    body: Callable[[Log], None], expected: list[str]
) -> None:
    before, log = signal.getsignal(signal.SIGTERM), []
    with pytest.raises(SystemExit) as caught, noticing_sigterm() as got_sigterm:
        log.append(str(got_sigterm()))
        try:
            body(log.append)
        finally:
            log.append(str(got_sigterm()))
    assert log == ["False", *expected, "True"]
    assert caught.value.code == 1
    assert signal.getsignal(signal.SIGTERM) is before


def test_without_sigterm_nothing_is_raised_and_the_handler_of_before_is_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with noticing_sigterm() as got_sigterm:
        assert signal.getsignal(signal.SIGTERM) is not before
    assert not got_sigterm()
    assert signal.getsignal(signal.SIGTERM) is before
