"""The processes of one training: this one alone, or those that torchrun started, on one machine or several."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import distributed

from cfplan.errors import InputError


@contextmanager
def processes(device: str) -> Iterator[tuple[int, int, torch.device]]:
    """Rank and number of the processes of this training, and where this one computes."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    try:
        place = torch.device(f"{device}:{local}" if device == "cuda" else device)
        torch.zeros(1, device=place)
    except (RuntimeError, AssertionError) as error:
        raise InputError(
            f"no device {device!r}: {' '.join(str(error).split())[:120]}", where="--device", hint="cpu always works"
        ) from None
    if world == 1:
        yield 0, 1, place
        return
    distributed.init_process_group("nccl" if place.type == "cuda" else "gloo")
    try:
        yield distributed.get_rank(), distributed.get_world_size(), place
    finally:
        distributed.destroy_process_group()
