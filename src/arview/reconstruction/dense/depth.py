"""Depth maps of all views, coarse to fine: PatchMatch at a quarter and at half of the working size, then refinement.

Views are independent within a stage, so each thread takes one; the second stage reads the maps of the first.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from arview.camera import Camera
from arview.core.progress import Progress
from arview.reconstruction.dense.kernels import PARALLAX, Problem, make_scratch
from arview.reconstruction.dense.options import BEST_SOURCES, DenseOptions
from arview.reconstruction.dense.patchmatch import NEIGHBOURS, sweep, try_hypotheses
from arview.reconstruction.dense.polish import polish
from arview.reconstruction.dense.torch_search import search_torch
from arview.reconstruction.dense.views import Cad, DenseView, Floats, Planes, cad_planes, relative_pose, sparse_planes
from arview.reconstruction.gpu.device import torch_device
from arview.reconstruction.types import SparseModel

CAD_HYPOTHESES = True
"""Also start from the surface of the CAD. It is only a hypothesis: photo-consistency decides."""
NOISE = 1.5
"""Standard deviation of the photos' noise in grey levels; less contrast does not count as texture."""
GEOMETRIC_WEIGHT = 0.1
"""Cost of one pixel of disagreement with the depth map of a source."""

STEPS = (4, 2)
"""Pixels of the working size per pixel of each PatchMatch stage; the depth maps have the grid of the last stage."""
SWEEPS = (2, 1)
"""Checkerboard sweeps in each stage."""
RANDOMS = 6
"""Random hypotheses for each pixel in the first stage."""
POLISH_ITERATIONS = 5
"""Iterations of the least-squares refinement."""
T = TypeVar("T")


@dataclass(frozen=True)
class DepthMap:
    """Surface elements of one view.

    Attributes:
        camera: ideal camera of the map's grid.
        cam_from_scan: (4,4).
        planes: (H,W,3) float32, see `views.Planes`; w = 0 where there is none.
        scores: (H,W) mean correlation with the sources that see the element.
        sigmas: (H,W) standard deviation of w.
        unit_w: change of w that moves a pixel of the map by one pixel in the sources.
    """

    camera: Camera
    cam_from_scan: NDArray[np.float64]
    planes: Planes
    scores: Floats
    sigmas: Floats
    unit_w: float


def depth_maps(
    views: list[DenseView],
    sparse: SparseModel,
    cad: Cad | None,
    options: DenseOptions,
    threads: int,
    progress: Progress,
) -> list[DepthMap]:
    """Depth maps of all views, whose sources are indices into the list."""
    greys = [cv2.cvtColor(view.color, cv2.COLOR_RGB2GRAY).astype(np.float32) for view in views]
    maps: list[Planes] = []
    device = torch_device(options.device)
    with ThreadPoolExecutor(threads) as pool:
        for stage, step in enumerate(STEPS):
            small = [_shrunk(grey, step) for grey in greys]
            search = partial(_search, views, small, maps, sparse, cad, (options, device), stage)
            maps = _each(pool, search, len(views), f"depth maps {stage + 1} of {len(STEPS)}", progress)
        return _each(pool, partial(_polished, views, greys, maps), len(views), "polishing", progress)


def _each(pool: ThreadPoolExecutor, job: Callable[[int], T], count: int, name: str, progress: Progress) -> list[T]:
    """Run a job for each index on the pool and report progress."""
    results = []
    for done, result in enumerate(pool.map(job, range(count)), start=1):
        results.append(result)
        progress(name, done, count)
    return results


