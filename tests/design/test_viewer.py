"""The view of the flow: what is in the page, and what a browser shows when its slider moves."""

import base64
import json
import re
import time

import numpy as np
import pytest

from design import viewer
from design.flow_figures import shown_flows
from design.report import render
from design.results import RunResults
from gns_model import measures

from .browser import Browser, find
from .fake_run import channel, write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return RunResults(write_run(tmp_path_factory.mktemp("run"), trials=10))


@pytest.fixture(scope="module")
def page(run):
    """The page without its pictures, as a file."""
    path = run.folder / "report.html"
    path.write_text(render(run, {}), encoding="utf-8")
    return path


def data_of(html):
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', html, re.S)
    return json.loads(text)


def test_the_data_are_the_flow(run):
    shown = shown_flows(run)
    data = data_of(viewer.view(shown))
    lower, upper = np.array(data["scene"]["lower"]), np.array(data["scene"]["upper"])
    for (_, flow), packed in zip(shown.flows, data["flows"], strict=True):
        raw = np.frombuffer(base64.b64decode(packed["positions"]), "<u2")
        positions = raw.reshape(len(data["times"]), packed["grains"], 3) / 65535
        positions = lower + positions * (upper - lower)
        assert packed["grains"] <= viewer.GRAINS
        whole = measures.moving_positions(flow)
        if packed["grains"] == whole.shape[1]:
            np.testing.assert_allclose(positions[-1], whole[-1], atol=2e-5)
        centre = whole[-1].mean(axis=0)
        np.testing.assert_allclose(positions[-1].mean(axis=0), centre, atol=0.02)
        summary = measures.summary(flow)
        for name in ("centroid_travel", "runout_p99"):
            assert float(packed["numbers"][name][-1]) == pytest.approx(summary[name], abs=6e-4)
        past = float(packed["numbers"]["mass_past_section"][-1]) / 100
        assert past == pytest.approx(summary["mass_past_section"], abs=6e-4)
        assert len(packed["baffles"]) == len(flow.scene.baffles)


def test_many_grains_are_thinned_evenly(run, monkeypatch):
    monkeypatch.setattr(viewer, "GRAINS", 100)
    monkeypatch.setattr(viewer, "FRAMES", 5)
    shown = shown_flows(run)
    data = data_of(viewer.view(shown))
    flow = data["flows"][0]
    assert flow["grains"] == 100
    assert data["times"][0] == 0
    assert data["times"][-1] == pytest.approx(shown.flows[0][1].time[-1])
    assert len(data["times"]) == 5
    raw = np.frombuffer(base64.b64decode(flow["positions"]), "<u2").reshape(5, 100, 3)
    assert raw[0].std(axis=0).min() > 1000  # from all of the release, in every direction


def test_a_name_cannot_end_the_script(run):
    shown = shown_flows(run)
    shown.flows[0][0].label = "</script><b>x"
    html = viewer.view(shown)
    assert "<b>x" not in html
    data_of(html)
    shown.flows[0][0].label = "Best found"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    executable = find()
    if executable is None:
        pytest.skip("no Chromium on this machine (apt-get install chromium)")
    with Browser(executable, tmp_path_factory.mktemp("profile")) as opened:
        yield opened


NUMBERS = """[...document.querySelectorAll("figure.flow .panels > div")].map(panel =>
  Object.fromEntries([...panel.querySelectorAll("[data-measure]")].map(
    cell => [cell.dataset.measure, cell.textContent])))"""
CANVAS = 'document.querySelector("figure.flow canvas").toDataURL()'


