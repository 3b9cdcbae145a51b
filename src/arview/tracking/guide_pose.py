"""Guide views by name: poses into which a user brings the part, so that tracking starts there."""

from __future__ import annotations

import difflib
import re
from dataclasses import replace

import numpy as np

from arview.cad import Guide, Part, Viewpoint, ViewRange, pose_at
from arview.camera import Camera
from arview.errors import InputError
from arview.geometry import Array

GUIDE_PREFIX = "guide:"
"""Prefix of the name of a guide view where a file with a pose could be meant as well."""
STANDARD_GUIDES = (
    Guide("front", -90.0, 0.0),
    Guide("back", 90.0, 0.0),
    Guide("left", 180.0, 0.0),
    Guide("right", 0.0, 0.0),
    Guide("top", -90.0, 90.0),
    Guide("bottom", -90.0, -90.0),
    Guide("iso", -45.0, 35.26),
)
"""Standard views of CAD programs, in the upright frame: front looks along +Y, right along -X; top has +Y up in the
picture."""
MIDDLE = "middle"
"""Name of the middle of the declared range, which every range has."""
FILL = 0.6
"""Share of the picture's smaller side that the part's diameter spans where no distance is given, within the range."""
ROOM = 1.15
"""Ratio to both ends of the range that is kept there, so that the part can be brought nearer and farther."""
MARGIN_DEG, MARGIN_SHARE = 1.0, 0.01
"""Angle, and share of the distance, by which a guide view may exceed the declared range."""
_NUMBER = r"(-?\d+(?:\.\d+)?)"
_DIRECTION = re.compile(rf"az{_NUMBER}_el{_NUMBER}(?:_d(\d+(?:\.\d+)?))?(?:_r{_NUMBER})?")


def guide_names(part: Part, view_range: ViewRange) -> list[str]:
    """Names of the guide views of a part: those of its part file, then the standard ones within the declared range."""
    own = [guide.name for guide in part.guides]
    standard = [g.name for g in STANDARD_GUIDES if _in_range(g, view_range) is not None]
    return own + [name for name in [*standard, MIDDLE] if name not in own]


def guide_pose(name: str, part: Part, view_range: ViewRange, camera: Camera) -> Array:
    """``cam_from_model`` (4,4) of a guide view, with the part's centre in the centre of the picture.

    Args:
        name: a name from the part file (``[guides.NAME]``), a standard name, ``middle``, or a direction like
            ``az45_el30``, optionally with ``_d650`` for the distance in mm and ``_r10`` for the roll in degrees.
        part: the part with its guides.
        view_range: declared range of the guide views in use.
        camera: intrinsics of the frames.

    Raises:
        InputError: the guide view does not exist or is outside the declared range.
    """
    guide = _find(name, part, view_range)
    placed = _in_range(guide, view_range)
    if placed is None:
        azimuths, elevations = (_interval(r) for r in (view_range.azimuth_deg, view_range.elevation_deg))
        raise InputError(
            f"guide view {name!r}: azimuth {guide.azimuth_deg:g}°, elevation {guide.elevation_deg:g}° is outside "
            f"the declared range (azimuth {azimuths}°, elevation {elevations}°)"
        )
    low, high = view_range.distance_mm
    distance_mm = placed.distance_mm
    if distance_mm is None:
        wanted = part.model.diameter_mm * camera.fx / (FILL * min(camera.width, camera.height))
        middle = np.sqrt(low * high)
        distance_mm = float(np.clip(wanted, min(ROOM * low, middle), max(high / ROOM, middle)))
    elif not low * (1 - MARGIN_SHARE) <= distance_mm <= high * (1 + MARGIN_SHARE):
        raise InputError(
            f"guide view {name!r}: {distance_mm:g} mm is outside the declared distances ({_interval((low, high))} mm)"
        )
    ray = camera.unproject([0.5 * (camera.width - 1), 0.5 * (camera.height - 1)])
    roll_deg = placed.roll_deg if placed.roll_deg is not None else _usual_roll_deg(view_range)
    place = Viewpoint(distance_mm, placed.elevation_deg, placed.azimuth_deg, roll_deg)
    return pose_at(place, part.model.center_in_model, ray, view_range.up)


def _find(name: str, part: Part, view_range: ViewRange) -> Guide:
    for guide in (*part.guides, *STANDARD_GUIDES):
        if guide.name == name:
            return guide
    if name == MIDDLE:
        low, high = view_range.azimuth_deg
        azimuth_deg = 0.5 * (low + high) if high - low < 360 else -45.0
        return Guide(MIDDLE, azimuth_deg, 0.5 * sum(view_range.elevation_deg))
    match = _DIRECTION.fullmatch(name)
    if match:
        azimuth, elevation, distance, roll = match.groups()
        if abs(float(elevation)) > 90:
            raise InputError(f"guide view {name!r}: elevation {elevation}° is not within -90 to 90°")
        return Guide(
            name, float(azimuth), float(elevation), float(roll) if roll else None, float(distance) if distance else None
        )
    names = guide_names(part, view_range)
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    raise InputError(
        f"no guide view {name!r}; {hint}There are: {', '.join(names)}; or a direction like az45_el30 "
        "(with _d650 for mm, _r10 for roll)"
    )


def _in_range(guide: Guide, view_range: ViewRange) -> Guide | None:
    """The guide if its direction is in the range, else None.

    Straight above or below, the azimuth only turns the part in the picture, so a standard view takes an azimuth of the
    range.
    """
    direction = view_range.direction(guide.azimuth_deg, guide.elevation_deg)
    if not view_range.contains_direction(direction, MARGIN_DEG):
        return None
    if abs(guide.elevation_deg) > 89.0 and guide in STANDARD_GUIDES:
        return replace(guide, azimuth_deg=_nearest_deg(guide.azimuth_deg, view_range.azimuth_deg))
    return guide


def _usual_roll_deg(view_range: ViewRange) -> float:
    """Roll 0 where the range allows it, else the middle of its rolls."""
    upright = _nearest_deg(0.0, view_range.roll_deg)
    return upright if abs(upright) < 1e-9 else 0.5 * sum(view_range.roll_deg)


def _nearest_deg(angle_deg: float, interval_deg: tuple[float, float]) -> float:
    """Angle of an interval that is nearest to a given angle, modulo 360°."""
    middle, half = 0.5 * sum(interval_deg), 0.5 * (interval_deg[1] - interval_deg[0])
    away = (angle_deg - middle + 180.0) % 360.0 - 180.0
    return angle_deg if abs(away) <= half else middle + float(np.clip(away, -half, half))


def _interval(limits: tuple[float, float]) -> str:
    """Text of an interval."""
    return f"{limits[0]:.0f} to {limits[1]:.0f}"
