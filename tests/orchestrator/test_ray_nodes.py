"""A launch on somebody else's cluster is refused in one sentence where it cannot go well."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import ClusterError, GridError, RecrlError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.provenance.own_package import copy_package, source_digest
from recrl.orchestrator.ray.clusters import existing_cluster
from recrl.orchestrator.ray.nodes import ACCESS_PROBLEM, differences

HERE = {
    "Python": "3.11.7",
    "recrl": "0.1.0",
    "ray": "2.60.0",
    "recrl's source": "0123456789",
    ACCESS_PROBLEM: "",
}
GRID = """\
name: small
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag]
methods: [none]
seeds: 1
run: {total_steps: 160, num_envs: 4, rollout_steps: 10}
"""


def test_equal_nodes_do_not_differ() -> None:
    assert differences("10.0.0.1", HERE, HERE, "/r/s") == []


def test_every_difference_of_a_node_is_named_with_what_is_here() -> None:
    there = {**HERE, "Python": "3.11.9", "recrl": "", "recrl's source": ""}
    assert differences("10.0.0.1", HERE, there, "/r/s") == [
        "10.0.0.1 has Python 3.11.9 (here 3.11.7), recrl missing (here 0.1.0), "
        "recrl's source missing (here 0123456789)"
    ]


def test_a_node_that_does_not_see_the_results_is_named() -> None:
    there = {**HERE, ACCESS_PROBLEM: ", which must be on a file system that all nodes share"}
    assert differences("10.0.0.1", HERE, there, "/r/s") == [
        "10.0.0.1 does not see /r/s, which must be on a file system that all nodes share"
    ]


def test_a_shipped_package_is_complete_and_comes_first(tmp_path: Path) -> None:
    package, metadata = copy_package(tmp_path)
    code = """
import importlib.metadata
from recrl.orchestrator import grid
from recrl.orchestrator.provenance import own_package
import recrl.environments.rivergrid.grid_world
print(grid.__file__)
print(own_package.source_digest())
print(importlib.metadata.version("recrl"), importlib.metadata.distribution("recrl").locate_file("").resolve())
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": f"{package.parent}:{metadata.parent}"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    file, digest, found = done.stdout.splitlines()
    assert file == str(package / "orchestrator/grid/__init__.py")
    assert digest == source_digest()
    assert found.endswith(str(metadata.parent.resolve()))


def test_ray_client_is_refused() -> None:
    with (
        pytest.raises(
            RecrlError,
            match=r"^cannot use the Ray cluster at ray://head:10001: the driver must run on a node of the "
            r"cluster, not through Ray Client; launch there with --address auto, or make this machine a ",
        ) as caught,
        existing_cluster("ray://head:10001"),
    ):
        pass
    assert type(caught.value) is RecrlError  # a wrong argument, and not a cluster that is away


@pytest.mark.parametrize(
    ("named", "error", "sentence"),
    [
        ("ray://head:10001", RecrlError, r"of RAY_ADDRESS, ray://head:10001: it must be host:port of a "),
        ("127.0.0.1:1", ClusterError, r"of RAY_ADDRESS, 127\.0\.0\.1:1: .*refused; is it running"),
    ],
)
def test_the_address_of_the_environment_is_checked_before_ray_uses_it(
    named: str, error: type[Exception], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", named)
    with pytest.raises(error, match=f"^cannot use the Ray cluster {sentence}"), existing_cluster("auto"):
        pass
    assert os.environ["RAY_ADDRESS"] == named


def test_an_address_of_ray_client_is_a_wrong_argument(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "grid.yaml").write_text(GRID)
    monkeypatch.chdir(tmp_path)
    assert main(["launch", "grid.yaml", "--address", "ray://head:10001"]) == ExitCode.WRONG_INPUT
    assert "not through Ray Client" in capsys.readouterr().err


def test_an_object_store_is_no_results_folder(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["launch", "grid.yaml", "--root", "s3://bucket/runs"])
    assert end.value.code == ExitCode.WRONG_INPUT
    assert "an object store is given by --storage, got 's3://bucket/runs'" in capsys.readouterr().err


def test_nothing_is_shipped_nowhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "grid.yaml").write_text(GRID)
    command = ["launch", str(tmp_path / "grid.yaml"), "--root", str(tmp_path / "runs"), "--no-mlflow"]
    assert main([*command, "--ship-package"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == "recrl-sweep: --ship-package: needs an --address to ship to\n"


def test_teachers_think_where_the_grid_says() -> None:
    assert parse_grid(GRID.encode(), source="grid.yaml").resources.teacher == "service"
    grid = parse_grid((GRID + "resources: {teacher: inline}\n").encode(), source="grid.yaml")
    assert grid.resources.teacher == "inline"


def test_custom_resources_come_from_the_grid() -> None:
    grid = parse_grid(
        (GRID + "resources: {custom_per_trial: {big_memory: 1}}\n").encode(), source="grid.yaml"
    )
    assert grid.resources.custom_per_trial == {"big_memory": 1.0}


@pytest.mark.parametrize(
    ("custom", "sentence"),
    [
        ("[big]", 'must be a mapping of names to amounts, got ["big"]'),
        ("{CPU: 2}", "must not name CPU; see cpus_per_trial and gpus_per_trial"),
        ("{big: 0}", "must be amounts above 0 and at most 1e6, got 0 of big"),
        ("{'a b': 1}", "must have names of letters, digits and _ . : - only, got 'a b'"),
    ],
)
def test_wrong_custom_resources_are_a_sentence(custom: str, sentence: str) -> None:
    with pytest.raises(GridError) as error:
        parse_grid((GRID + f"resources: {{custom_per_trial: {custom}}}\n").encode(), source="grid.yaml")
    assert error.value.problems == [f"grid.yaml:7: resources.custom_per_trial: {sentence}"]
