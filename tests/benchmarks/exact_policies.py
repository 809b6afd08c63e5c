"""Exact return and cost of the policies in an export of finite tasks, of any format that has policies.csv.

git show 3bde118:results/rivergrid/fresh.zip > fresh.zip
python tests/benchmarks/exact_policies.py fresh.zip --to results/rivergrid/fresh/exact.csv
"""

from __future__ import annotations

import argparse
import json
import zipfile
from pathlib import Path
from typing import Any

import pandas as pd

from recrl.analysis.data.exact_values import exact_values, finite_model
from recrl.analysis.data.labels import KEY
from recrl.analysis.statistics.verdicts import solved
from recrl.environments.cmdp import CostLimits
from recrl.environments.registry import optimal_return

METHODS = ("none", "linear", "cosine", "exponential", "dynamic")


def exact(path: Path) -> pd.DataFrame:
    """A row a trial and way of acting: KEY, policy, return, cost, limit, solved."""
    with zipfile.ZipFile(path) as archive:
        specs = [it["spec"] for it in json.loads(archive.read("sweep.json"))["trials"]]
        with archive.open("policies.csv") as file:
            policies = pd.read_csv(file)
    trials = pd.DataFrame(map(_labels, specs))
    rows = policies.merge(trials, left_on="trial", right_index=True)
    chosen = rows[rows["method"].isin(METHODS)].drop(columns=["trial", "deploy_limit_0"])
    names = dict.fromkeys(trials["task"])
    values = exact_values(chosen, {name: finite_model(name, {}) for name in names})
    values = values.merge(trials, on=list(KEY)).rename(columns={"episode_return": "return"})
    limits = zip(values["task"], values["deploy_limit_0"], strict=True)
    best = pd.Series([optimal_return(task, {}, CostLimits((limit,))) for task, limit in limits], values.index)
    values["solved"] = solved(values.assign(gap=best - values["return"]))
    return values.rename(columns={"cost_0": "cost", "deploy_limit_0": "limit"}).round(4)


def _labels(spec: dict[str, Any]) -> dict[str, Any]:
    names = {name: spec[name]["label"] for name in ("task", "agent", "method")}
    return {**names, "seed": spec["seed"], "deploy_limit_0": spec["deploy_limits"][0]}


def main() -> None:
    """Read, print counts, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("export", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    arguments = parser.parse_args()
    table = exact(arguments.export)
    table.to_csv(arguments.to, index=False, lineterminator="\n")
    print(table.groupby(["task", "method", "policy"])["solved"].agg(["sum", "size"]).to_string())


if __name__ == "__main__":
    main()
