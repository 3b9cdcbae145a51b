"""The manifold as a kind of sample part. Lengths in mm."""

from __future__ import annotations

from kinds import Kind


def components() -> list:
    import assembly  # only where build123d is installed

    return assembly.components()


def seats() -> dict:
    import assembly

    return assembly.seats()


KIND = Kind(
    name="manifold",
    components=components,
    seats=seats,
    moves=(
        (0.3, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, 0.0),
        (0.0, 0.4, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0),
        (0.2, 0.0, 3.0, 0.0),
        (0.0, 0.0, 0.0, 1.5),
        (0.6, 0.0, 0.7, 0.8),
        (2.5, 0.0, 0.0, 0.0),
    ),
    missing=2,
    foreign=1,
    spots=((-74.0, 64.0, 0.0), (-70.0, -62.0, 0.0), (98.0, 30.0, 0.0)),
    rings=((24.0, 540.0), (42.0, 500.0), (64.0, 480.0)),
    radius=165.0,
    floor=-14.0,
    aim=(0.0, 0.0, 35.0),
    aim_spread=10.0,
    finish="cast",
    tint=(0.30, 0.34, 0.36),
    metals={"nut": "zinc", "clip": "zinc", "cap": "zinc", "nipple": "zinc", "bracket": "cast"},
    loose=("nut_1", "stud_1", "clip_1"),
    stamp="MF",
)
