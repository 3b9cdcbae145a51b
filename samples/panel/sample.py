"""The panel as a kind of sample part. Lengths in mm."""

from __future__ import annotations

from kinds import Kind


def components() -> list:
    import assembly  # only where build123d is installed

    return assembly.components()


KIND = Kind(
    name="panel",
    components=components,
    moves=(
        (0.5, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, 0.0),
        (3.0, 0.0, 0.0, 0.0),
        (0.0, 0.5, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0),
        (0.3, 0.0, 2.5, 0.0),
        (0.0, 0.0, 0.0, 1.5),
        (0.6, 0.0, 0.7, 0.8),
        (1.5, 0.3, 0.0, 0.0),
        (0.2, 0.0, 0.0, 0.0),
    ),
    missing=2,
    foreign=1,
    spots=((-96.0, -92.0, 0.0), (192.0, -92.0, 0.0), (96.0, 112.0, 0.0), (-192.0, 112.0, 0.0)),
    rings=((34.0, 1600.0), (48.0, 1540.0), (66.0, 1500.0)),
    radius=560.0,
    floor=-31.6,
    aim=(0.0, 0.0, 0.0),
    aim_spread=18.0,
    finish="paint",
    tint=(0.36, 0.42, 0.40),
    loose=("bracket_1", "clip_1", "boss_1"),
    stamp="PN",
    supports=(((60.0, 640.0, 30.0), (-300.0, 0.0, -16.6)), ((60.0, 640.0, 30.0), (300.0, 0.0, -16.6))),
)
