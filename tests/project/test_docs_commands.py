"""Every command of the tutorials is executed, in the order of the page, with the files of the page."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.project.documentation import DOCS, PAGES, README, ROOT, fences, label

TUTORIALS = sorted(
    page for page in (DOCS / "tutorials").glob("*.md") if any(f.language == "shell" for f in fences(page))
)
SECONDS = 600


@pytest.mark.parametrize("page", TUTORIALS, ids=label)
def test_commands_of_a_tutorial(page: Path, tmp_path: Path) -> None:
    for fence in fences(page):
        if fence.language == "{literalinclude} ../../" or not fence.caption.startswith(("examples/", "grid")):
            continue
        source = ROOT / fence.caption
        text = source.read_text() if fence.caption.startswith("examples/") else fence.text
        (tmp_path / Path(fence.caption).name).write_text(text)
    script = "".join(fence.text for fence in fences(page) if fence.language == "shell")
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=tmp_path,
        env=environment,
        timeout=SECONDS,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"


def test_only_tutorials_have_commands_that_are_executed() -> None:
    elsewhere = [
        page for page in PAGES if page not in TUTORIALS and any(f.language == "shell" for f in fences(page))
    ]
    assert not elsewhere, "mark examples console, or execute them in this test"


def test_commands_that_are_not_executed_are_commands_that_exist() -> None:
    from recrl.orchestrator.cli.arguments import parser, spread  # noqa: PLC0415

    parsed = set()
    for page in (README, *PAGES):
        for fence in fences(page):
            if fence.language not in ("console", ""):
                continue
            for line in fence.text.splitlines():
                words = line.split("#")[0].split()
                if words[:1] == ["recrl-sweep"]:
                    parser().parse_args(spread([word.strip("'\"") for word in words[1:]]))
                    parsed.add(page)
    assert README in parsed