def _shrunk(grey: Floats, step: int) -> Floats:
    """The picture reduced by an integer factor."""
    if step == 1:
        return grey
    size = (grey.shape[1] // step, grey.shape[0] // step)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))


def _grown(planes: Planes, factor: int) -> Planes:
    """The planes on a grid that is ``factor`` times as fine."""
    fine = np.repeat(np.repeat(planes, factor, axis=0), factor, axis=1)
    height, width = fine.shape[:2]
    offset = (np.arange(factor) + 0.5) / factor - 0.5
    fine[..., 0] += np.where(fine[..., 0] > 0, fine[..., 1] * np.tile(offset, width // factor), 0.0)
    fine[..., 0] += np.where(fine[..., 0] > 0, fine[..., 2] * np.tile(offset, height // factor)[:, None], 0.0)
    fine[..., 1:] /= factor
    return fine


def _problem(views: list[DenseView], index: int, greys: list[Floats], maps: list[Planes], step: int) -> Problem:
    """The arrays of one view and its sources at one resolution; ``maps`` are the sources' depth maps, or empty."""
    view = views[index]
    camera = view.camera.scaled(greys[index].shape[1], greys[index].shape[0])
    sources = view.sources
    inverse = np.linalg.inv(camera.matrix)
    rows, columns = np.nonzero(view.region)
    middle = np.array([columns.mean() / step, rows.mean() / step, 1.0])
    w = 0.5 * (1.0 / view.nearest + 1.0 / view.farthest)
    warps = []
    for k in sources:
        source_from_view = relative_pose(view, views[k])
        matrix = views[k].camera.scaled(greys[k].shape[1], greys[k].shape[0]).matrix
        a, t = matrix @ source_from_view[:3, :3] @ inverse, matrix @ source_from_view[:3, 3]
        seen = a @ middle + w * t
        parallax = np.linalg.norm(t[:2] - seen[:2] / seen[2] * t[2]) / abs(seen[2])
        warps.append(np.concatenate([a.ravel(), t, [parallax]]))
    maps_there = [maps[k] for k in sources] if maps else []
    region = _shrunk(view.region.astype(np.float32), step) > 0.5
    map_step = camera.width / maps[index].shape[1] if maps else 1.0
    numbers = [NOISE**2, GEOMETRIC_WEIGHT, map_step, BEST_SOURCES]
    return Problem(
        grey=greys[index],
        region=region.astype(np.uint8),
        pixels=np.concatenate([greys[k].ravel() for k in sources]),
        maps=np.concatenate([there.reshape(-1, 3) for there in maps_there]) if maps else np.empty((0, 3), np.float32),
        sizes=np.concatenate(
            [
                _layout([greys[k] for k in sources]),
                _layout(maps_there or [np.empty((0, 0, 3), np.float32)] * len(sources)),
            ],
            axis=1,
        ),
        warps=np.array(warps, dtype=np.float32),
        numbers=np.array([*numbers, camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float32),
    )


def _layout(images: list[NDArray[np.float32]]) -> NDArray[np.int32]:
    """(S,3) first pixel, width and height of images that lie one after another in an array."""
    sizes = np.array([image.shape[:2] for image in images])
    first = np.concatenate([[0], np.cumsum(sizes[:, 0] * sizes[:, 1])[:-1]])
    return np.stack([first, sizes[:, 1], sizes[:, 0]], axis=1).astype(np.int32)


def _search(
    views: list[DenseView],
    greys: list[Floats],
    maps: list[Planes],
    sparse: SparseModel,
    cad: Cad | None,
    how: tuple[DenseOptions, str | None],
    stage: int,
    index: int,
) -> Planes:
    """PatchMatch of one view at one level by options and a torch device; ``maps``: of the previous level, or empty."""
    options, device = how
    view, step = views[index], STEPS[stage]
    height, width = greys[index].shape
    camera = view.camera.scaled(width, height)
    given = [_grown(maps[index], STEPS[stage - 1] // step)] if maps else [sparse_planes(sparse, view.index, camera)]
    if cad is not None and CAD_HYPOTHESES:
        given.insert(0 if stage == 0 else 1, cad_planes(cad, view.cam_from_scan, camera))
    problem = _problem(views, index, greys, maps, step)
    seed = (options.seed * 0x9E3779B1 + view.index * 0x85EBCA6B + stage * 0xC2B2AE35) & 0x7FFFFFFF
    low, high = 1.0 / view.farthest, 1.0 / view.nearest
    depth = 2.0 / (low + high)
    spread = options.band_mm / depth**2 if cad is not None else 0.25 * (high - low)
    unit_w = 1.0 / float(np.mean(problem.warps[:, PARALLAX]))
    steps = [(0.5 ** (turn + stage) * unit_w, 0.5 * 0.5 ** (turn + stage)) for turn in range(SWEEPS[stage])]
    randoms = RANDOMS if stage == 0 else 0
    if device is not None:
        return search_torch(
            problem,
            np.stack(given),
            spread,
            randoms=randoms,
            low=low,
            high=high,
            steps=steps,
            is_dense=stage > 0,
            seed=seed,
            device=device,
        )
    planes, costs = np.zeros((height, width, 3), np.float32), np.empty((height, width), np.float32)
    scratch, indices = make_scratch(is_dense=stage > 0)
    try_hypotheses(
        problem,
        scratch,
        indices,
        planes=planes,
        costs=costs,
        hypotheses=np.stack(given),
        spread=np.float32(spread),
        randoms=randoms,
        lowest=np.float32(low),
        highest=np.float32(high),
        seed=seed,
    )
    for turn, (step_w, step_tilt) in enumerate(steps):
        for color in (0, 1):
            sweep(
                problem,
                scratch,
                indices,
                planes=planes,
                costs=costs,
                regions=NEIGHBOURS,
                color=color,
                step_w=np.float32(step_w),
                step_tilt=np.float32(step_tilt),
                seed=seed + 101 * (turn + 1),
            )
    return planes


def _polished(views: list[DenseView], greys: list[Floats], maps: list[Planes], index: int) -> DepthMap:
    """Refine the depth map of one view at the working size."""
    planes = maps[index].copy()
    height, width = planes.shape[:2]
    problem = _problem(views, index, greys, [], 1)
    unit_w = 1.0 / float(np.mean(problem.warps[:, PARALLAX]))
    scores, sigmas = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    scratch, indices = make_scratch(0.5 * (STEPS[-1] - 1))
    polish(
        problem,
        scratch,
        indices,
        planes=planes,
        scores=scores,
        sigmas=sigmas,
        step_px=STEPS[-1],
        iterations=POLISH_ITERATIONS,
        unit_w=unit_w,
    )
    camera = views[index].camera.scaled(width, height)
    return DepthMap(camera, views[index].cam_from_scan, planes, scores, sigmas, unit_w * STEPS[-1])
