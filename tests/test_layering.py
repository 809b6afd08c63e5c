"""Who may import whom: the order of the packages, and one adapter for each third-party system."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("orchestrator", "agents", "environments", "teachers", "analysis")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
NAMES = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in FILES]
# Package files that do more than hold a docstring: Gymnasium imports this package to find the tasks in it.
IMPORTING_PACKAGES = {
    "environments.velocity.__init__": [
        "recrl.environments.velocity.registration",
        "recrl.environments.velocity.registration.register_velocity",
    ]
}

# For each package, what its modules may import of ours; a package's own modules are always allowed.
ALLOWED = {
    "environments": (),
    "teachers": ("recrl.environments.cmdp", "recrl.environments.plugins"),
    "agents": ("recrl.environments",),
    "analysis": (
        "recrl.environments",
        "recrl.orchestrator.archives",
        "recrl.orchestrator.errors",
        "recrl.orchestrator.foreign",
        "recrl.orchestrator.origins",
        "recrl.orchestrator.phase_totals",
        "recrl.orchestrator.redaction",
        "recrl.orchestrator.row_files",
        "recrl.orchestrator.small_files",
        "recrl.orchestrator.spec",
        "recrl.orchestrator.store",
        "recrl.orchestrator.tracking_reader",
        "recrl.orchestrator.validation",
        "recrl.teachers",
    ),
    "orchestrator": ("recrl.agents", "recrl.environments", "recrl.teachers"),
}
# Third-party modules that only some of our modules may import.
ADAPTERS = {
    "PIL": r"orchestrator\.videos",
    "av": r"orchestrator\.videos",
    "torch": r"agents\..*|orchestrator\.(trial|ray_executor)",
    "gymnasium": r"environments\..*|agents\..*",
    "minigrid": r"environments\..*",
    "mujoco": r"environments\..*",
    "numba": r"environments\.(machine_code|code_digest)",
    "ray": r"orchestrator\.(ray_executor|ray_nodes|ray_services|teacher_service)",
    "mlflow": r"orchestrator\.tracking(_reader)?",
    "sqlalchemy": r"orchestrator\.tracking_database",
    "adbc_driver_sqlite": r"orchestrator\.tracking_database",
    "matplotlib": r"analysis\..*",
    "yaml": r"orchestrator\.located_yaml",
    "rich": r"orchestrator\.(commands|display|output)",
    "safetensors": r"orchestrator\.checkpoint",
    "fsspec": r"orchestrator\.object_store",
}
# The order inside the orchestrator: no module may import one that stands in a later line.
LAYERS = (
    (
        "archives",
        "beside",
        "errors",
        "exit_codes",
        "located_yaml",
        "locks",
        "own_package",
        "phase_totals",
        "provenance",
        "redaction",
        "scratch",
        "small_files",
        "validation",
    ),
    ("foreign", "spec", "checkpoint", "heartbeat", "object_store", "row_files"),
    ("store",),
    ("origins",),
    (
        "grid_file",
        "status",
        "tracking_database",
        "tracking_points",
        "tracking_snapshot",
        "plan",
        "rollout_check",
        "trial",
        "videos",
        "remote_trial",
        "remote_sweep",
    ),
    ("grid", "executors", "frozen", "ray_nodes", "ray_services", "tracking", "teacher_service"),
    ("sweep", "ray_executor", "refresh", "tracking_mirror", "tracking_reader", "tracking_ui"),
    ("display", "output"),
    ("commands",),
    ("cli",),
)


def imports(tree: ast.AST, *, at_run_time: bool = False) -> Iterator[str]:
    """Every dotted name that is imported; with ``at_run_time``, without those for type checkers only."""
    for node in ast.iter_child_nodes(tree):
        if at_run_time and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module is not None
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        else:
            yield from imports(node, at_run_time=at_run_time)


def package(path: Path) -> str:
    """The folder at the top that a file is in, however deep."""
    return path.relative_to(ROOT).parts[0]


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), filename=str(path))


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_imports_of_ours_point_one_way(path: Path) -> None:
    own = package(path)
    allowed = (f"recrl.{own}", *ALLOWED[own])
    # "from recrl.environments import plugins" yields the package too: what counts is the module
    ours = {name for name in imports(parsed(path)) if name.count(".") >= 2 and within(name, "recrl")}
    if own == "orchestrator" and path.stem == "commands":
        allowed += ("recrl.analysis",)
    assert sorted(name for name in ours if not any(within(name, package) for package in allowed)) == []


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_each_third_party_system_has_its_adapter(path: Path) -> None:
    name = dotted(path)
    used = {module.partition(".")[0] for module in imports(parsed(path), at_run_time=True)}
    wrong = [
        system for system, allowed in ADAPTERS.items() if system in used and not re.fullmatch(allowed, name)
    ]
    assert wrong == []


def test_students_do_not_know_teachers_and_nobody_below_knows_the_orchestrator() -> None:
    for path in FILES:
        if package(path) in ("environments", "agents", "teachers"):
            names = set(imports(parsed(path)))
            assert not any(within(name, "recrl.orchestrator") for name in names), path
            assert package(path) == "teachers" or not any(within(name, "recrl.teachers") for name in names)


def test_the_orchestrator_has_layers() -> None:
    height = {stem: level for level, stems in enumerate(LAYERS) for stem in stems}
    stems = {path.stem for path in FILES if package(path) == "orchestrator"} - {"__init__"}
    assert set(height) == stems, "every module of orchestrator/ has its place in LAYERS"
    for path in FILES:
        if package(path) == "orchestrator" and path.stem != "__init__":
            for name in imports(parsed(path), at_run_time=True):
                parts = name.split(".")
                if parts[:2] == ["recrl", "orchestrator"] and len(parts) > 2:
                    assert height[parts[2]] <= height[path.stem], f"{path.stem} imports {parts[2]}"


def test_no_import_is_relative() -> None:
    for path in FILES:
        for node in ast.walk(parsed(path)):
            assert not (isinstance(node, ast.ImportFrom) and node.level), path


def test_files_of_subpackages_are_checked_too() -> None:
    assert "environments.velocity.worlds" in NAMES


def test_no_package_file_imports_anything() -> None:
    for path in FILES:
        if path.stem == "__init__":
            assert list(imports(parsed(path))) == IMPORTING_PACKAGES.get(dotted(path), []), path


def test_nothing_that_is_read_can_run_code() -> None:
    """No pickles, no unsafe YAML, no eval; tensors are loaded as weights only."""
    for path in FILES:
        tree = parsed(path)
        assert not {"pickle", "cloudpickle", "dill", "marshal", "shelve"} & set(imports(tree)), path
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in ("eval", "exec", "yaml.load", "yaml.unsafe_load"), path
                assert not any(keyword.arg == "allow_pickle" for keyword in node.keywords), path
                if called == "torch.load":
                    assert any(
                        keyword.arg == "weights_only" and ast.unparse(keyword.value) == "True"
                        for keyword in node.keywords
                    ), path
