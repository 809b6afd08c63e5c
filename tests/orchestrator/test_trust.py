"""Files that somebody else made run no code, name no place outside, and lead nobody to other files."""

import json
import re
import shutil
import signal
import sys
import threading
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import pandas as pd
import pytest

import recrl
from recrl.analysis.data import export
from recrl.analysis.data.optima import optima_of
from recrl.analysis.report import table_formats
from recrl.analysis.report.drawing import draw
from recrl.environments.cmdp import CostLimits
from recrl.environments.plugins import UntrustedNameError, refuse_import_paths
from recrl.environments.registry import find_task, task_options
from recrl.orchestrator.background_thread import background_thread
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import RecrlError, StorageError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.remote.remote_sweep import RemoteSweep
from recrl.orchestrator.remote.remote_trial import RemoteTrial
from recrl.orchestrator.run_sweep import stopping_on_signals
from recrl.orchestrator.spec import Choice, TrialSpec
from tests.faults.bad_inputs import changed
from tests.orchestrator.launches import INLINE

SPY = """\
from pathlib import Path
from recrl.environments.registry import Task
from recrl.environments.finite.two_state import TwoStateOptions, make_two_state

Path("RUN").touch()

def make(name, num_envs, options):
    return make_two_state("two-state", num_envs, options)

TASK = Task("Leaves a trace when it is imported.", TwoStateOptions, make)
"""
REFUSED = "because a file that is only read must run no code"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished sweep, and its zip, whose task is named by an import path."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "spy.py").write_text(SPY)
    (folder / "grid.yaml").write_text(changed("tasks", 0, "name", to="spy:TASK"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
        assert main(["export", "small", "--to", "small.zip"]) == ExitCode.OK
    (folder / "RUN").unlink()
    del sys.modules["spy"]
    return folder


@pytest.fixture
def foreign(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory that is a copy of it; nothing has imported its task."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        ["status", "small"],
        ["status", "grid.yaml"],
        ["logs", "small", "spy-TASK ppo-lag none"],
        ["figures", "small", "--to", "drawn"],
        ["figures", "small.zip", "--to", "drawn"],
        ["export", "small", "--to", "again.zip"],
        ["export", "small.zip", "--to", "again.zip"],
        ["merge", "small.zip", "small.zip", "--to", "again.zip"],
        ["bound", "small.zip"],
        ["validate", "grid.yaml"],
        ["plan", "grid.yaml"],
        ["evaluate", "small"],
        ["replay", "small", "--teacher", "spy:TASK"],
    ],
    ids=" ".join,
)
@pytest.mark.usefixtures("unrendered")
def test_reading_runs_nothing_that_a_file_names(foreign: Path, command: list[str]) -> None:
    main(command)
    assert not (foreign / "RUN").exists()
    assert "spy" not in sys.modules


@pytest.mark.parametrize(
    "command", [["validate", "grid.yaml"], ["plan", "grid.yaml"], ["evaluate", "small"]], ids=" ".join
)
def test_trust_runs_it(foreign: Path, command: list[str]) -> None:
    assert main([*command, "--trust"]) == ExitCode.OK
    assert (foreign / "RUN").exists()


@pytest.mark.usefixtures("unrendered")
def test_what_was_not_called_is_said(foreign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sentence = f"grid.yaml: tasks.0 (spy:TASK) was not called, {REFUSED}; if you trust it, add --trust"
    assert main(["validate", "grid.yaml"]) == ExitCode.OK
    said = "nothing else is wrong so far, but what depends on that code is not checked"
    assert capsys.readouterr().out == f"{sentence}; {said}\n"
    assert main(["plan", "grid.yaml"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == f"recrl-sweep: {sentence}\n"
    assert main(["evaluate", "small"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == (
        f"recrl-sweep: spy:TASK ppo-lag linear seed 0: 'spy:TASK' was not imported, {REFUSED}; "
        "if you trust it, add --trust\n"
    )
    assert main(["figures", "small.zip", "--to", "drawn"]) == ExitCode.OK
    note = f"spy:TASK: the optimum is unknown here, because 'spy:TASK' was not imported, {REFUSED}"
    assert note in (foreign / "drawn" / "report.md").read_text()


def test_an_optimum_is_unknown_here_only_where_it_is_known_elsewhere(foreign: Path) -> None:
    """A finite task may have one; of a task without a policy table none is known anywhere."""
    spec = TrialSpec(
        task=Choice("spy:TASK"),
        agent=Choice("ppo-lag"),
        method=Choice("none"),
        train_limits=CostLimits((2.0,)),
        deploy_limits=CostLimits((2.0,)),
        train_steps=80,
        deploy_steps=80,
        num_envs=4,
        rollout_steps=10,
        evaluation_episodes=2,
        seed=0,
    )
    with refuse_import_paths():
        assert optima_of([spec], ["spy:TASK"], finite=())[1] == ["spy:TASK: no optimum is known"]
        (note,) = optima_of([spec], ["spy:TASK"], finite={"spy:TASK"})[1]
    assert note == f"spy:TASK: the optimum is unknown here, because 'spy:TASK' was not imported, {REFUSED}"


@pytest.mark.parametrize("name", ["os:system", "spy:TASK"])
def test_a_process_that_refuses_import_paths_follows_none_until_it_does_again(name: str) -> None:
    with refuse_import_paths():
        with pytest.raises(UntrustedNameError):
            find_task(name)
        with pytest.raises(UntrustedNameError):
            task_options("gymnasium", {"id": "os:CartPole-v1"})
        assert find_task("two-state").summary
        own = "recrl.environments.registration:recrl/CarGoal2-v0"
        assert task_options("gymnasium", {"id": own}).model_dump()["id"] == own
    assert task_options("gymnasium", {"id": "gymnasium.envs:CartPole-v1", "costless": True})


def follows() -> bool:
    """Whether import paths are followed here."""
    try:
        find_task("math:floor")
    except UntrustedNameError:
        return False
    return True


def test_a_thread_refuses_for_itself_alone() -> None:
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(1) as other:
        in_one, in_other = refuse_import_paths(), refuse_import_paths()
        one.submit(in_one.__enter__).result()
        other.submit(in_other.__enter__).result()
        assert (follows(), one.submit(follows).result()) == (True, False)
        one.submit(in_one.__exit__, None, None, None).result()
        assert (one.submit(follows).result(), other.submit(follows).result()) == (True, False)
        other.submit(in_other.__exit__, None, None, None).result()
        assert other.submit(follows).result()


def test_threads_that_start_in_a_refusal_refuse_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[bool] = []

    def ask(*_: object, **__: object) -> None:
        answers.append(follows())

    monkeypatch.setattr(RemoteTrial, "download", ask)
    remote = RemoteSweep(f"file://{tmp_path}/bucket", SweepStore(tmp_path, "small"))
    for name in ("a", "b"):
        remote.objects.write(f"trials/{name}/spec.json", b"{}")
    for context in (refuse_import_paths(), nullcontext()):
        with context:
            with background_thread(ask, name="ask"):
                pass
            with stopping_on_signals(threading.Event(), ask):
                signal.raise_signal(signal.SIGINT)
            remote.pull(checkpoints=True)
    assert answers == [False] * 4 + [True] * 4


def test_no_thread_starts_without_the_context_of_its_starter() -> None:
    modules = [path.read_text() for path in Path(recrl.__file__).parent.glob("*/**/*.py")]
    starting = [text for text in modules if re.search(r"\b(Thread|ThreadPoolExecutor|Timer)\(", text)]
    assert len(starting) == 3
    assert all("copy_context()" in text for text in starting)


# Names


@pytest.mark.parametrize(
    "name", ["../evil", "/tmp/evil", "..", "", "a/b", "a\\b", "\x1b[31m", ".evil", "-evil"]
)
def test_a_name_from_a_file_leads_nowhere_else(tmp_path: Path, name: str, foreign: Path) -> None:
    with zipfile.ZipFile("small.zip") as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    told = json.loads(members["sweep.json"])
    del told["digests"]["sweep.json"]  # who changes a file can leave it out
    members["sweep.json"] = json.dumps({**told, "name": name}).encode()
    (foreign / "work").mkdir()
    evil = foreign / "work" / "small.zip"
    with zipfile.ZipFile(evil, "w") as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    before = sorted(foreign.rglob("*"))
    with pytest.raises(
        RecrlError,
        match=r"small\.zip: is a compact file of another .*, or was changed: the sweep's name must be a",
    ):
        export.load(evil)
    assert main(["export", "work/small.zip"]) == ExitCode.WRONG_INPUT
    assert main(["figures", "work/small.zip"]) == ExitCode.WRONG_INPUT
    assert sorted(foreign.rglob("*")) == before


@pytest.mark.parametrize(
    ("change", "mistake"),
    [
        ({"seed": -1}, "seed: must be at least 0, got -1"),
        ({"seed": "0"}, "seed: must be a whole number, got '0'"),
        ({"train_limits": ["nan"]}, "train_limits: must be numbers of at least 0, or 'inf', got 'nan'"),
        ({"train_limits": [3.0, 4.0]}, "train_limits and deploy_limits: must have the same length"),
        (
            {"train_limits": ["inf"], "deploy_limits": ["inf"]},
            "deploy_limits: must be finite, got ['inf']",
        ),
        ({"train_limits": [2.0]}, "train_limits: must be at least deploy_limits, [3.0], got [2.0]"),
        ({"task": "two-state"}, "task: must be a mapping of settings, got 'two-state'"),
        ({"nope": 1}, "nope: unknown key"),
        (
            {"agent": {"name": "x", "options": {}, "label": "\x1b[2J"}},
            r"agent.label: must hold no control characters, got '\x1b[2J'",
        ),
    ],
)
def test_a_spec_from_a_file_is_checked_like_one_from_a_grid(change: dict[str, object], mistake: str) -> None:
    spec = TrialSpec(
        task=Choice("two-state"),
        agent=Choice("ppo-lag"),
        method=Choice("linear"),
        train_limits=CostLimits((9.0,)),
        deploy_limits=CostLimits((3.0,)),
        train_steps=40,
        deploy_steps=40,
        num_envs=4,
        rollout_steps=10,
        evaluation_episodes=4,
        seed=0,
    )
    assert TrialSpec.from_json(spec.to_json()) == spec
    with pytest.raises(ValueError) as caught:
        TrialSpec.from_json({**spec.to_json(), **change})
    assert str(caught.value) == mistake


# Links


def test_a_lock_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "diary.txt").write_text("mine")
    store = SweepStore(tmp_path, "sweep")
    store.folder.mkdir()
    (store.folder / "lock").symlink_to(tmp_path / "diary.txt")
    sentence = r"sweep/lock: is a lock, and must be a file and no link; delete it if nothing runs there$"
    with pytest.raises(StorageError, match=sentence), store.lock():
        pass
    with pytest.raises(StorageError, match=sentence):
        store.is_locked()
    assert (tmp_path / "diary.txt").read_text() == "mine"


@pytest.mark.parametrize("name", [".lock", ".reserve", "log.txt", "episodes.csv", "events.jsonl"])
def test_no_file_of_a_trial_is_written_through_a_link(foreign: Path, name: str) -> None:
    (foreign / "diary.txt").write_text("mine")
    (foreign / "grid.yaml").write_text(changed("methods", to=["none"]))
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    [trial] = [it for it in SweepStore(foreign / "runs", "small").trials() if "two-state" in it.folder.name]
    (trial.folder / "state.json").unlink()
    (trial.folder / name).unlink(missing_ok=True)
    (trial.folder / name).symlink_to(foreign / "diary.txt")
    main(["launch", "grid.yaml", *INLINE])
    assert (foreign / "diary.txt").read_text() == "mine"


@pytest.mark.usefixtures("unrendered")
def test_no_figure_or_table_is_written_through_a_link(foreign: Path) -> None:
    (foreign / "diary.txt").write_text("mine")
    assert main(["figures", "small", "--to", "drawn"]) == ExitCode.OK
    drawn = [path for path in (foreign / "drawn").rglob("*") if path.is_file()]
    assert {path.suffix for path in drawn} >= {".csv", ".md", ".html", ".tex", ".pdf", ".png"}
    for path in drawn:
        path.unlink()
        path.symlink_to(foreign / "diary.txt")
    assert main(["figures", "small", "--to", "drawn"]) == ExitCode.OK
    assert (foreign / "diary.txt").read_text() == "mine"
    assert not any(path.is_symlink() for path in drawn)


# What is written for LaTeX, Markdown and matplotlib


def test_labels_are_text_in_latex_and_markdown() -> None:
    frame = pd.DataFrame({"task": [r"\input{/etc/passwd} $x$ ^~ {a}"]})
    assert r"\textbackslash{}input\{/etc/passwd\} \$x\$ \textasciicircum{}\textasciitilde{} \{a\}" in (
        table_formats.latex(frame)
    )
    frame = pd.DataFrame({"task": ["<script>x</script> [a](javascript:b) | c\nd"]})
    assert table_formats.markdown(frame).splitlines()[-1] == (
        r"| &lt;script&gt;x&lt;/script&gt; [a]\(javascript:b) \| c d |"
    )


@pytest.mark.usefixtures("laid_out")
def test_no_label_costs_a_figure(foreign: Path) -> None:
    labels = [r"$\frac{", "$", "a $d_d$ $", r"\$x$y", "50% & #1_2^3"]
    tasks = [{"name": "two-state", "label": label, "deploy_limits": 2} for label in labels]
    (foreign / "grid.yaml").write_text(changed("tasks", to=tasks).replace("name: small", "name: labelled"))
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK
    assert main(["figures", "labelled", "--to", "drawn"]) == ExitCode.OK
    drawn = [path.stem.partition("_")[0] for path in (foreign / "drawn").glob("*.pdf")]
    assert {"learning-curves", "curricula", "return-against-cost"} < set(drawn)
    assert drawn.count("diagnostics") == len(labels)
    assert "could not be drawn" not in (foreign / "drawn" / "report.md").read_text()


@pytest.mark.usefixtures("unrendered")
def test_one_figure_that_cannot_be_drawn_costs_no_other_and_is_named(
    foreign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from recrl.analysis.figures import learning_curves  # noqa: PLC0415

    def mistaken(*_: object, **__: object) -> None:
        raise KeyError("river")

    monkeypatch.setattr(learning_curves, "curricula", mistaken)
    with pytest.raises(KeyError, match="river"):
        draw(export.load(foreign / "small.zip"), foreign / "drawn")
    assert "- the figure curricula could not be drawn (KeyError: 'river')" in (
        (foreign / "drawn" / "report.md").read_text().splitlines()
    )
    assert (foreign / "drawn" / "learning-curves_ppo-lag.pdf").exists()


NETWORK = """\
name: n
tasks: [{name: two-state, deploy_limits: 2}]
methods: [none]
seeds: 1
run: {total_steps: 6_400}
"""


def test_a_network_of_the_users_own_is_listed_and_not_imported(
    foreign: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    agent = 'agents: [{name: ppo-lag, options: {network: "spy:TASK"}}]\n'
    (foreign / "n.yaml").write_text(NETWORK + agent)
    assert main(["validate", "n.yaml"]) == ExitCode.OK
    sentence = f"n.yaml: agents.0.options.network (spy:TASK) was not called, {REFUSED}"
    assert capsys.readouterr().out.startswith(sentence)
    assert not (foreign / "RUN").exists()
    (foreign / "n.yaml").write_text(NETWORK + agent.replace("spy:TASK", "spy:TASKS"))
    assert main(["validate", "n.yaml", "--trust"]) == ExitCode.WRONG_INPUT
    told = capsys.readouterr().err
    assert told.startswith("n.yaml:6: agents.0.options.network: cannot import 'spy:TASKS'")
