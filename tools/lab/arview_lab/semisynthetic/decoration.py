"""Decoration of a rendered part: surface patches with canvases, and rust and dirt in the volume.

The CAD stays plain. Flat faces have a canvas each; the rest of a component is mapped from the six sides of a box
(box mapping), so that every point of the model always has the same colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arview.cad.model import Model
from arview.core.kernel import kernel
from arview.geometry import Array
from arview.video import Image
from arview_lab.semisynthetic import prints

TEXELS_ACROSS = 700
"""Texels of a canvas along the part's diameter."""
MIN_FLAT_SHARE = 0.012
"""Area of the smallest flat face with a canvas of its own, as a share of the square of the part's diameter."""
LATTICE = 32
"""Side of the periodic lattice of random values."""


@dataclass(frozen=True)
class DecorationOptions:
    """How a part is decorated.

    Attributes:
        photos: share of the flat faces on which a photograph is printed.
        stickers: mean number of labels, logos and tags on a large flat face.
        tapes: mean number of pieces of transparent tape on a large flat face.
        scratches: mean number of scratches on 100 cm².
        rust, dirt: share of the surface that is rusty, and that is dirty.
    """

    photos: float = 0.0
    stickers: float = 0.0
    tapes: float = 0.0
    scratches: float = 0.0
    rust: float = 0.0
    dirt: float = 0.0


@dataclass(frozen=True)
class Decoration:
    """A model's decoration, prepared for `surface_samples`.

    Attributes:
        corners: (F,3,3) model coordinates of the faces' corners, mm.
        texture_px: (F,3,2) places of the corners in the canvas of their face's patch, texels.
        patch_of_face: (F,) index of the patch.
        patches: (P,3) of each canvas: index of its first texel, height, width.
        texels: (T,5) all canvases, row by row.
        lattice: (32,32,32) random values in 0–1 for rust and dirt.
        wear: cell sizes in mm and thresholds of rust and dirt: (rust cell, rust from, dirt cell, dirt from).
    """

    corners: NDArray[np.float64]
    texture_px: NDArray[np.float64]
    patch_of_face: NDArray[np.int32]
    patches: NDArray[np.int64]
    texels: NDArray[np.uint8]
    lattice: NDArray[np.float32]
    wear: NDArray[np.float64]


@dataclass(frozen=True)
class _Patch:
    """Faces that share a canvas, with the canvas's axes (3,) in the model."""

    faces: NDArray[np.int64]
    across: Array
    down: Array
    is_flat: bool


def decorate(model: Model, options: DecorationOptions, photos: list[Image], rng: np.random.Generator) -> Decoration:
    """Decorate a model at random; the same generator state gives the same decoration."""
    vertices, faces, owners = model.mesh
    corners = np.ascontiguousarray(vertices[faces], dtype=np.float64)
    texel_mm = model.diameter_mm / TEXELS_ACROSS
    texture = np.zeros((len(faces), 3, 2))
    patch_of_face = np.zeros(len(faces), np.int32)
    table, canvases, first = [], [], 0
    for number, patch in enumerate(_patches(corners, owners, MIN_FLAT_SHARE * model.diameter_mm**2)):
        places = corners[patch.faces] @ np.stack([patch.across, patch.down], axis=1)
        low, high = places.reshape(-1, 2).min(axis=0), places.reshape(-1, 2).max(axis=0)
        width, height = np.ceil((high - low) / texel_mm).astype(int) + 2
        texture[patch.faces] = (places - low) / texel_mm + 0.5
        patch_of_face[patch.faces] = number
        canvas = _painted(int(height), int(width), texel_mm, patch.is_flat, options, photos, rng)
        canvases.append(canvas.reshape(-1, 5))
        table.append((first, height, width))
        first += int(height) * int(width)
    lattice = rng.random((LATTICE, LATTICE, LATTICE), dtype=np.float32)
    rust_cell, dirt_cell = 0.10 * model.diameter_mm, 0.22 * model.diameter_mm
    wear = np.array([
        rust_cell, _threshold(corners, lattice, rust_cell, 0.0, options.rust),
        dirt_cell, _threshold(corners, lattice, dirt_cell, 11.3, options.dirt),
    ])  # fmt: skip
    return Decoration(
        corners, texture, patch_of_face, np.array(table, dtype=np.int64), np.concatenate(canvases), lattice, wear
    )


