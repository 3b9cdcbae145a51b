"""GuideViewSet: guide views of a model over a declared range, rendered, saved and loaded."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.cad.view_range import ViewRange
from arview.camera import Camera
from arview.core.progress import StepProgress
from arview.errors import InputError, MismatchError
from arview.geometry import Array
from arview.guideviews.extract import ViewFeatures, extract_features
from arview.guideviews.mesh_edges import mesh_edges
from arview.guideviews.sphere import directions_in_range, view_poses
from arview.guideviews.store import read_arrays, write_arrays
from arview.guideviews.surface import Surface, reduced_surface, surface_about
from arview.rendering.renderers import (
    PyrenderRenderer,
    ZBufferRenderer,
    open_renderer,
)

FORMAT_VERSION = 2
_UNIT16 = 32767.0


@dataclass(frozen=True)
class GuideViewOptions:
    """How guide views are made; every set remembers its own.

    Attributes:
        subdivisions: of the icosahedron; 4 gives 2,562 directions on the full sphere, about 4° apart.
        margin_deg: views are made this far outside the declared range, for the tracker that follows beyond it.
        resolution_px: side of the square picture of a view; the part fills about 85 % of it.
        contour_points: kept per view; 200 as in RBGT.
        edge_points: kept per view.
        crease_angle_deg: faces that meet at more than this make an edge.
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
    """One view: its pose and its features, see `ViewFeatures`."""

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
        center_in_model, diameter_mm: of the model's bounding box.
        poses: (N,4,4) ``cam_from_model`` of the views.
        directions: (N,3) unit vectors from the centre to the cameras.
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

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[GuideView]:
        return (self.view(index) for index in range(len(self)))

    def view(self, index: int) -> GuideView:
        """The view of that index, decoded anew: all of a full sphere would take 80 MB if they were kept."""
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
        """The surface of the model, perhaps of fewer faces, about its centre."""
        points, faces, component = (
            np.array(self.arrays[f"surface_{name}"]) for name in ("points", "faces", "component")
        )
        return surface_about(points, faces, component, self.center_in_model)

    def nearest(self, cam_from_model: Array) -> GuideView:
        """The view whose direction is nearest to that of the camera at this pose."""
        return self.view(self.nearest_index(cam_from_model))

    def nearest_index(self, cam_from_model: Array) -> int:
        """Index of that view."""
        eye = -cam_from_model[:3, :3].T @ cam_from_model[:3, 3]
        return int(np.argmax(self.directions @ (eye - self.center_in_model)))

    def save(self, path: Path) -> None:
        """Write the set to one file, atomically. Raises OutputError."""
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
        }  # fmt: skip
        write_arrays(path, meta, {"poses": self.poses, "directions": self.directions, **self.arrays})


def load_guide_views(path: Path, model: Model | None = None) -> GuideViewSet:
    """Load a set; arrays are memory-mapped.

    Raises:
        InputError: no such file, not a set, damaged, or of another format version.
        MismatchError: the set was rendered from another model than the one given.
    """
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
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise InputError(f"{path}: the guide-view set is damaged; make it again with `arview guideviews`") from error


