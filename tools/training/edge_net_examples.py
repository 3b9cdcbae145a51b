"""Examples for the edge net: random solids in front of photos, with their visible edges."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arview.cad.model import Component, Model, make_model
from arview.core.atomic import replacing
from arview.errors import InputError
from arview.geometry import Array, apply, rigid
from arview.rendering.rasterizer import rasterise
from arview.video import Image
from arview_lab.semisynthetic import CAMERA
from arview_lab.semisynthetic.backgrounds import read_photo, surroundings
from arview_lab.semisynthetic.random_solids import random_solid
from arview_lab.semisynthetic.sequence import FILL_LIGHT, JOIN_BLUR_PX, KEY_LIGHT, paste
from arview_lab.semisynthetic.shading import Light, Reflectance, ShadedModel
from arview_lab.semisynthetic.solids import box
from seeded_files import missing_files

SOLIDS_EACH, PICTURES_EACH = 14, 60
"""Solids and pictures of each example file."""
MIN_PICTURES = 20
"""Smallest number of pictures to train on."""
RADIUS_PX, OTHER_RADIUS_PX = (38.0, 300.0), (30.0, 120.0)
"""Ranges of the half diameters of the first solid of a picture, and of the others."""
COUNT_SHARES, COUNTS = (0.55, 0.3, 0.15), (1, 2, 3)
"""Shares of the pictures with one, two and three solids."""
CLUTTERED_SHARE = 0.45
"""Share of pictures cluttered with solids, as a workbench is: without them the network is uncertain there."""
CLUTTER_COUNT, CLUTTER_RADIUS_PX, MEMBER_RADIUS_PX = (4, 11), (45.0, 180.0), (14.0, 75.0)
"""Ranges of the number of solids in clutter, and of the half diameters of the first and of the others."""
BOARD_SHARE, BOARD_RADIUS_PX = 0.6, (180.0, 330.0)
"""Share of cluttered pictures with a board behind, and the range of its half diameter."""
STEEL_SHARE = 0.5
"""Share of cluttered pictures in which most solids have about the same grey."""
UNOCCLUDED_SHARE = 0.5
"""Share of pictures in which the solid of interest stands in front of the clutter."""
PATTERNED_SHARE = 0.35
"""Share of cluttered pictures on a surface with dots or stripes, which are not edges of solids."""
PATTERN_SIZE = 1200, 900
"""Size of that surface, px."""
MIN_DISTANCE = 0.75
"""Smallest distance of a solid from the camera, in diameters."""
RECOLOURED_SHARE, PLAIN_SHARE, PRINTED_SHARE = 0.5, 0.4, 0.35
"""Shares of the solids in other colours, with the surface of the sequences, and with a photo printed on."""
PHOTO_SCALE = 0.35, 1.2
"""Range of the zoom of a photo, as far as it still fills the picture."""
FINE = 2
"""Resolution of the grid on which edges are found, relative to the picture."""
JUMP = 0.035
"""Smallest jump in depth that is an edge, in diameters."""
CREASE_DEG = 38.0
"""Smallest dihedral angle of an edge, little more than where shading is smooth."""
RIDGE_PX = 2.0
"""Scale at which the direction of an edge is found."""
JPEG_QUALITY = 97


@dataclass(frozen=True)
class EdgePicture:
    """A picture without noise, and the edges of the solids in it.

    Attributes:
        jpeg: the picture.
        edges: (N,3) uint16: row and column on the fine grid, and direction of the normal, 256 to the half turn.
        inside: PNG of the share of each pixel that solids cover, 0–255.
    """

    jpeg: bytes
    edges: NDArray[np.uint16]
    inside: bytes

    def image(self) -> Image:
        """The decoded picture, (H,W,3) RGB."""
        bgr = cv2.imdecode(np.frombuffer(self.jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert bgr is not None
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def collect_edge_pictures(seeds: range, photos: Sequence[Path], folder: Path) -> None:
    """Write some pictures of some solids for each seed, unless its file exists."""
    for seed, path in missing_files(seeds, folder, "edges_{}.pkl", "edge pictures"):
        rng = np.random.default_rng([seed, 3])
        solids = []
        for k in range(SOLIDS_EACH):
            try:
                solids.append(random_solid(SOLIDS_EACH * seed + k))
            except ValueError:  # outlines that cross each other
                continue
        pictures = [_edge_picture(solids, photos, rng) for _ in range(PICTURES_EACH if solids else 0)]
        with replacing(path) as file:
            pickle.dump(pictures, file)


def read_edge_pictures(folder: Path) -> list[EdgePicture]:
    """All pictures in a folder.

    Raises:
        InputError: fewer than `MIN_PICTURES`.
    """
    pictures = [picture for path in sorted(folder.glob("edges_*.pkl")) for picture in pickle.loads(path.read_bytes())]
    if len(pictures) < MIN_PICTURES:
        raise InputError(f"{folder}: too few pictures; run: fit.py edge-examples")
    return pictures


def _edge_picture(solids: Sequence[Model], photos: Sequence[Path], rng: np.random.Generator) -> EdgePicture:
    photo = read_photo(photos[int(rng.integers(len(photos)))])
    picture = _crop(photo, rng).astype(np.float32)
    is_cluttered = rng.random() < CLUTTERED_SHARE
    if is_cluttered and rng.random() < PATTERNED_SHARE:
        picture = _patterned(picture, rng)
    placed = _clutter(solids, rng) if is_cluttered else _placed(solids, rng)
    picture, covers = drawn_before(picture, photo, placed, photos, rng)
    height, width = FINE * CAMERA.height, FINE * CAMERA.width
    depth = np.zeros((height, width), np.float32)
    normals = np.zeros((height, width, 3), np.float32)
    owners = np.zeros((height, width), np.int16)
    for number, ((solid, pose), cover) in enumerate(zip(placed, covers, strict=True), 1):
        if cover.any():
            _draw_geometry(solid, pose, number, depth, normals, owners)
    edges = _edges(depth, normals, owners, max(solid.diameter_mm for solid, _ in placed))
    image = np.clip(np.round(picture), 0, 255).astype(np.uint8)[..., ::-1]
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    inside = np.max(covers, axis=0)
    return EdgePicture(jpeg, edges, cv2.imencode(".png", (255.0 * inside).astype(np.uint8))[1].tobytes())


def cluttered_picture(
    solids: Sequence[Model], among: tuple[Model, Array] | None, photos: Sequence[Path], rng: np.random.Generator
) -> tuple[NDArray[np.float32], float]:
    """A picture (H,W,3), without noise, cluttered with solids, and the visible share of a solid of interest.

    Args:
        solids: for the clutter.
        among: the solid of interest with its ``cam_from_model``; None for none.
        photos: for the background.
        rng: random numbers.
    """
    photo = read_photo(photos[int(rng.integers(len(photos)))])
    picture = _crop(photo, rng).astype(np.float32)
    if rng.random() < PATTERNED_SHARE:
        picture = _patterned(picture, rng)
    if among is None:
        return drawn_before(picture, photo, _clutter(solids, rng), photos, rng)[0], 0.0
    center = apply(among[1], among[0].center_in_model)
    placed = _clutter(solids, rng, CAMERA.project(center[None])[0] + rng.normal(0.0, 40.0, 2))
    # The first may be a board; some of the others stand in front.
    place = len(placed) if rng.random() < UNOCCLUDED_SHARE else int(rng.integers(1, len(placed) + 1))
    picture, covers = drawn_before(picture, photo, [*placed[:place], among, *placed[place:]], photos, rng)
    corners_px = covers[place]
    for cover in covers[place + 1 :]:
        corners_px = corners_px * (1.0 - cover)
    return picture, float(corners_px.sum() / max(covers[place].sum(), 1.0))


def lone_picture(solid: Model, pose: Array, photos: Sequence[Path], rng: np.random.Generator) -> NDArray[np.float32]:
    """A picture (H,W,3), without noise, of one solid at a ``cam_from_model`` in front of a photo."""
    photo = read_photo(photos[int(rng.integers(len(photos)))])
    return drawn_before(_crop(photo, rng).astype(np.float32), photo, [(solid, pose)], photos, rng)[0]


def occluded_picture(
    picture: NDArray[np.float32],
    place_px: Array,
    radius_px: float,
    solids: Sequence[Model],
    photos: Sequence[Path],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """A picture with one of some solids, perhaps in other colours, drawn over a place."""
    solid = solids[int(rng.integers(len(solids)))]
    if rng.random() < RECOLOURED_SHARE:
        solid = recoloured(solid, rng)
    photo = read_photo(photos[int(rng.integers(len(photos)))])
    placed = [(solid, _pose_at(solid, place_px, radius_px, rng))]
    return drawn_before(picture, photo, placed, photos, rng)[0]


def _distance_mm(solid: Model, pose: Array) -> float:
    return float(apply(pose, solid.center_in_model)[2])


def drawn_before(
    picture: NDArray[np.float32],
    photo: Image,
    placed: Sequence[tuple[Model, Array]],
    photos: Sequence[Path],
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], list[NDArray[np.float32]]]:
    """A picture with solids drawn over it in order, under a random light, and the coverage (H,W) of each, 0–1."""
    key = KEY_LIGHT / np.linalg.norm(KEY_LIGHT)
    if rng.random() < 0.6:
        key = Rotation.from_rotvec(rng.normal(0.0, 0.8, 3)).apply(key)
    toward = np.stack([key, FILL_LIGHT / np.linalg.norm(FILL_LIGHT)])
    light = Light(toward, np.array([rng.uniform(0.25, 1.4), 0.25]), rng.uniform(0.15, 0.45), surroundings(photo))
    covers = []
    for solid, pose in placed:
        surface = Reflectance()
        if rng.random() > PLAIN_SHARE:
            surface = Reflectance(*(rng.uniform(*of) for of in ((0.4, 0.95), (0.0, 0.7), (0.0, 0.45), (6.0, 60.0))))
        layer = ShadedModel(solid, surface).draw(pose, CAMERA, light)
        cover = np.zeros((CAMERA.height, CAMERA.width), np.float32)
        covers.append(cover)
        if layer is None:
            continue
        both = np.zeros((*cover.shape, 4), np.float32)
        stacked = np.dstack([layer.color, layer.coverage])
        paste(cv2.GaussianBlur(stacked, (0, 0), JOIN_BLUR_PX, borderType=cv2.BORDER_CONSTANT), layer, both)
        paste(layer.coverage, layer, cover)
        if rng.random() < PRINTED_SHARE:
            share = rng.uniform(0.2, 1.0)
            print_on = _crop(read_photo(photos[int(rng.integers(len(photos)))]), rng).astype(np.float32) / 110.0
            both[..., :3] *= 1.0 - share + share * print_on
        picture = picture * (1.0 - both[..., 3:]) + 255.0 * np.clip(both[..., :3], 0.0, 1.0)
    return picture, covers


def _placed(solids: Sequence[Model], rng: np.random.Generator) -> list[tuple[Model, Array]]:
    """Some solids and their poses, the farthest first: one anywhere, others near it or anywhere."""
    size = np.array([CAMERA.width, CAMERA.height])
    placed: list[tuple[Model, Array]] = []
    first_px, first_radius_px = np.zeros(2), 0.0
    for number in range(rng.choice(COUNTS, p=COUNT_SHARES)):
        solid = solids[int(rng.integers(len(solids)))]
        if rng.random() < RECOLOURED_SHARE:
            solid = recoloured(solid, rng)
        radius_px = float(np.exp(rng.uniform(*np.log(OTHER_RADIUS_PX if number else RADIUS_PX))))
        center_px = rng.uniform(-20.0, size + 20.0)
        if number and rng.random() < 0.7:
            center_px = first_px + 0.9 * first_radius_px * rng.normal(size=2)
        center_px = np.clip(center_px, 0.08 * size, 0.92 * size)
        if not number:
            first_px, first_radius_px = center_px, radius_px
        placed.append((solid, _pose_at(solid, center_px, radius_px, rng)))
    return _by_distance(placed)


def _clutter(
    solids: Sequence[Model], rng: np.random.Generator, middle_px: Array | None = None
) -> list[tuple[Model, Array]]:
    """Many solids and their poses, the farthest first, around a place (random if None), perhaps on a board."""
    size = np.array([CAMERA.width, CAMERA.height])
    has_board = rng.random() < BOARD_SHARE
    if middle_px is None:
        middle_px = rng.uniform(0.25, 0.75, 2) * size
    spread_px = rng.uniform(45.0, 110.0) if has_board else rng.uniform(60.0, 190.0)
    steel = rng.uniform(0.15, 0.8) if rng.random() < STEEL_SHARE else None
    placed = []
    for number in range(rng.integers(*CLUTTER_COUNT)):
        solid = solids[int(rng.integers(len(solids)))]
        if steel is not None and rng.random() < 0.7:
            colors = steel * rng.uniform(0.7, 1.3, (len(solid.components), 1)) + rng.normal(0.0, 0.03, 3)
            solid = coloured(solid, colors)
        elif rng.random() < RECOLOURED_SHARE:
            solid = recoloured(solid, rng)
        radius_px = float(np.exp(rng.uniform(*np.log(MEMBER_RADIUS_PX if number else CLUTTER_RADIUS_PX))))
        center_px = np.clip(rng.normal(middle_px, spread_px), 0.08 * size, 0.92 * size)
        placed.append((solid, _pose_at(solid, center_px, radius_px, rng)))
    placed = _by_distance(placed)
    if not has_board:
        return placed
    half = np.array([rng.uniform(120.0, 190.0), rng.uniform(80.0, 160.0), 8.0])
    vertices, faces = box(-half, half)
    color = tuple(np.clip(rng.uniform(0.2, 0.8) + rng.normal(0.0, 0.05, 3), 0.03, 0.97).tolist())
    board = make_model("board", (Component("board", vertices, faces.astype(np.int32), color),))
    # The board is drawn first, whatever its distance.
    return [(board, _pose_at(board, middle_px, rng.uniform(*BOARD_RADIUS_PX), rng)), *placed]


def _pose_at(solid: Model, center_px: Array, radius_px: float, rng: np.random.Generator) -> Array:
    """A random ``cam_from_model`` that shows a solid at a place with a radius, smaller where it would be too near."""
    distance_mm = max(0.5 * CAMERA.fx * solid.diameter_mm / radius_px, MIN_DISTANCE * solid.diameter_mm)
    rotation = Rotation.random(random_state=rng).as_matrix()
    center = CAMERA.unproject(center_px[None])[0] * distance_mm
    return rigid(rotation, center - rotation @ solid.center_in_model)


def _by_distance(placed: list[tuple[Model, Array]]) -> list[tuple[Model, Array]]:
    return sorted(placed, key=lambda of: -_distance_mm(*of))


def _patterned(picture: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """A picture with a slanted surface drawn over it that has dots, stripes or checks."""
    width, height = PATTERN_SIZE
    surface = np.full((height, width, 3), rng.uniform(60.0, 230.0), np.float32)
    pitch, color = int(rng.integers(18, 60)), (float(rng.uniform(0.0, 255.0)),) * 3
    thick = max(1, int(pitch * rng.uniform(0.08, 0.38)))
    if rng.random() < 0.75:
        for y in range(0, height, pitch):
            for x in range(0, width, pitch):
                cv2.circle(surface, (x, y), thick, color, -1, cv2.LINE_AA)
    else:
        for x in range(0, width, pitch):
            cv2.line(surface, (x, 0), (x, height), color, thick, cv2.LINE_AA)
        for y in range(0, height, pitch) if rng.random() < 0.5 else ():
            cv2.line(surface, (0, y), (width, y), color, thick, cv2.LINE_AA)
    grain = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), rng.uniform(1.0, 8.0))
    surface *= 1.0 + rng.uniform(0.02, 0.15) * (grain / grain.std())[..., None]
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    inward = 1.0 - 2.0 * corners
    corners_px = corners * (CAMERA.width, CAMERA.height) + inward * rng.uniform(-240.0, -5.0, (4, 2))
    homography = cv2.getPerspectiveTransform(
        corners * np.array(PATTERN_SIZE, np.float32), corners_px.astype(np.float32)
    )
    size = CAMERA.width, CAMERA.height
    share = cv2.warpPerspective(np.ones((height, width), np.float32), homography, size)[..., None]
    return np.asarray(picture * (1.0 - share) + cv2.warpPerspective(surface, homography, size) * share)


def recoloured(solid: Model, rng: np.random.Generator) -> Model:
    """A solid in other colours, one for all components or some for single ones."""
    base, gray = rng.uniform(0.15, 0.9, 3), rng.uniform()
    base = gray * base.mean() + (1.0 - gray) * base
    others = [rng.uniform(0.1, 0.9) + rng.normal(0.0, 0.1, 3) for _ in solid.components]
    return coloured(solid, np.stack([base if rng.random() < 0.5 else other for other in others]))


def coloured(solid: Model, colors: Array) -> Model:
    """A solid whose components have given colours (C,3)."""
    limited = [tuple(color) for color in np.clip(colors, 0.03, 0.97).tolist()]
    components = zip(solid.components, limited, strict=True)
    return make_model(solid.name, tuple(replace(component, color=color) for component, color in components))


def _crop(photo: Image, rng: np.random.Generator) -> Image:
    """A part of a photo of the size of a picture, at a random zoom, perhaps mirrored or with permuted colours."""
    fill = max(CAMERA.width / photo.shape[1], CAMERA.height / photo.shape[0])
    zoom = np.exp(rng.uniform(np.log(max(1.01 * fill, PHOTO_SCALE[0])), np.log(max(1.06 * fill, PHOTO_SCALE[1]))))
    size = int(np.ceil(photo.shape[1] * zoom)), int(np.ceil(photo.shape[0] * zoom))
    photo = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA if zoom < 1.0 else cv2.INTER_LINEAR))
    top = rng.integers(photo.shape[0] - CAMERA.height + 1)
    left = rng.integers(photo.shape[1] - CAMERA.width + 1)
    part = photo[top : top + CAMERA.height, left : left + CAMERA.width]
    if rng.random() < 0.5:
        part = part[:, ::-1]
    if rng.random() < 0.15:
        part = part[::-1]
    return part[..., rng.permutation(3)] if rng.random() < 0.3 else part


def _draw_geometry(
    solid: Model,
    pose: Array,
    number: int,
    depth: NDArray[np.float32],
    normals: NDArray[np.float32],
    owners: NDArray[np.int16],
) -> None:
    """Write depth (H,W) mm, face normals (H,W,3) and the number of the solid (H,W) where it covers the fine grid."""
    vertices, faces, _ = solid.mesh
    points = apply(pose, vertices)
    height, width = depth.shape
    fine = CAMERA.scaled(width, height)
    inverse_depth, face_ids = rasterise(points, faces, fine.fx, fine.fy, fine.cx, fine.cy, width, height)
    a, b, c = points[faces].transpose(1, 0, 2)
    flat = np.cross(b - a, c - a)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    flat[np.sum(flat * a, axis=1) > 0] *= -1.0
    is_on = face_ids >= 0
    depth[is_on] = 1.0 / inverse_depth[is_on]
    normals[is_on] = flat[face_ids[is_on]]
    owners[is_on] = number


def _edges(
    depth: NDArray[np.float32], normals: NDArray[np.float32], owners: NDArray[np.int16], diameter_mm: float
) -> NDArray[np.uint16]:
    """The edges of an `EdgePicture`: where solid, depth or normals change abruptly, with the directions of ridges."""
    drawn = np.zeros(depth.shape, np.float32)
    for before, after in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        are_both = (owners[before] > 0) & (owners[after] > 0)
        jumps = np.abs(depth[before] - depth[after]) > JUMP * diameter_mm
        turns = np.sum(normals[before] * normals[after], axis=2) < np.cos(np.deg2rad(CREASE_DEG))
        is_edge = (owners[before] != owners[after]) | (are_both & (jumps | turns))
        drawn[before] = np.maximum(drawn[before], is_edge)
        drawn[after] = np.maximum(drawn[after], is_edge)
    smooth = cv2.GaussianBlur(drawn, (0, 0), RIDGE_PX)
    xx, yy, xy = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=5) for order in ((2, 0), (0, 2), (1, 1)))
    # The curvature is most negative across a ridge.
    across = 0.5 * np.arctan2(2.0 * xy, xx - yy) + 0.5 * np.pi
    bins = np.round(np.mod(across, np.pi) / np.pi * 256.0).astype(np.uint16) % 256
    rows, columns = np.nonzero(drawn)
    return np.stack([rows, columns, bins[rows, columns]], axis=1).astype(np.uint16)