def _patches(corners: Array, owners: NDArray[np.int32], min_area_mm2: float) -> list[_Patch]:
    """Flat faces of at least an area, and the rest of each component from six sides."""
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(crosses, axis=1)
    normals = crosses / np.maximum(2.0 * areas, 1e-12)[:, None]
    offsets = np.einsum("fk,fk->f", normals, corners.mean(axis=1))
    keys = np.column_stack([owners, np.round(50.0 * normals), np.round(2.0 * offsets)])
    _, plane = np.unique(keys, axis=0, return_inverse=True)
    plane = plane.ravel()
    is_flat = (np.bincount(plane, weights=areas) >= min_area_mm2)[plane]
    patches = []
    for index in np.unique(plane[is_flat]):
        faces = np.flatnonzero(plane == index)
        normal = np.average(normals[faces], axis=0, weights=areas[faces])
        patches.append(_Patch(faces, *_axes(normal), is_flat=True))
    main = np.abs(normals).argmax(axis=1)
    side = 2 * main + (np.take_along_axis(normals, main[:, None], axis=1)[:, 0] > 0)
    for owner in np.unique(owners):
        for index in range(6):
            faces = np.flatnonzero((owners == owner) & ~is_flat & (side == index))
            if len(faces):
                normal = (1.0 if index % 2 else -1.0) * np.eye(3)[index // 2]
                patches.append(_Patch(faces, *_axes(normal), is_flat=False))
    return patches


def _axes(normal: Array) -> tuple[Array, Array]:
    """Axes of a canvas, across and down, seen from outside along a normal (3,)."""
    up = np.eye(3)[2] if abs(normal[2]) < 0.7 * np.linalg.norm(normal) else np.eye(3)[1]
    across = np.cross(up, normal)
    across /= np.linalg.norm(across)
    down = np.cross(across, normal)
    return across, down / np.linalg.norm(down)


def _painted(
    height: int, width: int, texel_mm: float, is_flat: bool, options: DecorationOptions, photos: list[Image],
    rng: np.random.Generator,
) -> prints.Canvas:  # fmt: skip
    canvas = prints.empty_canvas(height, width)
    area_cm2 = height * width * texel_mm**2 / 100.0
    if is_flat:
        if photos and rng.random() < options.photos:
            prints.print_photo(canvas, photos[int(rng.integers(len(photos)))], rng)
        # A small face has fewer stickers than a large one.
        share = min(1.0, area_cm2 / 40.0)
        for _ in range(int(rng.poisson(share * options.stickers))):
            kind = (prints.label, prints.logo, prints.tag)[int(rng.choice(3, p=(0.5, 0.3, 0.2)))]
            prints.place(canvas, kind(texel_mm, rng), rng)
    prints.scratch(canvas, int(rng.poisson(options.scratches * area_cm2 / 100.0)), texel_mm, rng)
    if is_flat:
        for _ in range(int(rng.poisson(min(1.0, area_cm2 / 40.0) * options.tapes))):
            length = rng.uniform(0.4, 1.1) * max(height, width) * texel_mm
            prints.place(canvas, prints.tape(length, texel_mm, rng), rng)
    return canvas


def _threshold(corners: Array, lattice: NDArray[np.float32], cell_mm: float, shift: float, share: float) -> float:
    """Noise value that a share of the surface exceeds; out of reach for a share of 0."""
    if share <= 0.0:
        return 9.0
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weights = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), 4096)
    # Evenly spread over the surface: inverse transform sampling by area.
    chosen = np.searchsorted(np.cumsum(areas), np.linspace(0.0, 0.999999, 4096) * areas.sum())
    places = np.einsum("nk,nkd->nd", weights, corners[chosen])
    values = np.array([fractal_noise(lattice, x / cell_mm + shift, y / cell_mm, z / cell_mm) for x, y, z in places])
    return float(np.quantile(values, 1.0 - share))


