"""A grid file is checked whole: every mistake at once, each with its line; what is right is a product."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from recrl.environments.cmdp import CostLimits
from recrl.environments.registry import TASKS
from recrl.orchestrator.errors import GridError
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.checking import parse_grid, read_grid, read_name

SMALL = """\
name: small
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag]
methods: [none, linear]
seeds: 2
run: {total_steps: 4000}
"""

TEN_MISTAKES = """\
name: ten mistakes
tasks:
  - name: two-state
    deploy_limits: [1, 2]
  - name: two-stat
    deploy_limits: 3
agents:
  - ppo-lag
  - ppo-lag
method: [none]
methods:
  - linear
  - name: dynamic
    options:
      window: 0
      widnow: 80
seeds: 3
train_limits: automatic
run:
  total_steps: lots
  num_env: 4
"""


def _problems(text: str | bytes) -> list[str]:
    data = text.encode() if isinstance(text, str) else text
    with pytest.raises(GridError) as caught:
        parse_grid(data, source="grid.yaml")
    return caught.value.problems


def _grid(text: str) -> GridSpec:
    return parse_grid(text.encode(), source="grid.yaml")


def test_a_name_of_ours_that_a_package_has_too_is_refused(install: Callable[[str, str, str], None]) -> None:
    install("theirs", "recrl.teachers", "linear = theirs:LINEAR")
    assert _problems(SMALL) == [
        "grid.yaml:4: methods.1: the curriculum 'linear' is recrl's, and also an entry point, "
        "'theirs:LINEAR' of the package theirs; rename that entry point, or uninstall its package to use "
        "recrl's"
    ]


def test_ten_mistakes_give_ten_located_sentences() -> None:
    known = ", ".join(sorted(TASKS))
    assert _problems(TEN_MISTAKES) == [
        "grid.yaml:1: name: must be a name for a folder: letters, digits and . _ - only, at most 64, "
        "got 'ten mistakes'",
        "grid.yaml:4: tasks.0.deploy_limits: two-state has 1 cost (wear), got 2 limits",
        "grid.yaml:5: tasks.1.name: no task is called 'two-stat'; did you mean 'two-state'? "
        f"(known: {known}; or an import path package.module:attribute)",
        "grid.yaml:9: agents.1: is called 'ppo-lag', as is agents.0; give it another label",
        "grid.yaml:10: method: unknown key; did you mean 'methods'?",
        "grid.yaml:15: methods.1.options.window: must be at least 1, got 0",
        "grid.yaml:16: methods.1.options.widnow: unknown key; did you mean 'window'?",
        "grid.yaml:18: train_limits: must be 'auto', a number or a list of numbers, got 'automatic'",
        "grid.yaml:20: run.total_steps: must be a whole number, got 'lots'",
        "grid.yaml:21: run.num_env: unknown key; did you mean 'num_envs'?",
    ]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("name: small", "nmae: small", "1: nmae: unknown key; did you mean 'name'?"),
        ("name: small", "NAME: small", "1: NAME: unknown key; did you mean 'name'?"),
        ("seeds: 2", "sedes: [0]", "5: sedes: unknown key; did you mean 'seeds'?"),
        ("tasks: [{", "task: [{", "2: task: unknown key; did you mean 'tasks'?"),
        ("agents: [", "agent: [", "3: agent: unknown key; did you mean 'agents'?"),
        ("methods: [", "metods: [", "4: metods: unknown key; did you mean 'methods'?"),
        ("run: {", "runs: {", "6: runs: unknown key; did you mean 'run'?"),
        ("methods: [", "curricula: [", "4: curricula: unknown key; did you mean 'methods'?"),
        (
            "[ppo-lag]",
            "[{name: ppo-lag, options: {gamma: 0.9}}]",
            "3: agents.0.options.gamma: unknown key; did you mean 'discount'?",
        ),
        (
            "[ppo-lag]",
            "[{name: ppo-lag, activation: tanh}]",
            "3: agents.0.activation: unknown key (known: name, label, options); an option goes below options",
        ),
        (
            "[ppo-lag]",
            "[{name: ppo-lag, options: {num_envs: 8}}]",
            "3: agents.0.options.num_envs: unknown key; it belongs in the section 'run' of the grid",
        ),
        (
            "{name: two-state,",
            "{name: gymnasium, options: {id: CartPole-v1, limit: 3},",
            "2: tasks.0.options.limit: unknown key (known: id, keywords, cost_names, costless); an argument "
            "of the environment goes below keywords",
        ),
        (
            "{name: two-state,",
            "{name: gymnasium, options: {id: lab/Drift-v0},",
            "2: tasks.0.options.id: Namespace lab not found. Have you installed the proper package for lab? "
            "If a module of yours registers it, write my_module:lab/Drift-v0",
        ),
        ("{total_steps", "{total_step", "6: run.total_step: unknown key; did you mean 'total_steps'?"),
        ("{name: two", "{nam: two", "2: tasks.0.nam: unknown key; did you mean 'name'?"),
        (
            ", deploy_limits: 2",
            ", deploy_limit: 2",
            "2: tasks.0.deploy_limit: unknown key; did you mean 'deploy_limits'?",
        ),
        ("[ppo-lag]", "[{nmae: ppo-lag}]", "3: agents.0.nmae: unknown key; did you mean 'name'?"),
        ("[none, ", "[{nme: none}, ", "4: methods.0.nme: unknown key; did you mean 'name'?"),
        (
            "two-state, deploy_limits: 2}]",
            "two-state}]\ndeploy_limit: 2",
            "3: deploy_limit: unknown key; did you mean 'deploy_limits'?",
        ),
        (
            "two-state, deploy_limits: 2}]",
            "two-state}, {name: two-state, label: b}]\ndeploylimits: 2",
            "3: deploylimits: unknown key; did you mean 'deploy_limits'?",
        ),
    ],
)
def test_a_misspelt_key_is_one_mistake(old: str, new: str, problem: str) -> None:
    assert SMALL.count(old) == 1
    assert _problems(SMALL.replace(old, new)) == [f"grid.yaml:{problem}"]


@pytest.mark.parametrize(
    ("label", "problem"),
    [
        (r"none\u200b", "methods.1: is called 'none\\u200b', as is methods.0; give it another label"),
        ("none ", "methods.1.label: must be visible text without spaces at its ends, got 'none '"),
        (r"\u200b", "methods.1.label: must be visible text without spaces at its ends, got '\\u200b'"),
    ],
)
def test_labels_must_differ_for_a_reader(label: str, problem: str) -> None:
    methods = f'[none, {{name: linear, label: "{label}"}}]'
    assert _problems(SMALL.replace("[none, linear]", methods)) == [f"grid.yaml:4: {problem}"]


def test_labels_that_are_composed_in_another_way_are_the_same() -> None:
    methods = r'[{name: none, label: "\u00e9"}, {name: linear, label: "e\u0301"}]'
    (problem,) = _problems(SMALL.replace("[none, linear]", methods))
    assert problem.endswith("as is methods.0; give it another label")


@pytest.mark.parametrize(
    ("new", "problem"),
    [
        ("nmae: small", "1: nmae: unknown key; did you mean 'name'?"),
        ("colour: small", "1: name: is required"),
        ("name: a b", "1: name: must be a name for a folder: letters, digits and . _ - only, at most 64"),
    ],
)
def test_a_sweep_without_a_name_is_a_sentence(new: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "grid.yaml"
    path.write_text(SMALL.replace("name: small", new))
    with pytest.raises(GridError) as caught:
        read_name(path)
    assert str(caught.value).partition(", got")[0] == f"{path}:{problem}"


def test_an_unknown_key_that_is_near_no_missing_key_hides_none() -> None:
    assert _problems(SMALL.replace("seeds: 2", "colour: 2")) == [
        "grid.yaml:1: seeds: is required",
        "grid.yaml:5: colour: unknown key (known: train_limits, deploy_limits, name, tasks, agents, methods, "
        "seeds, run, resources, exclude)",
    ]


def test_a_wrong_name_is_reported_beside_a_wrong_limit_of_the_same_task() -> None:
    wrong = SMALL.replace("{name: two-state, deploy_limits: 2}", "{name: two-stat, deploy_limits: -1}")
    assert wrong != SMALL
    first, second = _problems(wrong)
    assert "tasks.0.name: no task is called 'two-stat'" in first + second
    assert "tasks.0.deploy_limits: must be" in first + second


def test_the_product_is_ordered_with_seeds_outermost() -> None:
    titles = [spec.title for spec in _grid(SMALL).trials()]
    assert titles == [
        "two-state ppo-lag none seed 0",
        "two-state ppo-lag linear seed 0",
        "two-state ppo-lag none seed 1",
        "two-state ppo-lag linear seed 1",
    ]


def test_every_default_is_filled_in() -> None:
    spec = _grid(SMALL).trials()[0]
    assert spec.task.options == {"horizon": 10, "arrival": 1.0}
    assert spec.train_limits == CostLimits((math.inf,))
    assert spec.deploy_limits == CostLimits((2.0,))
    assert (spec.train_steps, spec.deploy_steps) == (3800, 200)
    assert (spec.num_envs, spec.rollout_steps, spec.evaluation_episodes) == (64, 10, 100)


def test_saying_a_default_changes_no_trial() -> None:
    said = SMALL.replace("{name: two-state,", "{name: two-state, label: two-state, options: {horizon: 10},")
    assert _grid(said).trials() == _grid(SMALL).trials()


def test_more_seeds_keep_the_trials_there_are() -> None:
    few = {spec.trial_id for spec in _grid(SMALL).trials()}
    many = {spec.trial_id for spec in _grid(SMALL.replace("seeds: 2", "seeds: [1, 0, 7]")).trials()}
    assert few < many


def test_resources_change_no_trial() -> None:
    assert (
        _grid(SMALL + "resources: {cpus_per_trial: 0.5, max_concurrent: 3}\n").trials()
        == _grid(SMALL).trials()
    )


def test_exclusions_leave_out_what_matches_everything_in_them() -> None:
    grid = _grid(SMALL + "exclude: [{method: linear, seed: 1}]\n")
    assert [spec.title for spec in grid.trials()] == [
        "two-state ppo-lag none seed 0",
        "two-state ppo-lag linear seed 0",
        "two-state ppo-lag none seed 1",
    ]


def test_a_curriculum_of_mean_costs_does_not_go_with_limits_on_a_cvar() -> None:
    worst = SMALL.replace("[ppo-lag]", "[cpo, {name: ppo-lag, options: {constraint: cvar}}]")
    (problem,) = _problems(worst)
    assert problem == (
        "grid.yaml:3: agents.1: constraint: cvar does not suit the train_limits of two-state, which are "
        "measured as mean costs; give them as numbers, or exclude the pair"
    )
    for measures_nothing in ("step", "cooling"):
        assert len(_grid(worst.replace("linear", measures_nothing)).trials()) == 8
    given_limits = worst.replace("deploy_limits: 2", "deploy_limits: 2, train_limits: 6")
    assert len(_grid(given_limits).trials()) == 8
    dynamic = given_limits.replace("linear", "dynamic")
    (problem,) = _problems(dynamic)
    assert problem.startswith("grid.yaml:3: agents.1: constraint: cvar does not suit the method dynamic, ")
    assert len(_grid(dynamic + "exclude: [{agent: ppo-lag, method: dynamic}]\n").trials()) == 6


def test_a_curriculum_of_ones_own_declares_what_does_not_go_with_a_cvar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_curricula.py").write_text(
        "from recrl.teachers.registry import TeacherKind\n"
        "from recrl.teachers.static import NoConfig, step_teacher\n"
        "PLAIN = TeacherKind('d_t, then d_d.', NoConfig, step_teacher)\n"
        "COMPARING = TeacherKind('d_t, then d_d.', NoConfig, step_teacher, compares_costs=True)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    worst = SMALL.replace("[ppo-lag]", "[{name: ppo-lag, options: {constraint: cvar}}]")
    assert len(_grid(worst.replace("linear", '"own_curricula:PLAIN"')).trials()) == 4
    (problem,) = _problems(worst.replace("linear", '{name: "own_curricula:COMPARING", label: mine}'))
    assert problem.startswith("grid.yaml:3: agents.0: constraint: cvar does not suit the method mine, ")


def test_cooling_cannot_relax_limits_of_0() -> None:
    cooling = SMALL.replace("linear", "cooling")
    (problem,) = _problems(cooling.replace("limits: 2", "limits: 0"))
    assert problem == (
        "grid.yaml:4: methods.1: cooling relaxes a limit in proportion to it, so it never relaxes the "
        "deploy_limits of 0 of wear in two-state; use another method, deploy_limits above 0, or "
        "train_limits with a 0 there, and .inf for what is to be measured"
    )
    two = cooling.replace("two-state, ", "two-state-2, ")
    (problem,) = _problems(two.replace("limits: 2", "limits: [2, 0]"))
    assert "so it never relaxes the deploy_limits of 0 of noise in two-state-2; use" in problem
    assert len(_grid(two.replace("limits: 2", "limits: [2, 0], train_limits: [.inf, 0]")).trials()) == 4
    unrelaxed = SMALL.replace("linear", "{name: cooling, options: {relaxation: 0}}")
    assert len(_grid(unrelaxed.replace("limits: 2", "limits: 0")).trials()) == 4


def test_cooling_needs_discrete_actions() -> None:
    (problem,) = _problems(SMALL.replace("linear", "cooling").replace("two-state", "continuous-bandit"))
    assert problem == (
        "grid.yaml:4: methods.1: cooling rewards the policy's entropy, which has no bound with the "
        "continuous actions of continuous-bandit; use another method, or exclude the pair"
    )


def test_limits_are_the_tasks_own_or_the_grids() -> None:
    grid = _grid(
        """\
