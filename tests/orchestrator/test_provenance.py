"""Provenance says what is needed and nothing that is private."""

import getpass
import json
import os
import re
import socket
import subprocess
from pathlib import Path

import pytest

from recrl.orchestrator.provenance.versions import collect, git_state, package_versions


def _git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    done = subprocess.run(
        ["git", *identity, "-C", str(folder), *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def _repository(folder: Path) -> str:
    _git(folder, "init", "-q")
    (folder / "a.txt").write_text("one\n")
    _git(folder, "add", "a.txt")
    _git(folder, "commit", "-q", "-m", "one")
    return _git(folder, "rev-parse", "HEAD")


def test_a_clean_repository_gives_its_commit(tmp_path: Path) -> None:
    commit = _repository(tmp_path)
    (tmp_path / "untracked.txt").write_text("runs/ and the like\n")
    assert git_state(tmp_path) == {"commit": commit, "dirty": False}


def test_a_changed_tracked_file_makes_it_dirty(tmp_path: Path) -> None:
    commit = _repository(tmp_path)
    (tmp_path / "a.txt").write_text("two\n")
    assert git_state(tmp_path) == {"commit": commit, "dirty": True}


def test_a_name_that_is_not_utf_8_is_no_obstacle(tmp_path: Path) -> None:
    _repository(tmp_path)
    odd = os.fsencode(tmp_path) + b"/caf\xe9.txt"
    Path(os.fsdecode(odd)).write_text("one\n")
    _git(tmp_path, "add", ".")
    _git(tmp_path, "commit", "-q", "-m", "two")
    _git(tmp_path, "config", "core.quotePath", "false")
    Path(os.fsdecode(odd)).write_text("two\n")
    state = git_state(tmp_path)
    assert state is not None
    assert state["dirty"]


def test_outside_a_repository_there_is_no_commit(tmp_path: Path) -> None:
    assert git_state(tmp_path) is None
    assert collect(tmp_path)["project"] is None


def test_in_a_deleted_working_directory_there_is_no_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "deleted").mkdir()
    monkeypatch.chdir(tmp_path / "deleted")
    (tmp_path / "deleted").rmdir()
    assert collect()["project"] is None


def test_without_git_there_is_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _repository(tmp_path)
    monkeypatch.setenv("PATH", "")
    git_state.cache_clear()
    assert git_state(tmp_path) is None


def test_the_versions_of_what_results_depend_on_are_there(tmp_path: Path) -> None:
    packages = collect(tmp_path)["packages"]
    assert {"numpy", "torch", "gymnasium", "minigrid", "ray", "mlflow", "mujoco"} <= set(packages)
    assert "pytest" not in packages


def test_packages_that_are_not_installed_are_left_out() -> None:
    assert package_versions(["no-such-distribution-1b2c"]) == {}


def test_nothing_private_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "hunter2-secret")
    text = json.dumps(collect(tmp_path), allow_nan=False)
    for private in ("hunter2-secret", str(tmp_path), str(Path.home())):
        assert private not in text
    # A machine may be called "vm", which is part of the name of a package, llvmlite.
    assert not re.search(rf"(?<![A-Za-z]){re.escape(socket.gethostname())}(?![A-Za-z])", text)
    if getpass.getuser() != "root":
        assert getpass.getuser() not in text
    assert os.getcwd() not in text
