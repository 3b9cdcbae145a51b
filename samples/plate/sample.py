"""The plate as a kind of sample part. Lengths in mm."""

from __future__ import annotations

from kinds import Kind


def components() -> list:
    import assembly  # only where build123d is installed

    return assembly.components()


KIND = Kind(
    name="plate",
    components=components,
    moves=(
        (0.3, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, 0.0),
        (3.0, 0.0, 0.0, 0.0),
        (0.8, 0.6, 0.0, 0.0),  # 1 mm in space
        (0.0, 0.3, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0),
        (0.3, 0.0, 0.5, 0.0),
        (0.0, 0.0, 0.0, 1.2),
        (0.6, 0.0, 0.7, 0.8),
        (0.1, 0.0, 0.0, 0.0),
    ),
    rings=((35.0, 810.0), (49.0, 750.0), (66.0, 720.0)),
    radius=225.0,
    floor=-8.0,
    aim=(0.0, 0.0, 10.0),
    aim_spread=14.0,
    tint=(0.20, 0.27, 0.34),
    metals={"nut": "zinc", "link": "blued", "bracket": "blued"},
    loose=("nut_1", "post_2", "link_2"),
    stamp="PL",
    welds=True,
    exposure=1.15,
)
