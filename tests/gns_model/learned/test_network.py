from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import nn

from gns_model.learned import edge_kernel
from gns_model.learned.graph import radius_graph
from gns_model.learned.network import MLP, Block, EncodeProcessDecode


def example(n: int = 150, dtype: torch.dtype = torch.float64):
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(n, 3, generator=generator, dtype=dtype)
    senders, receivers = radius_graph(points, 0.3)
    vertex = torch.randn(n, 5, generator=generator, dtype=dtype)
    edge = torch.randn(len(senders), 4, generator=generator, dtype=dtype)
    weight = torch.rand(len(senders), 1, generator=generator, dtype=dtype)
    return vertex, edge, senders, receivers, weight


def network(activation: str = "silu", hidden_layers: int = 2, **options) -> EncodeProcessDecode:
    torch.manual_seed(4)
    sizes = {"latent": 8, "hidden_layers": hidden_layers, "blocks": 2, **options}
    return EncodeProcessDecode(5, 4, 3, activation=activation, **sizes).double()


def textbook(net: EncodeProcessDecode, vertex, edge, senders, receivers, weight):
    """The paper's equations, word for word: concatenate, MLP, scatter."""
    vertex, edge = net.encode_vertex(vertex), net.encode_edge(edge)
    for block in net.blocks:
        message = block.edge(torch.cat([vertex[receivers], vertex[senders], edge], dim=1))
        weighted = message if weight is None else message * weight
        total = torch.zeros_like(vertex).index_add(0, receivers, weighted)
        vertex = vertex + block.vertex(torch.cat([vertex, total], dim=1))
        edge = 2 * edge if block.doubled else edge + message
    return net.decode(vertex)


@pytest.mark.parametrize("activation", ["silu", "relu"])
@pytest.mark.parametrize("hidden_layers", [1, 2, 3])
@pytest.mark.parametrize("enveloped", [True, False])
@pytest.mark.parametrize("frozen", [True, False])
def test_equals_the_textbook_with_all_gradients(
    monkeypatch, activation, hidden_layers, enveloped, frozen
):
    monkeypatch.setitem(edge_kernel.TILE, "cpu", 100)  # several tiles, the last one not full
    check_against_textbook(network(activation, hidden_layers), enveloped, frozen)


@pytest.mark.parametrize("edge_update", ["residual", "doubled"])
@pytest.mark.parametrize("hidden", [3, 13])
@pytest.mark.parametrize("frozen", [True, False])
def test_other_widths_and_doubled_edges_too(monkeypatch, edge_update, hidden, frozen):
    monkeypatch.setitem(edge_kernel.TILE, "cpu", 100)
    net = network(hidden=hidden, edge_update=edge_update, blocks=3)
    check_against_textbook(net, True, frozen)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)  # in plain operations
    check_against_textbook(net, True, frozen)


def check_against_textbook(net, enveloped, frozen):
    net.requires_grad_(not frozen)
    vertex, edge, senders, receivers, weight = example()
    inputs = [t.requires_grad_() for t in (vertex, edge, weight)][: 3 if enveloped else 2]
    wanted = inputs + [p for p in net.parameters() if p.requires_grad]
    results = []
    for function in (net, lambda *a: textbook(net, *a)):
        out = function(vertex, edge, senders, receivers, weight if enveloped else None)
        # The last block's edges lead nowhere but to the receivers' sums.
        grads = torch.autograd.grad(out.sin().sum(), wanted, allow_unused=True)
        results.append([out, *grads])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-11)


def test_gradcheck():
    vertex, edge, senders, receivers, weight = example(12)
    net = network()
    inputs = [t.requires_grad_() for t in (vertex, edge, weight)]
    assert torch.autograd.gradcheck(
        lambda v, e, w: net(v, e, senders, receivers, w), inputs, atol=1e-6
    )


def test_bfloat16_is_close_and_float32_is_untouched_by_it():
    data = [t.float() if t.is_floating_point() else t for t in example()]
    net = network().float()
    with torch.inference_mode():
        exact = net(*data)
        with torch.autocast("cpu", torch.bfloat16):
            short = net(*data)
    assert short.dtype == torch.float32
    error = (short - exact).norm() / exact.norm()
    assert 0 < error < 0.02


def test_edge_latents_change_in_every_block():
    vertex, edge, senders, receivers, weight = example()
    net = network()
    seen: list[torch.Tensor] = []
    for block in net.blocks:
        block.register_forward_hook(lambda _m, args, out: seen.extend([args[1], out[1]]))
    net(vertex, edge, senders, receivers, weight)
    for before, after in zip(seen[::2], seen[1::2], strict=True):
        change = after - before
        # Not doubled, as a bug of long standing elsewhere had it, but by a message of their own.
        assert change.abs().max() > 0.1
        assert (change - before).abs().max() > 0.1


def test_latents_of_an_isolated_vertex_do_not_depend_on_others():
    block = Block(8, partial(MLP, hidden=8, hidden_layers=2, activation="silu"))
    vertex, edge = torch.randn(3, 8), torch.randn(2, 8)
    senders, receivers = torch.tensor([0, 1]), torch.tensor([1, 0])
    one, _ = block(vertex, edge, senders, receivers, None, torch.float32)
    other, _ = block(vertex, 2 * edge, senders, receivers, None, torch.float32)
    assert torch.equal(one[2], other[2])
    assert not torch.equal(one[0], other[0])


def test_no_edges_at_all():
    net = network()
    empty = torch.zeros(0, dtype=torch.int64)
    weight = torch.zeros(0, 1).double()
    vertex = torch.randn(4, 5).double()
    out = net(vertex, torch.zeros(0, 4).double(), empty, empty, weight)
    assert torch.isfinite(out).all()
    out.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def test_compiled_path_is_the_same_network(monkeypatch):
    net, data = network(), example()
    expected = net(*data)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    torch.testing.assert_close(net(*data), expected)


def test_layernorm_on_all_but_the_decoder():
    net = network()
    normed = [m for m in net.modules() if isinstance(m, nn.LayerNorm)]
    assert len(normed) == 2 + 2 * len(net.blocks)
    assert net.decode.norm is None
