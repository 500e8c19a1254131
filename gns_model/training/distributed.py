"""One process, or several that average their gradients: torchrun's conventions, gloo or NCCL.

The same script runs alone, under `torchrun` on one or more machines, and under `launching.launch`,
which starts local ranks with torchrun's environment variables.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor

from gns_model.errors import GnsError
from gns_model.training.heap import keep_heap


class RankError(GnsError, RuntimeError):
    """A rank that cannot run here, or one that the others have lost."""


@dataclass(frozen=True)
class Ranks:
    """This process among its peers."""

    rank: int
    world: int
    device: torch.device

    def sum(self, values: Tensor) -> Tensor:
        """`values` summed over all ranks, in place; same shape and dtype on every rank.

        Raises:
            RankError: if another rank has ended.
        """
        if self.world > 1:
            with _lost():
                dist.all_reduce(values)
        return values

    @torch.no_grad()
    def follow(self, tensors: Iterable[Tensor]) -> None:
        """Overwrite `tensors` with those of rank 0."""
        if self.world > 1:
            with _lost():
                for tensor in tensors:
                    dist.broadcast(tensor, 0)

    def share(self, content: bytes | None) -> bytes:
        """The bytes that rank 0 gives, on every rank; what the others give does not count."""
        if self.world == 1:
            return content or b""
        size = torch.tensor([len(content or b"")], device=self.device)
        self.follow([size])
        values = torch.zeros(int(size), dtype=torch.uint8, device=self.device)
        if self.rank == 0 and content:
            values.copy_(torch.frombuffer(bytearray(content), dtype=torch.uint8))
        if len(values):
            self.follow([values])
        return values.cpu().numpy().tobytes()


@contextlib.contextmanager
def _lost() -> Iterator[None]:
    """A connection that breaks in here means that a peer has gone."""
    try:
        yield
    except RuntimeError as error:
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise RankError(f"lost the connection to another rank ({reason[0]})") from None


@contextlib.contextmanager
def session(device: str = "auto", threads: int = 1) -> Iterator[Ranks]:
    """Join the other ranks, if the environment names any, and leave them at the end.

    Args:
        device: "auto" (CUDA if there is one), "cpu" or "cuda".
        threads: of this process, on a CPU.

    Raises:
        RankError: if there is no such device for this rank.
    """
    threads_before = torch.get_num_threads()
    world, rank = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("RANK", 0))
    cuda = torch.cuda.is_available() if device == "auto" else device == "cuda"
    if cuda:
        local, count = int(os.environ.get("LOCAL_RANK", 0)), torch.cuda.device_count()
        if local >= count:
            raise RankError(
                f'device = "{device}": rank {rank} needs GPU {local}, there are {count}'
            )
        place = torch.device("cuda", local)
        torch.cuda.set_device(place)
    else:
        place = torch.device("cpu")
        torch.set_num_threads(threads)
        torch.set_flush_denormal(True)
        keep_heap()
    started = world > 1 and not dist.is_initialized()
    if started:
        if cuda:
            dist.init_process_group("nccl", rank=rank, world_size=world, device_id=place)
        else:
            dist.init_process_group("gloo", rank=rank, world_size=world)
    try:
        yield Ranks(rank, world, place)
    finally:
        if started:
            dist.destroy_process_group()
        if not cuda:
            # Other code of this process expects the arithmetic that it came with.
            torch.set_flush_denormal(False)
            torch.set_num_threads(threads_before)


def leave() -> None:
    """End this process if it is one of several ranks, its work done and its files written.

    Threads of torch's process group can outlive `destroy_process_group`; when the interpreter takes
    them apart they abort the process (pytorch/pytorch#190489), and `torchrun` calls that a failure.
    """
    if int(os.environ.get("WORLD_SIZE", 1)) > 1:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
