"""Guide views against the geometry they come from: contours, normals, run lengths, files, ranges, uniqueness."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from arview.cad.model import Component, Model, make_model
from arview.cad.part_file import load_part
from arview.cad.view_range import ViewRange
from arview.errors import InputError, MismatchError
from arview.geometry import Array, apply, invert
from arview.guideviews import GuideViewOptions, GuideViewSet, load_guide_views, make_guide_views
from arview.guideviews.findings import assessed_guide_views, confusable_pair, uniqueness_findings
from arview.guideviews.sheet import CONFUSABLE_COLOR, CONTOUR_COLOR, PLAIN_COLOR, contact_sheet
from arview.guideviews.sphere import icosphere_directions, view_poses
from arview.guideviews.surface import MAX_FACES, reduced_surface
from arview.guideviews.uniqueness import assess
from arview.guideviews.views import guide_camera
from arview.rendering.mesh_edges import EDGE_CONTOUR, EDGE_CREASE, EDGE_SHARP, EDGE_SILHOUETTE
from arview.rendering.renderers import ZBufferRenderer
from helpers.synthetic import assembly, block, bracket

COARSE = GuideViewOptions(subdivisions=1, renderer="zbuffer")
SPHERE = ViewRange((400.0, 700.0))


@pytest.fixture(scope="module")
def views() -> GuideViewSet:
    made = make_guide_views(assembly(), SPHERE, COARSE)
    assert len(made) == 42 and made.arrays
    return made


def distances_to_mesh(points: Array, model: Model) -> Array:
    """Distance (N,) of points (N,3) to the nearest triangle (Ericson, Real-Time Collision Detection, 5.1.5)."""
    vertices, faces, _ = model.mesh
    best = np.full(len(points), np.inf)
    for face in faces:
        a, b, c = vertices[face]
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal)
        height = (points - a) @ normal
        flat = points - height[:, None] * normal
        inside = np.ones(len(points), dtype=bool)
        nearest = np.full(len(points), np.inf)
        for p, q in ((a, b), (b, c), (c, a)):
            inside &= np.cross(q - p, flat - p) @ normal >= 0
            t = np.clip((points - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1)
            nearest = np.minimum(nearest, np.linalg.norm(points - p - t[:, None] * (q - p), axis=1))
        best = np.minimum(best, np.where(inside, np.abs(height), nearest))
    return best


# --- View sphere ----------------------------------------------------------------------------------------


def test_2562_directions_about_4_degrees_apart() -> None:
    directions = icosphere_directions(4)
    assert directions.shape == (2562, 3)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(np.ones(2562))
    cosines = directions @ directions.T
    np.fill_diagonal(cosines, -1.0)
    nearest_deg = np.rad2deg(np.arccos(cosines.max(axis=1)))
    assert 3.5 < nearest_deg.min() <= nearest_deg.max() < 4.7
    # Nowhere on the sphere is a hole.
    anywhere = np.random.default_rng(0).normal(size=(3000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    assert np.rad2deg(np.arccos((anywhere @ directions.T).max(axis=1))).max() < 2.9


@pytest.mark.parametrize("level,count", [(0, 12), (1, 42), (2, 162), (3, 642)])
def test_directions_of_every_level(level: int, count: int) -> None:
    assert len(icosphere_directions(level)) == count


def test_poses_look_at_the_centre_from_their_distance() -> None:
    directions, center = icosphere_directions(2), np.array([10.0, -20.0, 30.0])
    for direction, pose in zip(directions, view_poses(directions, 500.0, center), strict=True):
        assert apply(pose, center) == pytest.approx([0, 0, 500.0], abs=1e-9)
        assert invert(pose)[:3, 3] == pytest.approx(center + 500.0 * direction)


def test_only_the_declared_range_is_rendered() -> None:
    narrow = ViewRange((400.0, 700.0), elevation_deg=(20.0, 60.0), azimuth_deg=(150.0, 230.0))
    found = make_guide_views(bracket(), narrow, GuideViewOptions(subdivisions=3, margin_deg=5.0, renderer="zbuffer"))
    elevation = np.rad2deg(np.arcsin(found.directions[:, 2]))
    azimuth = np.rad2deg(np.arctan2(found.directions[:, 1], found.directions[:, 0])) % 360.0
    assert elevation.min() >= 15.0 - 1e-9
    assert elevation.max() <= 65.0 + 1e-9
    widened = 5.0 / np.cos(np.deg2rad(elevation))
    assert np.all(np.abs(azimuth - 190.0) <= 40.0 + widened + 1e-9)
    # As many as the solid angle of the range asks for, and not the whole sphere.
    solid = np.deg2rad(90.0) * (np.sin(np.deg2rad(65.0)) - np.sin(np.deg2rad(15.0)))
    assert len(found) == pytest.approx(642 * solid / (4 * np.pi), rel=0.2)


def test_a_range_between_two_directions_still_has_a_view() -> None:
    needle = ViewRange((500.0, 500.0), elevation_deg=(33.0, 33.0), azimuth_deg=(12.0, 12.0))
    found = make_guide_views(bracket(), needle, GuideViewOptions(subdivisions=0, margin_deg=0.0, renderer="zbuffer"))
    assert len(found) == 1
    e, a = np.deg2rad([33.0, 12.0])
    assert found.directions[0] == pytest.approx([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def test_a_camera_inside_the_part_is_refused() -> None:
    with pytest.raises(InputError, match="inside the part"):
        guide_camera(assembly(), 90.0, 400)


# --- Features -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_contour_points_lie_on_the_outline_and_on_the_mesh(views: GuideViewSet) -> None:
    renderer = ZBufferRenderer(assembly(), views.camera)
    apart_px, apart_mm, snapped = [], [], []
    for view in list(views)[::3]:
        outline = cv2.findContours(
            renderer.render(view.cam_from_model).silhouette, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
        )[0]
        border = np.concatenate([chain[:, 0, :] for chain in outline]).astype(np.float64)
        f = view.features
        assert 100 < len(f.contour_points) <= views.options.contour_points
        pixels = views.camera.project(apply(view.cam_from_model, f.contour_points))
        apart_px.append(np.linalg.norm(pixels[:, None] - border[None], axis=-1).min(axis=1))
        distance_mm = distances_to_mesh(f.contour_points, assembly())
        apart_mm.append(distance_mm)
        snapped.append(distance_mm < 1e-3)
    px_mm = 500.0 / views.camera.fx
    assert np.quantile(np.concatenate(apart_px), 0.99) < 1.0
    assert np.concatenate(apart_px).max() < 2.2
    # Exactly on the CAD's edges, but where the last facet is seen at a grazing angle: there a pixel's depth stands in.
    assert np.mean(np.concatenate(snapped)) > 0.88
    assert np.concatenate(apart_mm).max() < px_mm


def test_the_outline_is_met_without_bias(views: GuideViewSet) -> None:
    """Along its normal a contour point lies between the part's last pixel and the first outside, on average halfway."""
    renderer = ZBufferRenderer(assembly(), views.camera.scaled(1600, 1600))
    big = renderer.camera
    offsets = []
    for view in list(views)[::6]:
        mask = renderer.render(view.cam_from_model).silhouette > 0
        signed = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) - cv2.distanceTransform(
            1 - mask.astype(np.uint8), cv2.DIST_L2, 5
        )
        signed -= np.where(mask, 0.5, -0.5)
        pixels = big.project(apply(view.cam_from_model, view.features.contour_points)).astype(np.float32)
        offsets.append(cv2.remap(signed, pixels[:, :1], pixels[:, 1:], cv2.INTER_LINEAR)[:, 0] / 4.0)
    assert abs(np.median(np.concatenate(offsets))) < 0.1
    assert np.quantile(np.abs(np.concatenate(offsets)), 0.9) < 0.6


