"""The page tells what the folder holds, admits what it does not, and stands alone."""

import json
import re
import shutil
from html.parser import HTMLParser

import pytest

from design.geometry import write_geometry
from design.report import render, write_report
from design.results import RunResults
from gns_model.scene import Scene

from .fake_run import BEST, OWN, SECOND, channel, write_run

VOID = {"meta", "img", "br", "input"}


class Checked(HTMLParser):
    """Refuses tags that do not nest, and collects text and addresses."""

    def __init__(self, source):
        super().__init__()
        self.open, self.words, self.links, self.sources = [], [], [], []
        self.feed(source)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        if tag not in VOID:
            self.open.append(tag)
        given = dict(attributes)
        self.links += [given["href"]] if "href" in given else []
        self.sources += [given["src"]] if "src" in given else []

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self):
        return re.sub(r"\s+", " ", " ".join(self.words))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = write_run(tmp_path_factory.mktemp("run"))
    write_geometry(Scene.from_toml(folder / "layouts/best.toml"), folder / "layouts", "best")
    return folder


@pytest.fixture(scope="module")
def page(folder):
    return Checked(write_report(folder).read_text(encoding="utf-8"))


@pytest.fixture
def copy(folder, tmp_path):
    """The run folder, to take parts of it away."""
    return shutil.copytree(folder, tmp_path / "run")


def read(folder):
    """The page without its figures: they take the time, and test_figures has them."""
    return Checked(render(RunResults(folder), {}))


def edit(folder, change):
    path = folder / "summary.json"
    summary = json.loads(path.read_text())
    change(summary)
    path.write_text(json.dumps(summary))


def test_the_answer_is_there_with_coordinates_and_verified_numbers(page, folder):
    summary = json.loads((folder / "summary.json").read_text())
    verified = summary["best"]["verified"]
    own = summary["paper_layout"]["verified"]
    none = summary["no_baffles"]["verified"]
    assert "Verified by the reference solver" in page.text
    for x, z in BEST:
        assert f"{x:.3f}" in page.text
        assert f"{z:.3f}" in page.text
    assert f"moves {verified['centroid_travel']:.3f} m" in page.text
    for other in (own, none):
        share = 100 * (verified["centroid_travel"] / other["centroid_travel"] - 1)
        assert f"{abs(share):.1f} % less than" in page.text
        assert f"−{abs(share):.1f} %" in page.text
        assert f"{100 * other['mass_past_section']:.2f} %" in page.text
    assert "What is missing" not in page.text


def test_the_gap_of_the_surrogate_is_told(page, folder):
    best = json.loads((folder / "summary.json").read_text())["best"]
    for name in ("centroid_travel", "upstream_depth", "runout_p99"):
        gap = 100 * (best["surrogate"][name] / best["verified"][name] - 1)
        assert f"{gap:+.1f} %".replace("-", "−") in page.text
    assert "rank correlation" in page.text
    assert "Four layouts ran on the reference solver" in page.text


def test_the_page_stands_alone_and_its_links_exist(page, folder):
    assert len(page.sources) == 6 * 2 + 1
    assert all(source.startswith("data:image/") for source in page.sources)
    assert {"layouts/best.toml", "layouts/best.stl", "layouts/best.glb"} <= set(page.links)
    for link in page.links:
        assert (folder / link).is_file()
    source = (folder / "report.html").read_text(encoding="utf-8")
    assert "<script src" not in source
    assert not re.search(r"(?:src|href)=.https?:|@import|url\(http", source)


def test_names_from_files_are_escaped(page, folder):
    source = (folder / "report.html").read_text(encoding="utf-8")
    assert "flume <of the paper>" in page.text
    for raw in ("<of the paper>", "<mine>", "<baffle-lite>"):
        assert raw not in source
    assert "models/<mine> & co" in page.text


def test_the_command_reproduces_the_run(page, folder):
    assert f"gns-design optimize {folder}/scene.toml --method hybrid --baffles 3" in page.text
    assert "--depth-weight 0.05" in page.text
    assert "2 min 38 s" in page.text
    assert "2.13.0" in page.text


def test_no_better_than_the_scene_own_layout_is_said_first(tmp_path):
    folder = write_run(tmp_path, layouts=(OWN[:2], SECOND), spacing=0.07)
    edit(folder, lambda s: s["best"].update(verified_cost=s["paper_layout"]["verified_cost"] * 1.1))
    page = read(folder)
    assert "nothing better than the scene's own layout" in page.text
    assert "not better than the scene's own layout" in page.text
    assert "stop the flow" not in page.text


def test_an_interrupted_run_says_that_nothing_is_verified(tmp_path):
    folder = write_run(tmp_path, verified=False, spacing=0.07)
    page = Checked(write_report(folder, gif=False).read_text(encoding="utf-8"))
    assert len(page.sources) == 4 * 2
    for words in (
        "Not verified yet",
        "These numbers are predictions",
        "What is missing",
        "interrupted",
        "--resume",
        "has not run any layout",
    ):
        assert words in page.text
    assert "On the reference solver, the centre" not in page.text


def test_a_failed_verification_is_not_recommended(copy):
    def fail(summary):
        for entry in (summary["best"], summary["ranked"][0]):
            entry.update(verified=None, verified_status="diverged", verified_cost=12.5)

    edit(copy, fail)
    (copy / "trajectories/best-mpm.h5").unlink()
    page = read(copy)
    assert "Failed on the reference solver" in page.text
    assert "cannot be recommended" in page.text


def test_before_any_summary_the_trials_alone_give_a_page(copy):
    (copy / "summary.json").unlink()
    for path in (copy / "trajectories").glob("best-*"):
        path.unlink()
    run = RunResults(copy)
    lowest = min(t.cost for t in run.trials if t.cost is not None)
    assert run.design("best").cost == lowest
    page = read(copy)
    assert "has not written its summary" in page.text
    assert "Where the baffles go" in page.text


def test_broken_parts_are_named_and_the_rest_is_shown(copy):
    path = copy / "trajectories/paper-mpm.h5"
    path.write_bytes(path.read_bytes()[:2000])
    (copy / "trials.csv").write_bytes(b"\xff\xfe\x00number")
    page = read(copy)
    assert "paper-mpm.h5" in page.text
    assert "trials.csv cannot be read" in page.text
    assert "Where the baffles go" in page.text


def test_an_empty_folder_gives_a_page_that_says_so(tmp_path):
    page = read(tmp_path)
    assert "No layout yet" in page.text
    assert "What is missing" in page.text


def test_plane_strain(tmp_path):
    page = read(write_run(tmp_path, channel(), layouts=([(1.0,)], [(0.9,)]), spacing=0.02))
    assert "x [m]" in page.text
    assert "z [m]" not in page.text
    assert "1.000" in page.text
    assert "J/m" in page.text


def test_files_are_written_whole(page, folder):
    assert not [p for p in folder.rglob(".*")]
    assert {"report.html", "flow.gif", "figures"} <= {p.name for p in folder.iterdir()}
