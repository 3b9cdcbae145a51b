"""Two halves of the photos compared: differences beside their bound, what enters U, and what is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arview.inspection import (
    ComponentDeviation,
    ForeignReport,
    HalvesDifference,
    MeasuredPresence,
    Repeatability,
    Verdict,
    load_inspection,
    save_inspection,
)
from arview.measurement.folder import MetricReconstruction
from arview.measurement.options import MeasureOptions
from arview.measurement.repeatability import BUDGET_LINE, compare, measure_halves, with_repeatability
from arview.measurement.seen_from import (
    MOSTLY_HIDDEN,
    SeenFrom,
    is_covered,
    is_mostly_hidden,
    seen_from,
    with_covered,
    with_hidden,
    with_seen_from,
)
from arview.reconstruction.coverage import ComponentCoverage
from arview.reconstruction.scale.types import Consistency, ScaleEvidence, ScaleResult
from arview.reconstruction.types import PosedPhoto, SparseModel
from arview.report.halves import repeatability_context
from helpers.inspections import deviation, inspection, missing, not_measured
from helpers.photo_scene import CAMERA, bench, photograph, ring, write_photos
from helpers.plate_scene import as_built, part

STD_MM = np.array([0.02, 0.03, 0.04])  # of `deviation`


def measured(moved: tuple[float | None, float | None, float | None], tolerance_mm: float = 0.5) -> ComponentDeviation:
    """A component that moved, with own axes along those of the model."""
    one = deviation("block", moved, np.zeros(3), tolerance_mm)
    assert one.details is not None
    eye = tuple(tuple(float(v) for v in row) for row in np.eye(3))
    return replace(one, details=replace(one.details, axes=eye, own_displacement_mm=moved))


def test_halves_differ_by_chance_as_often_as_stated() -> None:
    """Measurements with the covariance that they state are beyond the bound in 5 % of the cases."""
    rng = np.random.default_rng(3)
    ratios = []
    for _ in range(4000):
        one, other = (measured(tuple(map(float, rng.normal(0.0, STD_MM)))) for _ in range(2))
        ratios.append(compare(one, other).e_n or 0.0)
    assert 0.035 < np.mean(np.array(ratios) > 1.0) < 0.065


def test_only_common_axes_are_compared() -> None:
    found = compare(measured((0.1, 0.0, None)), measured((0.1, 0.05, 3.0)))
    assert found.difference_mm == pytest.approx(0.05) and found.e_n is not None and found.e_n < 1.0
    alone = compare(not_measured("block", np.zeros(3)), measured((0.1, 0.0, 0.0)))
    assert "cannot measure it alone" in alone.reason and alone.e_n is None


def test_a_contradiction_enters_u_and_is_named() -> None:
    """0.3 mm apart where 0.13 mm are expected: the error of all photos may be 0.14 mm, and a pass is left open."""
    model = bench()
    name = model.components[1].name
    one = replace(measured((0.35, 0.0, 0.0)), name=name)
    halves = HalvesDifference(name, 0.3, 0.13, 0.3 / 0.13, (0.08, 0.08))
    assert one.verdict is Verdict.PASS and one.uncertainty_mm is not None
    found = with_repeatability(inspection(model, (one,)), Repeatability((12, 12), (halves,), 0.3), MeasureOptions())
    wide = found.components[0]
    std = 0.5 * np.sqrt(0.3**2 - 0.13**2)
    assert wide.details is not None and wide.uncertainty_mm is not None
    along = np.sqrt(sum(line.std_mm**2 for line in one.details.budget)) if one.details else 0.0
    assert wide.uncertainty_mm == pytest.approx(one.uncertainty_mm * np.hypot(along, std) / along)
    assert wide.uncertainty_mm > 2.0 * std and wide.verdict is Verdict.UNDECIDED
    assert [line.std_mm for line in wide.details.budget if line.name == BUDGET_LINE] == [pytest.approx(std)]
    assert name in found.warnings[-1] and "contradict each other" in found.warnings[-1]
    assert any("two halves of the photos differ by 0.300 mm" in note for note in wide.details.notes)


def test_what_agrees_is_left_as_it_is(tmp_path: Path) -> None:
    model = bench()
    one = replace(measured((0.1, 0.0, 0.0)), name=model.components[1].name)
    halves = Repeatability((8, 8), (HalvesDifference(one.name, 0.03, 0.13, 0.03 / 0.13, (0.08, 0.09)),), 0.03, 20.0)
    found = with_repeatability(inspection(model, (one,)), halves)
    assert found.components == (one,) and not found.warnings
    save_inspection(found, tmp_path / "inspection.json")
    assert load_inspection(tmp_path / "inspection.json", model).repeatability == halves
    shown = repeatability_context(found)
    assert shown["halves"][0]["e_n"] == "0.23" and "0.030 mm rms" in shown["halves_lead"]
    none = replace(found, repeatability=Repeatability(reason="9 photos are too few"))
    assert "9 photos are too few" in repeatability_context(none)["halves_absent"]


def test_a_component_seen_from_too_few_sides_says_so() -> None:
    one = measured((0.1, 0.0, 0.0))
    seen = SeenFrom({"block": ComponentCoverage("block", (3, 4), 1, 12.0, 300.0)})
    found = with_seen_from(one, seen).details
    assert found is not None and found.photos == 2
    assert found.notes[-1] == (
        "only 2 photos from 1 direction show it, at most 12° apart, so its U is wide; take more from other sides"
    )
    many = SeenFrom({"block": ComponentCoverage("block", tuple(range(9)), 5, 80.0, 90.0)})
    kept = with_seen_from(one, many).details
    assert kept is not None and one.details is not None and kept.photos == 9 and kept.notes == one.details.notes


def test_what_is_hidden_is_not_missing() -> None:
    """Of a part that is half covered, 40 % of the edges are found, 28 % by chance; of one that is seen, most are."""
    assert is_mostly_hidden(Consistency(True, "", 0.40, 0.28)) and not is_mostly_hidden(Consistency(True, "", 0.7, 0.2))
    assert not is_mostly_hidden(Consistency(True, ""))
    found = with_hidden(missing("block", np.zeros(3)), MOSTLY_HIDDEN)
    assert (found.verdict, found.finding, found.presence) == (Verdict.NOT_MEASURED, None, MeasuredPresence.NOT_SEEN)
    assert found.details is not None and "whether it is missing cannot be told" in found.details.notes[0]
    seen = measured((0.1, 0.0, 0.0))
    assert with_hidden(seen, MOSTLY_HIDDEN) is seen


def test_a_component_under_a_foreign_object_is_covered() -> None:
    washer = ForeignReport((-121.0, -116.0, 3.2), (22.0, 29.0, 3.0), 314.0, "panel", 4.7, "")
    assert is_covered((-110.0, -118.0, 1.1), (washer,)) is True  # at its rim
    assert is_covered((-110.0, -140.0, 1.1), (washer,)) is False
    assert is_covered((-110.0, -118.0, 1.1), ()) is False


@pytest.fixture(scope="module")
def reconstruction(tmp_path_factory: pytest.TempPathFactory) -> MetricReconstruction:
    """Sixteen photos of the part as built, with exact poses."""
    poses = ring(16, distance_mm=420.0)
    built = as_built()
    paths = write_photos(tmp_path_factory.mktemp("photos"), [photograph(built, pose, seed=4) for pose in poses])
    photos = tuple(PosedPhoto(path.name, path, CAMERA, pose) for path, pose in zip(paths, poses, strict=True))
    none, index = np.zeros(0), np.zeros(0, np.int32)
    covariance = np.diag(np.tile([3e-6] * 3 + [2e-3] * 3, 16)) ** 2
    colors = np.zeros((0, 3), np.uint8)
    sparse = SparseModel(
        photos, np.zeros((0, 3)), colors, none, index, index, np.zeros((0, 2)), pose_covariance=covariance
    )
    scale = ScaleResult(
        1.0, 5e-5, np.eye(4), None, (ScaleEvidence("board", 1.0, 5e-5, "a board"),), (), "", Consistency(True, "")
    )
    return MetricReconstruction(sparse, scale, None)


@pytest.mark.slow
def test_halves_of_rendered_photos_agree(reconstruction: MetricReconstruction) -> None:
    sparse = reconstruction.sparse
    assert sparse.pose_covariance is not None
    halves = []
    for first in (0, 1):
        chosen = np.arange(first, 16, 2)
        entries = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in chosen])
        halves.append(
            replace(
                sparse,
                photos=tuple(sparse.photos[i] for i in chosen),
                pose_covariance=sparse.pose_covariance[np.ix_(entries, entries)],
            )
        )
    found = measure_halves(reconstruction, halves, part())
    assert found.photos == (8, 8) and not found.reason
    known = [one for one in found.components if one.e_n is not None]
    assert [one.reason for one in found.components if one.name == "block_4"] == ["missing in both halves"]
    assert len(known) >= 3 and found.rms_mm is not None and 0.0 < found.rms_mm < 0.25
    # Halves of one camera from the same sides: shares of U that they have in common make the ratio small.
    assert np.mean([one.e_n > 1.0 for one in known if one.e_n is not None]) <= 0.25


@pytest.mark.slow
def test_the_photos_that_show_a_component_are_counted(reconstruction: MetricReconstruction) -> None:
    seen = seen_from(reconstruction.sparse, part().model)
    assert all(len(one.photos) >= 8 for one in seen.components.values()) and len(seen.components) >= 3


def test_what_is_not_right_under_a_foreign_object_is_not_seen() -> None:
    seen = measured((0.1, 0.0, 0.0))
    assert with_covered(seen) is seen and seen.verdict is Verdict.PASS
    hidden = with_covered(missing("block", np.zeros(3)))
    assert hidden.verdict is Verdict.NOT_MEASURED and hidden.finding is None and hidden.distance_mm is None
    assert hidden.presence is MeasuredPresence.NOT_SEEN and "foreign object" in hidden.details.notes[0]
