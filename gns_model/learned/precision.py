"""Whether matrix products in bfloat16 are worth it on a device."""

from __future__ import annotations

import warnings
from typing import Literal

import torch

#: Of matrix products. "auto" is bfloat16 where the hardware multiplies it, float32 elsewhere.
Precision = Literal["float32", "bfloat16", "auto"]


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether the hardware does; a CPU without it (AVX2, most laptops) takes six to ten times as
    long for a step in bfloat16 as in float32 (`gns-model evaluate column-2d --suite speed`)."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type != "cpu":
        return False
    # Nothing public tells. Where this is gone, too, a slow answer is better than none.
    known = getattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", None)
    return bool(known()) if known is not None else False


def is_short(precision: Precision, device: torch.device) -> bool:
    """Whether to multiply in bfloat16 on `device`; warns where that was asked for and is slow."""
    if precision == "float32":
        return False
    fast = multiplies_bfloat16(device)
    if precision == "bfloat16" and not fast:
        warnings.warn(
            f'precision "bfloat16": this {device.type} has no instructions for it and is several '
            'times slower with it than in float32; "auto" takes what is faster',
            stacklevel=3,
        )
    return fast or precision == "bfloat16"
