"""The cabinet as a kind of sample part. Lengths in mm."""

from __future__ import annotations

import numpy as np
from kinds import Kind


def components() -> list:
    import assembly  # only where build123d is installed

    return assembly.components()


def seats() -> dict[str, np.ndarray]:
    """What is snapped on a rail stands on it."""
    on_rail = np.eye(4)
    on_rail[2, 3] = 7.5
    return dict.fromkeys(("breaker_1", "breaker_2", "breaker_3", "terminal_1", "terminal_2"), on_rail)


KIND = Kind(
    name="cabinet",
    components=components,
    seats=seats,
    moves=(
        (0.5, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, 0.0),
        (2.5, 0.0, 0.0, 0.0),
        (0.0, 0.5, 0.0, 0.0),
        (0.3, 0.0, 0.0, 2.0),
        (0.0, 0.0, 0.0, 5.0),
        (0.2, 0.0, 0.0, 0.0),
        (1.5, 0.0, 0.0, 0.0),
    ),
    missing=2,
    foreign=4,
    litter=True,
    spots=((110.0, -30.0, 7.5), (20.0, 15.0, 0.0), (-120.0, -118.0, 0.0), (125.0, 100.0, 0.0), (20.0, -55.0, 0.0)),
    rings=((36.0, 620.0), (50.0, 600.0), (66.0, 590.0)),
    radius=260.0,
    floor=-32.0,
    aim=(0.0, 0.0, 15.0),
    aim_spread=8.0,
    finish="paint",
    tint=(0.52, 0.54, 0.53),
    metals={
        "rail": "zinc",
        "m4": "zinc",
        "hinge": "zinc",
        "bolt": "machined",
        "spacer": "machined",
        "breaker": "blued",
        "terminal": "blued",
    },
    loose=("m4_1", "gland_1", "spacer_1"),
    stamp="CB",
    supports=(((40.0, 260.0, 30.0), (-130.0, 0.0, -17.0)), ((40.0, 260.0, 30.0), (130.0, 0.0, -17.0))),
)
