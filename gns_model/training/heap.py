"""What glibc does with the memory of freed tensors."""

from __future__ import annotations

import contextlib
import ctypes


def keep_heap() -> None:
    """Let glibc keep the memory of freed tensors for the next step.

    By default every large tensor is mapped and unmapped anew, and the page faults cost more than
    the arithmetic: a step with 58K edges took 1.4 to 1.7 s with MALLOC_MMAP_THRESHOLD_ = 4 MB and
    0.65 s so. What fragmentation piles up goes back through `release_heap`.
    """
    mmap_max, trim_threshold = -4, -1  # M_MMAP_MAX, M_TRIM_THRESHOLD of <malloc.h>
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(mmap_max, 0)
        libc.mallopt(trim_threshold, 2**31 - 1)


def release_heap() -> None:
    """Give free memory back to the system, in the middle of the heap, too (glibc; else nothing)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
