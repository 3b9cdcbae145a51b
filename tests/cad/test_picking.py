"""Features at a picked point: planes, holes, pins, cylinders and edges of meshes whose surfaces are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from arview.cad.datum_check import find_rims
from arview.cad.model import Component
from arview.cad.picking import PickedFeature, pick_features
from arview.errors import InputError
from arview.geometry import Array, apply, exp_so3, rigid
from helpers.feature_scene import slot_scene

POSE = rigid(exp_so3([0.4, -0.7, 1.1]), [120.0, -35.0, 60.0])


def component(mesh: trimesh.Trimesh) -> Component:
    return Component("part", apply(POSE, np.asarray(mesh.vertices)), np.asarray(mesh.faces, dtype=np.int32))


@pytest.fixture(scope="module")
def washer() -> Component:
    """A ring of radii 8 and 20 mm, 6 mm high."""
    return component(trimesh.creation.annulus(8.0, 20.0, 6.0, sections=48))


@pytest.fixture(scope="module")
def block() -> Component:
    return component(trimesh.creation.box((60.0, 40.0, 20.0)))


def pick(part: Component, local_point: list[float], local_normal: list[float]) -> list[PickedFeature]:
    """Features at the point of the surface nearest to a local one, of a face with a normal like the local one."""
    point = apply(POSE, np.array([local_point]))[0]
    mesh = trimesh.Trimesh(part.vertices_in_model, part.faces, process=False)
    facing = np.flatnonzero(mesh.face_normals @ (POSE[:3, :3] @ local_normal) > 0.95)
    on_face = trimesh.triangles.closest_point(mesh.triangles[facing], np.repeat(point[None], len(facing), axis=0))
    distance = np.linalg.norm(on_face - point, axis=1)
    assert distance.min() < 0.1
    return pick_features(part, int(facing[distance.argmin()]), on_face[distance.argmin()])


def local(direction: Array) -> Array:
    return np.asarray(POSE[:3, :3].T @ direction)


def test_a_plane_has_its_middle_and_normal(block: Component) -> None:
    found = pick(block, [5.0, -3.0, 10.0], [0, 0, 1])
    assert [one.feature for one in found] == ["plane"]
    assert apply(np.linalg.inv(POSE), found[0].point_in_model[None])[0] == pytest.approx([0, 0, 10], abs=1e-9)
    assert local(found[0].direction_in_model) == pytest.approx([0, 0, 1], abs=1e-9)


def test_a_slot_has_its_middle_its_width_and_its_length() -> None:
    plate = slot_scene().part.model.component("plate")
    slotted = Component("part", apply(POSE, plate.vertices_in_model), plate.faces)
    found = pick(slotted, [-20.0, -20.9, 0.0], [0, 0, 1])
    assert found[0].feature == "slot" and found[0].diameter_mm == pytest.approx(8.0, abs=2e-3)
    assert apply(np.linalg.inv(POSE), found[0].point_in_model[None])[0] == pytest.approx([-25, -25, 0], abs=1e-3)
    assert local(found[0].direction_in_model) == pytest.approx([0, 0, 1], abs=1e-6)
    assert found[0].size_mm == pytest.approx(26.0, abs=2e-3)
    # A slot is no round rim.
    assert not [one for one in find_rims(slotted) if one.half_in_model.any()]


def test_an_edge_near_the_point_is_offered_with_its_whole_length(block: Component) -> None:
    found = pick(block, [5.0, 19.0, 10.0], [0, 0, 1])
    edge = next(one for one in found if one.feature == "edge")
    assert abs(local(edge.direction_in_model)[0]) == pytest.approx(1.0, abs=1e-9)
    assert edge.size_mm == pytest.approx(60.0, abs=1e-6)
    assert edge.distance_mm == pytest.approx(1.0, abs=1e-6)
    assert apply(np.linalg.inv(POSE), edge.point_in_model[None])[0] == pytest.approx([0, 20, 10], abs=1e-6)


@pytest.mark.parametrize("radius,feature,aside", [(8.0, "hole", 0.4), (20.0, "pin", -0.4)])
def test_a_rim_near_the_point_comes_first(washer: Component, radius: float, feature: str, aside: float) -> None:
    found = pick(washer, [radius + aside, 0.0, 3.0], [0, 0, 1])
    assert found[0].feature == feature
    assert found[0].diameter_mm == pytest.approx(2 * radius, rel=1e-9)
    assert apply(np.linalg.inv(POSE), found[0].point_in_model[None])[0] == pytest.approx([0, 0, 3], abs=1e-9)
    assert local(found[0].direction_in_model) == pytest.approx([0, 0, 1], abs=1e-9)
    assert any(one.feature == "plane" for one in found)


def test_a_round_wall_is_a_cylinder_with_its_axis(washer: Component) -> None:
    found = pick(washer, [20.0, 0.0, 0.0], [1, 0, 0])
    cylinder = next(one for one in found if one.feature == "cylinder")
    assert cylinder.diameter_mm == pytest.approx(40.0, rel=1e-9)
    assert cylinder.size_mm == pytest.approx(6.0, rel=1e-9)
    assert abs(local(cylinder.direction_in_model)[2]) == pytest.approx(1.0, abs=1e-9)
    foot = apply(np.linalg.inv(POSE), cylinder.point_in_model[None])[0]
    assert foot[:2] == pytest.approx([0, 0], abs=1e-9)
    assert abs(foot[2]) == pytest.approx(3.0, abs=1e-9)


def test_the_middle_of_a_large_plane_is_no_rim(washer: Component) -> None:
    assert pick(washer, [14.0, 0.0, 3.0], [0, 0, 1])[0].feature == "plane"


def test_a_face_that_is_not_there_is_refused(block: Component) -> None:
    with pytest.raises(InputError, match="no face 99, it has 12"):
        pick_features(block, 99, np.zeros(3))
