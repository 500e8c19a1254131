"""The commands that read and write the formats of geoelements/gns."""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gns_model import console

Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bar.")]
Metadata = Annotated[Path, typer.Option(help="metadata.json of the dataset.")]
Dt = Annotated[
    float | None,
    typer.Option(min=1e-9, help="Time between frames in s; default: the metadata's, or 0.0025."),
]


class EdgeUpdate(StrEnum):
    """How edges go on from block to block."""

    residual = "residual"
    doubled = "doubled"


class Section(StrEnum):
    """Sections of a split metadata file."""

    train = "train"
    rollout = "rollout"


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command("import")(import_model)
    app.command("import-dataset")(import_dataset)
    app.command("export-dataset")(export_dataset)


def import_model(
    model: Annotated[Path, typer.Argument(help="Checkpoint of geoelements/gns, model-N.pt.")],
    metadata: Metadata,
    edge_update: Annotated[
        EdgeUpdate,
        typer.Option(help="doubled for weights trained before December 2024, else residual."),
    ],
    noise_std: Annotated[
        float, typer.Option(min=0.0, help="Its training noise in m; theirs is 6.7e-4 by default.")
    ],
    out: Annotated[Path, typer.Option(help="Checkpoint folder to write.")],
    dt: Dt = None,
    spacing: Annotated[
        float | None,
        typer.Option(min=1e-9, help="Of the points of a scene in m; default: by the radius."),
    ] = None,
) -> None:
    """Import the weights of geoelements/gns as a model of ours."""
    from gns_model.interop.weights import import_model as run
    from gns_model.learned.checkpoint import save_model

    loaded, card = run(
        model,
        metadata,
        edge_update=edge_update.value,
        noise_std=noise_std,
        dt=dt,
        spacing=spacing,
    )
    save_model(out, loaded, card)
    config = loaded.config
    print(
        f"{out}: {config.dim}D, {sum(p.numel() for p in loaded.parameters()):,} parameters, "
        f"{config.blocks} blocks, latent {config.latent}, {config.types or 'no'} types"
        + (", material property" if config.material_features else "")
    )
    for what, value in card["imported"]["assumed"].items():
        print(f"  assumed {what}: {value}")


def import_dataset(
    dataset: Annotated[Path, typer.Argument(help="train.npz, or its HDF5 form.")],
    metadata: Metadata,
    out: Annotated[Path, typer.Option(help="Folder to make.")],
    section: Annotated[Section, typer.Option(help="Of a split metadata file.")] = Section.train,
    dt: Dt = None,
    spacing: Annotated[
        float | None,
        typer.Option(min=1e-9, help="Of the points in m; default: as the first frame shows."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Import a dataset of geoelements/gns or DeepMind as trajectory files, to train on."""
    from gns_model.interop.dataset import import_dataset as run

    with warnings_as_lines(), console.progress_bar(quiet=quiet) as bar:
        task = bar.add_task(f"{dataset.name}", total=None)
        paths = run(
            dataset,
            metadata,
            out,
            section=section.value,
            dt=dt,
            spacing=spacing,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    print(f"{len(paths)} trajectories in {out}")


def export_dataset(
    folder: Annotated[Path, typer.Argument(help="Folder of trajectory files (HDF5).")],
    out: Annotated[Path, typer.Option(help="File to write, such as train.npz.")],
    radius: Annotated[
        float | None,
        typer.Option(min=1e-9, help="Connectivity radius for the metadata in m; default: paper's."),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            min=3, help="Write the first so many frames of every trajectory; default: all."
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Export trajectories as a dataset of geoelements/gns, with metadata.json beside it."""
    from gns_model.interop.export import export_dataset as run

    with console.progress_bar(quiet=quiet) as bar:
        task = bar.add_task(f"{out.name}", total=None)
        wrote = run(
            folder,
            out,
            radius=radius,
            frames=frames,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    print(f"{out}, metadata.json beside it" + ("" if wrote else " kept as it was"))


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Print warnings as one line each, without the place in the code."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for warning in caught:
        print(f"warning: {warning.message}", file=sys.stderr)
