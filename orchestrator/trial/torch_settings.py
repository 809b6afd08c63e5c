"""Settings of PyTorch in trials, whatever the process around them has set."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


def require_float32() -> None:
    """Check that PyTorch's default type is still that of ``torch_settings``.

    Raises:
        TypeError: a module that was imported since has changed it.
    """
    if (dtype := torch.get_default_dtype()) is not torch.float32:
        raise TypeError(
            f"the code of the task, the agent or the curriculum sets PyTorch's default type to {dtype}; "
            "trials compute in float32, so it must not call torch.set_default_dtype"
        )


@contextmanager
def torch_settings() -> Iterator[None]:
    """Let PyTorch use one thread and float32, and differentiate, until the end of the block.

    With one thread small networks are faster, and results are equal on all machines.
    """
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float32)
    try:
        with torch.inference_mode(False), torch.enable_grad():
            yield
    finally:
        torch.set_num_threads(threads)
        torch.set_default_dtype(dtype)