def test_normals_point_off_the_part_across_the_line_of_sight(views: GuideViewSet) -> None:
    renderer = ZBufferRenderer(assembly(), views.camera)
    right, total = 0, 0
    for view in list(views)[::3]:
        f = view.features
        assert np.linalg.norm(f.contour_normals, axis=1) == pytest.approx(np.ones(len(f.contour_normals)), abs=1e-3)
        eye = invert(view.cam_from_model)[:3, 3]
        sight = f.contour_points - eye
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        assert np.abs(np.sum(sight * f.contour_normals, axis=1)).max() < 1e-3
        mask = renderer.render(view.cam_from_model).silhouette
        step_mm = 2.0 * np.linalg.norm(f.contour_points - eye, axis=1, keepdims=True) / views.camera.fx
        for sign, expected in ((1.0, False), (-1.0, True)):
            at = views.camera.project(apply(view.cam_from_model, f.contour_points + sign * step_mm * f.contour_normals))
            u, v = np.round(at).astype(int).T
            right += np.count_nonzero((mask[v, u] > 0) == expected)
            total += len(u)
    assert right / total > 0.97


def test_run_lengths_of_a_block_seen_from_above() -> None:
    """Lines inwards from the long sides cross 60 mm; those from the short sides 80 mm, cut at half a picture."""
    above = ViewRange((500.0, 500.0), elevation_deg=(90.0, 90.0))
    found = make_guide_views(block(), above, GuideViewOptions(subdivisions=0, margin_deg=0.0, renderer="zbuffer"))
    f = found.view(0).features
    along_x = np.abs(f.contour_normals[:, 0]) > 0.99
    along_y = np.abs(f.contour_normals[:, 1]) > 0.99
    assert along_x.sum() > 40
    assert along_y.sum() > 40
    top_mm = 480.0  # from the camera to the block's top
    cut_mm = 0.5 * found.camera.width * top_mm / found.camera.fx
    assert 60.0 < cut_mm < 80.0
    assert f.contour_runs_mm[along_y, 0] == pytest.approx(np.full(along_y.sum(), 60.0), abs=1.3)
    assert np.median(f.contour_runs_mm[along_x, 0]) == pytest.approx(cut_mm, abs=0.01)
    # Outwards there is nothing else.
    assert np.median(f.contour_runs_mm[:, 1]) == pytest.approx(cut_mm, abs=0.01)
    assert np.all(f.contour_component == 0)


