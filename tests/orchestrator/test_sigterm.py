"""A worker process that gets SIGTERM ends with SystemExit, whatever its trial does with the interruption."""

import os
import signal
from collections.abc import Callable

import pytest

from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.ray.sigterm import noticing_sigterm


def interrupted() -> None:
    os.kill(os.getpid(), signal.SIGTERM)
    raise AssertionError("the signal interrupts")


def swallowed() -> None:
    try:
        interrupted()
    except SystemExit:
        os.kill(os.getpid(), signal.SIGTERM)  # a second signal interrupts nothing


def replaced() -> None:
    try:
        interrupted()
    except SystemExit as error:
        raise StorageError("the object store is down") from error


@pytest.mark.parametrize("body", [interrupted, swallowed, replaced])
def test_sigterm_is_noticed_whatever_the_body_does_with_it(body: Callable[[], None]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as caught, noticing_sigterm() as got_sigterm:
        try:
            assert not got_sigterm()
            body()
        finally:
            assert got_sigterm()
    assert caught.value.code == 1
    assert signal.getsignal(signal.SIGTERM) is before


def test_without_sigterm_nothing_is_raised_and_the_handler_of_before_is_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with noticing_sigterm() as got_sigterm:
        assert signal.getsignal(signal.SIGTERM) is not before
    assert not got_sigterm()
    assert signal.getsignal(signal.SIGTERM) is before
