"""The design gradient of a real flow, by the model that layouts are chosen with."""

import numpy as np
import pytest
import torch

from design.gradient import cost_and_gradient, differentiate, smooth_costs
from gns_env.objective import Objective
from gns_env.task import BaffleTask
from gns_model.simulator import load_simulator


@pytest.mark.slow
def test_the_gradient_of_a_whole_flow_says_what_a_move_does(small_flume):
    """Measured: 0.89 with one start, 0.93 with the mean of two, three times and twice as long as
    the differences; 0.92 and 0.96 before the model was trained through whole flows. A flow of 650
    grains over 20 steps is too tame to tell shared adjoints from exact ones:
    `benchmarks/gradients.py` does that."""
    scene = small_flume.replace(duration=0.4)
    travel = Objective(depth_weight=0.0)
    task = BaffleTask(scene, load_simulator("baffle-lite"), n_baffles=1, objective=travel)
    layout, starts, step = np.array([[0.45, 0.22]]), 2, 0.02

    def cost(centres):
        with torch.no_grad():
            leaves = [torch.tensor(centres)] * starts
            return float(smooth_costs(task, leaves, draws=range(starts))[1].mean())

    differences = np.array(
        [(cost(layout + m) - cost(layout - m)) / (2 * step) for m in step * np.eye(2)[:, None]]
    )
    _, one = cost_and_gradient(task, layout)
    _, mean = cost_and_gradient(task, layout, starts=starts)
    for gradient, least in ((one, 0.88), (mean, 0.90)):
        norms = np.linalg.norm(gradient) * np.linalg.norm(differences)
        assert (gradient[0] * differences).sum() / norms >= least, (gradient, differences)
    # What a search asks for is the same gradient, and another start another one.
    np.testing.assert_allclose(differentiate(task, [layout])[0].gradient, one, rtol=1e-3)
    assert np.abs(mean - one).max() > 1e-3