def test_run_lengths_end_where_the_next_part_begins() -> None:
    """Along +Y at the bracket, 900 mm from its middle: inwards its wall, outwards air as far as its step."""
    side = ViewRange((900.0, 900.0), elevation_deg=(0.0, 0.0), azimuth_deg=(-90.0, -90.0))
    options = GuideViewOptions(subdivisions=0, margin_deg=0.0, renderer="zbuffer", resolution_px=800)
    f = make_guide_views(bracket(), side, options).view(0).features
    wall = (np.abs(f.contour_points[:, 0] - 26.0) < 0.1) & (f.contour_points[:, 2] > 24) & (f.contour_points[:, 2] < 36)
    assert wall.sum() >= 5
    # The camera is at x = 60, y = -855: the wall's outline is its far corner (26, 90), 945 mm away, and ends at its
    # near corner (0, 0); the step's outline is its far corner (70, 48).
    wall_x, end_x, step_x = (26 - 60) / 945, (0 - 60) / 855, (70 - 60) / 903
    assert f.contour_runs_mm[wall, 0] == pytest.approx(np.full(wall.sum(), (wall_x - end_x) * 945), abs=1.3)
    assert f.contour_runs_mm[wall, 1] == pytest.approx(np.full(wall.sum(), (step_x - wall_x) * 945), abs=1.3)


