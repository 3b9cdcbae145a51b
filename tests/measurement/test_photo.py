"""Components measured in photos: both ways against exact truth in mm, with noise, and what is said when they fail."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from arview.cad.model import Component, Model, make_model
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, log_so3, rigid
from arview.measurement.photo import PhotoViews, measure_components_in_photos, sweep_offsets
from arview.measurement.photo.component import joint_mm
from arview.measurement.photo.views import views_of
from arview.measurement.types import Method, Move, NotMeasured
from helpers import photo_scene
from helpers.cad_files import box
from helpers.photo_scene import CAMERA, bench, photograph, ring
from helpers.synthetic import post

pytestmark = pytest.mark.slow  # components measured in ten photos

BLOCKS = ("block_1", "block_2", "block_3", "block_4")
METHODS: tuple[Method, ...] = ("sweep", "edges")


def displaced(model: Model, places: dict[str, Array | None]) -> Model:
    """The model as built: components at ``measured_from_nominal`` (4,4), or left out (None)."""
    built = []
    for part in model.components:
        place = places.get(part.name, np.eye(4))
        if place is not None:
            built.append(Component(part.name, apply(place, part.vertices_in_model), part.faces))
    return make_model("as built", tuple(built))


def place_of(
    model: Model, name: str, shift_mm: tuple[float, float, float], turn_deg: tuple[float, float, float]
) -> Array:
    """Place of a component that is shifted, and turned about its centre."""
    center = model.component(name).bounds_in_model.mean(axis=0)
    rotation = exp_so3(np.deg2rad(turn_deg))
    return rigid(rotation, center - rotation @ center + np.array(shift_mm))


def views_on(model: Model, built: Model, count: int = 12) -> PhotoViews:
    """Photos of what was built, for measuring against the nominal model."""
    poses = ring(count)
    grays = [cv2.cvtColor(photograph(built, pose, CAMERA, seed=3), cv2.COLOR_RGB2GRAY) for pose in poses]
    names = tuple(f"img_{i:03d}" for i in range(count))
    return views_of(grays, (CAMERA,) * count, np.stack(poses), model, names)


def errors(move: Move, place: Array) -> tuple[Array, Array]:
    """Error of the centre (3,) in mm, and of the turn (3,) in degrees."""
    center = move.center_in_model
    true_shift = apply(place, center) - center
    return move.twist[3:] - true_shift, np.rad2deg(move.twist[:3] - log_so3(place[:3, :3]))


def with_post(model: Model) -> Model:
    """The bench with a round post of ⌀24 × 30 mm in its middle."""
    vertices, faces = post((0.0, 5.0), 12.0, 0.0, 30.0, 48)
    return make_model("bench", (*model.components, Component("post", vertices, faces.astype(np.int32))))


NOMINAL = with_post(bench(1))
PLACES: dict[str, Array | None] = {
    "block_1": place_of(NOMINAL, "block_1", (0.3, -0.2, 0.0), (0.0, 0.0, 0.0)),
    "block_2": place_of(NOMINAL, "block_2", (-0.8, 0.6, 0.5), (1.0, -0.7, 0.0)),
    "block_3": place_of(NOMINAL, "block_3", (2.4, 1.8, 0.0), (0.0, 0.0, 1.5)),
    "block_4": None,
    "post": place_of(NOMINAL, "post", (1.0, -0.6, 0.0), (0.0, 0.0, 0.0)),
}


@cache
def textured() -> tuple[PhotoViews, dict[str, dict[Method, Move | NotMeasured]]]:
    """The bench with blocks displaced by 0.4, 1.1 (tilted) and 3.0 mm (turned), one missing, the post by 1.2 mm."""
    views = views_on(NOMINAL, displaced(NOMINAL, PLACES))
    return views, measure_components_in_photos(views, None, NOMINAL, names=(*BLOCKS, "post"))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", BLOCKS[:3])
def test_displaced_blocks(name: str, method: Method) -> None:
    """0.72 mm a pixel: 0.08 mm is 0.11 px."""
    move = textured()[1][name][method]
    assert isinstance(move, Move), move
    place = PLACES[name]
    assert place is not None
    shift, turn_deg = errors(move, place)
    assert np.linalg.norm(shift) < 0.08, shift
    assert np.abs(turn_deg).max() < 0.25, turn_deg
    assert move.observable.all()
    # The stated uncertainty is neither a boast nor a shrug.
    sigmas = np.sqrt(np.diag(move.covariance)[3:])
    assert (np.abs(shift) < 4.0 * sigmas).all() and sigmas.max() < 0.1


def test_missing_block_is_said_to_be_missing() -> None:
    for method in METHODS:
        found = textured()[1]["block_4"][method]
        assert isinstance(found, NotMeasured) and found.is_missing, found
        assert "missing" in found.reason


@pytest.mark.parametrize("method", METHODS)
def test_round_post_has_a_place_but_no_spin(method: Method) -> None:
    move = textured()[1]["post"][method]
    place = PLACES["post"]
    assert isinstance(move, Move) and place is not None, move
    shift, turn_deg = errors(move, place)
    assert np.linalg.norm(shift) < 0.12, shift
    assert (np.abs(shift) < 4.0 * np.sqrt(np.diag(move.covariance)[3:])).all(), shift
    assert np.abs(turn_deg[:2]).max() < 0.4, turn_deg
    assert move.observable.tolist() == [True, True, False, True, True, True]
    assert abs(move.twist[2]) < 1e-4 and move.covariance[2, 2] < 1e-8
    assert np.abs(move.undetermined[0, 2]) > 0.999


@cache
def painted(is_there: bool = True) -> dict[str, dict[Method, Move | NotMeasured]]:
    """Blocks of one grey on a darker plate: no texture at all. One of them is 32 mm from its place, or missing."""

    def paint(points: Array) -> Array:
        return np.where(points[:, 2] > 0.01, 150.0, np.where(points[:, 2] > -7.9, 70.0, 30.0))

    away = place_of(NOMINAL, "block_4", (25.0, -20.0, 0.0), (0.0, 0.0, 0.0))
    places = PLACES | {"block_4": away if is_there else None}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photo_scene, "PAINT", paint)
        views = views_on(NOMINAL, displaced(NOMINAL, places), 10)
    return measure_components_in_photos(views, None, NOMINAL, names=BLOCKS)


@pytest.mark.parametrize("name", BLOCKS[:3])
def test_without_texture_edges_still_measure(name: str) -> None:
    sweep, edges = painted()[name]["sweep"], painted()[name]["edges"]
    assert isinstance(sweep, NotMeasured) and not sweep.is_missing
    assert "texture" in sweep.reason
    place = PLACES[name]
    assert isinstance(edges, Move) and place is not None, edges
    shift, turn_deg = errors(edges, place)
    assert np.linalg.norm(shift) < 0.08, shift
    assert np.abs(turn_deg).max() < 0.25, turn_deg


@pytest.mark.parametrize("method", METHODS)
def test_out_of_range_gives_no_number(method: Method) -> None:
    found = painted()["block_4"][method]
    assert isinstance(found, NotMeasured), found


def test_missing_without_texture() -> None:
    """None of its edges is seen while those of the others are; what stands 32 mm away is not taken for missing."""
    for method in METHODS:
        found = painted(is_there=False)["block_4"][method]
        assert isinstance(found, NotMeasured) and found.is_missing, found
        assert found.reason.startswith("missing, or far from its place: none of its edges is seen")
        elsewhere = painted()["block_4"][method]
        assert isinstance(elsewhere, NotMeasured) and not elsewhere.is_missing
    assert all(isinstance(painted(is_there=False)[name]["edges"], Move) for name in BLOCKS[:3])


def test_low_heads_are_measured_and_a_missing_one_is_named() -> None:
    """Heads of ⌀12 × 2.6 mm, 17 px: lower than the distance from a seat within which edges usually are dropped."""
    heads = {f"head_{k}": post(at, 6.0, 0.0, 2.6, 32) for k, at in enumerate(((-80, 0), (0, -80), (82, 5)), 1)}
    rail = box((-60, -6, 0), (60, 4, 7))
    parts = [Component(name, mesh[0], mesh[1].astype(np.int32)) for name, mesh in {**heads, "rail": rail}.items()]
    nominal = make_model("bench", (*bench(1).components, *parts))
    places: dict[str, Array | None] = {
        "head_1": place_of(nominal, "head_1", (0.7, -0.5, 0.0), (0.0, 0.0, 0.0)),
        "head_3": None,
        "rail": place_of(nominal, "rail", (0.0, 0.0, 0.0), (0.0, 0.0, 5.0)),
    }
    views = views_on(nominal, displaced(nominal, places))
    assert [joint_mm(nominal, nominal.index(name)) for name in ("head_1", "rail", "block_1")] == [1.0, 2.8, 4.0]
    found = measure_components_in_photos(views, None, nominal, names=("head_1", "head_2", "head_3", "rail", *BLOCKS))
    for name in ("head_1", "head_2"):
        move = found[name]["edges"]
        assert isinstance(move, Move) and move.support > 0.4
        assert np.abs(errors(move, places.get(name, np.eye(4)))[0]).max() < 0.2
    missing = found["head_3"]["edges"]
    assert isinstance(missing, NotMeasured) and missing.is_missing
    turned = found["rail"]["edges"]
    assert isinstance(turned, Move)
    mm, deg = errors(turned, places["rail"])
    assert np.abs(mm).max() < 0.1 and np.abs(deg).max() < 0.2


def test_thin_sheet_whose_narrow_face_is_not_seen() -> None:
    """A sheet of 2 mm stands on edge, its top as bright as the ground: of two edges 1 to 3 px apart one is seen."""
    vertices, faces = box((-60, 2, 0), (-20, 4, 40))
    plain = make_model("bench", (NOMINAL.component("bench"), NOMINAL.component("plate")))
    nominal = make_model("bench", (*plain.components, Component("sheet", vertices, faces.astype(np.int32))))
    place = place_of(nominal, "sheet", (0.4, -0.3, 0.2), (0.0, 0.0, 0.0))

    def paint(points: Array) -> Array:
        return np.where(points[:, 2] > 0.01, 70.0 * 1.25 / 0.8, np.where(points[:, 2] > -7.9, 70.0, 30.0))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photo_scene, "PAINT", paint)
        views = views_on(nominal, displaced(nominal, {"sheet": place}), 12)
    move = measure_components_in_photos(views, None, nominal, names=["sheet"])["sheet"]["edges"]
    assert isinstance(move, Move), move
    shift, turn_deg = errors(move, place)
    assert np.linalg.norm(shift) < 0.1, shift  # a pixel is 0.72 mm
    assert (np.abs(shift) < 4.0 * np.sqrt(np.diag(move.covariance)[3:])).all(), shift
    assert np.abs(turn_deg).max() < 0.4, turn_deg
    assert len(move.undetermined) == 0


def test_samples_of_a_plane_say_where_it_is() -> None:
    """The plate's top, as a datum: photos that are taken to look 0.4 mm too high see it 0.4 mm too low."""
    views, _ = textured()
    lifted = replace(views, cam_from_model=views.cam_from_model @ rigid(np.eye(3), [0.0, 0.0, 0.4]))
    stacks = tuple(s._replace(poses=np.ascontiguousarray(lifted.cam_from_model[:, :3])) for s in views.levels)
    lifted = replace(lifted, levels=stacks)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-90, 90, (300, 2)), np.zeros(300)])
    normals = np.tile([0.0, 0.0, 1.0], (300, 1))
    for shown, expected_mm in ((views, 0.0), (lifted, -0.4)):
        found = sweep_offsets(points, normals, shown, 2.0)
        assert np.count_nonzero(found.is_ok) > 120
        # Some lie under blocks that stand elsewhere than nominal: the median passes them by.
        assert np.median(found.offsets_mm[found.is_ok]) == pytest.approx(expected_mm, abs=0.02)


def test_bad_input_is_said() -> None:
    views, _ = textured()
    with pytest.raises(InputError, match="no component 'knob'"):
        measure_components_in_photos(views, None, NOMINAL, names=["knob"])
    away = replace(views, cam_from_model=views.cam_from_model @ rigid(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 2e3]))
    with pytest.raises(InputError, match="not in the frame of the CAD"):
        measure_components_in_photos(away, None, NOMINAL, names=["block_1"])
