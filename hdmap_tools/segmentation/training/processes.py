"""The processes that train together: one alone, or those that torchrun started."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import distributed, nn

from hdmap_tools.errors import ConfigError
from hdmap_tools.types import NDArrayInt


@dataclass(frozen=True)
class Processes:
    """This process among those that train together.

    Attributes:
        rank: Its number; 0 writes and speaks.
        world: How many there are.
        device: Where it computes.
    """

    rank: int
    world: int
    device: torch.device

    @property
    def is_first(self) -> bool:
        """Whether this one writes and speaks."""
        return self.rank == 0

    def joined(self, model: nn.Module) -> nn.Module:
        """The model, its gradients averaged over the processes.

        Batch normalization is over all of them on GPUs; torch has it for GPUs only, so
        processes on CPUs normalize each their own share of the batch.
        """
        if self.world == 1:
            return model
        if self.device.type == "cuda":
            model = nn.SyncBatchNorm.convert_sync_batchnorm(model)
            return nn.parallel.DistributedDataParallel(model, device_ids=[self.device.index])
        return nn.parallel.DistributedDataParallel(model)

    def of_first(self, value: float) -> float:
        """What the first process says: clocks differ, and all must end at the same step."""
        if self.world == 1:
            return value
        said = torch.tensor([value], dtype=torch.float64, device=self.device)
        distributed.broadcast(said, 0)
        return float(said.item())

    def total(self, counts: NDArrayInt) -> NDArrayInt:
        """Counts added up over the processes."""
        if self.world == 1:
            return counts
        added = torch.from_numpy(counts.copy()).to(self.device)
        distributed.all_reduce(added)
        result: NDArrayInt = added.cpu().numpy()
        return result

    def wait(self) -> None:
        """Let no process go on before all are here."""
        if self.world > 1:
            distributed.barrier()


@contextlib.contextmanager
def joined_processes() -> Iterator[Processes]:
    """Join the processes that torchrun started, if it did.

    Raises:
        ConfigError: If they are more than there are GPUs on a machine with some.
    """
    world = int(os.environ.get("WORLD_SIZE", "1"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    has_gpu = torch.cuda.is_available()
    if has_gpu and local >= torch.cuda.device_count():
        raise ConfigError(
            f"Process {local} of this machine has no GPU: there are {torch.cuda.device_count()}; start "
            "torchrun with --nproc-per-node of at most that."
        )
    device = torch.device("cuda", local) if has_gpu else torch.device("cpu")
    if world == 1:
        yield Processes(0, 1, device)
        return
    if has_gpu:
        torch.cuda.set_device(device)
    distributed.init_process_group("nccl" if has_gpu else "gloo")
    try:
        yield Processes(distributed.get_rank(), distributed.get_world_size(), device)
    finally:
        distributed.destroy_process_group()


def unwrapped(model: Any) -> nn.Module:
    """The model itself, whose names of weights do not depend on how it was trained."""
    is_wrapped = isinstance(model, nn.parallel.DistributedDataParallel)
    return model.module if is_wrapped else model
