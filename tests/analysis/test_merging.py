"""Parts of a sweep that ran in several places: joined, they are the sweep that ran in one."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from recrl.analysis.data import export, sweep_data
from recrl.analysis.data.merging import merge, part_of
from recrl.analysis.data.sweep_data import ROWS, Sweep, TrialFacts
from recrl.analysis.report import drawing
from recrl.analysis.statistics import metrics
from recrl.analysis.statistics.comparisons import comparisons
from recrl.analysis.statistics.cumulative_cost import cumulative_costs
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.spec import TrialStatus
from tests.conftest import MadeUpSweep
from tests.faults.committing import commit_file

SMALL: Mapping[str, object] = {"tasks": ("a",), "methods": ("none", "dynamic"), "seeds": 2, "updates": 20}
TITLES = [f"a {agent} {method} seed {seed}" for agent in ("cpo", "ppo-lag") for method in ("dynamic", "none")
          for seed in (0, 1)]  # fmt: skip

Part = Callable[..., Sweep]


@pytest.fixture
def part(tmp_path: Path) -> Part:
    """A function that writes a part of the sweep, with these fields changed, and reads it."""

    def write(name: str = "part", **fields: object) -> Sweep:
        return sweep_data.load(MadeUpSweep(**{**SMALL, **fields}).write(tmp_path, name))  # type: ignore[arg-type]

    return write


def without_rows(trials: Sequence[TrialFacts]) -> Sweep:
    """A part whose trials have learnt nothing yet."""
    none = pd.DataFrame()
    return sweep_data.assemble("part", trials, dict.fromkeys(ROWS, none))


def assert_equal(one: Sweep, other: Sweep) -> None:
    """The frames are equal but for what was timed while writing them."""
    for name in ("trials", *sweep_data.ROWS):
        left, right = (getattr(it, name).drop(columns="cpu_seconds", errors="ignore") for it in (one, other))
        pd.testing.assert_frame_equal(left, right, check_exact=True)


def test_a_part_is_a_sweep_without_the_other_trials(part: Part) -> None:
    half, whole = part("half", missing=TITLES[1::2]), part("whole")
    chosen = part_of(whole, [trial.spec for trial in half.facts])
    assert_equal(chosen, half)
    assert chosen.folder == whole.folder
    assert [trial.spec for trial in chosen.facts] == [trial.spec for trial in half.facts]


def test_two_halves_are_the_whole(part: Part) -> None:
    halves = part("one", missing=TITLES[::2]), part("two", missing=TITLES[1::2])
    assert [len(half.facts) for half in halves] == [4, 4]
    merged, whole = merge(halves), part("whole")
    assert_equal(merged, whole)
    assert (merged.name, merged.notes) == ("one", ())
    assert {trial.spec.title for trial in merged.facts} == set(TITLES)


def test_one_part_is_itself(finished: Sweep) -> None:
    merged = merge([finished])
    assert_equal(merged, finished)
    assert (merged.facts, merged.grid, merged.notes) == (finished.facts, finished.grid, finished.notes)


def test_the_part_that_got_furthest_is_taken(part: Part) -> None:
    whole = part("whole")
    behind = part("behind", unfinished=TITLES[:3], failed=TITLES[3:4])
    for parts in ([behind, whole], [whole, behind]):
        merged = merge(parts)
        assert_equal(merged, whole)
        assert all(trial.status is TrialStatus.COMPLETE for trial in merged.facts)


def with_options(sweep: Sweep, kind: str, options: Mapping[str, object]) -> Sweep:
    """The part, had its grid these options of every task, agent or method."""
    facts = []
    for it in sweep.facts:
        choice = dataclasses.replace(getattr(it.spec, kind), options=options)
        facts.append(dataclasses.replace(it, spec=dataclasses.replace(it.spec, **{kind: choice})))
    return sweep_data.assemble(sweep.name, facts, {name: sweep.rows(name) for name in ROWS})


def by_hand(store: SweepStore) -> Sweep:
    """The sweep, where every final policy leaves the camp at once, and then is hasty in 4 of 10 steps."""
    for trial in store.trials():
        commit_file(trial, "policy.csv", "action_0,action_1\n0.0,1.0\n0.6,0.4\n")
    return sweep_data.load(store)


def test_trials_of_other_limits_stay_apart_and_are_compared_with_their_own_baseline(part: Part) -> None:
    merged = merge([part("loose", deploy_limit=5.0), part("tight", deploy_limit=4.0)])
    assert len(merged.facts) == 2 * len(TITLES)
    labels = merged.trials["task"].cat.categories
    assert [label.partition(" [")[0] for label in labels] == ["a", "a"]
    assert merged.notes[0].startswith("2 tasks have the label a but different settings; they are kept apart ")
    assert "(deploy_limits [5.0])" in merged.notes[0]
    compared = comparisons(metrics.outcomes(merged), np.random.default_rng(0))
    assert set(compared["task"]) == set(labels)
    assert set(compared["method"]) == {"dynamic"}


def test_methods_on_other_limits_and_budgets_are_not_compared(part: Part) -> None:
    parts = [
        part("none", methods=("none",), deploy_limit=1.0),
        part("linear", methods=("linear",), deploy_limit=5.0, updates=40),
    ]
    merged = merge(parts)
    assert comparisons(metrics.outcomes(merged), np.random.default_rng(0)).empty
    assert set(merged.trials["method"]) == {"none", "linear"}
    (note,) = merged.notes
    assert note.startswith("2 tasks have the label a but different settings")
    assert "(deploy_limits [1.0], train_steps 7600, deploy_steps 400)" in note
    same = merge([parts[0], part("like-it", methods=("linear",), deploy_limit=1.0)])
    assert same.notes == ()
    assert len(comparisons(metrics.outcomes(same), np.random.default_rng(0)))


def test_policies_are_evaluated_on_their_own_task(tmp_path: Path) -> None:
    few = {**SMALL, "methods": ("none",), "agents": ("cpo",), "seeds": 1}
    parts = [
        by_hand(MadeUpSweep(**few, horizon=horizon).write(tmp_path, f"horizon-{horizon}"))  # type: ignore[arg-type]
        for horizon in (10, 12)
    ]
    for merged in (merge(parts), merge(parts[::-1])):
        assert "(horizon 10)" in merged.notes[0]
        label = {options["horizon"]: task for task, options in merged.task_options.items()}
        rows = metrics.outcomes(merged).query("measure == 'stochastic'").set_index("task")
        for horizon, value, cost in ((10, 12.6, 3.6), (12, 15.4, 4.4)):
            assert rows["exact"].all()
            found = rows.loc[label[horizon], ["episode_return", "cost_0"]]
            assert list(found) == pytest.approx([value, cost])
        sums = cumulative_costs(merged).set_index("task")["ceiling_sum"].to_dict()
        assert sums[label[12]] / sums[label[10]] == pytest.approx(12 / 10)


@pytest.mark.parametrize(("kind", "nouns"), [("agent", "agents"), ("method", "curricula")])
def test_other_options_of_one_label_stay_apart(part: Part, kind: str, nouns: str) -> None:
    few = {"methods": ("dynamic",), "agents": ("cpo",)}
    merged = merge([with_options(part(**few), kind, {"discount": value}) for value in (0.9, 0.99)])
    label = few[f"{kind}s"][0]
    assert all(str(it).startswith(f"{label} [") for it in merged.trials[kind].cat.categories)
    assert merged.trials[kind].nunique() == 2
    (note,) = merged.notes
    assert note.startswith(f"2 {nouns} have the label {label} on a but different settings")
    assert "(discount 0.9), " in note


def test_each_agent_has_its_own_discount_in_the_bounds(part: Part) -> None:
    few = {"methods": ("none",), "agents": ("cpo",), "seeds": 1}
    parts = [with_options(part(**few), "agent", {"discount": value}) for value in (0.5, 0.9)]
    alone = [cumulative_costs(it)["discounted_bound"].iloc[0] for it in parts]
    together = cumulative_costs(merge(parts))["discounted_bound"].tolist()
    assert sorted(together) == sorted(alone)
    assert alone[0] != alone[1]


@pytest.mark.usefixtures("unrendered")
def test_a_task_of_another_number_of_costs_under_one_label_is_drawn(part: Part, tmp_path: Path) -> None:
    few = {"methods": ("none",), "agents": ("cpo",), "seeds": 1}
    merged = merge([part("two", num_costs=2, **few), part("one", **few)])
    numbers = merged.trials.groupby("task", observed=True)["num_costs"].unique()
    assert sorted(map(list, numbers)) == [[1], [2]]
    assert drawing.draw(merged, tmp_path / "figures")
    report = (tmp_path / "figures" / "report.html").read_text()
    for label, name in dict(zip(merged.trials["task"], merged.trials["task_name"], strict=True)).items():
        assert f"task {label}: {{&quot;name&quot;: &quot;{name}&quot;" in report


def test_labels_of_different_tasks_need_no_digest(part: Part) -> None:
    few = {"methods": ("none", "dynamic"), "agents": ("cpo",), "seeds": 1}
    first, second = part(**few), part("other", tasks=("b",), **few)
    merged = merge([first, with_options(second, "agent", {"discount": 0.9})])
    assert merged.notes == ()
    assert merged.trials["agent"].unique().tolist() == ["cpo"]
    assert merged.agent_options["b", "cpo"]["discount"] == 0.9
    assert merged.agent_options["a", "cpo"].get("discount") != 0.9


def test_variants_of_a_label_keep_its_place_in_the_order(part: Part) -> None:
    few = {"methods": ("none", "linear", "dynamic"), "agents": ("cpo",), "seeds": 1}
    merged = merge([with_options(part(**few), "method", {"discount": value}) for value in (0.9, 0.99)])
    bare = [str(label).split(" ")[0] for label in merged.trials["method"].cat.categories]
    assert bare == ["none", "none", "linear", "linear", "dynamic", "dynamic"]


def test_parts_of_other_numbers_of_costs_join(part: Part) -> None:
    merged = merge([part("two", tasks=("b",), num_costs=2), part("one")])
    assert merged.num_costs == 2
    assert merged.updates.loc[merged.updates["task"] == "a", "cost_1"].isna().all()
    assert merged.updates.loc[merged.updates["task"] == "b", "cost_1"].notna().all()


def test_a_trial_that_failed_before_its_first_step_is_further_than_one_that_waits(part: Part) -> None:
    failed = part("failed")
    facts = [
        dataclasses.replace(it, status=TrialStatus.FAILED, error="no luck", env_steps=0)
        for it in failed.facts
    ]
    waiting = [dataclasses.replace(it, status=TrialStatus.WAITING, env_steps=0) for it in failed.facts]
    merged = merge([without_rows(of) for of in (waiting, facts)])
    assert {trial.error for trial in merged.facts} == {"no luck"}


@pytest.mark.usefixtures("laid_out")
def test_figures_need_no_row_of_the_trials_with_most_costs(part: Part, tmp_path: Path) -> None:
    few = {"methods": ("none", "dynamic"), "agents": ("cpo",), "seeds": 1}
    unstarted = part("two", tasks=("b",), num_costs=2, **few)
    waiting = [dataclasses.replace(it, status=TrialStatus.WAITING, env_steps=0) for it in unstarted.facts]
    merged = merge([part("one", **few), without_rows(waiting)])
    assert merged.num_costs == 2
    assert merged.updates["limit_1"].isna().all()
    assert drawing.draw(merged, tmp_path / "figures")


def test_notes_that_are_no_longer_true_are_left_out(part: Part) -> None:
    parts = [part(f"limit-{limit}", deploy_limit=limit) for limit in (3.0, 4.0, 5.0)]
    notes = merge([merge(parts[:2]), parts[2]]).notes
    (note,) = notes
    assert note.startswith("3 tasks have the label a ")


def test_parts_of_different_grids_are_named(part: Part) -> None:
    one, two = (dataclasses.replace(part(name), grid=f"name: {name}") for name in ("one", "two"))
    merged = merge([one, two])
    assert merged.notes == ("the parts have different grid files; the first part's is kept",)
    assert merged.grid == "name: one"
    assert merge([dataclasses.replace(one, grid=""), two]).grid == "name: two"


def test_a_folder_that_cannot_be_made_is_a_sentence(part: Part, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecrlError, match=r"all\.zip: its folder cannot be made \(File exists\)"):
        export.save(part(), tmp_path / "file" / "all.zip")


def test_trials_completed_alike_in_two_parts_need_no_note(part: Part) -> None:
    assert merge([part("one"), part("two")]).notes == ()


def test_trials_completed_in_two_parts_with_other_episodes_are_named(part: Part, tmp_path: Path) -> None:
    one, two = part("one"), part("two", missing=TITLES[:2])
    changed = two.phases.assign(episode_return=two.phases["episode_return"] + 0.001)
    merged = merge([one, dataclasses.replace(two, phases=changed)])
    assert merged.notes == (
        "completed in several parts with different episodes, as machines or versions differ; the first "
        "part's are taken: a ppo-lag none seed 0, a ppo-lag none seed 1, a ppo-lag dynamic seed 0 and 3 more",
    )
    assert_equal(merged, one)


@pytest.mark.usefixtures("unrendered")
def test_the_command_writes_one_file(part: Part, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [tmp_path / "one.zip", tmp_path / "two.zip"]
    export.save(part("one", missing=TITLES[4:], unfinished=TITLES[:1]), paths[0])
    export.save(part("two", missing=TITLES[1:4]), paths[1])
    to = tmp_path / "all.zip"
    assert main(["merge", *map(str, paths), "--to", str(to)]) == ExitCode.OK
    assert "all.zip: 8 trials, 8 of them complete, " in capsys.readouterr().out
    assert_equal(export.load(to), merge([export.load(path) for path in paths]))
    assert main(["figures", str(to), "--sketch", "--to", str(tmp_path / "figures")]) == ExitCode.OK


def test_only_finished_trials_are_kept_if_that_is_wanted(
    part: Part, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rows of the others are left out, too. Failed trials stay: verdicts count them."""
    paths = [tmp_path / "one.zip", tmp_path / "two.zip"]
    export.save(part("one", missing=TITLES[4:], unfinished=TITLES[:1]), paths[0])
    export.save(part("two", missing=TITLES[1:4], unfinished=TITLES[:1], failed=TITLES[5:6]), paths[1])
    to = tmp_path / "all.zip"
    assert main(["merge", *map(str, paths), "--to", str(to), "--finished"]) == ExitCode.OK
    assert "all.zip: 7 trials, 6 of them complete, " in capsys.readouterr().out
    expected = merge([part("whole", missing=TITLES[:1], failed=TITLES[5:6])])
    kept = export.load(to)
    assert {trial.spec.title for trial in kept.facts} == set(TITLES[1:])
    for name in ("phases", "evaluations"):
        keys = ["task", "agent", "method", "seed"]
        found, wanted = (getattr(it, name).sort_values(keys, kind="stable") for it in (kept, expected))
        pd.testing.assert_frame_equal(
            found.reset_index(drop=True), wanted.reset_index(drop=True), check_categorical=False
        )


def test_without_a_finished_trial_there_is_nothing_to_keep(
    part: Part, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export.save(part(unfinished=TITLES), tmp_path / "one.zip")
    command = ["merge", str(tmp_path / "one.zip"), "--to", str(tmp_path / "all.zip"), "--finished"]
    assert main(command) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == "recrl-sweep: none of the 8 trials is finished\n"
    assert not (tmp_path / "all.zip").exists()


def test_a_sweep_that_is_no_file_is_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["merge", "my-sweep", "--to", str(tmp_path / "all.zip")]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == (
        "recrl-sweep: my-sweep: merge joins files that export wrote (.zip): recrl-sweep export SWEEP\n"
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["merge", "export"])
@pytest.mark.parametrize("name", ["all", "folder.zip"])
def test_what_is_written_is_a_zip_file(
    command: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "folder.zip").mkdir()
    with pytest.raises(SystemExit) as ended:
        main([command, "one.zip", "--to", str(tmp_path / name)])
    assert ended.value.code == ExitCode.WRONG_INPUT
    assert (
        f"argument --to: must be a file that ends with .zip, got '{tmp_path / name}'"
        in capsys.readouterr().err
    )
