"""Components measured in the photos, by surface and by edges."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from arview.cad.model import Model
from arview.cad.part import Part
from arview.cad.samples import Samples, sample_surface
from arview.core.parallel import pool
from arview.measurement.photo.component import MeasuredComponent
from arview.measurement.photo.edges import ComponentEdges
from arview.measurement.photo.options import PhotoOptions
from arview.measurement.photo.patches import near_others
from arview.measurement.photo.sweep import ComponentSweep, sweep_offsets
from arview.measurement.photo.views import PhotoViews, load_views
from arview.measurement.types import Method, Move, NotMeasured
from arview.reconstruction.types import SparseModel

MethodResults = dict[Method, Move | NotMeasured]


def measure_components_in_photos(
    sparse: SparseModel | PhotoViews,
    part: Part | None,
    model: Model,
    options: PhotoOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
    names: Sequence[str] | None = None,
) -> dict[str, MethodResults]:
    """Where components stand, by each of the two ways.

    Both look around the nominal place by themselves, and where the other found the component. The frame is that of
    the poses: measure the datums, or the base by its name, to state moves relative to it.

    Args:
        sparse: placed photos, mm, within about 0.3 mm and 0.05° in the frame of the model; or views of it.
        part: roles and declared symmetries; None takes every component to be inspected.
        model: the nominal CAD.
        options: see ``PhotoOptions``.
        progress: called with a component's name and the share that is done.
        names: of the components to measure; default: those that are inspected.

    Raises:
        InputError: fewer than three photos, photos that cannot be read, no such component, poses not in the frame.
    """
    options = options or PhotoOptions()
    views = sparse if isinstance(sparse, PhotoViews) else load_views(sparse, model)
    if names is None:
        known = {component.name for component in model.components}
        names = [component.name for component in model.components if part is None]
        names = names or [name for name in part.inspected if name in known] if part is not None else names
    indices = [model.index(name) for name in names]
    results: dict[str, MethodResults] = {}
    jobs = [(index, pool().submit(measure_component, views, index, part, options)) for index in indices]
    for done, (index, job) in enumerate(jobs, 1):
        name = model.components[index].name
        results[name] = job.result()
        if progress is not None:
            progress(name, done / len(jobs))
    return results


def measure_component(views: PhotoViews, index: int, part: Part | None, options: PhotoOptions) -> MethodResults:
    """One component by both ways; when a way fails, whether the component is there at all is looked at."""
    body = MeasuredComponent(views, index, part, options)
    edges = ComponentEdges(body).measure()
    # Where edges found it is one more place to look at; what the surface says there is its own.
    sweep = ComponentSweep(body).measure([edges.measured_from_nominal] if isinstance(edges, Move) else [])
    if isinstance(edges, NotMeasured) and isinstance(sweep, Move):
        edges = ComponentEdges(body).measure(sweep.measured_from_nominal)
    if isinstance(edges, NotMeasured) and is_gone(body):
        reason = "not there: the photos show the surface that it should stand on"
        return {
            "sweep": NotMeasured(body.shape.name, "sweep", reason, is_missing=True),
            "edges": NotMeasured(body.shape.name, "edges", reason, is_missing=True),
        }
    return {"sweep": sweep, "edges": edges}


def is_gone(body: MeasuredComponent) -> bool:
    """Whether the photos show what the component would hide: the surfaces of others that it stands on."""
    o, model = body.options.sweep, body.views.model
    samples = sample_surface(body.shape, o.sample_spacing_px * body.px_mm, o.samples)
    contact = samples.of(near_others(samples.points, model, body.index, 0.5))
    if len(contact.points) < 10:
        return False
    # Seen from the other side: the surface below faces against the component's own.
    below = Samples(contact.points, -contact.normals)
    found = sweep_offsets(below.points, below.normals, body.views, 3.0 * body.px_mm, o, removed=body.index)
    looked = np.count_nonzero(found.views >= 0, axis=1) >= o.min_views
    agree = looked & found.is_ok & (np.abs(found.offsets_mm) < 1.5 * body.px_mm)
    return bool(
        np.count_nonzero(looked) >= 10 and np.count_nonzero(agree) > body.options.gone_share * np.count_nonzero(looked)
    )
