"""The wheel carries every module of the five folders."""

import tomllib

from setuptools import find_packages

from tests.project.documentation import ROOT

FOLDERS = ("orchestrator", "agents", "environments", "teachers", "analysis")


def test_every_folder_with_python_files_is_found_as_a_package() -> None:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert config["packages"]["find"] == {"where": ["src"], "namespaces": False}
    on_disk = {
        "recrl." + ".".join(path.parent.relative_to(ROOT).parts)
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
    }
    assert {"recrl", *on_disk} == set(find_packages(str(ROOT / "src")))
