"""Print generated RiverGrid instances as lines for a grid file: map, J*(d) and limit d_d.

    python -m recrl.environments.rivergrid.print_instances 0 1 2
    python -m recrl.environments.rivergrid.print_instances 7 --options '{"width": 12, "river_width": [1, 3]}'

Paste the output below ``tasks:``. The limit is that of ``instances.suggested_limit``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from recrl.environments.cmdp import CostLimits
from recrl.environments.registry import optimal_return
from recrl.environments.rivergrid.grid_world import RiverGridGeneratedOptions
from recrl.environments.rivergrid.instances import Route, cheapest_route, quickest_route, suggested_limit

TASK = "rivergrid-generated"


def grid_entry(options: Mapping[str, Any]) -> str:
    """Return an entry for ``tasks:`` in a grid file, with the map and its optimum in a comment above it.

    Args:
        options: of ``rivergrid-generated``, with the river as the only cost.

    Raises:
        ValueError: an option is wrong, there are other costs, or a route of the rule for limits takes longer
            than an episode.
    """
    settings = RiverGridGeneratedOptions.model_validate(dict(options))
    if settings.costs != ("river",):
        raise ValueError(
            f'costs must be ["river"], because the rule for limits counts the river only, '
            f"got {json.dumps(settings.costs)}"
        )
    river_map = settings.river_map()
    limit, seed = suggested_limit(river_map), options["map_seed"]
    quickest, cheapest = quickest_route(river_map), cheapest_route(river_map)
    assert quickest is not None and cheapest is not None, "an instance's goal can be reached"
    if settings.horizon < cheapest.steps:
        raise ValueError(
            f"horizon must be at least {cheapest.steps}, the steps of the cheapest path on map {seed}, "
            f"got {settings.horizon}"
        )
    optima = {
        value: optimal_return(TASK, options, CostLimits((value,)))
        for value in sorted({*range(quickest.cost + 1), limit})
    }
    comments = [
        f"Map {seed}: the shortest path takes {_words(quickest)}, "
        f"{'the safe path' if cheapest.cost == 0 else 'the cheapest'} {_words(cheapest)}.",
        *str(river_map).split("\n"),
        ", ".join(f"J*({value:g}) = {optimum:.2f}" for value, optimum in optima.items()),
    ]
    entry = f"{{name: {TASK}, label: map-{seed}, options: {json.dumps(options)}, deploy_limits: {limit:g}}}"
    return "\n".join([*(f"  # {line}" for line in comments), f"  - {entry}"])


def _words(route: Route) -> str:
    return f"{route.steps} steps at a cost of {route.cost}"


def _options(text: str) -> dict[str, Any]:
    """Parse the options on the command line."""
    try:
        options = json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be a JSON object ({error}), got {text!r}") from error
    if not isinstance(options, dict):
        raise argparse.ArgumentTypeError(f"must be a JSON object, got {text!r}")
    if "map_seed" in options:
        raise argparse.ArgumentTypeError(f"must not have map_seed, give the seeds before it, got {text!r}")
    return options


def _sentence(error: ValueError) -> str:
    """Return an error as one line, which pydantic's are not."""
    if not isinstance(error, ValidationError):
        return str(error)
    return "; ".join(
        ": ".join([*map(str, each["loc"]), each["msg"].removeprefix("Value error, ")])
        for each in error.errors()
    )


def main() -> None:
    """Print one entry for each map seed on the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m recrl.environments.rivergrid.print_instances",
        description="Entries for the tasks of a grid file: generated RiverGrid maps and their limits.",
    )
    parser.add_argument("map_seed", type=int, nargs="+", help="seeds of the maps")
    parser.add_argument(
        "--options", type=_options, default={}, help="other options of rivergrid-generated, as JSON"
    )
    arguments = parser.parse_args()
    try:
        print("\n".join(grid_entry({"map_seed": seed, **arguments.options}) for seed in arguments.map_seed))
    except ValueError as error:
        parser.error(_sentence(error))


if __name__ == "__main__":
    main()
