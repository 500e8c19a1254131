"""The windows of each step, read while the GPU still works on the step before."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

from gns_model.data.windows import Window, WindowIndex
from gns_model.training import batches
from gns_model.training.distributed import Ranks
from gns_model.training.kinematic import kinematic_spacing
from gns_model.training.recipe import Recipe
from gns_model.training.statistics import Statistics


class Feeder:
    """Reads this rank's windows of any step; what they are follows from the seed and the step.

    Args:
        ahead: read those of the next step in the background. Where steps are computed on the CPU,
            that would only take its time from them.
    """

    def __init__(
        self,
        data: WindowIndex,
        recipe: Recipe,
        statistics: Statistics,
        ranks: Ranks,
        *,
        ahead: bool,
    ) -> None:
        self._data, self._recipe, self._statistics = data, recipe, statistics
        self._ranks = ranks
        self._pool = ThreadPoolExecutor(1) if ahead else None
        self._next: tuple[tuple[int, int], Future[tuple[list[Window], float]]] | None = None

    def unroll(self, step: int, progress: float) -> int:
        """How many steps the model takes in optimiser step `step`, `progress` into the budget."""
        recipe = self._recipe
        if recipe.unroll == 1 or not recipe.unrolled(progress):
            return 1
        rng = batches.generator(recipe.seed, batches.UNROLL, step)
        return int(rng.integers(1, recipe.unroll + 1))

    def take(self, step: int, progress: float) -> tuple[list[Window], float]:
        """The windows of optimiser step `step`, and about how many edges they have."""
        key = (step, self.unroll(step, progress))
        if self._next is not None and self._next[0] == key:
            taken = self._next[1].result()
        else:
            taken = self._read(*key)
        if self._pool is not None:
            after = (step + 1, self.unroll(step + 1, progress))
            self._next = (after, self._pool.submit(self._read, *after))
        return taken

    def close(self) -> None:
        """End the thread."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def _read(self, step: int, unroll: int) -> tuple[list[Window], float]:
        recipe = self._recipe
        drawn = batches.draw(
            self._data,
            batches.generator(recipe.seed, batches.DRAW, step),
            ranks=self._ranks.world,
            edges_per_batch=recipe.edges_per_batch,
            statistics=self._statistics,
            mirror=recipe.mirror,
            early=recipe.early,
            early_steps=recipe.early_steps,
            halves=recipe.halves,
            unroll=unroll,
        )[self._ranks.rank]
        kinematic = kinematic_spacing(recipe.model)
        windows = [
            batches.read(self._data, item, unroll=unroll, kinematic=kinematic) for item in drawn
        ]
        return windows, sum(item.edges for item in drawn)