def test_edges_lie_on_the_mesh_and_their_kinds_are_right(views: GuideViewSet) -> None:
    for view in list(views)[::9]:
        f = view.features
        assert distances_to_mesh(f.edge_points, assembly()).max() < 1e-3
        assert np.linalg.norm(f.edge_tangents, axis=1) == pytest.approx(np.ones(len(f.edge_points)), abs=1e-3)
        assert np.all((f.edge_kinds & (EDGE_CREASE | EDGE_SILHOUETTE)) > 0)
        assert np.all((f.edge_kinds & EDGE_CREASE)[(f.edge_kinds & EDGE_SHARP) > 0] > 0)
        # Only the posts, of facets 15° apart, have edges that are no design edges.
        names = np.array(views.component_names)[f.edge_component]
        soft = (f.edge_kinds & EDGE_SHARP) == 0
        assert set(names[soft]) <= {"post_1", "post_2", "post_3"}
        assert np.mean((f.edge_kinds & EDGE_CONTOUR) > 0) > 0.2


def test_edges_of_the_outline_run_with_the_outside_on_one_side(views: GuideViewSet) -> None:
    renderer = ZBufferRenderer(assembly(), views.camera)
    right, count = 0, 0
    for view in (views.view(k) for k in range(0, len(views), 4)):
        mask = renderer.render(view.cam_from_model).silhouette > 0
        outline = (view.features.edge_kinds & EDGE_CONTOUR) > 0
        points, tangents = view.features.edge_points[outline], view.features.edge_tangents[outline]
        pixels = views.camera.project(apply(view.cam_from_model, points))
        along = views.camera.project(apply(view.cam_from_model, points + tangents)) - pixels
        normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        ahead, behind = (np.round(pixels + shift).astype(int) for shift in (3.0 * normals, -3.0 * normals))
        is_told = mask[ahead[:, 1], ahead[:, 0]] != mask[behind[:, 1], behind[:, 0]]
        right += np.count_nonzero(~mask[ahead[:, 1], ahead[:, 0]][is_told])
        count += np.count_nonzero(is_told)
    assert count > 500 and right >= 0.99 * count


def test_hidden_edges_are_left_out() -> None:
    """Of a block seen corner on, the three edges that meet at the far corner are hidden, the other nine seen."""
    corner = ViewRange((600.0, 600.0), elevation_deg=(30.0, 30.0), azimuth_deg=(40.0, 40.0))
    f = (
        make_guide_views(block(), corner, GuideViewOptions(subdivisions=0, margin_deg=0.0, renderer="zbuffer"))
        .view(0)
        .features
    )
    x, y, z = f.edge_points.T
    behind = [(y < 0.1) & (z < 0.1), (x < 0.1) & (z < 0.1), (x < 0.1) & (y < 0.1)]
    corners = np.array(list(np.ndindex(2, 2, 2))) * [80, 60, 40]
    ends = np.linalg.norm(f.edge_points[:, None] - corners, axis=-1).min(axis=1)
    assert not any((hidden & (ends > 4.0)).any() for hidden in behind)
    seen = [(y > 59.9) & (z > 39.9), (x > 79.9) & (z > 39.9), (x > 79.9) & (y > 59.9), (y < 0.1) & (z > 39.9)]
    assert all(edge.sum() > 10 for edge in seen)


def test_the_surface_of_a_small_mesh_is_kept_as_it_is() -> None:
    model = block()
    points, faces, component = reduced_surface(model)
    vertices, all_faces, owners = model.mesh
    assert (component == owners).all()
    assert points[faces] == pytest.approx(vertices[all_faces], abs=1e-4)


def test_a_fine_mesh_is_reduced_and_stays_where_it_was() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=50.0)
    model = make_model("ball", (Component("ball", sphere.vertices + 20.0, sphere.faces.astype(np.int32)),))
    assert len(sphere.faces) > 3 * MAX_FACES
    points, faces, component = reduced_surface(model)
    assert len(component) == len(faces)
    assert 1000 < len(faces) <= MAX_FACES
    assert np.linalg.norm(points - 20.0, axis=1) == pytest.approx(50.0, abs=0.2)
    reduced = trimesh.Trimesh(points, faces, process=False)
    assert reduced.area == pytest.approx(sphere.area, rel=0.01)