def _from_parts(meta: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> GuideViewSet:
    """The set of a file's metadata and arrays."""
    width, height, fx, fy, cx, cy = meta["camera"]
    arrays = dict(arrays)
    return GuideViewSet(
        model_name=meta["model_name"],
        model_hash=meta["model_hash"],
        component_names=tuple(meta["component_names"]),
        camera=Camera(width, height, fx, fy, cx, cy),
        view_range=ViewRange(**{name: tuple(pair) for name, pair in meta["view_range"].items()}),
        options=GuideViewOptions(**meta["options"]),
        center_in_model=np.array(meta["center_in_model"]),
        diameter_mm=meta["diameter_mm"],
        poses=np.array(arrays.pop("poses")),
        directions=np.array(arrays.pop("directions")),
        arrays=arrays,
    )


def guide_camera(model: Model, distance_mm: float, resolution_px: int) -> Camera:
    """Square ideal camera in which the model's bounding sphere fills 85 % at that distance."""
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
    """Distance the views are rendered from: harmonic mean of the range, since perspective goes with 1/distance."""
    low, high = view_range.distance_mm
    return max(2.0 / (1.0 / low + 1.0 / high), 0.75 * model.diameter_mm)


def make_guide_views(
    model: Model,
    view_range: ViewRange,
    options: GuideViewOptions | None = None,
    progress: StepProgress | None = None,
) -> GuideViewSet:
    """Render and extract the guide views of a model over a range.

    Args:
        model: the part, or one component of it.
        view_range: declared range.
        options: see GuideViewOptions.
        progress: called with (views done, views in all).

    Raises:
        MissingDependencyError: pyrender was asked for and GL is not there.
        InputError: the range puts the camera inside the part.
    """
    options = options or GuideViewOptions()
    if view_range.distance_mm[1] <= 0.5 * model.diameter_mm:
        raise InputError(
            f"view range: at {view_range.distance_mm[1]:.0f} mm from its centre the camera is inside the part "
            f"({model.diameter_mm:.0f} mm across); distance_mm must be larger"
        )
    distance_mm = view_distance_mm(view_range, model)
    camera = guide_camera(model, distance_mm, options.resolution_px)
    directions = directions_in_range(view_range, options.subdivisions, options.margin_deg)
    poses = view_poses(directions, distance_mm, model.center_in_model)
    edges = mesh_edges(model, options.crease_angle_deg)

    def extract(rendering_and_pose: tuple[Any, Array]) -> ViewFeatures:
        rendering, pose = rendering_and_pose
        return extract_features(rendering, pose, camera, edges, options.contour_points, options.edge_points)

    found: list[ViewFeatures] = []
    renderer = open_renderer(model, camera, options.renderer)
    try:
        with ThreadPoolExecutor(max(1, min(8, os.cpu_count() or 1))) as pool:
            if isinstance(renderer, PyrenderRenderer):
                # One GL context, one thread: it renders while the pool extracts what is finished.
                batch = 32
                pending: list[Any] = []
                for index, pose in enumerate(poses):
                    pending.append(pool.submit(extract, (renderer.render(pose), pose)))
                    if len(pending) >= batch:
                        found.append(pending.pop(0).result())
                        if progress:
                            progress(index + 1, len(poses))
                found.extend(future.result() for future in pending)
            else:
                assert isinstance(renderer, ZBufferRenderer)
                for features in pool.map(lambda pose: extract((renderer.render(pose), pose)), poses):
                    found.append(features)
                    if progress:
                        progress(len(found), len(poses))
    finally:
        renderer.close()
    if progress:
        progress(len(poses), len(poses))

    def starts(counts: list[int]) -> NDArray[np.int64]:
        return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    surface_points, surface_faces, surface_component = reduced_surface(model)
    arrays: dict[str, NDArray[Any]] = {
        "surface_points": surface_points,
        "surface_faces": surface_faces,
        "surface_component": surface_component,
        "contour_start": starts([len(f.contour_points) for f in found]),
        "contour_points": np.concatenate([f.contour_points for f in found]).astype(np.float32),
        "contour_normals": np.round(np.concatenate([f.contour_normals for f in found]) * _UNIT16).astype(np.int16),
        "contour_runs_mm": np.concatenate([f.contour_runs_mm for f in found]).astype(np.float32),
        "contour_component": np.concatenate([f.contour_component for f in found]).astype(np.int16),
        "edge_start": starts([len(f.edge_points) for f in found]),
        "edge_points": np.concatenate([f.edge_points for f in found]).astype(np.float32),
        "edge_tangents": np.round(np.concatenate([f.edge_tangents for f in found]) * _UNIT16).astype(np.int16),
        "edge_kinds": np.concatenate([f.edge_kinds for f in found]),
        "edge_component": np.concatenate([f.edge_component for f in found]).astype(np.int16),
    }
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
        arrays=arrays,
    )
