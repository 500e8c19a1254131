"""The scenes and numbers of Choi & Kumar that the solver and the models are held against.

"Graph Neural Network-based surrogate model for granular flows", table "Normalized runout" and
section "Flow with debris-resisting baffles". `examples/` holds the same scenes as files.
"""

from __future__ import annotations

from dataclasses import dataclass

from gns_model.scene import Scene

#: Base friction of the columns [-]. The paper does not state it; this value was calibrated on the
#: six runouts of its MPM together (`gns-model validate`), so their agreement is a fit, not a proof.
COLUMN_BASE_FRICTION = 0.265


@dataclass(frozen=True)
class Column:
    """A column against the left wall: height and length [m], and the paper's normalised runout."""

    aspect: float
    height: float
    length: float
    runout_mpm: float
    runout_gns: float
    domain: tuple[float, float] = (1.0, 0.5)


#: The table's rows. Its a = 4.0 reads 0.35 x 0.075 m, which is a = 4.67; its 576 points fit 0.30.
COLUMNS = (
    Column(0.5, 0.20, 0.40, 0.831, 0.811),
    Column(0.8, 0.24, 0.30, 1.444, 1.445),
    Column(1.0, 0.30, 0.30, 2.071, 2.152),
    Column(2.0, 0.30, 0.15, 3.892, 3.682),
    Column(3.0, 0.36, 0.12, 5.620, 5.341),
    Column(4.0, 0.30, 0.075, 5.753, 6.070),
)
UPSCALED = Column(0.8, 0.36, 0.45, 1.76, 1.74, domain=(1.5, 1.0))

#: What the paper says of its flume: arrival at the rows and rest [s], peak upstream depth [m].
FLUME_FACTS = {
    "row_1_arrival": (0.12, 0.16),
    "row_2_arrival": (0.30, 0.36),
    "rest": (0.58, 0.70),
}


#: Friction angles of the paper's multi-friction collapse [degrees].
FRICTION_ANGLES = (15.0, 22.5, 30.0, 37.5, 45.0)


def column_material(friction_angle: float = 30.0) -> dict[str, float]:
    """The columns' grains. E is 20 MPa: the paper's 2 GPa costs 10 times as much for the same."""
    return {
        "density": 1800.0,
        "youngs_modulus": 2.0e7,
        "poisson_ratio": 0.3,
        "friction_angle": friction_angle,
        "cohesion": 100.0,
        "tension_cutoff": 50.0,
    }


def column_scene(
    column: Column,
    *,
    base_friction: float = COLUMN_BASE_FRICTION,
    friction_angle: float = 30.0,
) -> Scene:
    """A granular column in plane strain, against the left wall."""
    return Scene.from_dict(
        {
            "name": f"column-a-{column.aspect:.1f}",
            "duration": 1.0,
            "domain": {"lower": (0.0, 0.0), "upper": column.domain},
            "friction": {"base": base_friction, "walls": 0.0},
            "material": column_material(friction_angle),
            "release": [
                {
                    "lower": (0.0, 0.0),
                    "upper": (column.length, column.height),
                    "velocity": (0.0, 0.0),
                }
            ],
        }
    )


def flume_scene() -> Scene:
    """The flume with three baffles, as `examples/flume.toml` has it."""
    size = (0.15, 0.30, 0.15)
    centres = ((0.775, 0.375), (0.775, 1.625), (1.275, 1.0))
    return Scene.from_dict(
        {
            "name": "flume",
            "duration": 0.9,
            "section": 1.1,
            "domain": {"lower": (0.1, 0.1, 0.1), "upper": (1.9, 0.9, 1.9)},
            "friction": {"base": 0.7, "walls": 0.0, "baffles": 0.7},
            "material": {"density": 1800.0, "youngs_modulus": 2.0e6, "friction_angle": 35.0},
            "release": [
                {
                    "lower": (0.1, 0.1, 0.3),
                    "upper": (0.45, 0.35, 1.7),
                    "velocity": (2.0, 0.0, 0.0),
                }
            ],
            "baffle": [{"center": centre, "size": size} for centre in centres],
            "placement": {"lower": (0.6, 0.1), "upper": (1.5, 1.9), "gap": 0.10, "size": size},
        }
    )
