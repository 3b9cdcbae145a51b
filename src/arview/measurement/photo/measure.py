"""Components measured in the photos, by surface and by edges."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from arview.cad import Model, Part, Samples, sample_surface
from arview.core.parallel import pool
from arview.geometry import Array
from arview.measurement.photo.component import MeasuredComponent
from arview.measurement.photo.edges import ComponentEdges
from arview.measurement.photo.patches import near_others
from arview.measurement.photo.sweep import MIN_VIEWS, SAMPLE_SPACING_PX, SAMPLES, ComponentSweep, sweep_offsets
from arview.measurement.photo.views import PhotoViews, load_views
from arview.measurement.types import Method, Move, NotMeasured
from arview.measurement.uncertainty.combine import agreements
from arview.reconstruction import SparseModel

ABSENT_SUPPORT = 0.1
"""Share of a component's edges found below which nothing of it is there."""
SOME_SUPPORT = 0.2
"""Share from which something of it is there, whatever the surface below seems to show."""
MIN_HEIGHT_PX = 4.0
"""Height of a component below which the surface that it stands on is not told from its own."""
CLEAR_SUPPORT = 0.5
"""Share of other components' edges found for the photos to show what is there."""
MIN_CLEAR = 3
"""Components whose edges are found so well that one without any edges is missing."""
GONE_SHARE = 0.6
"""A component is missing when more than this share of what it would hide is visible."""
TRUSTED_SUPPORT = 0.6
"""Share of a component's edges found from which a sweep that contradicts them is not used."""
RETRIED_SUPPORT = 0.5
"""Share of its edges that must be found at a second try, turned or by the joints too: the best of several fits by
chance more often."""
TURNS_DEG = (-2.5, 2.5, -5.0, 5.0, -8.0, 8.0)
"""Turns on its seat from which a component is sought that neither method finds near its place."""

MethodResults = dict[Method, Move | NotMeasured]
"""The outcome of each method for one component."""


def measure_components_in_photos(
    sparse: SparseModel | PhotoViews,
    part: Part | None,
    model: Model,
    progress: Callable[[str, float], None] | None = None,
    names: Sequence[str] | None = None,
    methods: Sequence[Method] = ("sweep", "edges"),
    starts: Mapping[str, Array] | None = None,
) -> dict[str, MethodResults]:
    """Measure where components are, by each of the two methods.

    Both methods search around the nominal place, and also where the other one found the component. Moves are stated in
    the frame of the poses; measure the datums, or the base as a component, to state moves relative to them.

    Args:
        sparse: placed photos in mm, in the frame of the model within about 0.3 mm and 0.05°; or their views.
        part: roles and declared symmetries; None inspects every component.
        model: the nominal CAD.
        progress: called with the name of a finished component and the share that is done.
        names: components to measure; default: those inspected.
        methods: without "sweep", only what the edges do not find is also measured by its surface.
        starts: (4,4) places of components that are known within two pixels, by name.

    Raises:
        InputError: there are fewer than three photos, photos cannot be read, a component does not exist, or the poses
            are not in the frame of the model.
    """
    views = sparse if isinstance(sparse, PhotoViews) else load_views(sparse, model)
    if names is None:
        known = {component.name for component in model.components}
        names = [component.name for component in model.components if part is None]
        names = names or [name for name in part.inspected if name in known] if part is not None else names
    indices = [model.index(name) for name in names]
    near = {model.index(name): place for name, place in (starts or {}).items()}
    views = views.standing(near)
    results: dict[str, MethodResults] = {}
    jobs = [
        (index, pool().submit(measure_component, views, index, part, methods, near.get(index))) for index in indices
    ]
    for done, (index, job) in enumerate(jobs, 1):
        name = model.components[index].name
        results[name] = job.result()
        if progress is not None:
            progress(name, done / len(jobs))
    return {name: _absent_if_no_edges(found, results) for name, found in results.items()}


def _absent_if_no_edges(found: MethodResults, results: Mapping[str, MethodResults]) -> MethodResults:
    """The result of a component as missing, if none of its edges is seen while those of others are seen well.

    This finds what is missing from surfaces without texture. The photos must show where it should be, and neither
    method may have measured it.
    """
    edges = found.get("edges")
    if not isinstance(edges, NotMeasured) or edges.is_missing or isinstance(found.get("sweep"), Move):
        return found
    if edges.support is None or edges.support > ABSENT_SUPPORT:
        return found
    others = [one.get("edges") for one in results.values() if one is not found]
    clear = sum(isinstance(one, Move) and one.support > CLEAR_SUPPORT for one in others)
    if clear < MIN_CLEAR:
        return found
    return {
        method: NotMeasured(
            edges.component,
            method,
            "missing, or far from its place: none of its edges is seen where it should be"
            f" ({100 * edges.support:.0f} % more than by chance), while those of {clear} others are",
            is_missing=True,
        )
        for method in found
    }


