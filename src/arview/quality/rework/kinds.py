"""Steps of the usual kinds of rework, where the part file has none of its own."""

from __future__ import annotations

STEPS: dict[str, tuple[str, ...]] = {
    "adjust": (
        "Free {component} as far as its fixing allows.",
        "{move}",
        "Fix {component} again without moving it.",
    ),
    "unbolt": (
        "Loosen the bolts of {component} until it can be moved; leave them in.",
        "{move}",
        "Hold {component} in place and tighten the bolts crosswise to their torque.",
    ),
    "reweld": (
        "Cut the weld of {component} open and protect what is beside it.",
        "Grind and clean both sides of the joint.",
        "{move}",
        "Clamp and tack {component}, and check its place before the seam is welded.",
        "Weld the seam and let it cool down before it is measured.",
    ),
    "reglue": (
        "Take {component} off and remove the old glue from both sides.",
        "{move}",
        "Glue {component} on, hold it in place and let the glue cure before it is measured.",
    ),
    "shim": (
        "Loosen {component}.",
        "{move}",
        "Tighten {component} again; check that no shim sticks out.",
    ),
    "bend": (
        "Support {component} beside the place that is to be bent.",
        "{move}; go a little further for the springback and let it come back",
    ),
    "replace": (
        "Take {component} off and mark it as rejected.",
        "Check that the new one is the right part, and that its seat is clean.",
        "Fit the new one: {place}.",
    ),
}
"""Steps by kind of rework. ``{move}`` stands for the moves, ``{place}`` for the place by what is beside it."""

INSTALL_STEPS = (
    "Take the right part for {component}, and check that its seat is clean.",
    "Put it in its place: {place}.",
)
FIXING = {
    "unbolt": "Bolt it on, crosswise to the torque.",
    "reweld": "Clamp and tack it, check its place, and weld it.",
    "reglue": "Glue it on, hold it in place and let the glue cure.",
    "shim": "Bolt it on with the shims that belong under it.",
}
"""How a component that was missing is fixed, by its kind of rework."""
ANY_FIXING = "Fix it as its drawing says."
LAST_STEP = "Check {component} again: a few photos of it are enough."