name: limits
tasks:
  - {name: two-state-2, deploy_limits: [3, 1], train_limits: 9}
  - {name: two-state-2, label: other}
agents: [ppo-lag]
methods: [none]
seeds: 1
deploy_limits: 2
train_limits: [.inf, 8]
run: {total_steps: 4000}
"""
    )
    first, second = grid.trials()
    assert (first.train_limits, first.deploy_limits) == (CostLimits((9, 9)), CostLimits((3, 1)))
    assert (second.train_limits, second.deploy_limits) == (CostLimits((math.inf, 8)), CostLimits((2, 2)))


def test_two_teachers_of_one_kind_need_two_labels() -> None:
    methods = "methods: [dynamic, {name: dynamic, label: dynamic-40, options: {window: 40}}]"
    specs = _grid(SMALL.replace("methods: [none, linear]", methods)).trials()
    assert [spec.method.label for spec in specs[:2]] == ["dynamic", "dynamic-40"]
    assert len({spec.trial_id for spec in specs}) == 4


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("name: small\n", "", "grid.yaml:1: name: is required"),
        (
            "seeds: 2",
            "seeds: 0",
            "grid.yaml:5: seeds: must be a number of seeds from 1 to 10000, or a list, got 0",
        ),
        ("seeds: 2", "seeds: [3, 4, 3]", "grid.yaml:5: seeds: must differ, got 3 twice"),
        (
            "seeds: 2",
            "seeds: yes",
            "grid.yaml:5: seeds: must be a number of seeds or a list of seeds, got 'yes'",
        ),
        (
            "seeds: 2",
            "seeds: true",
            "grid.yaml:5: seeds: must be a number of seeds or a list of seeds, got true",
        ),
        ("4000", "true", "grid.yaml:6: run.total_steps: must be a number, got true"),
        ("4000", "4000.5", "grid.yaml:6: run.total_steps: must be a whole number, got 4000.5"),
        (
            "4000",
            "100",
            "grid.yaml:6: run.total_steps: must be at least one update of two-state, "
            "64 environments x 10 steps = 640, got 100",
        ),
        ("4000}", "4000, num_envs: 0}", "grid.yaml:6: run.num_envs: must be at least 1, got 0"),
        (
            "4000}",
            "4000, deploy_fraction: 1}",
            "grid.yaml:6: run.deploy_fraction: must be at most 0.9, got 1",
        ),
        (
            "4000}",
            "2, num_envs: 1, rollout_steps: 1, deploy_fraction: 0.9}",
            "grid.yaml:2: tasks.0: train_steps: must be at least 1, got 0",
        ),
        ("[ppo-lag]", "ppo-lag", "grid.yaml:3: agents: must be a list, got 'ppo-lag'"),
        ("[ppo-lag]", "[]", "grid.yaml:3: agents: must have at least 1 entries, got 0"),
        (
            "{name: two-state,",
            "{name: rivergrid-1a, options: {costs: [rivers]},",
            "grid.yaml:2: tasks.0.options.costs.0: must be 'river', 'turns' or 'mud', got 'rivers'",
        ),
        ("[ppo-lag]", "[3]", "grid.yaml:3: agents.0: must be a name or a mapping with a name, got 3"),
        ("[ppo-lag]", "[{label: x}]", "grid.yaml:3: agents.0.name: is required"),
        (
            "[ppo-lag]",
            "[ppo-lag, {name: ppo-lag, label: again}]",
            "grid.yaml:3: agents.1: is the same as agents.0, under another label",
        ),
        (
            "[ppo-lag]",
            "['json:no_such_thing']",
            "grid.yaml:3: agents.0: cannot import 'json:no_such_thing': "
            "module 'json' has no attribute 'no_such_thing'",
        ),
        (", deploy_limits: 2", "", "grid.yaml:2: tasks.0: deploy_limits is required, here or for all tasks"),
        (
            "deploy_limits: 2",
            "deploy_limits: .inf",
            "grid.yaml:2: tasks.0.deploy_limits: must be finite, got infinity; for a cost without a limit "
            "give more than an episode can cost",
        ),
        (
            "deploy_limits: 2",
            "deploy_limits: -0.5",
            "grid.yaml:2: tasks.0.deploy_limits: must be numbers of at least 0 (cost per episode), got -0.5",
        ),
        (
            "deploy_limits: 2",
            "deploy_limits: .nan",
            "grid.yaml:2: tasks.0.deploy_limits: must be numbers of at least 0 (cost per episode), got NaN",
        ),
        (
            "deploy_limits: 2",
            f"deploy_limits: 1{'0' * 400}",
            f"grid.yaml:2: tasks.0.deploy_limits: must be at most 1.8e+308, got 1{'0' * 56}...",
        ),
        (
            "deploy_limits: 2",
            "deploy_limits: 5, train_limits: 3",
            "grid.yaml:2: tasks.0.train_limits: must be at least the deploy_limits of two-state "
            "(d_t >= d_d), got 3 under 5",
        ),
        (
            "deploy_limits: 2",
            "deploy_limits: 2, options: {horizon: 1}",
            "grid.yaml:2: tasks.0.options.horizon: must be at least 2, got 1",
        ),
        (
            "run:",
            "exclude: [{method: linaer}]\nrun:",
            "grid.yaml:6: exclude.0.method: this grid has no method 'linaer'; did you mean 'linear'?",
        ),
        ("run:", "exclude: [{agent: ppo-lag}]\nrun:", "grid.yaml:6: exclude: leaves no trial"),
        (
            "run:",
            "exclude: [{}]\nrun:",
            "grid.yaml:6: exclude.0: must name at least one of task, agent, method, seed",
        ),
        (
            "run:",
            "exclude: [{method: []}]\nrun:",
            "grid.yaml:6: exclude.0.method: must have at least 1 entries, got 0",
        ),
        (
            "run:",
            "resources: {cpus_per_trial: 0}\nrun:",
            "grid.yaml:6: resources.cpus_per_trial: must be at least 0.0001, got 0",
        ),
        (
            "run:",
            "resources: {gpus_per_trial: 1.5}\nrun:",
            "grid.yaml:6: resources.gpus_per_trial: must be a whole number above 1, or less than 1 to share "
            "a GPU, got 1.5",
        ),
        (
            "run:",
            "resources: {gpus_per_trial: 0.00001}\nrun:",
            "grid.yaml:6: resources.gpus_per_trial: must be 0 or at least 0.0001, got 1e-05",
        ),
        ("seeds: 2", "seeds: 2\nseeds: 3", "grid.yaml:6: seeds: given twice, first on line 5"),
        ("seeds: 2", "seeds: !!python/name:os.system ''", None),
        ("seeds: 2", "<<: {seeds: 2}", None),
        ("seeds: 2", "? [1]\n: 2\nseeds: 2", "grid.yaml:5: a key must be text"),
    ],
)
def test_each_mistake_has_its_sentence(old: str, new: str, problem: str | None) -> None:
    problems = _problems(SMALL.replace(old, new))
    if problem is None:
        problem = {
            "seeds": "grid.yaml:5: seeds: only plain values are allowed, got the tag "
            "'tag:yaml.org,2002:python/name:os.system'",
            "<<": "grid.yaml:5: <<: unknown key (known: train_limits, deploy_limits, name, tasks, agents, "
            "methods, seeds, run, resources, exclude)",
        }[new.partition(":")[0]]
        assert problem in problems
    else:
        assert problems == [problem]


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "grid.yaml:1: the file is empty"),
        (b"# nothing but a remark\n", "grid.yaml:1: the file is empty"),
        (b"- 1\n", "grid.yaml:1: a grid must be a mapping of settings, got [1]"),
        (b"just text", "grid.yaml:1: a grid must be a mapping of settings, got 'just text'"),
        (b"name: [1\nseeds: 2", "grid.yaml:2: not valid YAML: expected ',' or ']', but got ':'"),
        (b"a: 1\n\tb: 2", "grid.yaml:2: not valid YAML: found character '\\t' that cannot start any token"),
        (b"a: 1\nb: \xff\n", "grid.yaml:2: the file must be UTF-8 text, and this line is not"),
        (b"a: 1\nb: \x00", "grid.yaml:2: YAML does not allow the character U+0000"),
        (b'a: "\\UFFFFFFFF"', "grid.yaml:1: not valid YAML: a character is out of range"),
        (b"a: 1\n---\nb: 2\n", "grid.yaml:2: not valid YAML: but found another document"),
        (b"a: *b\n", "grid.yaml:1: not valid YAML: found undefined alias 'b'"),
        (b"a: " + b"x" * 2**20, "grid.yaml:1: the file must have at most 1048576 bytes, got 1048579"),
        (b"[" * 3000, "grid.yaml:1: nested deeper than 40 levels"),
        (b"a: " + b"[" * 60 + b"]" * 60, "grid.yaml:1: nested deeper than 40 levels"),
        (b"a: &a [*a]", "grid.yaml:1: nested deeper than 40 levels"),
        (
            b"a0: &a0 [x]\n"
            + b"".join(
                b"a%d: &a%d [%s]\n" % (i, i, b", ".join([b"*a%d" % (i - 1)] * 9)) for i in range(1, 10)
            ),
            "grid.yaml:1: the file expands to more than 20000 values",
        ),
    ],
)
def test_what_is_no_grid_at_all_is_refused_in_one_sentence(data: bytes, problem: str) -> None:
    assert _problems(data) == [problem]


def test_a_missing_file_is_a_sentence_that_says_where_it_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "sweep.yaml").touch()
    meant = "; did you mean 'sweep.yaml'?"
    for name, ends in [("sweep.yml", meant), ("sweeps.yaml", meant), ("other.yaml", "")]:
        with pytest.raises(GridError) as raised:
            read_grid(tmp_path / name)
        assert str(raised.value) == f"{tmp_path / name}: there is no such file in {tmp_path}{ends}"
    with pytest.raises(GridError, match=r"grid\.yaml: there is no folder .*nowhere$"):
        read_grid(tmp_path / "nowhere" / "grid.yaml")


def test_what_cannot_be_read_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(GridError, match=": cannot be read: Is a directory"):
        read_grid(tmp_path)


def test_scalars_are_what_they_look_like() -> None:
    """``1e3`` is a number, ``none`` and ``no`` are text, ``010`` is ten."""
    grid = _grid(SMALL.replace("4000", "1e4").replace("[ppo-lag]", "[{name: ppo-lag, label: no}]"))
    assert grid.run.total_steps == 10_000
    assert grid.agents[0].label == "no"
    assert _grid(SMALL.replace("seeds: 2", "seeds: [010]")).seeds == (10,)


def test_aliases_stand_for_what_they_repeat() -> None:
    text = SMALL.replace("run:", "resources: &r {cpus_per_trial: 1}\nrun:")
    assert _grid(text).trials() == _grid(SMALL).trials()
    shared = SMALL.replace("deploy_limits: 2}]", "deploy_limits: &d 2}]").replace("seeds: 2", "seeds: *d")
    assert _grid(shared).trials() == _grid(SMALL).trials()


def test_a_task_that_cannot_be_built_is_a_sentence() -> None:
    problems = _problems(SMALL.replace("name: two-state,", "name: 'json:loads',"))
    assert len(problems) == 1
    assert problems[0].startswith("grid.yaml:2: tasks.0: json:loads cannot be built: TypeError: ")


def test_too_many_trials_are_refused() -> None:
    methods = ", ".join(
        f"{{name: linear, label: l{i}, options: {{start_fraction: 0.{i + 10}}}}}" for i in range(11)
    )
    text = SMALL.replace("[none, linear]", f"[{methods}]").replace("seeds: 2", "seeds: 10000")
    assert _problems(text) == ["grid.yaml:1: a grid must have at most 100000 trials, got 110000"]


ROOT = Path(__file__).parents[2]
SHIPPED = {
    "demo": 20,
    "rivergrid": 100,
    "safety-gym": 150,
    "safety-gym-agents": 27,
    "safety-gym-curricula": 54,
    "safety-gym-table": 90,
    "safety-gym-level1": 54,
    "safety-gym-controls": 18,
    "safety-gym-paper-preset": 18,
    "velocity": 180,
    "velocity-curricula": 180,
}


@pytest.mark.parametrize("path", sorted((ROOT / "grids").glob("*.yaml")), ids=lambda path: path.stem)
def test_the_grids_we_ship_are_right(path: Path) -> None:
    grid = read_grid(path)
    assert grid.name == path.stem
    assert len(grid.trials()) == SHIPPED[path.stem]


RESULTS = {
    path.relative_to(ROOT / "results").with_suffix("").as_posix(): path
    for path in sorted((ROOT / "results").glob("*/*.yaml"))
}


# Records of what was run, with options of `dynamic` that have been removed since.
RECORDS = (
    "rivergrid/ablation-teacher",
    "rivergrid/all-episodes",
    "safety-gym/overlapping-episodes",
    "velocity/all-episodes",
    "velocity/dynamic-noise",
)
REMOVED = "adherence_tolerance|clock_reset|overlapping_episodes|remaining|windows_after_noise"


@pytest.mark.parametrize("name", sorted(set(RESULTS) - set(RECORDS)))
def test_the_grids_of_our_results_are_right(name: str) -> None:
    assert read_grid(RESULTS[name]).trials()


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_has_removed_options_and_names_the_commit_at_which_it_runs(name: str) -> None:
    with pytest.raises(GridError) as caught:
        read_grid(RESULTS[name])
    refused = rf".*: methods\.\d+\.options\.({REMOVED}): unknown key\b.*"
    assert all(re.fullmatch(refused, problem) for problem in caught.value.problems)
    assert re.search(r"^#   git checkout [0-9a-f]{7}$", RESULTS[name].read_text(), re.MULTILINE)


@pytest.mark.parametrize("key", ["train_limits", "deploy_limits"])
@pytest.mark.parametrize("at_task", [True, False])
def test_a_list_of_one_limit_is_not_for_all_costs(key: str, at_task: bool) -> None:
    entry = f", {key}: [8]" if at_task else ""
    top = "" if at_task else f"{key}: [8]\n"
    others = "" if key == "deploy_limits" else ", deploy_limits: 1"
    data = (
        f"name: two\ntasks: [{{name: two-state-2{others}{entry}}}]\n"
        f"agents: [cpo]\nmethods: [none]\nseeds: 1\n{top}run: {{total_steps: 10_000}}\n"
    )
    with pytest.raises(GridError) as caught:
        parse_grid(data.encode(), source="grid.yaml")
    place = f"grid.yaml:2: tasks.0.{key}" if at_task else f"grid.yaml:6: {key}"
    (problem,) = caught.value.problems
    assert problem.startswith(f"{place}: two-state-2 has 2 costs (")
    assert problem.endswith("), got 1 limit; one for all is a plain number")
    plain = parse_grid(data.replace("[8]", "8").encode(), source="grid.yaml")
    assert getattr(plain.trials()[0], key) == CostLimits((8.0, 8.0))


OWN_PARTS = """\
import torch
from pydantic import BaseModel
from recrl.agents.registry import AgentEntry
from recrl.teachers.registry import TeacherKind