def test_slider_in_a_browser(run, page, browser):
    """The slider, moved by the keyboard, changes time, numbers and picture; a drag turns it."""
    browser.open(page)
    assert browser.run('document.querySelector("figure.flow").dataset.ready') == "yes"
    shown = shown_flows(run)
    flows = [flow for _, flow in shown.flows]
    data = data_of(page.read_text(encoding="utf-8"))

    def check(frame):
        clock = browser.run('document.querySelector("figure.flow output").value')
        assert clock == f"t = {data['times'][frame]:.2f} s"
        for found, flow in zip(browser.run(NUMBERS), flows, strict=True):
            at = int(np.abs(flow.time - data["times"][frame]).argmin())
            x = measures.moving_positions(flow)[:, :, 0]
            travel = float(found["centroid_travel"].replace("−", "-"))
            assert travel == pytest.approx(x[at].mean() - x[0].mean(), abs=6e-4)
            past = float(found["mass_past_section"])
            assert past == pytest.approx(
                100 * (x[at] > flow.scene.control_section).mean(), abs=0.06
            )

    last = len(data["times"]) - 1
    check(last)
    end = browser.run(CANVAS)
    browser.run('document.querySelector("figure.flow input").focus()')
    browser.key("Home")
    check(0)
    begin = browser.run(CANVAS)
    assert begin != end
    for _ in range(3):
        browser.key("ArrowRight")
    check(3)
    browser.key("End")
    check(last)
    assert browser.run(CANVAS) == end
    place = browser.run(
        """(() => { const c = document.querySelector("figure.flow canvas");
        c.scrollIntoView({block: "center"}); const r = c.getBoundingClientRect();
        return [r.x + r.width / 2, r.y + r.height / 2]; })()"""
    )
    browser.drag(*place, 80, 20)
    assert browser.run(CANVAS) != end
    browser.picture(run.folder / "view.png")
    asked = [
        e["params"]["request"]["url"]
        for e in browser.events
        if e.get("method") == "Network.requestWillBeSent"
    ]
    assert [url for url in asked if not url.startswith(("file:", "data:", "about:"))] == []
    assert not [e for e in browser.events if e.get("method") == "Runtime.exceptionThrown"]


def test_play_runs_to_the_end(page, browser):
    browser.open(page)
    last = browser.run('Number(document.querySelector("figure.flow input").max)')
    browser.run(
        'document.querySelector("figure.flow input").value = '
        f"{last - 2}; document.querySelector('figure.flow button').click()"
    )
    deadline = time.monotonic() + 60
    while browser.run('document.querySelector("figure.flow button").textContent') != "Play":
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert browser.run('Number(document.querySelector("figure.flow input").value)') == last


def test_plane_strain_in_a_browser(tmp_path, browser):
    run = RunResults(write_run(tmp_path, channel(), layouts=([[0.9]], [[1.0]]), trials=10))
    path = tmp_path / "report.html"
    path.write_text(render(run, {}), encoding="utf-8")
    browser.open(path)
    assert browser.run('document.querySelector("figure.flow").dataset.ready') == "yes"
    sand = browser.run(
        """(() => { const c = document.querySelector("figure.flow canvas");
        const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        let n = 0; for (let i = 3; i < d.length; i += 4) n += d[i] > 200; return n; })()"""
    )
    assert sand > 500
    browser.picture(tmp_path / "view.png")


WIDER = """[...document.querySelectorAll(".scroll, main")]
  .filter(e => e.scrollWidth > e.clientWidth + 1).length"""


@pytest.fixture
def screen(browser):
    """Shows the page as wide as asked for, on screen or printed; as before when done."""

    def show(width, media="screen"):
        browser.call("Emulation.setEmulatedMedia", media=media)
        browser.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=900, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip

    yield show
    browser.call("Emulation.setEmulatedMedia", media="")
    browser.call("Emulation.clearDeviceMetricsOverride")


def test_a_printed_page_shows_its_tables_whole(page, browser, screen):
    """A4 less its margins is 182 mm: 688 pixels of CSS. On paper nothing can be scrolled to."""
    browser.open(page)
    assert browser.run('document.querySelectorAll("main table").length') > 4
    screen(688, "print")
    assert browser.run(WIDER) == 0
    answer = browser.run('document.querySelector(".answer").getBoundingClientRect().bottom')
    assert answer < 0.9 * 688 * (297 - 28) / 182  # where the baffles go is on the first sheet


def test_on_a_phone_only_tables_are_wider_than_the_screen(page, browser, screen):
    browser.open(page)
    screen(390)
    assert browser.run("document.documentElement.scrollWidth") <= 390
    assert browser.run(WIDER) > 0  # they scroll within their cards
