"""Features, matches and depth maps on torch devices beside those of the processor's own code."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from arview.cad import Model
from arview.camera import Camera
from arview.geometry import Array, invert, skew
from arview.reconstruction.dense import Cad, DenseOptions
from arview.reconstruction.dense.depth import DepthMap, depth_maps
from arview.reconstruction.dense.views import DenseView, choose_sources, make_view
from arview.reconstruction.features import FeatureOptions, Features, find_features
from arview.reconstruction.intake import read_photo
from arview.reconstruction.matching import Matches, match_along_lines, match_descriptors
from arview.reconstruction.sparse import SparseOptions, reconstruct_from_poses
from arview.reconstruction.types import Photo, SparseModel
from gpu.clock import Row, timed
from helpers.photo_scene import CAMERA, bench, photograph, ring, write_photos

PHOTO = Path(__file__).resolve().parents[3] / "samples" / "plate" / "photos" / "img_000.jpg"
MIN_ALIKE = 0.98  # share of features, and of matches, that both have
MAX_APART_PX = 0.05  # of the same feature, and of depths in pixels of parallax in the median
PHOTO_PX, MAX_FEATURES = 1200, 6000
DENSE_PHOTOS, DENSE_PX = 6, 60_000


def feature_rows(devices: list[str]) -> list[Row]:
    """SIFT of one photo."""
    image = cv2.cvtColor(cv2.imread(str(PHOTO)), cv2.COLOR_BGR2RGB)
    factor = PHOTO_PX / max(image.shape)
    image = np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))
    options, rows = FeatureOptions(max_features=MAX_FEATURES), []
    for device in devices:
        is_wall = device != "cpu:0"
        own_s, own = timed(partial(find_features, image, options), is_wall)
        other_s, other = timed(partial(find_features, image, options, device=device), is_wall)
        alike = min(_share_alike(own, other), _share_alike(other, own))
        subject = f"a photo of {image.shape[1]}×{image.shape[0]}, {len(own)} features"
        result = f"{100 * alike:.1f} % within {MAX_APART_PX} px with the same description"
        rows.append(Row("features", subject, device, own_s, other_s, result, alike >= MIN_ALIKE))
    return rows


def _share_alike(ones: Features, others: Features) -> float:
    """Share of the features that the others have too, in place, size and description."""
    tree = cKDTree(np.column_stack([others.points_px, others.sizes_px]))
    near = tree.query_ball_point(np.column_stack([ones.points_px, ones.sizes_px]), MAX_APART_PX)
    found = [
        len(rows) > 0 and bool((others.descriptors[rows] @ described).max() > 0.99)
        for rows, described in zip(near, ones.descriptors, strict=True)
    ]
    return float(np.mean(found))


def matching_rows(devices: list[str]) -> list[Row]:
    """Both ways of matching, of two photos with known poses."""
    camera = CAMERA.scaled(2 * CAMERA.width, 2 * CAMERA.height)
    poses = ring(24, elevations_deg=(50.0,))[:2]
    pair = tuple(find_features(photograph(bench(), pose, camera)) for pose in poses)
    rays = tuple(np.ascontiguousarray(camera.unproject(one.points_px)[:, :2]) for one in pair)
    relative = poses[1] @ invert(poses[0])
    essential = skew(relative[:3, 3]) @ relative[:3, :3]
    subject, rows = f"{len(pair[0])} and {len(pair[1])} features", []
    for device in devices:
        is_wall = device != "cpu:0"

        def by_appearance(device: str | None) -> Matches:
            return match_descriptors(pair[0].descriptors, pair[1].descriptors, device)

        def along_lines(device: str | None) -> Matches:
            return match_along_lines((rays[0], rays[1]), camera.fx, (pair[0], pair[1]), essential, 2.0, device)

        for what, match in (("matching by appearance", by_appearance), ("matching along epipolar lines", along_lines)):
            own_s, own = timed(partial(match, None), is_wall)
            other_s, other = timed(partial(match, device), is_wall)
            one, two = ({tuple(row) for row in matches.tolist()} for matches in (own, other))
            common = len(one & two) / max(len(one | two), 1)
            result = f"{100 * common:.1f} % of {len(own)} matches the same"
            rows.append(Row(what, subject, device, own_s, other_s, result, common >= MIN_ALIKE and len(own) > 100))
    return rows


def dense_rows(devices: list[str]) -> list[Row]:
    """Depth maps of a few photos with known poses."""
    if not devices:
        return []
    rows = []
    options = DenseOptions(max_region_px=DENSE_PX, threads=2, device="cpu")
    with tempfile.TemporaryDirectory() as folder:
        sparse, nominal = _scene(Path(folder))
        views = _views(sparse, nominal, options)

        def maps(device: str) -> list[DepthMap]:
            return depth_maps(
                views, sparse, nominal, replace(options, device=device), 2, lambda name, done, total: None
            )

        for device in devices:
            is_wall = device != "cpu:0"
            own_s, own = timed(partial(maps, "cpu"), is_wall)
            other_s, other = timed(partial(maps, device), is_wall)
            both, apart_px = _apart(own, other)
            result = (
                f"{100 * both:.1f} % of depths in both; apart in the median {np.median(apart_px):.4f} px, "
                f"{100 * np.mean(apart_px < 0.1):.1f} % by less than 0.1 px"
            )
            is_within = both > MIN_ALIKE and float(np.median(apart_px)) < MAX_APART_PX
            subject = f"{len(views)} photos, {sum(int((one.scores > 0).sum()) for one in own):,} depths"
            rows.append(Row("depth maps", subject, device, own_s, other_s, result, is_within))
    return rows


def _scene(folder: Path) -> tuple[SparseModel, Cad]:
    poses = ring(2 * DENSE_PHOTOS, elevations_deg=(50.0,))[:DENSE_PHOTOS]
    model: Model = bench()
    paths = write_photos(folder, [photograph(model, pose) for pose in poses])
    camera: Camera = CAMERA
    photos = [Photo(path.name, path, camera.width, camera.height, "lens", camera, True) for path in paths]
    posed: list[tuple[Photo, Array]] = list(zip(photos, poses, strict=True))
    sparse = reconstruct_from_poses(posed, folder / "sparse", SparseOptions(threads=2, device="cpu"))
    return sparse, Cad(model, np.eye(4))


def _views(sparse: SparseModel, nominal: Cad, options: DenseOptions) -> list[DenseView]:
    """The photos as the dense stage has them; all of them have sources."""
    sources = choose_sources(sparse)
    made = [
        make_view(sparse, i, sources[i], nominal, options, lambda photo: read_photo(photo.path))
        for i in range(len(sparse.photos))
    ]
    return [view for view in made if view is not None]


def _apart(ones: list[DepthMap], others: list[DepthMap]) -> tuple[float, NDArray[np.float64]]:
    """Share of depths that both maps have, of those in either, and how far these are apart in pixels of parallax."""
    in_both, in_any, apart = 0, 0, []
    for one, other in zip(ones, others, strict=True):
        has_one, has_other = one.planes[..., 0] > 0, other.planes[..., 0] > 0
        both = has_one & has_other
        in_both, in_any = in_both + int(both.sum()), in_any + int((has_one | has_other).sum())
        apart.append(np.abs(one.planes[..., 0] - other.planes[..., 0])[both].astype(np.float64) / one.unit_w)
    return in_both / max(in_any, 1), np.concatenate(apart)
