"""A picture of a calibration: where the board was seen, and the uncertainty of rays over the picture."""

from __future__ import annotations

import io

import numpy as np

from arview.calibration.run import Calibration
from arview.calibration.solve import picture_grid, pixel_uncertainty
from arview.core.figures import INK, figure
from arview.errors import InputError

FORMATS = ("png", "svg", "pdf")
"""Formats that `draw` writes."""
_ARROW = 0.08
"""Length of the longest residual arrow, as a share of the picture's longer side."""


def draw(calibration: Calibration, kind: str = "png") -> bytes:
    """Corners with their residuals, and U of rays over the picture, in one of FORMATS. Raises InputError."""
    if kind not in FORMATS:
        raise InputError(f"plot: {kind!r}: expected one of {', '.join(FORMATS)}")
    solution, verdict = calibration.solution, calibration.verdict
    camera = solution.camera
    pixels = np.concatenate([view.pixels for view in solution.views])
    residuals = np.concatenate(solution.residuals)
    length = np.linalg.norm(residuals, axis=1)
    longest = float(np.percentile(length, 99)) or 1.0
    scale = _ARROW * max(camera.width, camera.height) / longest
    height = 4.6 * min(1.6, max(0.5, camera.height / camera.width)) + 0.7
    with figure(height, 10.0, has_grid=False, ncols=2) as (made, (left, right)):
        arrows = left.quiver(
            *pixels.T,
            *(residuals * scale).T,
            length,
            angles="xy",
            scale_units="xy",
            scale=1,
            cmap="viridis",
            width=0.0022,
            clim=(0, longest),
        )
        made.colorbar(arrows, ax=left, orientation="horizontal", aspect=40, label="residual, px")
        covered = f"{len(pixels)} corners, {len(solution.views)} views, {100 * verdict.coverage:.0f} % of the picture"
        left.set_title(f"{covered}; residuals {solution.rms_px:.2f} px", loc="left", fontsize=9.5, color=INK)
        columns, rows = 33, 25
        grid = picture_grid(camera.width, camera.height, columns, rows)
        uncertainty = pixel_uncertainty(solution, grid).reshape(rows, columns)
        if np.isfinite(uncertainty).any():
            u, v = grid[:, 0].reshape(rows, columns), grid[:, 1].reshape(rows, columns)
            top = max(float(np.nanpercentile(uncertainty, 98)), 1e-6)
            levels = np.linspace(0.0, top, 9)
            filled = right.contourf(u, v, uncertainty, levels=levels, cmap="magma_r", extend="max")
            made.colorbar(filled, ax=right, orientation="horizontal", aspect=40, label="U (k = 2), px", format="%.2f")
        median, worst = verdict.pixel_u_px
        title = f"U of a ray's place: median {median:.2f}, worst {worst:.2f} px"
        right.set_title(title, loc="left", fontsize=9.5, color=INK)
        for axes in (left, right):
            axes.set_xlim(-0.5, camera.width - 0.5)
            axes.set_ylim(camera.height - 0.5, -0.5)
            axes.set_aspect("equal")
            axes.set_xlabel("u, px")
        left.set_ylabel("v, px")
        focal = f"focal length {camera.fx:.1f} px ± {100 * verdict.focal_u:.2f} % (k = 2)"
        made.suptitle(f"{calibration.sightings.label}: {verdict.grade.value}, {focal}", x=0.01, ha="left", fontsize=11)
        out = io.BytesIO()
        metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
        made.savefig(out, format=kind, dpi=110, metadata=metadata)
    return out.getvalue()