@kernel
def lattice_noise(lattice: NDArray[np.float32], x: float, y: float, z: float) -> float:
    """Value noise in 0–1: random values at a periodic lattice's points, smoothly interpolated."""
    side = lattice.shape[0]
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i0, j0, k0 = int(fx) % side, int(fy) % side, int(fz) % side
    i1, j1, k1 = (i0 + 1) % side, (j0 + 1) % side, (k0 + 1) % side
    u, v, w = x - fx, y - fy, z - fz
    u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
    a = (1.0 - u) * lattice[i0, j0, k0] + u * lattice[i1, j0, k0]
    b = (1.0 - u) * lattice[i0, j1, k0] + u * lattice[i1, j1, k0]
    c = (1.0 - u) * lattice[i0, j0, k1] + u * lattice[i1, j0, k1]
    d = (1.0 - u) * lattice[i0, j1, k1] + u * lattice[i1, j1, k1]
    return (1.0 - w) * ((1.0 - v) * a + v * b) + w * ((1.0 - v) * c + v * d)


@kernel
def fractal_noise(lattice: NDArray[np.float32], x: float, y: float, z: float) -> float:
    """Sum of four octaves of value noise, in 0–1."""
    total = weight = 0.0
    amount, scale = 1.0, 1.0
    for octave in range(4):
        total += amount * lattice_noise(lattice, scale * x + 7.1 * octave, scale * y + 3.7 * octave, scale * z)
        weight += amount
        amount *= 0.55
        scale *= 2.17
    return total / weight


@kernel
def barycentric(
    corners: NDArray[np.float64], x: float, y: float, z: float
) -> tuple[float, float, float]:  # fmt: skip
    """Weights of a triangle's corners (3,3) at a point of its plane, limited to the triangle."""
    e1x, e1y, e1z = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    e2x, e2y, e2z = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    px, py, pz = x - corners[0, 0], y - corners[0, 1], z - corners[0, 2]
    d11 = e1x * e1x + e1y * e1y + e1z * e1z
    d12 = e1x * e2x + e1y * e2y + e1z * e2z
    d22 = e2x * e2x + e2y * e2y + e2z * e2z
    p1 = px * e1x + py * e1y + pz * e1z
    p2 = px * e2x + py * e2y + pz * e2z
    determinant = max(d11 * d22 - d12 * d12, 1e-18)
    wj = min(max((d22 * p1 - d12 * p2) / determinant, 0.0), 1.0)
    wk = min(max((d11 * p2 - d12 * p1) / determinant, 0.0), 1.0 - wj)
    return 1.0 - wj - wk, wj, wk


