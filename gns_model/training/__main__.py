"""`python -m gns_model.training RECIPE --out DIR`: one rank of a training run.

Alone it trains in one process; under `torchrun` or `launch` it is one of several.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from gns_model.console import main
from gns_model.training.distributed import leave
from gns_model.training.loop import train
from gns_model.training.recipe import Recipe

app = typer.Typer(add_completion=False)


@app.command()
def run(
    recipe: Annotated[Path, typer.Argument(help="Recipe (TOML), see examples/recipes.")],
    out: Annotated[Path, typer.Option(help="Folder for weights, state, logs and plot.")],
    resume: Annotated[bool, typer.Option(help="Go on from the state in --out, if any.")] = True,
) -> None:
    """Train a learned simulator."""
    path = train(Recipe.from_toml(recipe), out, resume=resume)
    if os.environ.get("RANK", "0") == "0":
        print(path)
    leave()


if __name__ == "__main__":
    main(app, "python -m gns_model.training")