def test_nearest_view_is_the_nearest(views: GuideViewSet) -> None:
    for view in list(views)[::7]:
        assert views.nearest(view.cam_from_model).index == view.index


def test_pool_and_order_give_the_same_views(views: GuideViewSet) -> None:
    again = make_guide_views(assembly(), SPHERE, COARSE)
    assert all(np.array_equal(again.arrays[name], array) for name, array in views.arrays.items())


# --- Files ----------------------------------------------------------------------------------------------


@pytest.fixture
def saved(views: GuideViewSet, tmp_path: Path) -> Path:
    views.save(tmp_path / "a.gv")
    return tmp_path / "a.gv"


def test_a_set_comes_back_equal_and_mapped(views: GuideViewSet, saved: Path) -> None:
    loaded = load_guide_views(saved, assembly())
    assert np.array_equal(loaded.camera.matrix, views.camera.matrix)
    assert (loaded.model_hash, loaded.component_names) == (views.model_hash, views.component_names)
    assert (loaded.view_range, loaded.options) == (views.view_range, views.options)
    assert np.array_equal(loaded.poses, views.poses)
    for name, array in views.arrays.items():
        assert np.array_equal(loaded.arrays[name], array)
        base: object = loaded.arrays[name]
        while isinstance(base, np.ndarray) and not isinstance(base, np.memmap):
            base = base.base
        assert isinstance(base, np.memmap)
    assert np.array_equal(loaded.view(5).features.contour_points, views.view(5).features.contour_points)
    assert [file.name for file in saved.parent.iterdir()] == [saved.name]


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("contour_start", 3, 10**9),
        ("edge_start", -1, 0),
        ("contour_component", 0, 7),
        ("edge_component", 5, -1),
        ("surface_faces", 0, 2_000_000),
        ("surface_points", 0, np.nan),
        ("edge_points", 4, np.inf),
        ("surface_component", 0, 99),
    ],
)
def test_indices_and_points_are_checked_when_a_set_is_read(
    views: GuideViewSet, tmp_path: Path, name: str, index: int, value: float
) -> None:
    array = views.arrays[name].copy()
    array.reshape(len(array), -1)[index] = value
    replace(views, arrays=views.arrays | {name: array}).save(tmp_path / "a.gv")
    with pytest.raises(InputError, match="the guide-view set is damaged"):
        load_guide_views(tmp_path / "a.gv")
    replace(views, arrays={key: kept for key, kept in views.arrays.items() if key != name}).save(tmp_path / "b.gv")
    with pytest.raises(InputError, match="the guide-view set is damaged"):
        load_guide_views(tmp_path / "b.gv")


def test_poses_that_are_no_poses_are_refused(views: GuideViewSet, tmp_path: Path) -> None:
    for poses in (views.poses[:-1], 2.0 * views.poses, np.full_like(views.poses, np.nan)):
        replace(views, poses=poses).save(tmp_path / "a.gv")
        with pytest.raises(InputError, match="the guide-view set is damaged"):
            load_guide_views(tmp_path / "a.gv")


def test_views_of_another_model_are_refused(saved: Path) -> None:
    with pytest.raises(MismatchError, match=r"'assembly'.*'bracket'"):
        load_guide_views(saved, bracket())


@pytest.mark.parametrize("keep", [0, 10, 25, 400, 0.5, 0.999])
def test_a_truncated_file_is_refused(saved: Path, keep: float) -> None:
    content = saved.read_bytes()
    saved.write_bytes(content[: int(keep * len(content)) if isinstance(keep, float) else keep])
    with pytest.raises(InputError, match=r"not a guide-view set|damaged|truncated"):
        load_guide_views(saved)