def measure_component(
    views: PhotoViews,
    index: int,
    part: Part | None,
    methods: Sequence[Method] = ("sweep", "edges"),
    start: Array | None = None,
) -> MethodResults:
    """Measure one component by both methods; if the edges fail, check whether the component is missing.

    With a near ``start`` (4,4) its edges are searched for only there, and elsewhere if few of them are.
    """
    body = MeasuredComponent(views, index, part)
    edges = _by_edges(body, start)
    if "sweep" not in methods and isinstance(edges, Move):
        return {"edges": edges}
    # The place found by edges is one more start of the sweep; the sweep's result there remains independent.
    sweep = ComponentSweep(body).measure([edges.measured_from_nominal] if isinstance(edges, Move) else [])
    if isinstance(edges, NotMeasured) and isinstance(sweep, Move):
        edges = ComponentEdges(body).measure(sweep.measured_from_nominal)
    if isinstance(edges, NotMeasured) and isinstance(sweep, NotMeasured) and not edges.is_unseen:
        edges = _turned(body, edges)
    if isinstance(edges, NotMeasured) and (edges.support or 0.0) < SOME_SUPPORT and is_gone(body):
        reason = "missing: the photos show the surface that it should stand on"
        return {
            "sweep": NotMeasured(body.shape.name, "sweep", reason, is_missing=True),
            "edges": NotMeasured(body.shape.name, "edges", reason, is_missing=True),
        }
    return {"sweep": _uncontradicted(sweep, edges), "edges": edges}


def _uncontradicted(sweep: Move | NotMeasured, edges: Move | NotMeasured) -> Move | NotMeasured:
    """The sweep, unless it contradicts well-supported edges that determine as much: gloss moves over a surface."""
    if isinstance(sweep, NotMeasured) or isinstance(edges, NotMeasured):
        return sweep
    if edges.support < TRUSTED_SUPPORT or len(edges.undetermined) > len(sweep.undetermined):
        return sweep
    apart_mm = [pair.difference_mm for pair in agreements([sweep, edges]) if pair.is_contradiction]
    if not apart_mm:
        return sweep
    return NotMeasured(
        sweep.component,
        "sweep",
        f"contradicts its edges, {100 * edges.support:.0f} % of which are seen: {apart_mm[0]:.2f} mm apart",
    )


def _by_edges(body: MeasuredComponent, near: Array | None = None) -> Move | NotMeasured:
    """The component by its edges; by those at its joints, too, where the others leave directions undetermined."""
    edges = ComponentEdges(body).measure(near, is_near=near is not None)
    if near is not None and not (isinstance(edges, Move) and edges.support >= RETRIED_SUPPORT):
        edges = ComponentEdges(body).measure()
    count = 6 if isinstance(edges, NotMeasured) else len(edges.undetermined)
    if count == len(body.free):
        return edges
    start = edges.measured_from_nominal if isinstance(edges, Move) else None
    more = ComponentEdges(body.with_joints()).measure(start)
    is_better = isinstance(more, Move) and more.support >= RETRIED_SUPPORT and len(more.undetermined) < count
    return more if is_better else edges


def _turned(body: MeasuredComponent, failed: NotMeasured) -> Move | NotMeasured:
    """The component by its edges, from places at which it is turned on what it stands on; ``failed`` if at none."""
    normals = _contact(body).normals
    if not len(normals):
        return failed
    axis = normals.mean(axis=0) / max(float(np.linalg.norm(normals.mean(axis=0))), 1e-9)
    starts = (body.moved(np.eye(4), np.concatenate([np.deg2rad(angle) * axis, np.zeros(3)])) for angle in TURNS_DEG)
    measured = [ComponentEdges(body).measure(start) for start in starts]
    found = [one for one in measured if isinstance(one, Move) and one.support >= RETRIED_SUPPORT]
    return max(found, key=lambda one: one.support, default=failed)


def _contact(body: MeasuredComponent) -> Samples:
    """Samples of the component's surface that touch other components."""
    samples = sample_surface(body.shape, SAMPLE_SPACING_PX * body.px_mm, SAMPLES)
    return samples.of(near_others(samples.points, body.views.model, body.index, 0.5))


def is_gone(body: MeasuredComponent) -> bool:
    """Whether the photos show the surfaces of other components that this one would hide."""
    contact = _contact(body)
    # A component that is hardly higher than the search is exact looks like the bare surface.
    if len(contact.points) < 10 or 2.0 * body.joint_mm < MIN_HEIGHT_PX * body.px_mm:
        return False
    # The surface below faces opposite to the component's own.
    below = Samples(contact.points, -contact.normals)
    found = sweep_offsets(below.points, below.normals, body.views, 3.0 * body.px_mm, removed=body.index)
    visible = np.count_nonzero(found.views >= 0, axis=1) >= MIN_VIEWS
    agree = visible & found.is_ok & (np.abs(found.offsets_mm) < 1.5 * body.px_mm)
    return bool(np.count_nonzero(visible) >= 10 and np.count_nonzero(agree) > GONE_SHARE * np.count_nonzero(visible))
