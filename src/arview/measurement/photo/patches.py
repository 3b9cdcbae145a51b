"""Patches that follow a component's surface, distances to other components, and the motions its shape leaves free."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from arview.cad import Component, Model, Part, Samples, Symmetry, find_symmetries, make_model
from arview.core.fits import row_space
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.rendering import RayCaster
from arview.rendering.mesh_edges import mesh_edges


def tangents_of(normals: Array) -> tuple[Array, Array]:
    """Two unit vectors (N,3) each, orthogonal to unit normals (N,3) and to each other."""
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)


def cut_patches(
    samples: Samples, surface: RayCaster | None, normals_of_faces: Array | None, width: int, spacing_mm: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Cut patches that follow the surface.

    A grid across the normal is projected along the normal onto the surface. Points that miss it, that hit it more than
    half a patch away, or that hit a face inclined by more than 60° are off the surface. Without a surface, patches are
    flat.

    Args:
        samples: N surface points with normals.
        surface: ray caster of the component's mesh, or None.
        normals_of_faces: (F,3) unit normals of the mesh, or None.
        width: grid points across a patch; P = width².
        spacing_mm: distance between grid points.

    Returns:
        points (N,P,3) in mm, and (N,P) which of them are on the surface.
    """
    first, second = tangents_of(samples.normals)
    steps = (np.arange(width) - (width - 1) / 2) * spacing_mm
    a, b = (grid.ravel() for grid in np.meshgrid(steps, steps))
    flat = samples.points[:, None] + a[None, :, None] * first[:, None] + b[None, :, None] * second[:, None]
    if surface is None or normals_of_faces is None:
        return flat, np.ones(flat.shape[:2], dtype=bool)
    lift_mm = 0.75 * width * spacing_mm
    toward = np.broadcast_to(-samples.normals[:, None], flat.shape).reshape(-1, 3)
    distances, faces = surface.cast((flat + lift_mm * samples.normals[:, None]).reshape(-1, 3), toward)
    depth = distances.reshape(flat.shape[:2]) - lift_mm
    cosine = np.einsum("nx,npx->np", samples.normals, normals_of_faces[faces].reshape(flat.shape))
    is_on = (np.abs(depth) < lift_mm / 1.5) & (cosine > 0.5)
    return flat - np.where(is_on, depth, 0.0)[..., None] * samples.normals[:, None], is_on


def shades_of(is_on: NDArray[np.bool_]) -> Array:
    """(N,P,3) brightness changes that shading may add: constant and two slopes, orthonormal over the points on."""
    width = int(np.sqrt(is_on.shape[1]))
    a, b = (grid.ravel() for grid in np.meshgrid(*2 * [np.linspace(-1.0, 1.0, width)]))
    plain = np.stack([np.ones_like(a), a, b], axis=1)[None] * is_on[..., None]
    return np.asarray(np.linalg.qr(plain)[0])


def face_normals(component: Component) -> Array:
    """(F,3) unit normals."""
    corners = component.vertices_in_model[component.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300))


