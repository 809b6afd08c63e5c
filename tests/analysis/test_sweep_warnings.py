"""Results of trials that ran different code are averaged and compared, but not without a remark."""

import dataclasses
import json
from collections.abc import Mapping

import pytest

from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.data.sweep_warnings import (
    doubts,
    mixed_code_sentence,
    mixed_devices_sentence,
    mixed_versions_sentence,
)
from recrl.analysis.report import pages

REMEDY = "in a sweep's own folder, launch --rerun-changed makes it that of the installed version"


def with_code(sweep: Sweep, codes: Mapping[str, str], *, others: str = "new") -> Sweep:
    """The sweep, had its trials run these digests of recrl: by the beginning of their title."""
    facts = []
    for it in sweep.facts:
        code = next((code for title, code in codes.items() if it.spec.title.startswith(title)), others)
        attempts = [{"code": {"recrl": "first"}}, {"code": {"recrl": code, "mine": "same"}}]
        facts.append(dataclasses.replace(it, provenance=json.dumps({"attempts": attempts})))
    return dataclasses.replace(sweep, facts=tuple(facts))


def test_one_code_needs_no_remark(finished: Sweep) -> None:
    assert mixed_code_sentence(finished) == ""
    assert mixed_code_sentence(with_code(finished, {})) == ""


def test_seeds_of_a_cell_that_ran_different_code_are_one_sentence(finished: Sweep) -> None:
    sweep = with_code(finished, {"river-a cpo linear seed 1": "old", "river-b cpo none seed 0": "old"})
    sentence = (
        "the code that trials ran differs between seeds that are averaged (river-a cpo linear, river-b cpo "
        f"none); {REMEDY}"
    )
    assert mixed_code_sentence(sweep) == sentence
    assert doubts(sweep)[1:] == [sentence]  # after that on code which is not installed
    assert sentence in pages.remarks(sweep)


def test_an_export_is_advised_what_only_its_folder_can_do(finished: Sweep) -> None:
    sweep = with_code(finished, {})
    advice = "launch --rerun-changed runs them again"
    assert doubts(sweep)[0].endswith(advice)
    export = dataclasses.replace(sweep, folder=None)
    assert doubts(export)[0].endswith(f"{advice}, in a sweep's own folder")


def test_code_that_differs_from_that_of_the_baseline_is_named(finished: Sweep) -> None:
    assert mixed_code_sentence(with_code(finished, {"river-a cpo linear": "old"})) == (
        "the code that trials ran differs between none and curricula compared with it (river-a cpo linear); "
        f"{REMEDY}"
    )
    both = {"river-a cpo none": "old", "river-b cpo none seed 2": "old"}
    assert mixed_code_sentence(with_code(finished, both)) == (
        "the code that trials ran differs between seeds that are averaged (river-b cpo none) and "
        f"between none and curricula compared with it (river-a cpo linear, river-a cpo dynamic); {REMEDY}"
    )


def test_many_cells_are_counted(finished: Sweep) -> None:
    old = {it.spec.title: "old" for it in finished.facts if it.spec.seed == 0}
    assert "and 7 more); in a sweep" in mixed_code_sentence(with_code(finished, old))


def with_versions(sweep: Sweep, older: str) -> Sweep:
    """The sweep, had the first attempts of trials run with another torch: by the beginning of their title."""
    facts = []
    for it in sweep.facts:
        then = "2.12.0" if it.spec.title.startswith(older) else "2.13.0+cu128"
        attempts = [
            {"code": {"recrl": "same"}, "packages": {"torch": torch, "mlflow": it.spec.title}}
            for torch in (then, "2.13.0+cpu")
        ]
        facts.append(dataclasses.replace(it, provenance=json.dumps({"attempts": attempts})))
    return dataclasses.replace(sweep, facts=tuple(facts))


def test_versions_of_libraries_that_differ_between_seeds_are_one_sentence(finished: Sweep) -> None:
    sweep = with_versions(finished, "river-a cpo linear seed 1")
    assert mixed_versions_sentence(finished) == mixed_versions_sentence(with_versions(finished, "none")) == ""
    assert mixed_versions_sentence(sweep) == (
        "versions of libraries differ between seeds that are averaged (river-a cpo linear), so a difference "
        "may come from them: torch 2.12.0, 2.13.0"
    )
    assert mixed_versions_sentence(sweep) in pages.remarks(sweep)


def test_a_curriculum_that_ran_with_other_versions_than_none_is_named(finished: Sweep) -> None:
    facts = []
    for it in finished.facts:
        torch = "2.12.0" if it.spec.title.startswith("river-a cpo dynamic") else "2.13.0"
        attempt = {"code": {}, "packages": {"torch": torch}}
        facts.append(dataclasses.replace(it, provenance=json.dumps({"attempts": [attempt]})))
    sentence = mixed_versions_sentence(dataclasses.replace(finished, facts=tuple(facts)))
    assert "between none and curricula compared with it (river-a cpo dynamic)" in sentence


def test_seeds_that_learnt_on_other_devices_are_one_sentence(finished: Sweep) -> None:
    facts = []
    for it in finished.facts:
        device = "cuda: H200" if it.spec.title == "river-a cpo linear seed 1" else "cpu"
        attempts = [{"code": {}}, {"code": {}, "device": device}]
        facts.append(dataclasses.replace(it, provenance=json.dumps({"attempts": attempts})))
    sweep = dataclasses.replace(finished, facts=tuple(facts))
    assert mixed_devices_sentence(finished) == ""
    assert mixed_devices_sentence(sweep) == (
        "devices differ between seeds that are averaged (river-a cpo linear), so a difference may come from "
        "them: learnt on cpu, cuda: H200"
    )
    assert mixed_devices_sentence(sweep) in pages.remarks(sweep)


@pytest.mark.parametrize("packages", [None, [], "text"])
def test_a_record_of_packages_of_the_wrong_form_is_no_error(finished: Sweep, packages: object) -> None:
    text = json.dumps({"attempts": [{"code": {}, "packages": packages}]})
    facts = tuple(dataclasses.replace(it, provenance=text) for it in finished.facts)
    assert mixed_versions_sentence(dataclasses.replace(finished, facts=facts)) == ""


@pytest.mark.parametrize("code", [[], "text", {"recrl": ["a list"]}])
def test_a_record_of_the_wrong_form_is_no_error(finished: Sweep, code: object) -> None:
    text = json.dumps({"attempts": [{"code": code}]})
    facts = tuple(dataclasses.replace(it, provenance=text) for it in finished.facts)
    assert mixed_code_sentence(dataclasses.replace(finished, facts=facts)) == ""
