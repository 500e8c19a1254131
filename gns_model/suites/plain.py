"""The network as one would write it first, with the same weights: what our own is timed against.

cat [v_i, v_j, e_ij] -> MLP -> add to the receiver, float32, every edge's inputs written out. This
is how the field's implementations work, geoelements/gns among them; findings: on 4 quiet threads
ours and theirs, written so, differ by a few percent.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor, nn

from gns_model.learned.model import LearnedModel
from gns_model.learned.network import Block, EncodeProcessDecode


class PlainNetwork(nn.Module):
    """`EncodeProcessDecode` without the split first layer, the tiles or a short dtype.

    It holds the very parameters of `network`.
    """

    def __init__(self, network: EncodeProcessDecode) -> None:
        super().__init__()
        self.network = network

    def forward(
        self,
        vertex: Tensor,
        edge: Tensor,
        senders: Tensor,
        receivers: Tensor,
        envelope: Tensor | None = None,
    ) -> Tensor:
        """As `EncodeProcessDecode.forward`, which see."""
        net = self.network
        vertex, edge = net.encode_vertex(vertex), net.encode_edge(edge)
        for block in cast(Iterable[Block], net.blocks):
            message = block.edge(torch.cat([vertex[receivers], vertex[senders], edge], dim=1))
            weighted = message if envelope is None else message * envelope
            total = torch.zeros_like(vertex).index_add(0, receivers, weighted)
            vertex = vertex + block.vertex(torch.cat([vertex, total], dim=1))
            edge = edge + (edge if block.doubled else message)
        return net.decode(vertex)


def plain(model: LearnedModel) -> LearnedModel:
    """A copy of `model` whose network is a `PlainNetwork` of the same weights."""
    out = copy.deepcopy(model)
    out.network = PlainNetwork(out.network)  # type: ignore[assignment]
    return out
