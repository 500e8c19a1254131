"""The colours of the report, once: matplotlib and the page's CSS both take them from here.

The flow is sand-coloured and everything that a person decides on (layouts) is not, so that no
colour has two meanings. The two themes differ in more than the background: a depth map has to
grow away from its ground, so it darkens on paper and brightens on a dark screen.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache
from typing import Any

from matplotlib import font_manager
from matplotlib.colors import LinearSegmentedColormap

#: Width of a figure across the page [inch].
WIDTH = 10.4

#: Wanted first, for a page that is read beside system-ui text; DejaVu comes with matplotlib.
FONTS = ("Inter", "Helvetica Neue", "Helvetica", "Arial", "Liberation Sans", "DejaVu Sans")


@dataclass(frozen=True)
class Theme:
    """One set of colours, as CSS hex strings."""

    name: str
    page: str  #: behind everything
    paper: str  #: behind text, tables and charts
    ground: str  #: the base of the flume in a view
    ink: str
    muted: str
    line: str
    best: str  #: the layout that the search found
    own: str  #: the layout that the scene file holds
    none: str  #: no baffles
    good: str
    bad: str
    sand: tuple[str, ...]  #: thin to thick
    origins: tuple[str, ...]  #: where a trial came from, in order of first appearance

    def css_variables(self) -> str:
        """`--ink: #…;` for every single colour."""
        names = [f.name for f in fields(self) if f.name not in ("name", "sand", "origins")]
        sand = f"--sand: {self.sand[len(self.sand) // 2]};"
        return " ".join([f"color-scheme: {self.name};", sand]) + " ".join(
            f" --{name}: {getattr(self, name)};" for name in names
        )

    def colormap(self) -> LinearSegmentedColormap:
        """Depth of sand: the ground where there is none, then thin to thick."""
        return LinearSegmentedColormap.from_list(f"sand-{self.name}", [self.ground, *self.sand])

    def rc(self) -> Any:
        """matplotlib settings, a dict: hairlines, no box, text in the page's ink."""
        return {
            "font.family": _available_fonts(),
            "font.size": 9,
            "axes.titlesize": 9.5,
            "axes.titleweight": "bold",
            "axes.titlelocation": "left",
            "axes.titlepad": 7,
            "axes.labelsize": 9,
            "axes.labelcolor": self.muted,
            "axes.titlecolor": self.ink,
            "axes.edgecolor": self.line,
            "axes.facecolor": self.paper,
            "axes.linewidth": 0.8,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "axes.axisbelow": True,
            "grid.color": self.line,
            "grid.linewidth": 0.6,
            "xtick.color": self.line,
            "ytick.color": self.line,
            "xtick.labelcolor": self.muted,
            "ytick.labelcolor": self.muted,
            "xtick.labelsize": 8,
            "ytick.labelsize": 8,
            "legend.frameon": False,
            "legend.fontsize": 8.5,
            "legend.labelcolor": self.ink,
            "text.color": self.ink,
            "lines.linewidth": 1.6,
            "figure.facecolor": self.paper,
            "savefig.facecolor": self.paper,
        }


LIGHT = Theme(
    name="light",
    page="#f4f2ee",
    paper="#ffffff",
    ground="#f3f0ea",
    ink="#1d1b18",
    muted="#6d675d",
    line="#dfdad1",
    best="#0f766e",
    own="#5b50c8",
    none="#7a746a",
    good="#0f766e",
    bad="#b42318",
    sand=("#ecdcb8", "#dcae5c", "#b8722c", "#7c3f17", "#42200d"),
    origins=("#8a8378", "#2f6fb2", "#c2571a", "#94307c", "#5c7f1e", "#1f8aa0"),
)

DARK = Theme(
    name="dark",
    page="#131210",
    paper="#1b1917",
    ground="#26231f",
    ink="#eee9e1",
    muted="#a59e92",
    line="#3a3630",
    best="#3fd0bd",
    own="#aaa3ff",
    none="#a59e92",
    good="#3fd0bd",
    bad="#ff8a7a",
    sand=("#4a3821", "#84592a", "#c58a3d", "#ecc26f", "#fff0c9"),
    origins=("#a59e92", "#6aaef0", "#f0935a", "#e07cc6", "#a9cf5e", "#5cc7dc"),
)


def layout_colour(theme: Theme, key: str) -> str:
    """The colour of a layout, the same in every figure; ranks after the first share one."""
    return {"best": theme.best, "paper": theme.own, "none": theme.none}.get(key, theme.sand[2])


@cache
def _available_fonts() -> list[str]:
    """Those of FONTS that are installed; naming a missing one makes matplotlib warn each time."""
    installed = {font.name for font in font_manager.fontManager.ttflist}
    return [name for name in FONTS if name in installed] or ["sans-serif"]