class Options(BaseModel):
    network: str | None = None

class Curriculum:
    def __init__(self, spec):
        pass
    def start(self):
        return None
    def step(self, state, report):
        return None

def make_agent(cmdp, options, seed):
    raise KeyError("momentum")

def network(inputs, outputs):
    return torch.nn.Linear(inputs, outputs + 1)

AGENT = AgentEntry("Fails.", Options, make_agent)
CURRICULUM = TeacherKind("Answers nothing.", Options, Curriculum)
"""


def test_what_a_user_brings_is_built_once_on_each_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_parts.py").write_text(OWN_PARTS)
    monkeypatch.syspath_prepend(tmp_path)
    data = b"""\
name: own
tasks: [{name: two-state, deploy_limits: 2}]
agents: [{name: ppo-lag, label: mine, options: {network: "own_parts:network"}}, "own_parts:AGENT"]
methods: [none, "own_parts:CURRICULUM"]
seeds: 1
run: {total_steps: 10_000}
"""
    with pytest.raises(GridError) as caught:
        parse_grid(data, source="grid.yaml", build=True)
    network, agent, curriculum = caught.value.problems
    assert network.startswith("grid.yaml:3: agents.0: mine cannot be built on two-state: NetworkError: ")
    assert agent == (
        "grid.yaml:3: agents.1: own_parts:AGENT cannot be built on two-state: KeyError: 'momentum' "
        "(own_parts.py, line 18, in make_agent)"
    )
    assert curriculum == (
        "grid.yaml:4: methods.1: own_parts:CURRICULUM cannot be started on two-state: TypeError: curriculum "
        "own_parts:CURRICULUM: must return a CurriculumStep and its state, a mapping, got NoneType"
    )
    assert len(parse_grid(data, source="grid.yaml").trials()) == 4  # a launch leaves that to the trials


def test_one_mistake_on_every_task_is_one_line_with_the_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_parts.py").write_text(OWN_PARTS)
    monkeypatch.syspath_prepend(tmp_path)
    data = b"""\