def test_garbage_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.gv"
    path.write_bytes(np.random.default_rng(0).bytes(5000))
    with pytest.raises(InputError, match="not a guide-view set"):
        load_guide_views(path)
    path.write_bytes(b"ARVIEW-GUIDEVIEWS\n" + (64).to_bytes(8, "little") + bytes(range(128, 192)) + b"\0" * 500)
    with pytest.raises(InputError, match="damaged"):
        load_guide_views(path)
    with pytest.raises(InputError, match="cannot be read"):
        load_guide_views(tmp_path / "absent.gv")


@pytest.mark.parametrize(
    "header", ["[]", "{}", '{"meta": {}, "arrays": 3}', '{"meta": {"format_version": 2}, "arrays": {}}']
)
def test_a_header_without_sense_is_refused(tmp_path: Path, header: str) -> None:
    path = tmp_path / "x.gv"
    path.write_bytes(b"ARVIEW-GUIDEVIEWS\n" + len(header).to_bytes(8, "little") + header.encode() + b"\0" * 64)
    with pytest.raises(InputError, match="damaged"):
        load_guide_views(path)


def test_an_older_version_is_refused(saved: Path) -> None:
    content = saved.read_bytes()
    assert content.count(b'"format_version": 2,') == 1
    saved.write_bytes(content.replace(b'"format_version": 2,', b'"format_version": 1,'))
    with pytest.raises(InputError, match=r"format 1, this arview reads 2.*again"):
        load_guide_views(saved)


@pytest.mark.parametrize("change", [{"subdivisions": 7}, {"resolution_px": 20}, {"contour_points": 5}])
def test_options_without_sense_are_refused(change: dict[str, int]) -> None:
    with pytest.raises(InputError, match="guide views"):
        GuideViewOptions(**change)  # type: ignore[arg-type]


# --- Uniqueness -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_lone_block_is_insufficient_and_says_why() -> None:
    found = make_guide_views(block(), SPHERE, GuideViewOptions(subdivisions=2, renderer="zbuffer"))
    unique = assess(found)
    assert not unique.is_sufficient
    assert "insufficient" in unique.reason
    assert "plain block" in unique.reason
    assert unique.score < 0.1
    assert np.median(unique.distinct_lines) < 10


def test_the_assembly_is_sufficient() -> None:
    top = ViewRange((400.0, 700.0), elevation_deg=(10.0, 90.0))
    found = make_guide_views(assembly(), top, GuideViewOptions(subdivisions=2, renderer="zbuffer"))
    unique = assess(found)
    assert unique.is_sufficient
    assert unique.reason.startswith("sufficient")
    assert unique.score > 0.8
    assert len(unique.distinct_lines) == len(unique.likeness) == len(found)


@pytest.mark.slow
def test_views_of_a_block_are_alike_from_opposite_sides() -> None:
    """Half a turn about Z brings a block back: every view is as good as equal to the one from the other side."""
    found = make_guide_views(block(), SPHERE, GuideViewOptions(subdivisions=2, renderer="zbuffer"))
    unique = assess(found)
    assert np.median(unique.likeness) > 0.97
    words = confusable_pair(found, unique)
    assert "azimuth" in words
    assert "likeness 0.9" in words or "likeness 1.0" in words


@pytest.mark.slow
def test_findings_name_the_block_a_problem_and_the_assembly_none() -> None:
    (finding,) = uniqueness_findings(block(), SPHERE)
    assert finding.severity == "problem"
    assert "insufficient" in finding.text
    (finding,) = uniqueness_findings(assembly(), ViewRange((400.0, 700.0), elevation_deg=(10.0, 90.0)))
    assert finding.severity == "note"
    assert "score 1.00" in finding.text


