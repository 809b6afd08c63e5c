"""The private names of Ray are there, and one that is missing is a sentence that says what to install."""

import tomllib
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import ray

from recrl.orchestrator.errors import ClusterError
from recrl.orchestrator.ray import clusters, private_api

WHAT_TO_DO = """\
Ray has changed a private name that recrl uses. In orchestrator/ray/private_api.py, for each name:
1. own_sessions: how does Ray start its processes now? Ctrl-C must not reach them (test_ray_services.py).
2. fewer_processes: may be dropped; then a local cluster has two idle processes more.
3. at_loopback: does ray.init(_node_ip_address="127.0.0.1") keep to it now? If so, drop it. Never drop it
   otherwise: Ray's services would listen on the network (test_ray_services.py).
4. quiet_driver: may be dropped; then Ray prints a paragraph about every dead process.
Then run tests/orchestrator/test_ray_*.py, and set NEWEST and RANGE there and the range in pyproject.toml.
"""


@pytest.mark.parametrize("name", private_api.NAMES)
def test_the_installed_ray_has_the_names(name: str) -> None:
    module, attribute = private_api._owner_of(name)
    assert hasattr(module, attribute), WHAT_TO_DO


def test_the_installed_ray_has_the_parameters_that_are_set() -> None:
    import inspect  # noqa: PLC0415

    known = inspect.signature(ray._private.parameter.RayParams).parameters
    assert known.keys() >= private_api.LEFT_OUT.keys(), WHAT_TO_DO


def test_the_project_declares_the_range_that_was_tested() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    assert private_api.RANGE in project["project"]["dependencies"]
    major, minor = private_api.NEWEST
    assert private_api.RANGE.endswith(f",<{major}.{minor + 1}")


def test_a_missing_name_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(ray._private.services, "ConsolePopen")
    with pytest.raises(ClusterError) as caught:
        private_api.require_known_ray()
    assert str(caught.value) == (
        f"Ray {ray.__version__} has no ray._private.services.ConsolePopen, which recrl uses; install a "
        "version that it was tested with: pip install 'ray[tune]>=2.59,<2.61'"
    )


def test_a_ray_that_starts_without_a_token_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "_connection", lambda *_, **__: nullcontext())
    with (
        pytest.raises(ClusterError, match=r"started without a token, .*: pip install 'ray\[tune\]>=2\.59"),
        clusters.local_cluster(num_cpus=1),
    ):
        pass


def test_a_newer_ray_is_used_with_a_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    private_api.require_known_ray()
    assert caplog.messages == []
    monkeypatch.setattr(ray, "__version__", "2.61.0")
    private_api.require_known_ray()
    assert caplog.messages == ["Ray 2.61.0 is newer than the tested versions: ray[tune]>=2.59,<2.61"]


@pytest.mark.parametrize(
    ("patch", "name"),
    [
        (private_api.own_sessions, "services.ConsolePopen"),
        (private_api.fewer_processes, "parameter.RayParams"),
        (private_api.at_loopback, "ray_constants.ENABLE_RAY_CLUSTER"),
    ],
)
def test_a_patch_lasts_as_long_as_its_context(patch: Any, name: str) -> None:
    place: Any = private_api._owner_of(name)
    before = getattr(*place)
    with pytest.raises(KeyError), patch():
        assert getattr(*place) is not before
        raise KeyError
    assert getattr(*place) is before


def test_processes_start_in_sessions_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray._private.services, "ConsolePopen", SimpleNamespace)
    with private_api.own_sessions():
        made: Any = ray._private.services.ConsolePopen(args=["ray"])
        assert made.start_new_session
