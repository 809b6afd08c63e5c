"""Checks of a grid file: all mistakes at once, each with its line, before any trial starts.

    name: rivergrid
    tasks:
      - {name: rivergrid-1a, deploy_limits: 5}
      - {name: rivergrid-1b, deploy_limits: 1}
    agents: [ppo-lag, cpo]
    methods: [none, linear, {name: dynamic, options: {window: 5}}]
    seeds: 5
    run: {total_steps: 960000}

A grid is a product: every task x agent x method x seed, without the entries of ``exclude``. ``read_grid``
reports all mistakes at once, each with its line. ``GridSpec.trials`` is pure, ordered and without duplicates.
Seeds are the outermost loop, so that every method gets its first seed before any gets its second.

Symbols: ``train_limits`` is d_t, ``deploy_limits`` is d_d, k the number of a task's costs, B the training
budget, T ``rollout_steps``. Limits are undiscounted costs per episode.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from recrl.environments.cmdp import CMDPSpec, CostLimits
from recrl.environments.plugins import (
    UnknownNameError,
    UntrustedNameError,
    WrongKindError,
    nearest,
    refuse_shadowed_entry_point,
    trusted_attribute,
)
from recrl.orchestrator.errors import USERS_ERRORS, GridError, UntrustedGridError, described, missing
from recrl.orchestrator.grid.building import BuildError, build_own, cmdp_of
from recrl.orchestrator.grid.catalogue import KINDS, Kind
from recrl.orchestrator.grid.checked_grid import GridSpec, TaskCell
from recrl.orchestrator.grid.curriculum_checks import unsuitable
from recrl.orchestrator.grid.file_models import Entry, GridFile, Limits, Run, SweepName, TaskEntry
from recrl.orchestrator.grid.problem_list import TASK_MARK, ProblemList
from recrl.orchestrator.located_yaml import Problem, YamlPath, parse
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.orchestrator.untrusted import as_seen
from recrl.orchestrator.validation_sentences import (
    NotJsonError,
    as_written,
    ignored_keys,
    misspells,
    require_json,
    sentences,
)

MAX_TRIALS = 100_000
ROLLOUT_STEPS = 64  # by default: short rollouts of many environments give many updates
# Defaults: an infinite d_t, so that the curriculum measures its start. There is no default d_d.
DEFAULT_LIMITS: Mapping[str, tuple[float, ...] | None] = {"train_limits": (math.inf,), "deploy_limits": None}

Model = TypeVar("Model", bound=BaseModel)


def read_grid(path: Path, *, build: bool = False) -> GridSpec:
    """Read and check the grid in a file.

    Args:
        path: of the file.
        build: whether to build and rehearse the user's own tasks, agents, networks and curricula.

    Raises:
        GridError: the file is missing or wrong; one located sentence for each mistake.
        UntrustedGridError: no mistake was found, but import paths were not checked, as they are refused here.
    """
    return parse_grid(_read(path), source=str(path), build=build)


def parse_grid(data: bytes, *, source: str, build: bool = False) -> GridSpec:
    """Read and check the grid in ``data``.

    Args:
        data: a YAML document.
        source: the file's name, for errors.
        build: see ``read_grid``.

    Raises:
        GridError: one located sentence for each mistake.
        UntrustedGridError: see ``read_grid``.
    """
    check = _Check(data)
    grid = check.grid()
    if grid is not None and build:
        for place, sentence, task in build_own(grid, check.cmdps):
            check.problems.add_of_task(place, sentence, task)
    if check.problems:
        raise GridError(check.problems.located(source))
    if grid is None:
        raise UntrustedGridError(source, check.uncalled)
    return grid


def read_name(path: Path) -> str:
    """Read the sweep's name from a grid file; the rest is not checked, and no code is called.

    Raises:
        GridError: the file is missing, no mapping, or its name is wrong.
    """
    document = parse(_read(path))
    value = document.value
    if not isinstance(value, dict):
        problems = document.problems or (Problem(1, (), "a grid must be a mapping of settings"),)
        raise GridError([f"{path}:{problem}" for problem in problems])
    if "name" not in value:
        misspelt = next((key for key in value if misspells(key, "name", GridFile)), None)
        place: YamlPath = ("name",) if misspelt is None else (misspelt,)
        sentence = "is required" if misspelt is None else "unknown key; did you mean 'name'?"
        raise GridError([f"{path}:{Problem(document.line(place), place, sentence)}"])
    try:
        return TypeAdapter(SweepName).validate_python(value["name"])
    except ValidationError as error:
        problem = Problem(document.line(("name",)), ("name",), next(sentences(error, None))[1])
        raise GridError([f"{path}:{problem}"]) from error


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise GridError([f"{path}: {missing(path)}"]) from error
    except (OSError, ValueError) as error:
        raise GridError([f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"]) from error


class _Check:
    """One pass over a grid file; it continues after mistakes as far as possible.

    First the whole file is checked against its schema. Then each entry of the right form is checked against
    the registries and the other entries, independent of other mistakes.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._document = parse(data)
        self.problems = ProblemList(self._document)
        self.uncalled: list[str] = []
        self.cmdps: dict[str, CMDPSpec] = {}  # of the tasks that can be built, by label
        raw = self._document.value
        self._raw: Mapping[str, Any] = raw if isinstance(raw, dict) else {}

    def grid(self) -> GridSpec | None:
        """Return the grid, or None if there are problems."""
        value = self._document.value
        if not isinstance(value, dict):
            if not self.problems:
                self.problems.add((), f"a grid must be a mapping of settings, got {as_written(value)}")
            return None
        file = self._validated(GridFile, self._raw)
        tasks = self._tasks()
        agents = self._choices(KINDS["agents"], Entry)
        methods = self._choices(KINDS["curricula"], Entry)
        if file is None or self.problems or self.uncalled:
            return None
        grid = GridSpec(
            name=file.name,
            tasks=tuple(tasks),
            agents=tuple(agents.values()),
            methods=tuple(methods.values()),
            seeds=file.seeds,
            run=file.run,
            resources=file.resources,
            exclude=tuple(file.exclude),
            text=self._data,
        )
        self._check_whole(grid)
        return None if self.problems else grid

    def _check_whole(self, grid: GridSpec) -> None:
        """Check the product of all parts."""
        size = len(grid.tasks) * len(grid.agents) * len(grid.methods) * len(grid.seeds)
        if size > MAX_TRIALS:
            self.problems.add((), f"a grid must have at most {MAX_TRIALS} trials, got {size}")
            return
        known: dict[str, list[Any]] = {
            "task": [cell.task.label for cell in grid.tasks],
            "agent": [agent.label for agent in grid.agents],
            "method": [method.label for method in grid.methods],
            "seed": list(grid.seeds),
        }
        for index, rule in enumerate(grid.exclude):
            wanted = rule.model_dump(exclude_none=True)
            if not wanted:
                self.problems.add(("exclude", index), f"must name at least one of {', '.join(known)}")
            for key, values in wanted.items():
                for value in (value for value in values if value not in known[key]):
                    hint = nearest(str(value), [str(name) for name in known[key]])
                    sentence = f"this grid has no {key} {as_written(value)}{hint}"
                    self.problems.add(("exclude", index, key), sentence)
        if not self.problems and not grid.trials():
            self.problems.add(("exclude",), "leaves no trial")
        self._check_specs(grid)
        self._check_curricula(grid)

    def _check_specs(self, grid: GridSpec) -> None:
        """Check that the file of a trial's specification can be read again; one trial of each task."""
        first = {trial.task.label: trial for trial in reversed(grid.trials())}
        for index, cell in enumerate(grid.tasks):
            if trial := first.get(cell.task.label):
                try:
                    TrialSpec.from_json(trial.to_json())
                except ValueError as error:
                    self.problems.add(("tasks", index), str(error))

    def _check_curricula(self, grid: GridSpec) -> None:
        """Check that the curriculum of each trial suits its agent and limits; one sentence per entry."""
        found: dict[YamlPath, str] = {}
        for trial in grid.trials():
            for section, sentence in unsuitable(trial, self.cmdps[trial.task.label]):
                entries, entry = (
                    (grid.agents, trial.agent) if section == "agents" else (grid.methods, trial.method)
                )
                found.setdefault((section, entries.index(entry)), sentence)
        for place, sentence in found.items():
            self.problems.add(place, sentence)

    def _tasks(self) -> list[TaskCell]:
        """Return the tasks with correct limits and rollouts."""
        run = _valid(Run, self._raw.get("run"))
        cells = []
        for index, task in self._choices(KINDS["tasks"], TaskEntry).items():
            try:
                cmdp = cmdp_of(task)
            except BuildError as error:
                self.problems.add(("tasks", index), str(error))
                continue
            self.cmdps[task.label] = cmdp
            limits = self._both_limits(index, task.label, cmdp)
            rollout_steps = self._rollout_steps(run, task.label, cmdp)
            if limits is not None and rollout_steps is not None:
                cells.append(TaskCell(task, *limits, rollout_steps, cmdp.horizon))
        return cells

    def _choices(self, kind: Kind, model: type[Entry]) -> dict[int, Choice]:
        """Return the correct entries of a kind's section, by their index."""
        choices: dict[int, Choice] = {}
        for index, value in enumerate(_items(self._raw.get(kind.section))):
            entry = _valid(model, value)
            if entry is None:  # the schema check has reported why; its name may be wrong as well
                named = _valid(Entry, _named(value))
                if named is not None:
                    self._options((kind.section, index), named, kind)
                continue
            options = self._options((kind.section, index), entry, kind)
            if options is None:
                continue
            choice = Choice(entry.name, options, entry.label)
            self._check_differs((kind.section, index), choice, choices)
            choices[index] = choice
        return choices

    def _options(self, place: YamlPath, entry: Entry, kind: Kind) -> dict[str, Any] | None:
        """Return the entry's options with defaults, as JSON values."""
        name_place = (*place, "name") if (*place, "name") in self._document.lines else place
        model_of_options: type[BaseModel] | None = None
        try:
            refuse_shadowed_entry_point(entry.name, kind=kind.singular, group=kind.group, ours=kind.ours)
            model_of_options = kind.model(entry.name)
            model = model_of_options.model_validate(dict(entry.options))
            require_json(entry.options)  # of an untyped option, model_dump writes an infinite number as null
            options = model.model_dump(mode="json")
            require_json(options)
            if reason := _not_read_back(model):
                raise TypeError(f"its model of options must read back what its model_dump returns ({reason})")
        except ValidationError as error:
            for inner, sentence in sentences(error, model_of_options):
                self.problems.add((*place, "options", *inner), sentence)
        except (UnknownNameError, WrongKindError) as error:
            self.problems.add(name_place, str(error))
        except UntrustedNameError as error:
            self.uncalled.append(f"{'.'.join(map(str, place))} ({error.path})")
        except NotJsonError as error:
            self.problems.add((*place, "options"), f"must be finite JSON values ({error})")
        except USERS_ERRORS as error:
            self.problems.add(name_place, f"{entry.name!r} cannot be used: {described(error)}")
        else:
            for inner, sentence in ignored_keys(type(model), entry.options):
                self.problems.add((*place, "options", *inner), sentence)
            self._check_network((*place, "options", "network"), options)
            return options
        return None

    def _check_network(self, place: YamlPath, options: Mapping[str, Any]) -> None:
        """Check that a user's network can be imported, if import paths are followed."""
        path = options.get("network")
        if place[0] != "agents" or not isinstance(path, str):
            return
        try:
            trusted_attribute(path)
        except UnknownNameError as error:
            self.problems.add(place, str(error))
        except UntrustedNameError as error:
            self.uncalled.append(f"{'.'.join(map(str, place))} ({error.path})")
        except USERS_ERRORS as error:
            self.problems.add(place, f"{path!r} cannot be imported: {described(error)}")

    def _check_differs(self, place: YamlPath, choice: Choice, earlier: Mapping[int, Choice]) -> None:
        """Check that no earlier entry has the same label, or is the same under another label."""
        for index, other in earlier.items():
            if as_seen(other.label) == as_seen(choice.label):
                self.problems.add(
                    place, f"is called {choice.label!r}, as is {place[0]}.{index}; give it another label"
                )
                return
            if (other.name, other.options) == (choice.name, choice.options) and place[0] != "tasks":
                self.problems.add(place, f"is the same as {place[0]}.{index}, under another label")
                return

    def _both_limits(self, index: int, label: str, cmdp: CMDPSpec) -> tuple[CostLimits, CostLimits] | None:
        """Return the task's d_t and d_d."""
        train_limits, place = self._limits(index, "train_limits", label, cmdp)
        deploy_limits, _ = self._limits(index, "deploy_limits", label, cmdp)
        if train_limits is None or deploy_limits is None:
            return None
        if any(train < deploy for train, deploy in zip(train_limits, deploy_limits, strict=True)):
            self.problems.add(
                place,
                f"must be at least the deploy_limits of {label} (d_t >= d_d), "
                f"got {_numbers(train_limits)} under {_numbers(deploy_limits)}",
            )
            return None
        return train_limits, deploy_limits

    def _limits(self, index: int, key: str, label: str, cmdp: CMDPSpec) -> tuple[CostLimits | None, YamlPath]:
        """Return one kind of a task's limits, its own or the grid's, and their place in the file."""
        place: YamlPath = ("tasks", index, key)
        raw = self._raw["tasks"][index]
        values = getattr(_valid(TaskEntry, raw), key)
        if values is None:
            place, raw = (key,), self._raw
            shared = _valid(Limits, {key: self._raw.get(key)})
            if shared is None:  # the schema check has reported it
                return None, place
            values = getattr(shared, key) or DEFAULT_LIMITS[key]
        if values is None:
            if not any(misspells(it, key, GridFile) for it in self._raw):  # then the schema check has said so
                self.problems.add(("tasks", index), f"{key} is required, here or for all tasks")
            return None, place
        is_listed = isinstance(raw, dict) and isinstance(raw.get(key), list)
        if len(values) != cmdp.num_costs and (is_listed or len(values) > 1):
            costs = f"{cmdp.num_costs} cost{'s' * (cmdp.num_costs > 1)} ({', '.join(cmdp.cost_names)})"
            got = f"{len(values)} limits" if len(values) > 1 else "1 limit; one for all is a plain number"
            self.problems.add(place, f"{label} has {costs}, got {got}")
            return None, place
        return CostLimits(values if len(values) == cmdp.num_costs else values * cmdp.num_costs), place

    def _rollout_steps(self, run: Run | None, label: str, cmdp: CMDPSpec) -> int | None:
        """Return T: the given value, or its default."""
        if run is None:
            return None
        default = min(ROLLOUT_STEPS, cmdp.horizon or ROLLOUT_STEPS)
        steps, num_envs = run.rollout_steps or default, run.num_envs
        if run.total_steps < num_envs * steps:
            self.problems.add_of_task(
                ("run", "total_steps"),
                f"must be at least one update of {TASK_MARK}, "
                f"{num_envs} environments x {steps} steps = {num_envs * steps}, got {run.total_steps}",
                label,
            )
        else:
            return steps
        return None

    def _validated(self, model: type[Model], value: Any) -> Model | None:
        """Return the value as ``model``; all mistakes are added to the problems."""
        try:
            return model.model_validate(value)
        except ValidationError as error:
            for place, sentence in sentences(error, model):
                self.problems.add(place, sentence)
        return None


def _valid(model: type[Model], value: Any) -> Model | None:
    """Return the value as ``model``, or None if it is wrong; its mistakes are reported elsewhere."""
    try:
        return model.model_validate(value)
    except ValidationError:
        return None


def _named(value: Any) -> Any:
    """Return an entry's name and options without its other settings."""
    return (
        {key: value[key] for key in ("name", "options") if key in value} if isinstance(value, dict) else value
    )


def _not_read_back(model: BaseModel) -> str:
    """Return why options with their defaults, as a trial stores them, are read as others; empty if not."""
    stored = model.model_dump(mode="json")
    try:
        again = type(model).model_validate(stored)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    if again.model_dump(mode="json") == stored or again == model:  # sets have no order in a dump
        return ""
    return "it reads other values; a field with an alias needs populate_by_name=True"


def _items(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _numbers(limits: CostLimits) -> str:
    return ", ".join(f"{limit:g}" for limit in limits)