@kernel
def surface_samples(
    inverse_depth: NDArray[np.float64], face_ids: NDArray[np.int32], points_of_faces: NDArray[np.float64],
    colors: NDArray[np.float64], lens: NDArray[np.float64], corners: NDArray[np.float64],
    texture_px: NDArray[np.float64], patch_of_face: NDArray[np.int32], patches: NDArray[np.int64],
    texels: NDArray[np.uint8], lattice: NDArray[np.float32], wear: NDArray[np.float64]
) -> NDArray[np.float32]:  # fmt: skip
    """Colour and gloss (H,W,4) of every sample: albedo in 0–1, and the factor of highlights and reflections."""
    height, width = face_ids.shape
    fx, fy, cx, cy = lens
    out = np.zeros((height, width, 4), dtype=np.float32)
    for r in range(height):
        for col in range(width):
            face = face_ids[r, col]
            if face < 0:
                continue
            z = 1.0 / inverse_depth[r, col]
            x, y = (col - cx) / fx * z, (r - cy) / fy * z
            wi, wj, wk = barycentric(points_of_faces[face], x, y, z)
            mx = wi * corners[face, 0, 0] + wj * corners[face, 1, 0] + wk * corners[face, 2, 0]
            my = wi * corners[face, 0, 1] + wj * corners[face, 1, 1] + wk * corners[face, 2, 1]
            mz = wi * corners[face, 0, 2] + wj * corners[face, 1, 2] + wk * corners[face, 2, 2]
            red, green, blue, gloss = colors[face, 0], colors[face, 1], colors[face, 2], 1.0
            if wear[1] < 1.0:
                cell = wear[0]
                value = fractal_noise(lattice, mx / cell, my / cell, mz / cell)
                rust = min(max((value - wear[1]) / 0.035, 0.0), 1.0)
                if rust > 0.0:
                    grain = fractal_noise(lattice, 6.0 * mx / cell, 6.0 * my / cell + 5.0, 6.0 * mz / cell)
                    tone = 0.55 + 0.9 * grain
                    red += rust * (0.40 * tone - red)
                    green += rust * (0.20 * tone - green)
                    blue += rust * (0.10 * tone - blue)
                    gloss *= 1.0 - 0.9 * rust
            # The canvas, bilinear.
            first, rows, columns = patches[patch_of_face[face]]
            u = wi * texture_px[face, 0, 0] + wj * texture_px[face, 1, 0] + wk * texture_px[face, 2, 0]
            v = wi * texture_px[face, 0, 1] + wj * texture_px[face, 1, 1] + wk * texture_px[face, 2, 1]
            c0, r0 = min(max(int(u), 0), columns - 2), min(max(int(v), 0), rows - 2)
            fu, fv = min(max(u - c0, 0.0), 1.0), min(max(v - r0, 0.0), 1.0)
            at = first + r0 * columns + c0
            w00, w01, w10, w11 = (1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv
            below = at + columns
            opacity = (
                w00 * texels[at, 3] + w01 * texels[at + 1, 3] + w10 * texels[below, 3] + w11 * texels[below + 1, 3]
            ) / 255.0
            if opacity > 0.0:
                # Weighted by opacity, because the colour of a clear texel means nothing.
                s00, s01 = w00 * texels[at, 3], w01 * texels[at + 1, 3]
                s10, s11 = w10 * texels[below, 3], w11 * texels[below + 1, 3]
                scale = 1.0 / (255.0 * max(s00 + s01 + s10 + s11, 1e-9))
                red += opacity * (
                    scale * (s00 * texels[at, 0] + s01 * texels[at + 1, 0] + s10 * texels[below, 0]
                             + s11 * texels[below + 1, 0]) - red)  # fmt: skip
                green += opacity * (
                    scale * (s00 * texels[at, 1] + s01 * texels[at + 1, 1] + s10 * texels[below, 1]
                             + s11 * texels[below + 1, 1]) - green)  # fmt: skip
                blue += opacity * (
                    scale * (s00 * texels[at, 2] + s01 * texels[at + 1, 2] + s10 * texels[below, 2]
                             + s11 * texels[below + 1, 2]) - blue)  # fmt: skip
            sheen = w00 * texels[at, 4] + w01 * texels[at + 1, 4] + w10 * texels[below, 4] + w11 * texels[below + 1, 4]
            gloss *= sheen / 64.0
            if wear[3] < 1.0:
                cell = wear[2]
                value = fractal_noise(lattice, mx / cell + 11.3, my / cell, mz / cell)
                dirt = 0.75 * min(max((value - wear[3]) / 0.08, 0.0), 1.0)
                if dirt > 0.0:
                    red += dirt * (0.17 - red)
                    green += dirt * (0.15 - green)
                    blue += dirt * (0.12 - blue)
                    gloss *= 1.0 - 0.85 * dirt
            out[r, col, 0], out[r, col, 1], out[r, col, 2], out[r, col, 3] = red, green, blue, gloss
    return out
