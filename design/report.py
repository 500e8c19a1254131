"""report.html: what a search found, as one page that can be mailed.

It is read from top to bottom by somebody who wants to build: where the baffles go, what that gains
as measured by the reference solver, how it looks, how far the learned simulator is to be trusted,
what else there was to choose from, and how to get the same page again. Every number is read from
the run folder; what is missing there is said in words.
"""

from __future__ import annotations

from pathlib import Path

from design import animation, page
from design.answer import answer, gains
from design.constraints_page import kept
from design.evidence import Pictures, choice, flow, search, trust
from design.figures import write_figures
from design.front_page import pareto, scenarios
from design.provenance import files, reproduce
from design.results import RunResults
from gns_model.files import write_whole

FOOTER = (
    "<footer>Baffle layout by gns-design. Axes: x downstream, y up, z across; SI units. "
    "Coordinates are the centres of the footprints.</footer>"
)


def write_report(folder: str | Path, *, gif: bool = True) -> Path:
    """Write figures/*.png, flow.gif and report.html of a run folder, each whole; return the page.

    A partial run gives a partial page. `gif=False` leaves the animation out: it takes seconds.
    """
    run = RunResults(folder)
    pictures = write_figures(run)
    if gif:
        animation.write_animation(run)
    path = run.folder / "report.html"
    write_whole(path, render(run, pictures).encode())
    return path


def render(run: RunResults, pictures: Pictures) -> str:
    """The page as text, from what is in the folder and `pictures` of it."""
    name = run.scene.name if run.scene else run.folder.name
    parts = [
        answer(run, name),
        gains(run),
        kept(run),
        flow(run, pictures),
        trust(run, pictures),
        pareto(run, pictures),
        scenarios(run),
        choice(run, pictures),
        search(run, pictures),
        reproduce(run),
        files(run),
    ]
    return page.document(f"Baffle layout · {name}", "".join(parts) + FOOTER)