name: own
deploy_limits: 2
tasks: [{name: two-state, label: zebra}, {name: two-state, label: ant}, two-state-2]
agents: ["own_parts:AGENT"]
methods: ["own_parts:CURRICULUM"]
seeds: 2
run: {total_steps: 10_000}
"""
    with pytest.raises(GridError) as caught:
        parse_grid(data, source="grid.yaml", build=True)
    assert caught.value.problems == [
        "grid.yaml:4: agents.0: own_parts:AGENT cannot be built: KeyError: 'momentum' "
        "(own_parts.py, line 18, in make_agent) "
        "(on zebra, ant, two-state-2)",
        "grid.yaml:5: methods.0: own_parts:CURRICULUM cannot be started: TypeError: curriculum "
        "own_parts:CURRICULUM: must return a CurriculumStep and its state, a mapping, got NoneType "
        "(on zebra, ant, two-state-2)",
    ]
    with pytest.raises(GridError) as caught:
        parse_grid(data.replace(b"10_000", b"100"), source="grid.yaml")
    (problem,) = caught.value.problems
    assert problem.endswith("got 100 (on zebra, ant, two-state-2)")


@pytest.mark.parametrize("value", [".inf", "[1, -.inf]", "{a: .nan}"])
@pytest.mark.parametrize(
    "task", ["name: 'own_room:make', options: {wind: %s}", "name: gymnasium, options: %s"]
)
def test_an_option_that_is_not_finite_is_no_null(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, task: str, value: str
) -> None:
    (tmp_path / "own_room.py").write_text("def make(wind): raise AssertionError")
    monkeypatch.syspath_prepend(tmp_path)
    options = (
        value if "own_room" in task else f"{{id: CartPole-v1, costless: true, keywords: {{wind: {value}}}}}"
    )
    (problem,) = _problems(SMALL.replace("name: two-state", task % options))
    assert problem.startswith("grid.yaml:2: tasks.0.options: must be finite JSON values (")
