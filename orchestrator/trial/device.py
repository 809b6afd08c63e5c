"""What a trial learns on: the processor, or a GPU."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch

from recrl.orchestrator.errors import RecrlError


def require_gpu() -> None:
    """Check that PyTorch can use a GPU here.

    Raises:
        RecrlError: it cannot.
    """
    if not torch.cuda.is_available():
        raise RecrlError(
            f"resources.gpus_per_trial is above 0, but torch {torch.__version__} cannot use a GPU here; "
            "install torch with CUDA and a driver for it, or set gpus_per_trial to 0"
        )


def usable_gpus() -> int:
    """Return the number of GPUs that PyTorch can use here."""
    return torch.cuda.device_count()


def device_name(*, on_gpu: bool) -> str:
    """Return ``cpu``, or the name of the GPU: ``cuda: NVIDIA H100 80GB HBM3``.

    Raises:
        RecrlError: PyTorch cannot use a GPU here.
    """
    if not on_gpu:
        return "cpu"
    require_gpu()
    return f"cuda: {torch.cuda.get_device_name()}"


def torch_without_gpu() -> str:
    """Return the version of a PyTorch that was built for CPUs only, else an empty text."""
    return "" if torch.version.cuda or torch.version.hip else torch.__version__


def learning_on(*, gpu: bool) -> AbstractContextManager[Any]:
    """Make agents on the GPU inside the block, if one is asked for."""
    return torch.device("cuda") if gpu else nullcontext()
