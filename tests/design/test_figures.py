"""Figures show what the run folder holds, and maps keep the mass."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from design import animation, views
from design.agreement_figures import COMPARED
from design.figures import FIGURES, png, write_figures
from design.flow_figures import shown_flows
from design.results import LEARNED, SOLVER, RunResults
from design.search_figures import _front, history, trade_off
from design.theme import DARK, LIGHT

from .fake_run import BEST, channel, flume, slide, write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return RunResults(write_run(tmp_path_factory.mktemp("run")))


def test_a_whole_run_has_every_figure(run):
    pictures = write_figures(run)
    # The front is drawn where there are several objectives: test_pareto.py.
    assert set(pictures) == set(FIGURES) - {"front"}
    for name, (light, dark) in pictures.items():
        shown = Image.open(run.folder / "figures" / f"{name}.png").convert("RGB")
        assert shown.width > 1500
        assert shown.getpixel((1, 1)) == (255, 255, 255)
        ground = Image.open(io.BytesIO(dark)).convert("RGB").getpixel((1, 1))
        assert f"#{ground[0]:02x}{ground[1]:02x}{ground[2]:02x}" == DARK.paper
        assert len(light) < 400_000


@given(
    frame=st.integers(0, 18),
    cell=st.sampled_from([0.03, 0.05, 0.08]),
    layout=st.sampled_from([None, [], BEST]),
)
@settings(max_examples=12, deadline=None)
def test_maps_hold_all_the_material(frame, cell, layout):
    scene = flume() if layout is None else flume().with_baffles(layout)
    flow = slide(scene, spacing=0.07)
    volume = flow.positions.shape[1] * flow.point_volume
    for seen, across in (
        (views.plan_map(flow, frame, cell=cell), 1.0),
        (views.side_map(flow, frame, cell=cell), scene.domain.size[2]),
    ):
        left, right, bottom, top = seen.extent
        area = (right - left) * (top - bottom) / seen.values.size
        assert seen.values.sum() * area * across == pytest.approx(volume, rel=1e-6)
    x, depth = views.surface(flow, frame, cell=cell)
    assert depth.sum() * (x[1] - x[0]) * scene.domain.size[2] == pytest.approx(volume, rel=1e-6)


def test_depth_stands_where_the_grains_are():
    flow = slide(flume(), spacing=0.05)
    seen = views.plan_map(flow, 0, cell=0.05)
    ix, iz = np.unravel_index(seen.values.argmax(), seen.values.shape)
    assert 0.1 + 0.05 * ix < 0.45
    assert 0.3 < 0.1 + 0.05 * iz < 1.7
    assert seen.values.max() == pytest.approx(0.25, rel=0.15)
    assert seen.values[20:].max() < 1e-6


def test_history_never_rises_and_shows_failures(run):
    axes = history(run, LIGHT).axes[0]
    texts = [t.get_text() for t in axes.get_legend().get_texts()]
    assert {"baseline", "bayes", "gradient", "best so far", "failed"} == set(texts)
    best = next(line for line in axes.lines if line.get_label() == "best so far")
    assert (np.diff(best.get_ydata()) <= 0).all()
    good = [t.cost for t in run.trials if t.cost is not None]
    assert best.get_ydata()[-1] == min(good)
    assert len(good) == len(run.trials) - 1
    notes = [t.get_text() for t in axes.texts]
    assert "No baffles" in notes
    assert "Scene's own layout" in notes


def test_one_absurd_cost_does_not_flatten_the_history(tmp_path):
    folder = write_run(tmp_path, spacing=0.07)
    lines = (folder / "trials.csv").read_text().splitlines()
    cells = lines[5].split(",")
    cells[3] = "400.0"
    lines[5] = ",".join(cells)
    (folder / "trials.csv").write_text("\n".join(lines))
    low, high = history(RunResults(folder), LIGHT).axes[0].get_ylim()
    assert high - low < 2.0


def test_trade_off_names_the_layouts(run):
    names = {t.get_text() for t in trade_off(run, LIGHT).axes[0].texts}
    assert names == {"Best found", "Scene's own layout", "No baffles"}


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1)), min_size=1, max_size=30))
def test_pareto_front_is_what_nothing_beats(points):
    points = np.array(points)
    front = _front(points)
    beaten = [any((q <= p).all() and (q < p).any() for q in points) for p in points]
    expected = {tuple(p) for p, b in zip(points, beaten, strict=True) if not b}
    assert {tuple(p) for p in front} == expected


def test_agreement_has_a_dot_for_every_layout_judged_twice(run):
    figure = FIGURES["agreement"](run, LIGHT)
    assert len(figure.axes) == len(COMPARED)
    for axes in figure.axes:
        dots = [line for line in axes.lines if line.get_marker() == "o"]
        assert len(dots) == len(list(run.compared())) == 4


def test_flows_side_by_side_are_by_one_simulator(run, tmp_path):
    assert shown_flows(run).by == "reference solver"
    folder = write_run(tmp_path, spacing=0.07)
    (folder / "trajectories" / f"paper-{SOLVER}.h5").unlink()
    (folder / "trajectories" / f"none-{SOLVER}.h5").unlink()
    shown = shown_flows(RunResults(folder))
    assert shown.by == "learned simulator"
    assert [d.key for d, _ in shown.flows] == ["best", "paper"]
    for key in ("best", "paper", "none"):
        (folder / "trajectories" / f"{key}-{LEARNED}.h5").unlink()
    alone = shown_flows(RunResults(folder))
    assert alone.by == "reference solver"
    assert [d.key for d, _ in alone.flows] == ["best"]


def test_animation_is_small_moves_and_ends_with_a_pause(run):
    path = animation.write_animation(run)
    assert path.stat().st_size <= animation.MOST_BYTES
    with Image.open(path) as film:
        assert film.n_frames == animation.FRAMES
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(film.n_frames - 1)
        assert film.info["duration"] == animation.HOLD_MS
        last = np.asarray(film.convert("RGB")).astype(int)
        assert film.info.get("loop", 0) == 0
    assert (np.abs(first - last).sum(-1) > 60).mean() > 0.02


def test_animation_shrinks_until_it_fits(run, monkeypatch):
    monkeypatch.setattr(animation, "FRAMES", 4)
    path = animation.write_animation(run)
    size = path.stat().st_size
    with Image.open(path) as film:
        width = film.width
    with Image.open(animation.write_animation(run, most_bytes=size - 1)) as film:
        assert film.width < width
    assert path.stat().st_size < size


def test_plane_strain_has_no_plan(tmp_path):
    run = RunResults(write_run(tmp_path, channel(), layouts=([(1.0,)], [(0.9,)]), spacing=0.02))
    assert png(run, "plan", LIGHT) is None
    for name in ("side", "deposit"):
        assert png(run, name, LIGHT) is not None


def test_an_empty_folder_has_no_figures(tmp_path):
    run = RunResults(tmp_path)
    assert write_figures(run) == {}
    assert animation.write_animation(run) is None
    assert list(tmp_path.iterdir()) == []
