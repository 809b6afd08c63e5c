"""First steps without a clone: templates, lists, options and the schema for editors."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import yaml
from pydantic import BaseModel

from recrl.agents.registry import AGENTS
from recrl.environments.plugins import modules_in
from recrl.environments.registry import TASKS, make_drawn
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.cli.requests import TEMPLATES
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.grid.checking import read_grid
from recrl.orchestrator.grid.file_models import (
    Entry,
    Exclusion,
    GridFile,
    Limits,
    Resources,
    Run,
    TaskEntry,
)
from recrl.orchestrator.grid.json_schema import grid_schema
from recrl.teachers.registry import TEACHERS

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def output(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(arguments) == ExitCode.OK
    return capsys.readouterr().out


@pytest.mark.parametrize("template", TEMPLATES)
def test_every_template_is_a_right_grid(
    folder: Path, capsys: pytest.CaptureFixture[str], template: str
) -> None:
    out = output(capsys, "init", "--template", template)
    assert out.endswith(f"Next: recrl-sweep launch {template}.yaml\n")
    assert f"{template} is right" in output(capsys, "validate", f"{template}.yaml", "--trust")


def test_the_task_of_the_template_can_be_filmed(folder: Path) -> None:
    main(["init", "--template", "own-task"])
    with modules_in(folder):
        environment = make_drawn("my_task:make", options={"length": 12})
    environment.reset(seed=0)
    for _ in range(7):
        environment.step(1)
    frame = environment.render()
    assert isinstance(frame, np.ndarray)
    assert frame.shape == (48, 312, 3)
    assert frame.dtype == np.uint8
    assert (frame[24, -24:] != 255).any()  # at the goal, and not beyond the image


def test_the_demo_is_that_of_the_repository() -> None:
    main(["init"])
    assert read_grid(Path("demo.yaml")).trials() == read_grid(ROOT / "grids/demo.yaml").trials()


def test_a_file_of_ones_own_is_named_in_the_comments(capsys: pytest.CaptureFixture[str]) -> None:
    output(capsys, "init", "first/try.yaml")
    text = Path("first/try.yaml").read_text()
    assert "recrl-sweep launch first/try.yaml" in text
    assert "demo.yaml" not in text


@pytest.mark.parametrize("there", ["own-task.yaml", "my_task.py"])
def test_nothing_is_overwritten(folder: Path, capsys: pytest.CaptureFixture[str], there: str) -> None:
    (folder / there).write_text("mine")
    assert main(["init", "--template", "own-task"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == (
        f"recrl-sweep: {there}: exists already and is not overwritten; give another name or folder\n"
    )
    assert {path.name: path.read_text() for path in folder.iterdir()} == {there: "mine"}


def test_a_grid_file_has_the_right_ending(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", "demo.yml.txt"]) == ExitCode.WRONG_INPUT
    assert "must end with .yaml" in capsys.readouterr().err


@pytest.mark.parametrize(("kind", "names"), [("tasks", TASKS), ("agents", AGENTS), ("curricula", TEACHERS)])
def test_everything_is_listed_with_its_summary(
    capsys: pytest.CaptureFixture[str], kind: str, names: dict[str, Any]
) -> None:
    lines = output(capsys, "list", kind).splitlines()
    for name, entry in names.items():
        assert any(re.match(rf"{re.escape(name)} +{re.escape(entry.summary)}", line) for line in lines), name


@pytest.mark.parametrize("name", [*AGENTS, *TEACHERS, *TASKS])
def test_every_option_is_described(capsys: pytest.CaptureFixture[str], name: str) -> None:
    from recrl.orchestrator.grid.catalogue import kinds_of, options_of  # noqa: PLC0415

    (kind,) = kinds_of(name)
    for option in options_of(kind.model(name)):
        assert option.description.endswith("."), f"{name}: {option.name}"
        odd = re.search(r"[\[\]]|<(?!=? -?[0-9])|typing|None", option.type)
        assert not odd, f"{name}: {option.name}: {option.type}"


def test_options_show_type_default_and_description(capsys: pytest.CaptureFixture[str]) -> None:
    out = output(capsys, "options", "cpo")
    assert re.search(r"^discount +number >= 0, <= 1 +0.995 +Discount gamma of the critics", out, re.MULTILINE)
    out = output(capsys, "options", "rivergrid")
    assert re.search(r"^map +text +required +The map as text", out, re.MULTILINE)


def test_options_of_a_grids_sections_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    out = output(capsys, "options", "run")
    assert out.startswith("run, a section of a grid: Length and width of every trial.\n")
    total = r"^total_steps +whole number >= 1, <= 1e\+12 +required +Environment steps"
    assert re.search(total, out, re.MULTILINE)
    assert "silence_seconds" in output(capsys, "options", "resources")
    out = output(capsys, "options", "limits")
    auto, number = "'auto' or number or list of number or null", "number or list of number or null"
    assert re.search(rf'^train_limits +{auto} +"auto" +Training limits', out, re.MULTILINE)
    assert re.search(rf"^deploy_limits +{number} +required +Deployment limits", out, re.MULTILINE)


@pytest.mark.parametrize("model", [GridFile, TaskEntry, Entry, Run, Resources, Exclusion])
def test_every_key_of_a_grid_is_described(model: type[BaseModel]) -> None:
    for name, field in model.model_fields.items():
        assert (field.description or "").endswith("."), name


def test_the_editors_schema_does_not_demand_limits_that_may_stand_elsewhere() -> None:
    assert Limits.model_json_schema().get("required", []) == []


def test_the_next_command_finds_a_task_of_ones_own_in_another_folder(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = output(capsys, "init", "a b/own.yaml", "--template", "own-task")
    assert shown.splitlines()[-1] == "Next: cd 'a b' && recrl-sweep launch own.yaml"
    monkeypatch.chdir(folder / "a b")
    assert "recrl-sweep launch own.yaml" in Path("own.yaml").read_text()
    assert "is right" in output(capsys, "validate", "own.yaml", "--trust")


@pytest.mark.parametrize(
    ("section", "command"), [("tasks", "tasks"), ("agents", "agents"), ("methods", "curricula")]
)
def test_options_of_a_list_of_a_grid_say_what_it_takes(
    section: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = " ".join(output(capsys, "options", section).split())
    assert out.startswith(f"{section}, a section of a grid: a list; each entry is a name, or a mapping with ")
    assert f"Names: recrl-sweep list {command}; options of one: recrl-sweep options " in out
    assert ("deploy_limits" in out) == (section == "tasks")
    assert "label" in out


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("cpoo", "no task, agent or curriculum is called 'cpoo'; did you mean 'cpo'?; see recrl-sweep list"),
        (
            "my_task:make",
            "'my_task:make' was not imported, because a file that is only read must run no code; if you "
            "trust it, add --trust",
        ),
    ],
)
def test_options_of_nobody_and_of_a_stranger(
    capsys: pytest.CaptureFixture[str], name: str, sentence: str
) -> None:
    assert main(["options", name]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err.startswith(f"recrl-sweep: {sentence}")


def test_options_of_a_module_with_an_error_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    Path("broken.py").write_text("raise ValueError('no such map')\n")
    assert main(["options", "broken:TASK", "--trust"]) == ExitCode.WRONG_INPUT
    sentence = "recrl-sweep: broken:TASK cannot be used: ValueError: no such map\n"
    assert capsys.readouterr().err == sentence


def test_options_of_a_task_of_ones_own_are_shown_to_who_trusts_it(capsys: pytest.CaptureFixture[str]) -> None:
    output(capsys, "init", "--template", "own-task")
    out = output(capsys, "options", "my_task:make", "--trust")
    assert out.startswith("my_task:make, in a grid's tasks: ")
    assert out.endswith("Its options are these keyword arguments.\n")


def test_the_schema_accepts_every_grid_of_ours(capsys: pytest.CaptureFixture[str]) -> None:
    schema = json.loads(output(capsys, "schema"))
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    grids = [*ROOT.glob("grids/*.yaml"), *ROOT.glob("orchestrator/cli/templates/*.yaml")]
    assert len(grids) > len(TEMPLATES)
    for path in grids:
        validator.validate(yaml.safe_load(path.read_text()))


@pytest.mark.parametrize(
    ("wrong", "place"),
    [
        ({"agents": ["cpx"]}, "$.agents[0]"),
        ({"agents": [{"name": "cpo", "options": {"discont": 0.9}}]}, "$.agents[0]"),
        ({"agents": [{"name": "cpo", "options": {"discount": 1.5}}]}, "$.agents[0]"),
        ({"train_limits": "automatic"}, "$.train_limits"),
        ({"seeds": -1}, "$.seeds"),
        ({"run": {"total_stepz": 100}}, "$.run"),
        ({"name": "a/b"}, "$.name"),
    ],
)
def test_the_schema_marks_mistakes(wrong: dict[str, Any], place: str) -> None:
    grid = yaml.safe_load((ROOT / "grids/demo.yaml").read_text())
    errors = list(jsonschema.Draft202012Validator(grid_schema()).iter_errors({**grid, **wrong}))
    assert {error.json_path for error in errors} == {place}
