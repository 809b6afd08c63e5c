"""No secret of an address is shown or kept, however it is written; nor what a terminal would obey."""

import io
import logging
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from recrl.orchestrator.cli.main import main
from recrl.orchestrator.cli.output import TextConsole, logging_to_stderr
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.redaction import RedactedStream, printable, redacted
from recrl.orchestrator.tracking.export_file import ExportUpload
from recrl.orchestrator.tracking.positions import Position
from tests.faults.bad_inputs import changed

CANARY = "c4n4ry"
ADDRESSES = (
    f"http://me:{CANARY}@127.0.0.1:1",
    f"http://{CANARY}@127.0.0.1:1",
    f"http://{CANARY}:@127.0.0.1:1/path",
    f"http://me:p@ss{CANARY}@127.0.0.1:1",
    f"http://me:p@{CANARY}/x@127.0.0.1:1",
    f"http://me:'{CANARY}'@127.0.0.1:1",
    f"http://127.0.0.1:1/?password={CANARY}",
    f"http://127.0.0.1:1/?a=b&access_token={CANARY}&c=d",
    f"postgresql://me:{CANARY}@127.0.0.1:1/mlflow",
    f"postgresql://127.0.0.1:1/mlflow?user=me&password={CANARY}",
    f"nope://me:{CANARY}@host",
    f"http://me:{CANARY} with@space",
)
NO_ADDRESSES = (ADDRESSES[4], *ADDRESSES[-2:])  # the others are right, but nothing answers there


@pytest.mark.parametrize("address", ADDRESSES[:-1])
def test_what_is_secret_in_an_address_is_hidden(address: str) -> None:
    for text in (address, f"cannot reach '{address}' (refused)", f"{address}, {address}"):
        assert CANARY not in redacted(text)
        assert "***" in redacted(text)


@pytest.mark.parametrize(
    "text",
    [
        "http://host:5000/#/experiments/1",
        "sqlite:////home/me@work/mlflow.db",
        "s3://bucket/folder@2",
        "abfs://container@account.dfs.core.windows.net/folder",
        "recrl-sweep launch grid.yaml --only method=none",
        "target_kl=0.1, monkey=3",
    ],
)
def test_what_is_no_secret_stays(text: str) -> None:
    assert redacted(text) == text


def test_secrets_are_hidden_from_everybody_elses_output() -> None:
    stream = io.StringIO()
    print(f"WARNING retrying http://me:{CANARY}@host/api", file=RedactedStream(stream))
    assert stream.getvalue() == "WARNING retrying http://***@host/api\n"


def test_nothing_that_a_terminal_would_obey_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    evil = "a\x1b]0;title\x07b\x9b31m\u202ec"
    assert printable(evil) == r"a\x1b]0;title\x07b\x9b31m\u202ec"
    assert printable("two\nlines\tand ±") == "two\nlines\tand ±"
    TextConsole(width=80).print(evil, markup=False, highlight=False)
    with logging_to_stderr():
        logging.getLogger("recrl.sweep").warning("%s", evil)
    shown = capsys.readouterr()
    assert shown.err == printable(evil) + "\n"
    assert shown.out == printable(evil.replace("\x07", "")) + "\n"  # Rich itself rings no bell


def everything(folder: Path) -> bytes:
    """The names and contents of all files of a folder."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return b"\n".join([bytes(path) for path in paths] + [path.read_bytes() for path in paths])


def test_no_secret_is_in_a_sweeps_folder_or_in_any_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """MLflow is away, so that every address ends up in errors, reports and the log of the MLflow sync."""
    monkeypatch.chdir(tmp_path)
    Path("grid.yaml").write_text(changed("methods", to=["none"]))
    launch = ["launch", "grid.yaml", "--executor", "inline", "--no-figures"]
    assert main([*launch, "--tracking-uri", ADDRESSES[0]]) == ExitCode.OK
    for address in ADDRESSES:
        code = ExitCode.WRONG_INPUT if address in NO_ADDRESSES else ExitCode.CANNOT_RUN
        for command in ("sync", "figures", "export", "bound"):
            assert main([command, "small", "--tracking-uri", address]) == code
    assert main(["status", "small", "--storage", f"s3://key:{CANARY}@bucket/x"]) == ExitCode.WRONG_INPUT
    with pytest.raises(SystemExit):
        main(["status", "small", "--tracking-urii", ADDRESSES[0]])
    shown = capfd.readouterr()
    assert CANARY not in shown.out + shown.err
    assert CANARY.encode() not in everything(tmp_path)
    [log] = tmp_path.rglob("mlflow-sync/*/log.txt")
    assert log.stat().st_mode & 0o077 == 0
    assert sorted(tmp_path.rglob("mlflow-sync/*/report.json"))


def test_an_address_reaches_a_child_in_its_environment_and_not_on_its_command_line(tmp_path: Path) -> None:
    from recrl.orchestrator.files.sweep_store import SweepStore  # noqa: PLC0415
    from recrl.orchestrator.tracking.ui import ui_command  # noqa: PLC0415

    command = ui_command(SweepStore(tmp_path, "small"), f"postgresql://me:{CANARY}@host/mlflow")
    assert not any(CANARY in argument for argument in command)


def test_a_failed_trial_keeps_no_secret_of_an_error(tmp_path: Path) -> None:
    (tmp_path / "leaky.py").write_text(
        f"def make():\n    raise RuntimeError('no http://me:{CANARY}@host and \\x1b[31m')\n"
    )
    (tmp_path / "grid.yaml").write_text(changed("tasks", 0, "name", to="leaky:make"))
    command = [sys.executable, "-m", "recrl", "validate", "grid.yaml", "--trust"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.WRONG_INPUT
    assert done.stderr.splitlines()[0] == (
        r"grid.yaml:15: tasks.0: leaky:make cannot be built: RuntimeError: no http://***@host and \x1b[31m"
        " (leaky.py, line 2, in make)"
    )


def test_a_server_that_refuses_the_export_file_tells_no_password(tmp_path: Path) -> None:
    def refused(*_: object) -> None:
        raise ConnectionError("PUT to http://me:hunter2@host/artifacts failed")

    runs = cast(Any, SimpleNamespace(parent_id="0", client=SimpleNamespace(log_artifact=refused)))
    upload = ExportUpload(SweepStore(tmp_path, "s"), runs, lambda _, path: path.touch(), tmp_path)
    _, remark = upload.bring_up_to_date(Position("0"), {"trial": TrialRecord()}, live=False)
    assert remark == "PUT to http://***@host/artifacts failed"