def near_others(points: Array, model: Model, component: int, reach_mm: float) -> NDArray[np.bool_]:
    """(N,) which points (N,3) are within ``reach_mm`` of the surface of any other component."""
    result = np.zeros(len(points), dtype=np.bool_)
    if not len(points):
        return result
    bounds = np.stack([other.bounds_in_model for other in model.components])
    touches = (bounds[:, 0] <= points.max(axis=0) + reach_mm) & (bounds[:, 1] >= points.min(axis=0) - reach_mm)
    for index in np.flatnonzero(touches.all(axis=1)):
        if index == component:
            continue
        other = model.components[index]
        low, high = bounds[index, 0] - reach_mm, bounds[index, 1] + reach_mm
        (near,) = np.nonzero(~result & ((points >= low) & (points <= high)).all(axis=1))
        if len(near) == 0:
            continue
        corners = other.vertices_in_model[other.faces]
        low, high = points[near].min(axis=0) - reach_mm, points[near].max(axis=0) + reach_mm
        corners = corners[((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1)]
        result[near] = _nearer_than(points[near], np.ascontiguousarray(corners), reach_mm)
    return result


def near_edges(points: Array, component: Component, reach_mm: float) -> NDArray[np.bool_]:
    """(N,) which points (N,3) are within ``reach_mm`` of a sharp edge of the component."""
    from scipy.spatial import cKDTree

    edges = mesh_edges(make_model(component.name, (component,)))
    start, end = (edges.vertices_in_model[edges.ends[edges.is_crease, k]] for k in (0, 1))
    count = np.maximum(1, np.ceil(np.linalg.norm(end - start, axis=1) / (0.25 * reach_mm))).astype(int)
    which = np.repeat(np.arange(len(count)), count)
    along = (np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[which]
    if not len(which):
        return np.zeros(len(points), dtype=bool)
    tree = cKDTree(start[which] + along[:, None] * (end - start)[which])
    return np.asarray(np.isfinite(tree.query(points, distance_upper_bound=reach_mm)[0]))


def free_directions(component: Component, part: Part | None, center: Array, radius_mm: float) -> Array:
    """(K,6) orthonormal motions (rotation times ``radius_mm``, translation of the centre) that keep the shape.

    These follow from continuous symmetries, found in the mesh or declared in the part file.
    """
    symmetries, moves = symmetries_of(component, part), []
    for symmetry in symmetries:
        if symmetry.order is None:
            axis = np.array(symmetry.axis_in_model)
            shift = np.cross(axis, center - np.array(symmetry.through_in_model))
            moves.append(np.concatenate([axis * radius_mm, np.where(np.abs(shift) < 1e-3 * radius_mm, 0.0, shift)]))
    return row_space(np.array(moves).reshape(-1, 6), 1e-6 * radius_mm)


def symmetries_of(component: Component, part: Part | None) -> list[Symmetry]:
    """Exact symmetries of a component in the model frame: the declared one, then those found in its mesh.

    Of two with one axis the declared one is kept, unless only the found one is continuous.
    """
    # Relative to their centres, components of one shape share their symmetries; the cache then serves all of them.
    center = component.bounds_in_model.mean(axis=0)
    local = np.round(component.vertices_in_model - center, 6) + 0.0
    found = [
        replace(one, through_in_model=tuple((np.array(one.through_in_model) + center).tolist()))
        for one in _symmetries(local.tobytes(), component.faces.astype(np.int64).tobytes())
    ]
    declared = None if part is None else part.component_settings(component.name).symmetry
    if declared is None or any(
        one.order is None and declared.order is not None and one.is_same_axis(declared) for one in found
    ):
        return found
    return [declared, *(one for one in found if not one.is_same_axis(declared))]


def turning_center(component: Component, part: Part | None) -> Array:
    """(3,) point about which the moves of all methods turn: the centre of mass, on the declared axis if it is round."""
    center = component.centroid_in_model
    declared = None if part is None else part.component_settings(component.name).symmetry
    if declared is None or declared.order is not None:
        return center
    axis, through = np.array(declared.axis_in_model), np.array(declared.through_in_model)
    return np.asarray(through + axis * (axis @ (center - through)))


@lru_cache(maxsize=1024)  # more than an assembly has shapes: with fewer places each step searches anew
def _symmetries(vertices: bytes, faces: bytes) -> tuple[Symmetry, ...]:
    """Exact symmetries of a mesh, given as the bytes of its vertices (V,3) float64 and faces (F,3) int64."""
    points, corners = np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3)
    found = find_symmetries(points, corners, near_share=0.0)
    return tuple(item.symmetry for item in found if item.is_exact)


@kernel
def _nearer_than(points: NDArray[np.float64], corners: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
    """Whether each point is nearer than ``reach`` to any triangle (T,3,3), measured to its plane or to its edges."""
    count = corners.shape[0]
    boxes = np.empty((count, 6))
    planes = np.empty((count, 3))
    for k in range(count):
        a, b, c = corners[k, 0], corners[k, 1], corners[k, 2]
        for x in range(3):
            boxes[k, x] = min(a[x], b[x], c[x]) - reach
            boxes[k, 3 + x] = max(a[x], b[x], c[x]) + reach
        planes[k] = np.cross(b - a, c - a)
        planes[k] /= max(np.sqrt(np.sum(planes[k] * planes[k])), 1e-300)
    result = np.zeros(points.shape[0], dtype=np.bool_)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(count):
            if (
                x < boxes[k, 0]
                or y < boxes[k, 1]
                or z < boxes[k, 2]
                or x > boxes[k, 3]
                or y > boxes[k, 4]
                or z > boxes[k, 5]
            ):
                continue
            n0, n1, n2 = planes[k, 0], planes[k, 1], planes[k, 2]
            is_inside, nearest = True, 1e300
            for e in range(3):
                s, t = corners[k, e], corners[k, (e + 1) % 3]
                e0, e1, e2 = t[0] - s[0], t[1] - s[1], t[2] - s[2]
                d0, d1, d2 = x - s[0], y - s[1], z - s[2]
                turn = n0 * (e1 * d2 - e2 * d1) + n1 * (e2 * d0 - e0 * d2) + n2 * (e0 * d1 - e1 * d0)
                is_inside = is_inside and turn >= 0.0
                along = (d0 * e0 + d1 * e1 + d2 * e2) / max(e0 * e0 + e1 * e1 + e2 * e2, 1e-300)
                along = min(max(along, 0.0), 1.0)
                square = (d0 - along * e0) ** 2 + (d1 - along * e1) ** 2 + (d2 - along * e2) ** 2
                nearest = min(nearest, square)
            if is_inside:
                a = corners[k, 0]
                nearest = ((x - a[0]) * n0 + (y - a[1]) * n1 + (z - a[2]) * n2) ** 2
            if nearest < reach * reach:
                result[i] = True
                break
    return result
