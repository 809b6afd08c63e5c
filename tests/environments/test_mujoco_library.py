"""The types declared for MuJoCo's library are those of its headers; another version is refused."""

import ctypes
import re
import tomllib
from pathlib import Path
from typing import Any

import mujoco
import pytest

from recrl.environments.simulation import mujoco_library
from recrl.environments.simulation.mujoco_batch import _Batch

WHAT_TO_DO = """\
MuJoCo has changed its C interface. In environments/simulation/mujoco_library.py:
1. Correct the types that differ from MuJoCo's headers, and the calls in mujoco_batch.py.
2. mj_updateSleep is in no header: read its declaration in MuJoCo's source.
3. Can mujoco.batch.Batch put bodies back to sleep and run mj_rnePostConstraint now? Then use it instead.
Then run tests/environments, and set TESTED and RANGE there and the range in pyproject.toml.
"""
HEADERS = "".join(
    path.read_text() for path in sorted((Path(mujoco.__file__).parent / "include" / "mujoco").glob("*.h"))
)
CODE = re.sub(r"//[^\n]*", "", HEADERS)


def kind(declared: Any) -> str:
    """Return what the processor sees of a type of ctypes."""
    plain = {None: "void", ctypes.c_int: "int", ctypes.c_bool: "bool"}
    return plain.get(declared, "pointer")


def kind_in_c(text: str) -> str:
    """Return the same of a C type, without the name of a parameter."""
    if "*" in text or text == "mjfBatchFunc":
        return "pointer"
    alias = re.search(rf"typedef (\w+) {text};", CODE)
    return (alias[1] if alias else text).removeprefix("_").lower()  # _Bool is C's name of bool


def c_types(parameters: str) -> list[str]:
    """Return the kinds of named parameters."""
    return [kind_in_c(it.strip().rpartition(" ")[0]) for it in parameters.split(",")]


@pytest.mark.parametrize("name", sorted(mujoco_library.SIGNATURES.keys() - mujoco_library.WITHOUT_HEADER))
def test_a_function_has_the_types_of_the_header(name: str) -> None:
    found = re.search(rf"MJAPI ([\w\s*]+?)\b{name}\(([^)]*)\);", CODE)
    assert found is not None, WHAT_TO_DO
    result, arguments = mujoco_library.SIGNATURES[name]
    declared = [kind(result), *map(kind, arguments)]
    assert declared == [kind_in_c(found[1].strip()), *c_types(found[2])], WHAT_TO_DO


def test_the_configuration_has_the_fields_of_the_header() -> None:
    found = re.search(r"typedef struct mjBatchConfig_ \{(.*?)\}", CODE, re.DOTALL)
    assert found is not None, WHAT_TO_DO
    fields = [line.split() for line in found[1].split(";") if line.strip()]
    declared = [(kind(field[1]), field[0]) for field in mujoco_library.BatchConfig._fields_]
    assert declared == [(kind_in_c(type_), name) for type_, name in fields], WHAT_TO_DO


def test_a_function_of_apply_has_the_types_of_the_header() -> None:
    found = re.search(r"typedef void \(\*mjfBatchFunc\)\(([^)]*)\)", CODE)
    assert found is not None, WHAT_TO_DO
    assert [kind(it) for it in mujoco_library.BatchFunction._argtypes_] == c_types(found[1]), WHAT_TO_DO


def test_mujoco_reads_the_configuration_that_it_is_given() -> None:
    batch = _Batch(mujoco.MjModel.from_xml_string("<mujoco/>"), 4, 3)
    loaded = mujoco_library.library()
    assert (loaded.mjb_nthread(batch.address), loaded.mjb_persistent(batch.address)) == (3, 1), WHAT_TO_DO


def test_the_project_declares_the_version_that_was_tested() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    major, minor = mujoco_library.TESTED
    assert f"mujoco>={major}.{minor},<{major}.{minor + 1}" == mujoco_library.RANGE
    assert mujoco_library.RANGE in project["project"]["dependencies"]


@pytest.mark.parametrize("version", ["3.9.0", "4.1.0", "5.0.0"])
def test_another_version_is_refused(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mujoco, "__version__", version)
    with pytest.raises(ImportError) as error:
        mujoco_library.library.__wrapped__()  # as if it had not been loaded yet
    assert str(error.value) == (
        f"MuJoCo {version} may have other types in C than recrl uses; install a version that it was tested "
        "with: pip install 'mujoco>=4.0,<4.1'"
    )
