"""The nodes of a Ray cluster: their capacity, and whether they can run the trials.

A trial's result is the same on every machine only if the code is, and the node must see the results folder or
the object store. Ray itself refuses nodes with another Python or Ray than its head's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from recrl.orchestrator.capacity import trials_on_gpus, trials_within
from recrl.orchestrator.errors import ClusterError, first_line
from recrl.orchestrator.provenance.versions import DISTRIBUTION, LIBRARIES

DISTRIBUTIONS = (DISTRIBUTION, "ray", *LIBRARIES)
ANSWER_SECONDS = 180.0  # a node may have to start its first process
ACCESS_PROBLEM = "what keeps it from the results"


def trials_that_fit(wanted: Mapping[str, float]) -> int:
    """Return how many trials the present nodes can run in parallel.

    Args:
        wanted: resources of one trial, by Ray's names; at least 0 each.
    """
    asked = {name: amount for name, amount in wanted.items() if amount > 0.0}
    return sum(
        min(_fitting(name, node["Resources"].get(name, 0.0), asked[name]) for name in asked)
        for node in _nodes()
    )


def _fitting(name: str, there: float, asked: float) -> int:
    """Return how many trials a node's amount of one resource is enough for."""
    return trials_on_gpus(there, asked) if name == "GPU" else trials_within(there, asked)


def check_nodes(probe: str, uri: str = "") -> None:
    """Check every node with cores against this machine, before any trial.

    Args:
        probe: an existing file in the sweep's folder, or the key of an object.
        uri: of the sweep's object store, if any.

    Raises:
        ClusterError: one sentence with every node that differs, and its differences.
    """
    look = _look()
    here, place = look(DISTRIBUTIONS, probe, uri), uri or str(Path(probe).parent)
    answers, problems = _asked("CPU", look, DISTRIBUTIONS, probe, uri)
    for address, there in answers:
        problems += differences(address, here, there, place)
    if problems:
        raise ClusterError(
            f"not every node of the cluster can run these trials: {'; '.join(sorted(problems))}; "
            "give all of them the same environment or image (docker/README.md), or leave them out"
        )


def check_gpus() -> None:
    """Check that PyTorch was built for GPUs on every node that has some, before any trial.

    Raises:
        ClusterError: one sentence with every node whose PyTorch was not, or that cannot tell.
    """
    answers, problems = _asked("GPU", _torch_without_gpu)
    problems += [f"{address} has torch {there} for CPUs only" for address, there in answers if there]
    if problems:
        raise ClusterError(
            "resources.gpus_per_trial is above 0, but not every node can use its GPUs: "
            f"{'; '.join(sorted(problems))}; install torch with CUDA there, or set gpus_per_trial to 0"
        )


def differences(address: str, here: Mapping[str, str], there: Mapping[str, str], place: str) -> list[str]:
    """Return a sentence for each difference of a node.

    Args:
        address: of the node.
        here: versions on this machine, by name.
        there: versions on the node; under ACCESS_PROBLEM the problem if it does not see the place.
        place: a folder or the address of an object store.
    """
    others = [
        f"{name} {there.get(name) or 'missing'} (here {value})"
        for name, value in here.items()
        if name != ACCESS_PROBLEM and there.get(name) != value
    ]
    found = [f"{address} has {', '.join(others)}"] if others else []
    if there.get(ACCESS_PROBLEM):
        found.append(f"{address} does not see {place}{there[ACCESS_PROBLEM]}")
    return found


def _asked(
    resource: str, function: Callable[..., Any], *arguments: Any
) -> tuple[list[tuple[str, Any]], list[str]]:
    """Call a function on every node that has some of a resource.

    Returns:
        Pairs of a node's address and its answer; a sentence for each node without an answer.
    """
    task = ray.remote(function)
    asked = {}
    for node in _nodes():
        if node["Resources"].get(resource, 0.0) > 0.0:
            only = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            answer = task.options(num_cpus=0, scheduling_strategy=only).remote(*arguments)
            asked[answer] = node["NodeManagerAddress"]
    ready = ray.wait(list(asked), num_returns=len(asked), timeout=ANSWER_SECONDS)[0] if asked else []
    answers, problems = [], []
    for answer, address in asked.items():
        if answer not in ready:
            problems.append(f"{address} has not answered for {ANSWER_SECONDS:g} seconds")
            continue
        try:
            answers.append((address, ray.get(answer)))
        except RayError as error:
            cause = error.cause if isinstance(error, RayTaskError) else error
            problems.append(f"{address} cannot run anything: {type(cause).__name__}: {first_line(cause)}")
    return answers, problems


def _nodes() -> list[dict[str, Any]]:
    """Return the present nodes, as Ray describes them."""
    described: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return [node for node in described if node["Alive"]]


def _torch_without_gpu() -> str:
    from recrl.orchestrator.trial.device import torch_without_gpu  # noqa: PLC0415  (imports torch)

    return torch_without_gpu()


def _look() -> Callable[[tuple[str, ...], str, str], dict[str, str]]:
    """Return the function that runs on the nodes. As a closure it is sent by value: a node may lack recrl."""
    problem = ACCESS_PROBLEM

    def look(distributions: tuple[str, ...], probe: str, uri: str) -> dict[str, str]:
        import importlib  # noqa: PLC0415
        import importlib.metadata  # noqa: PLC0415
        import platform  # noqa: PLC0415

        found = {"Python": platform.python_version()}
        for name in distributions:
            try:  # torch's CPU and CUDA builds of one version differ after the plus
                found[name] = (importlib.metadata.version(name) or "").partition("+")[0]
            except importlib.metadata.PackageNotFoundError:
                found[name] = ""
        try:
            package = importlib.import_module("recrl.orchestrator.provenance.own_package")
            found["recrl's source"] = package.source_digest()
        except ImportError:
            found["recrl's source"] = ""
        try:
            if uri:
                package = importlib.import_module("recrl.orchestrator.remote.object_store")
                seen = package.ObjectStore(uri).read(probe) is not None
                found[problem] = "" if seen else ", but another file in its place"
            else:  # a network file system may cache that a file is absent; opening it asks the server
                with open(probe):
                    found[problem] = ""
        except OSError:
            shared = ", which must be on a file system that all nodes share"
            found[problem] = shared
        except Exception as error:  # an error of a class that may be missing here
            found[problem] = f" ({error})"
        return found

    return look
