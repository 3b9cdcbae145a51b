"""Number and layout of photos against the error of each component, on the photos of one reconstruction.

Subsets of the photos are adjusted and measured without the others. They share the features and matches of the whole
set and the start of the adjustment: what a small set is spared is the risk that its photos cannot be matched at all.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arview.cad import load_part
from arview.cad.part import Part
from arview.core.progress import Progress
from arview.errors import CannotMeasureError, InputError
from arview.geometry import Array, apply
from arview.inspection import ComponentDeviation, Inspection
from arview.measurement.folder import MetricReconstruction, in_model_frame, read_folder
from arview.measurement.options import MeasureOptions
from arview.measurement.run import measure
from arview.reconstruction.halves import adjusted_alone
from arview_lab.chart import Chart, stack
from arview_lab.studies.cloud_registration import true_places
from arview_lab.studies.common import Study

NUMBERS = (6, 8, 12, 16, 24, 36, 48, 60)
QUICK_NUMBERS = (8, 16)
SIDE_DEG, LEVEL_DEG = 110.0, 12.0
"""Width of the sector of directions of `one side`, and of the band of heights of `one height`."""
_NO_PROGRESS: Progress = lambda what, done, total: None  # noqa: E731

Chosen = NDArray[np.int64]


@dataclass(frozen=True)
class PhotoStudyOptions:
    """What is tried.

    Attributes:
        numbers: of photos; those that the set does not have are left out, and the whole set is always measured.
        runs: random subsets of each number and layout.
        seed: of the subsets.
        layouts: names of `LAYOUTS`.
    """

    numbers: Sequence[int] = NUMBERS
    runs: int = 2
    seed: int = 0
    layouts: Sequence[str] = ("spread", "random", "one side", "one height")

    def __post_init__(self) -> None:
        unknown = [name for name in self.layouts if name not in LAYOUTS]
        if unknown or not self.layouts:
            raise InputError(f"layouts {', '.join(unknown) or 'none'}: expected some of {', '.join(LAYOUTS)}")
        if not self.numbers or min(self.numbers) < 3:
            raise InputError("numbers of photos: expected 3 or more")
        if self.runs < 1:
            raise InputError(f"runs {self.runs}: expected 1 or more")


@dataclass(frozen=True)
class Subset:
    """Some of the photos.

    Attributes:
        layout: a name of `LAYOUTS`, or ``all``.
        run: its number.
        photos: (N,) their indices.
    """

    layout: str
    run: int
    photos: Chosen


def photo_study(
    folder: str, part_path: str, truth_path: str | None = None, photos: str | None = None,
    options: PhotoStudyOptions | None = None, progress: Progress = _NO_PROGRESS,
) -> Study:  # fmt: skip
    """Measure subsets of the photos of a reconstruction, and compare them with the truth or with all photos.

    Args:
        folder: what `arview inspect` or `arview reconstruct` wrote.
        part_path: part or CAD file.
        truth_path: ``truth.json`` of a sample; None: the measurement with all photos, with which the subsets share
            observations, so that differences are smaller than errors.
        photos: folder of the photos, if they have been moved.
        options: see `PhotoStudyOptions`.
        progress: called with (what, done, total).

    Raises:
        InputError: a file cannot be read, the part has no frame in the photos, or nothing is measured with all of them.
    """
    options = options or PhotoStudyOptions()
    part = load_part(part_path)
    whole = read_folder(folder, photos, with_cloud=False)
    places = {} if truth_path is None else true_places(truth_path)
    known = {name: places[name] for name in part.inspected if name in places}
    if truth_path is not None and not known:
        raise InputError(f"{truth_path}: names none of the components that {part_path} inspects")
    subsets = subsets_of(directions_of(whole, part), options)
    model = Path(folder) / "sparse" / "model"
    of_subset: list[tuple[object, ...]] = []
    of_component: list[tuple[object, ...]] = []
    reference: Inspection | None = None
    for done, one in enumerate(subsets):
        progress("subsets of the photos", done, len(subsets))
        began = time.process_time()
        found: Inspection | str
        try:
            found = measured(whole, model, part, one.photos)
        except (CannotMeasureError, InputError) as error:
            if reference is None:
                raise InputError(f"{folder}: cannot be measured with all photos: {error}") from error
            found = str(error)
        head = (one.layout, len(one.photos), one.run)
        if isinstance(found, str):
            of_subset.append((*head, 0, "", "", "", "", time.process_time() - began, found))
            continue
        reference = reference or found
        rows = compared(found, reference, known)
        if one.layout == "all" and not known:
            rows = []
        of_component += [(*head, *row) for row in rows]
        of_subset.append((*head, *_summed(rows, found), time.process_time() - began, ""))
    progress("subsets of the photos", len(subsets), len(subsets))
    what = "error" if known else "difference from all photos"
    columns = ("layout", "photos", "run")
    tables = {
        "photos": (
            (*columns, "components", "median_mm", "p95_mm", "mean_u_mm", "within_u", "cpu_s", "note"), of_subset,
        ),
        "photos_components": ((*columns, "component", "off_mm", "u_mm", "within_u"), of_component),
    }  # fmt: skip
    return Study("photos", tables, _drawn(of_subset, what), _told(of_subset, what))


def directions_of(whole: MetricReconstruction, part: Part) -> Array:
    """(N,3) unit vectors from the middle of the part to the photos, in a frame whose z is their mean."""
    placed = in_model_frame(whole, replace(part, datums=()))
    away = np.array([photo.centre_in_scan for photo in placed.sparse.photos]) - part.model.center_in_model
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    middle = away.mean(axis=0)
    z = middle / max(float(np.linalg.norm(middle)), 1e-9)
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    return np.asarray(away @ np.array([x, np.cross(z, x), z]).T)


def subsets_of(directions: Array, options: PhotoStudyOptions) -> list[Subset]:
    """The whole set, then every layout with every number of photos that it has.

    Args:
        directions: (N,3) of the photos, as of `directions_of`.
        options: see `PhotoStudyOptions`.
    """
    count = len(directions)
    found = [Subset("all", 0, np.arange(count, dtype=np.int64))]
    for layout in options.layouts:
        for number in sorted({one for one in options.numbers if one < count}):
            for run in range(options.runs):
                rng = np.random.default_rng([options.seed, number, run])
                chosen = LAYOUTS[layout](directions, number, rng)
                if len(chosen) == number:
                    found.append(Subset(layout, run, np.sort(chosen)))
    return found


def _spread(directions: Array, number: int, rng: np.random.Generator) -> Chosen:
    """As far apart as possible, from a random first one (farthest-point sampling, Gonzalez 1985)."""
    chosen = [int(rng.integers(len(directions)))]
    nearest = directions @ directions[chosen[0]]
    while len(chosen) < min(number, len(directions)):
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return np.array(chosen, dtype=np.int64)


def _at_random(directions: Array, number: int, rng: np.random.Generator) -> Chosen:
    """Without a plan."""
    return np.asarray(rng.permutation(len(directions))[:number], dtype=np.int64)


def _from_one_side(directions: Array, number: int, rng: np.random.Generator) -> Chosen:
    """Within a sector of `SIDE_DEG` about a random direction, as far apart as possible; fewer where it has fewer."""
    azimuth_deg = np.rad2deg(np.arctan2(directions[:, 1], directions[:, 0]))
    off_deg = np.abs((azimuth_deg - rng.uniform(-180.0, 180.0) + 180.0) % 360.0 - 180.0)
    within = np.flatnonzero(off_deg <= 0.5 * SIDE_DEG)
    if len(within) < number:
        return within
    return np.asarray(within[_spread(directions[within], number, rng)])


def _at_one_height(directions: Array, number: int, rng: np.random.Generator) -> Chosen:
    """Within a band of `LEVEL_DEG` of heights that starts at a random photo; fewer where it has fewer."""
    height_deg = np.rad2deg(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    within = np.array([], dtype=np.int64)
    for start in rng.permutation(height_deg):
        within = np.flatnonzero((height_deg >= start) & (height_deg <= start + LEVEL_DEG))
        if len(within) >= number:
            return np.asarray(within[_spread(directions[within], number, rng)])
    return within


LAYOUTS: dict[str, Callable[[Array, int, np.random.Generator], Chosen]] = {
    "spread": _spread,
    "random": _at_random,
    "one side": _from_one_side,
    "one height": _at_one_height,
}
"""Names of the layouts, and what chooses a number of photos by their directions."""


def measured(whole: MetricReconstruction, model: Path, part: Part, chosen: Chosen) -> Inspection:
    """The inspection with some of the photos, adjusted without the others.

    Raises:
        CannotMeasureError, InputError: they are not placed without the others, or nothing can be measured.
    """
    photos = [whole.sparse.photos[index] for index in chosen]
    is_whole = len(photos) == len(whole.sparse.photos)
    sparse = whole.sparse if is_whole else adjusted_alone(model, whole.sparse, photos)
    one = replace(whole, sparse=sparse, cloud=None)
    return measure(one, part, MeasureOptions(methods=("sweep", "edges")))


def compared(
    found: Inspection, reference: Inspection, truth: dict[str, Array]
) -> list[tuple[str, float | str, float | str, int | str]]:  # fmt: skip
    """Name, length of the error, U and whether U holds, of each component; without numbers where none were measured.

    The error is that of the displacement along the axes that are determined, against the truth or the reference.
    """
    others = {one.name: one for one in reference.components}
    rows: list[tuple[str, float | str, float | str, int | str]] = []
    for one in found.components:
        if truth and one.name not in truth:
            continue
        off = _off(one, others[one.name], truth.get(one.name))
        if off is None or one.uncertainty_mm is None:
            rows.append((one.name, "", "", ""))
        else:
            length, along = off
            rows.append((one.name, length, one.uncertainty_mm, int(along <= one.uncertainty_mm)))
    return rows


def _off(one: ComponentDeviation, other: ComponentDeviation, truth: Array | None) -> tuple[float, float] | None:
    """Length of the error, and by how much the distance is wrong, mm; None where something is not measured."""
    details, wanted = one.details, other.details
    if details is None or details.axes is None or details.own_displacement_mm is None or one.distance_mm is None:
        return None
    own = np.array([np.nan if value is None else value for value in details.own_displacement_mm], dtype=np.float64)
    axes, center = np.array(details.axes), np.array(details.center_mm)
    if truth is not None:
        target = axes @ (apply(truth, center) - center)
    else:
        if wanted is None or wanted.axes is None or wanted.own_displacement_mm is None:
            return None
        theirs = [np.nan if value is None else value for value in wanted.own_displacement_mm]
        target = axes @ np.array(wanted.axes).T @ np.array(theirs, dtype=np.float64)
    seen = np.isfinite(own) & np.isfinite(target)
    if not seen.any():
        return None
    return float(np.linalg.norm((own - target)[seen])), abs(one.distance_mm - float(np.linalg.norm(target[seen])))


def _summed(
    rows: Sequence[tuple[str, float | str, float | str, int | str]], found: Inspection
) -> tuple[object, object, object, object, object]:  # fmt: skip
    """Number of measured components, median and 95th percentile of the errors, mean U, and share within U."""
    known = [(float(off), float(u), int(held)) for _, off, u, held in rows if off != ""]
    if not known:
        return sum(one.distance_mm is not None for one in found.components), "", "", "", ""
    off, u, held = np.array(known).T
    return len(known), float(np.median(off)), float(np.quantile(off, 0.95)), float(u.mean()), float(held.mean())


def _means(rows: Sequence[tuple[object, ...]], layout: str, column: int) -> tuple[Array, Array]:
    """Numbers of photos of a layout, and the mean of a column over its runs."""
    known = [(float(str(row[1])), float(str(row[column]))) for row in rows if row[0] == layout and row[column] != ""]
    numbers = sorted({number for number, _ in known})
    return np.array(numbers), np.array([np.mean([v for n, v in known if n == number]) for number in numbers])


def _drawn(rows: Sequence[tuple[object, ...]], what: str) -> NDArray[np.uint8]:
    """Median error and mean U by number of photos, a line for each layout."""
    charts = []
    for title, column in ((f"Median {what} of the components", 4), ("Mean U of the components", 6)):
        chart = Chart(title, "photos", "mm")
        for layout in dict.fromkeys(str(row[0]) for row in rows):
            numbers, values = _means(rows, layout, column)
            if len(numbers):
                chart.add(numbers, values, layout, "line" if len(numbers) > 1 else "points")
        charts.append(chart.draw(height=460))
    return stack(charts)


def _told(rows: Sequence[tuple[object, ...]], what: str) -> tuple[str, ...]:
    """A line for every layout and number of photos."""
    lines = []
    for layout, number in dict.fromkeys((str(row[0]), int(str(row[1]))) for row in rows):
        mine = [row for row in rows if row[0] == layout and row[1] == number]
        good = [row for row in mine if row[4] != ""]
        name = f"{layout}, {number} photos" if layout != "all" else f"all {number} photos"
        if not good:
            lines.append(f"{name}: {mine[0][-1] or 'the reference'}")
            continue
        median, p95, u, held, count = (
            float(np.mean([float(str(row[k])) for row in good])) for k in (4, 5, 6, 7, 3)
        )  # fmt: skip
        text = f"{name}: {count:.0f} components, {what} median {1e3 * median:.0f} um, 95 % {1e3 * p95:.0f} um"
        text += f", mean U {1e3 * u:.0f} um, {100 * held:.0f} % within U"
        lines.append(
            text + (f"; {len(mine) - len(good)} of {len(mine)} sets not measured" if len(good) < len(mine) else "")
        )
    return tuple(lines)
