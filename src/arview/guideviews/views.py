"""Guide views: renderings of a model from directions all over a range, reduced to features, in a set that is saved."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad import Model, ViewRange
from arview.camera import Camera
from arview.core.checks import PATH, check_type
from arview.core.progress import StepProgress
from arview.errors import InputError, MismatchError
from arview.geometry import Array
from arview.guideviews.extract import ViewFeatures, extract_features
from arview.guideviews.sphere import directions_in_range, view_poses
from arview.guideviews.store import read_arrays, write_arrays
from arview.guideviews.surface import Surface, reduced_surface, surface_about
from arview.guideviews.validity import check_arrays, check_poses
from arview.rendering import Rendering, open_renderer
from arview.rendering.mesh_edges import mesh_edges

FORMAT_VERSION = 2
_UNIT16 = 32767.0
"""Components of unit vectors are stored as 16-bit integers, 1 as this."""
MAX_THREADS = 8
"""Threads that extract features."""
MAX_PENDING = 32
"""Views that are drawn or wait to be."""


@dataclass(frozen=True)
class GuideViewOptions:
    """How guide views are made; stored with the set.

    Attributes:
        subdivisions: subdivisions of the icosahedron whose vertices are the directions; 4 gives 2,562 directions on the
            full sphere, about 4° apart.
        margin_deg: how far outside the declared range views are made, since tracking goes on beyond it.
        resolution_px: side of the square picture of a view; the part fills about 85 % of it.
        contour_points: largest number of contour points of a view; 200 as in RBGT.
        edge_points: largest number of edge points of a view.
        crease_angle_deg: dihedral angle above which an edge is a crease.
        renderer: ``auto``, ``pyrender`` or ``zbuffer``.
    """

    subdivisions: int = 4
    margin_deg: float = 12.0
    resolution_px: int = 400
    contour_points: int = 200
    edge_points: int = 400
    crease_angle_deg: float = 30.0
    renderer: str = "auto"

    def __post_init__(self) -> None:
        if not 0 <= self.subdivisions <= 6:
            raise InputError(f"guide views: subdivisions = {self.subdivisions}, expected 0 to 6")
        if not 100 <= self.resolution_px <= 2000:
            raise InputError(f"guide views: resolution_px = {self.resolution_px}, expected 100 to 2000")
        if self.contour_points < 20 or self.edge_points < 20:
            raise InputError("guide views: fewer than 20 points a view cannot hold a pose")


@dataclass(frozen=True)
class GuideView:
    """One view: its index in the set, its pose and its features."""

    index: int
    cam_from_model: Array
    features: ViewFeatures


@dataclass(frozen=True)
class GuideViewSet:
    """All guide views of a model.

    Attributes:
        model_name, model_hash: of the model they were rendered from.
        component_names: in the order of the component indices.
        camera: ideal camera of the views.
        view_range: the declared range.
        options: how they were made.
        center_in_model, diameter_mm: centre and diagonal of the model's bounding box.
        poses: (N,4,4) ``cam_from_model`` of the views.
        directions: (N,3) unit vectors from the centre to the cameras.
        arrays: the features of all views, packed; see `view`.
    """

    model_name: str
    model_hash: str
    component_names: tuple[str, ...]
    camera: Camera
    view_range: ViewRange
    options: GuideViewOptions
    center_in_model: Array
    diameter_mm: float
    poses: Array
    directions: Array
    arrays: dict[str, NDArray[Any]] = field(repr=False)

    def __repr__(self) -> str:
        return f"<GuideViewSet {self.model_name}: {len(self)} views, {self.diameter_mm:.0f} mm>"

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[GuideView]:
        return (self.view(index) for index in range(len(self)))

    def view(self, index: int) -> GuideView:
        """The view at an index, decoded at each call: all decoded views of a full sphere would take 80 MB."""
        arrays = self.arrays
        c0, c1 = arrays["contour_start"][index : index + 2]
        e0, e1 = arrays["edge_start"][index : index + 2]
        features = ViewFeatures(
            contour_points=arrays["contour_points"][c0:c1].astype(np.float64),
            contour_normals=arrays["contour_normals"][c0:c1].astype(np.float64) / _UNIT16,
            contour_runs_mm=arrays["contour_runs_mm"][c0:c1].astype(np.float64),
            contour_component=arrays["contour_component"][c0:c1].astype(np.int32),
            edge_points=arrays["edge_points"][e0:e1].astype(np.float64),
            edge_tangents=arrays["edge_tangents"][e0:e1].astype(np.float64) / _UNIT16,
            edge_kinds=np.array(arrays["edge_kinds"][e0:e1]),
            edge_component=arrays["edge_component"][e0:e1].astype(np.int32),
        )
        return GuideView(index=index, cam_from_model=self.poses[index], features=features)

    @property
    def surface(self) -> Surface:
        """The surface of the model, reduced where it has many faces, about its centre."""
        points, faces, component = (
            np.array(self.arrays[f"surface_{name}"]) for name in ("points", "faces", "component")
        )
        return surface_about(points, faces, component, self.center_in_model)

    def nearest(self, cam_from_model: Array) -> GuideView:
        """The view whose direction is nearest to that of the camera at a pose."""
        return self.view(self.nearest_index(cam_from_model))

    def nearest_index(self, cam_from_model: Array) -> int:
        """Index of the view whose direction is nearest to that of the camera at a pose."""
        eye = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3]
        return int(np.argmax(self.directions @ (eye - self.center_in_model)))

    def save(self, path: str | Path, is_packed: bool = False) -> None:
        """Write the set to one file, atomically.

        Args:
            path: of the file.
            is_packed: a quarter of the size, points kept to 1/65535 of the part's size; not memory-mapped when loaded.

        Raises:
            OutputError: the file cannot be written.
        """
        camera = self.camera
        meta = {
            "format_version": FORMAT_VERSION,
            "model_name": self.model_name,
            "model_hash": self.model_hash,
            "component_names": list(self.component_names),
            "camera": [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy],
            "view_range": asdict(self.view_range),
            "options": asdict(self.options),
            "center_in_model": self.center_in_model.tolist(),
            "diameter_mm": self.diameter_mm,
        }
        arrays = {"poses": self.poses, "directions": self.directions, **self.arrays}
        write_arrays(Path(path), meta, arrays, is_packed)


def load_guide_views(path: str | Path, model: Model | None = None) -> GuideViewSet:
    """Load a set, whose arrays are memory-mapped.

    Raises:
        InputError: the file is missing, is not a set, is damaged, or has another format version.
        MismatchError: the set was rendered from another model than the one given.
    """
    check_type(path, PATH, "load_guide_views: path")
    path = Path(path)
    meta, arrays = read_arrays(path)
    if meta.get("format_version") != FORMAT_VERSION:
        raise InputError(
            f"{path}: guide views of format {meta.get('format_version')}, this arview reads {FORMAT_VERSION}; "
            "make them again with `arview guideviews`"
        )
    if model is not None and meta.get("model_hash") != model.source_hash:
        raise MismatchError(
            f"{path}: guide views of model {meta.get('model_name')!r} ({str(meta.get('model_hash'))[:12]}), "
            f"but the part is {model.name!r} ({model.source_hash[:12]}); make them again with `arview guideviews`"
        )
    try:
        return _from_parts(meta, arrays)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, InputError) as error:
        raise InputError(f"{path}: the guide-view set is damaged; make it again with `arview guideviews`") from error


def _from_parts(meta: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> GuideViewSet:
    """A set from the metadata and the arrays of a file, all of which are checked.

    Raises:
        InputError, KeyError, TypeError, ValueError, AttributeError, OverflowError: something is damaged.
    """
    names = [meta["model_name"], meta["model_hash"], *meta["component_names"]]
    center, diameter_mm = np.array(meta["center_in_model"], dtype=np.float64), float(meta["diameter_mm"])
    if not all(isinstance(name, str) for name in names) or center.shape != (3,) or not np.isfinite(center).all():
        raise ValueError("names or centre")
    if not 0.0 < diameter_mm < np.inf:
        raise ValueError("diameter")
    width, height, fx, fy, cx, cy = meta["camera"]
    arrays = dict(arrays)
    poses, directions = np.array(arrays.pop("poses")), np.array(arrays.pop("directions"))
    check_poses(poses, directions)
    check_arrays(arrays, len(poses), len(meta["component_names"]))
    ranges: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in meta["view_range"].items()
    }
    return GuideViewSet(
        model_name=meta["model_name"],
        model_hash=meta["model_hash"],
        component_names=tuple(meta["component_names"]),
        camera=Camera(width, height, fx, fy, cx, cy),
        view_range=ViewRange(**ranges),
        options=GuideViewOptions(**meta["options"]),
        center_in_model=center,
        diameter_mm=diameter_mm,
        poses=poses,
        directions=directions,
        arrays=arrays,
    )


def guide_camera(model: Model, distance_mm: float, resolution_px: int) -> Camera:
    """Square ideal camera in which the bounding sphere of a model fills 85 % of the picture at a distance.

    Raises:
        InputError: the camera would be inside the part.
    """
    radius_mm = 0.5 * model.diameter_mm
    if distance_mm <= 1.05 * radius_mm:
        raise InputError(
            f"view range: at {distance_mm:.0f} mm the camera would be inside the part (radius {radius_mm:.0f} mm)"
        )
    tangent = radius_mm / np.sqrt(distance_mm**2 - radius_mm**2)
    focal = 0.425 * resolution_px / tangent
    middle = 0.5 * (resolution_px - 1)
    return Camera(resolution_px, resolution_px, focal, focal, middle, middle)


def view_distance_mm(view_range: ViewRange, model: Model) -> float:
    """Distance of the views: the harmonic mean of the range, since perspective changes with 1/distance."""
    low, high = view_range.distance_mm
    return max(2.0 / (1.0 / low + 1.0 / high), 0.75 * model.diameter_mm)


def make_guide_views(
    model: Model,
    view_range: ViewRange,
    options: GuideViewOptions | None = None,
    *,
    progress: StepProgress | None = None,
) -> GuideViewSet:
    """Render the guide views of a model over a range, and extract their features.

    Args:
        model: of the part, or of one component.
        view_range: the declared range.
        options: how they are made; None for the defaults.
        progress: called with the number of finished views and the number of all.

    Raises:
        MissingDependencyError: the renderer is pyrender, and its GL library is missing.
        InputError: the range puts the camera inside the part.
    """
    check_type(model, Model, "make_guide_views: model")
    check_type(view_range, ViewRange, "make_guide_views: view_range")
    options = options or GuideViewOptions()
    if view_range.distance_mm[1] <= 0.5 * model.diameter_mm:
        raise InputError(
            f"view range: at {view_range.distance_mm[1]:.0f} mm from its centre the camera is inside the part "
            f"({model.diameter_mm:.0f} mm across); distance_mm must be larger"
        )
    distance_mm = view_distance_mm(view_range, model)
    camera = guide_camera(model, distance_mm, options.resolution_px)
    directions = directions_in_range(view_range, options.subdivisions, options.margin_deg)
    poses = view_poses(directions, distance_mm, model.center_in_model, view_range.up_in_model)
    features = []
    for found in _extracted(model, camera, poses, options):
        features.append(found)
        if progress:
            progress(len(features), len(poses))
    return GuideViewSet(
        model_name=model.name,
        model_hash=model.source_hash,
        component_names=tuple(component.name for component in model.components),
        camera=camera,
        view_range=view_range,
        options=options,
        center_in_model=model.center_in_model,
        diameter_mm=model.diameter_mm,
        poses=poses,
        directions=directions,
        arrays=_packed(model, features),
    )


def _extracted(model: Model, camera: Camera, poses: Array, options: GuideViewOptions) -> Iterator[ViewFeatures]:
    """Features of the views at some poses (N,4,4), in their order, rendered and extracted by a pool of threads."""
    edges = mesh_edges(model, options.crease_angle_deg)

    def extract(draw: Callable[[], Rendering], pose: Array) -> ViewFeatures:
        return extract_features(draw(), pose, camera, edges, options.contour_points, options.edge_points)

    renderer = open_renderer(model, camera, options.renderer)
    try:
        with ThreadPoolExecutor(max(1, min(MAX_THREADS, os.cpu_count() or 1))) as pool:
            pending: deque[Future[ViewFeatures]] = deque()
            for pose, draw in zip(poses, renderer.draw_each(list(poses)), strict=True):
                pending.append(pool.submit(extract, draw, pose))
                if len(pending) >= MAX_PENDING:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
    finally:
        renderer.close()


def _packed(model: Model, features: Sequence[ViewFeatures]) -> dict[str, NDArray[Any]]:
    """The arrays of a set: the features of all views one after the other, directions as 16-bit integers."""

    def starts(counts: list[int]) -> NDArray[np.int64]:
        return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    surface_points, surface_faces, surface_component = reduced_surface(model)
    return {
        "surface_points": surface_points,
        "surface_faces": surface_faces,
        "surface_component": surface_component,
        "contour_start": starts([len(f.contour_points) for f in features]),
        "contour_points": np.concatenate([f.contour_points for f in features]).astype(np.float32),
        "contour_normals": np.round(np.concatenate([f.contour_normals for f in features]) * _UNIT16).astype(np.int16),
        "contour_runs_mm": np.concatenate([f.contour_runs_mm for f in features]).astype(np.float32),
        "contour_component": np.concatenate([f.contour_component for f in features]).astype(np.int16),
        "edge_start": starts([len(f.edge_points) for f in features]),
        "edge_points": np.concatenate([f.edge_points for f in features]).astype(np.float32),
        "edge_tangents": np.round(np.concatenate([f.edge_tangents for f in features]) * _UNIT16).astype(np.int16),
        "edge_kinds": np.concatenate([f.edge_kinds for f in features]),
        "edge_component": np.concatenate([f.edge_component for f in features]).astype(np.int16),
    }
