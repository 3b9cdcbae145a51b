"""Steps of the usual kinds of rework, where the part file has none of its own: keys of sentences."""

from __future__ import annotations

STEPS: dict[str, tuple[str, ...]] = {
    "adjust": ("rework.adjust_1", "rework.step_move", "rework.adjust_2"),
    "unbolt": ("rework.unbolt_1", "rework.step_move", "rework.unbolt_2"),
    "reweld": ("rework.reweld_1", "rework.reweld_2", "rework.step_move", "rework.reweld_3", "rework.reweld_4"),
    "reglue": ("rework.reglue_1", "rework.step_move", "rework.reglue_2"),
    "shim": ("rework.shim_1", "rework.step_move", "rework.shim_2"),
    "bend": ("rework.bend_1", "rework.bend_2"),
    "replace": ("rework.replace_1", "rework.replace_2", "rework.replace_3"),
}
"""Steps by kind of rework, with the values ``component``, ``move`` and ``place``."""

INSTALL_STEPS = "rework.install_1", "rework.install_2"
FIXING = {one: f"rework.fix_{one}" for one in ("unbolt", "reweld", "reglue", "shim")}
"""How a component that was missing is fixed, by its kind of rework."""
ANY_FIXING = "rework.fix"
LAST_STEP = "rework.last_step"