@pytest.mark.slow
@pytest.mark.parametrize("elevation_deg", [(50.0, 90.0), (55.0, 70.0)])
def test_the_shares_do_not_depend_on_the_number_of_views(elevation_deg: tuple[float, float]) -> None:
    """`check` renders few views, `guideviews` many and a margin around the range: both state the same shares."""
    view_range = ViewRange((400.0, 700.0), elevation_deg=elevation_deg)
    few = assess(assessed_guide_views(assembly(), view_range))
    many = assess(make_guide_views(assembly(), view_range, GuideViewOptions(subdivisions=4, renderer="zbuffer")))
    assert len(many.distinct_lines) > 3 * len(few.distinct_lines) >= 60
    assert (many.reason, many.score) == (few.reason, few.score)


# --- Contact sheet --------------------------------------------------------------------------------------


def has_color(image: np.ndarray, color: tuple[int, int, int]) -> bool:
    return bool(np.any(np.all(np.abs(image.astype(int) - color) <= 8, axis=-1)))


def test_the_sheet_shows_the_views_and_frames_weak_ones(views: GuideViewSet) -> None:
    sheet = contact_sheet(assembly(), views, columns=5, tile_px=120, max_views=10)
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] == 5 * 126 + 6
    assert sheet.shape[0] > 2 * 154
    assert has_color(sheet, CONTOUR_COLOR)
    plain = make_guide_views(block(), SPHERE, COARSE)
    legend_only = contact_sheet(assembly(), views, columns=5, tile_px=120, max_views=1)
    framed = contact_sheet(block(), plain, columns=5, tile_px=120, max_views=10)
    tiles = framed[-2 * 160 :]
    assert has_color(tiles, PLAIN_COLOR) or has_color(tiles, CONFUSABLE_COLOR)
    assert legend_only.shape[1] == 132


def test_a_sheet_of_no_size_is_refused(views: GuideViewSet) -> None:
    with pytest.raises(InputError, match="contact sheet"):
        contact_sheet(assembly(), views, columns=0)


def test_a_packed_set_is_small_and_the_same_to_a_few_micrometres(tmp_path: Path) -> None:
    views = make_guide_views(assembly(), SPHERE, GuideViewOptions(subdivisions=1, renderer="zbuffer"))
    views.save(tmp_path / "whole.gv")
    views.save(tmp_path / "packed.gv", is_packed=True)
    assert (tmp_path / "packed.gv").stat().st_size < 0.55 * (tmp_path / "whole.gv").stat().st_size
    read = load_guide_views(tmp_path / "packed.gv", assembly())
    for theirs, ours in zip(read, views, strict=True):
        assert np.array_equal(theirs.cam_from_model, ours.cam_from_model)
        assert theirs.features.edge_points == pytest.approx(ours.features.edge_points, abs=1e-4 * views.diameter_mm)
        assert np.array_equal(theirs.features.edge_kinds, ours.features.edge_kinds)
        assert np.array_equal(theirs.features.contour_component, ours.features.contour_component)


@pytest.mark.parametrize("at", [0.4, 0.6, 0.9])
def test_a_damaged_packed_set_is_refused(tmp_path: Path, at: float) -> None:
    views = make_guide_views(assembly(), SPHERE, GuideViewOptions(subdivisions=1, renderer="zbuffer"))
    path = tmp_path / "packed.gv"
    views.save(path, is_packed=True)
    content = bytearray(path.read_bytes())
    middle = int(at * len(content))
    content[middle : middle + 40] = b"\xff" * 40
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged"):
        load_guide_views(path, assembly())


SETS = Path(__file__).parents[2] / "guideviews"


@pytest.mark.parametrize("name", ["bracket_plate", "manifold", "panel", "plate"])
def test_the_sets_of_the_samples_belong_to_their_parts(name: str) -> None:
    """Made again with `make guideviews` when a sample or the loader changes."""
    part = load_part(SETS.parent / "samples" / name / "part.toml")
    path = SETS / name / f"{name}.gv"
    views = load_guide_views(path, part.model)
    assert len(views) > 100 and views.view_range == part.effective_view_range
    assert path.stat().st_size < 3e6
    assert (SETS / name / "sheet.jpg").is_file()
    assert assess(views).reason.lower() in (SETS / name / "report.md").read_text().lower()
