"""Who may import whom: the order of the packages, and one adapter for each third-party system."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.project.documentation import ROOT

FOLDERS = ("orchestrator", "agents", "environments", "teachers", "analysis")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
NAMES = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in FILES]

# For each package, what its modules may import of ours; a package's own modules are always allowed.
ALLOWED = {
    "environments": (),
    "teachers": ("recrl.environments.cmdp", "recrl.environments.options", "recrl.environments.plugins"),
    "agents": ("recrl.environments",),
    "analysis": (
        "recrl.environments",
        "recrl.orchestrator.counting",
        "recrl.orchestrator.errors",
        "recrl.orchestrator.files",
        "recrl.orchestrator.number_texts",
        "recrl.orchestrator.provenance.code_changes",
        "recrl.orchestrator.redaction",
        "recrl.orchestrator.spec",
        "recrl.orchestrator.tracking.export_download",
        "recrl.orchestrator.trial_warnings",
        "recrl.orchestrator.untrusted",
        "recrl.orchestrator.validation_sentences",
        "recrl.teachers",
    ),
    "orchestrator": ("recrl.agents", "recrl.environments", "recrl.teachers"),
}
# Modules of the orchestrator that may import the analysis, too: a launch draws its figures.
WITH_ANALYSIS = r"orchestrator\.(cli\..*|launch_grid)"
# The Python API stands on top of everything; of the command line it uses only these modules.
API_FILES = sorted((ROOT / "src" / "recrl").glob("*.py"))
API_OF_CLI = {
    "__main__": ("recrl.orchestrator.cli.main",),
    "_train_and_launch": (
        "recrl.orchestrator.cli.launch",
        "recrl.orchestrator.cli.output",
    ),  # to print progress
}
# Third-party modules that only some of our modules may import.
ADAPTERS = {
    "PIL": r"orchestrator\.trial\.videos",
    "av": r"orchestrator\.trial\.videos",
    "torch": r"agents\..*|orchestrator\.trial\.(torch_settings|device)",
    "gymnasium": r"environments\..*|agents\..*",
    "minigrid": r"environments\.rivergrid\..*",
    "mujoco": r"environments\.(simulation|safety_gym|velocity)\..*",
    "numba": r"environments\.simulation\.machine_code",
    "ray": r"orchestrator\.ray\..*",
    "mlflow": r"orchestrator\.tracking\.(client|export_download|mlflow_runs|sweep_sync|trial_sync)",
    "matplotlib": r"analysis\..*",
    "yaml": r"orchestrator\.located_yaml",
    "rich": r"orchestrator\.cli\..*",
    "safetensors": r"orchestrator\.files\.checkpoint_format",
    "fsspec": r"orchestrator\.remote\.object_store",
}
# The order inside the orchestrator, of its folders and of the modules beside them: nothing may import what
# stands in a later line.
LAYERS = (
    (
        "background_thread",
        "capacity",
        "counting",
        "errors",
        "executor_kind",
        "exit_codes",
        "located_yaml",
        "number_texts",
        "process_scope",
        "redaction",
        "spec",
        "untrusted",
        "validation_sentences",
    ),
    ("files",),
    ("provenance",),
    ("executors", "sweep_place", "sweep_progress", "trial", "trial_warnings"),
    ("grid", "remote"),
    ("find_sweep", "launch_plan", "tracking"),
    ("ray", "report_refresh", "run_sweep"),
    ("launch_grid",),
    ("cli",),
)

AGENT_LAYERS = (  # likewise inside the agents
    ("agent", "errors", "observation_features", "shared_options", "spaces"),
    ("collection", "networks"),
    ("building_blocks", "evaluation"),
    ("experience", "torch_export"),
    ("constraints", "trust_region"),
    ("learning",),
    ("algorithms",),
    ("registry",),
)


def imports(tree: ast.AST, *, at_run_time: bool = False) -> Iterator[str]:
    """Every dotted name that is imported; with ``at_run_time``, without those for type checkers only."""
    return (name for _, name in located_imports(tree, at_run_time=at_run_time))


def located_imports(tree: ast.AST, *, at_run_time: bool = False) -> Iterator[tuple[int, str]]:
    """The names of ``imports``, each with its line."""
    for node in ast.iter_child_nodes(tree):
        if at_run_time and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.module is not None
            yield node.lineno, node.module
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)
        else:
            yield from located_imports(node, at_run_time=at_run_time)


def package(path: Path) -> str:
    """The folder at the top that a file is in, however deep."""
    return path.relative_to(ROOT).parts[0]


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), filename=str(path))


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


def may_import(path: Path, name: str) -> bool:
    """Whether a module may import a name of ours. It may import a package of which it may import a part."""
    own = package(path)
    allowed = [f"recrl.{own}", *ALLOWED[own]]
    if re.fullmatch(WITH_ANALYSIS, dotted(path)):
        allowed.append("recrl.analysis")
    # "from recrl.environments import plugins" yields the package, too
    is_package = name.count(".") == 1
    return any(within(name, it) or (is_package and within(it, name)) for it in allowed)


def test_imports_of_ours_point_one_way() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in FILES
        for line, name in located_imports(parsed(path))
        if name.startswith("recrl.") and not may_import(path, name)
    ]
    assert not wrong, "\n".join(wrong)


def test_each_third_party_system_has_its_adapter() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in FILES
        for line, name in located_imports(parsed(path), at_run_time=True)
        if not re.fullmatch(ADAPTERS.get(name.partition(".")[0], ".*"), dotted(path))
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(("package", "layers"), [("orchestrator", LAYERS), ("agents", AGENT_LAYERS)])
def test_a_package_has_layers(package: str, layers: tuple[tuple[str, ...], ...]) -> None:
    height = {name: level for level, names in enumerate(layers) for name in names}
    folder = ROOT / package
    parts_of = {path.relative_to(folder).parts[0].removesuffix(".py") for path in folder.rglob("*.py")}
    assert set(height) == parts_of - {"__init__"}, "every folder and module has its place"
    for path in folder.rglob("*.py"):
        own = path.relative_to(folder).parts[0].removesuffix(".py")
        for name in imports(parsed(path), at_run_time=True):
            parts = name.split(".")
            if parts[:2] == ["recrl", package] and len(parts) > 2 and own != "__init__":
                assert height[parts[2]] <= height[own], f"{dotted(path)} imports {name}"


def test_the_analysis_has_layers() -> None:
    layers = ("data", "statistics", "figures", "report")
    for path in (ROOT / "analysis").rglob("*.py"):
        own = path.parent.name
        for name in imports(parsed(path), at_run_time=True):
            parts = name.split(".")
            if parts[:2] == ["recrl", "analysis"] and len(parts) > 2 and own != "analysis":
                assert layers.index(parts[2]) <= layers.index(own), f"{dotted(path)} imports {name}"


@pytest.mark.parametrize("path", API_FILES, ids=lambda path: path.stem)
def test_the_python_api_uses_the_command_line_only_to_print(path: Path) -> None:
    of_cli = [name for name in imports(parsed(path)) if within(name, "recrl.orchestrator.cli")]
    allowed = API_OF_CLI.get(path.stem, ())
    assert [name for name in of_cli if not any(within(name, module) for module in allowed)] == []
    third_party = {name.partition(".")[0] for name in imports(parsed(path), at_run_time=True)}
    assert not third_party & {"ray", "mlflow", "matplotlib", "yaml", "rich", "fsspec"}


def test_nothing_imports_the_python_api() -> None:
    api = tuple(f"recrl.{path.stem}" for path in API_FILES if path.stem != "__init__")
    for path in FILES:
        assert not [it for it in imports(parsed(path)) if any(within(it, name) for name in api)], path


def test_files_of_subpackages_are_checked_too() -> None:
    assert "environments.safety_gym.compiled_step" in NAMES


def test_no_package_file_imports_anything() -> None:
    for path in FILES:
        if path.stem == "__init__":
            assert list(imports(parsed(path))) == [], path


# What may load pickles, with the reason.
MAY_UNPICKLE = {
    # Tune hands the error of a trial to a callback only as a file that this process wrote a moment before, in
    # a private folder. Ray's Trial.get_pickled_error reads the storage, where the file is not yet.
    "orchestrator.ray.tune_callbacks": {"cloudpickle"},
    # Python's own bytecode of a module that this process has imported from it; it is compared, not run.
    "environments.plugins": {"marshal"},
}


def unpicklers(tree: ast.AST) -> set[str]:
    """The modules that load pickles among the imports, those of other packages too: ``ray.cloudpickle``."""
    parts = {part for name in imports(tree) for part in name.split(".")}
    return parts & {"pickle", "cloudpickle", "dill", "marshal", "shelve"}


@pytest.mark.parametrize(
    "line", ["from ray import cloudpickle", "import ray.cloudpickle as cp", "import dill"]
)
def test_a_pickle_of_another_package_is_found(line: str) -> None:
    assert unpicklers(ast.parse(line))


def test_nothing_that_is_read_can_run_code() -> None:
    """No pickles, no unsafe YAML, no eval; tensors are loaded as weights only."""
    for path in FILES:
        tree = parsed(path)
        assert unpicklers(tree) == MAY_UNPICKLE.get(dotted(path), set()), path
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
