"""Rendering: depth, normals, components and shaded views of a model; rays against its mesh."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.rendering.mesh_edges import EDGE_CONTOUR as EDGE_CONTOUR
    from arview.rendering.mesh_edges import EDGE_CREASE as EDGE_CREASE
    from arview.rendering.mesh_edges import EDGE_ROUGH as EDGE_ROUGH
    from arview.rendering.mesh_edges import EDGE_SHARP as EDGE_SHARP
    from arview.rendering.mesh_edges import EDGE_SILHOUETTE as EDGE_SILHOUETTE
    from arview.rendering.mesh_edges import EdgeSamples as EdgeSamples
    from arview.rendering.mesh_edges import MeshEdges as MeshEdges
    from arview.rendering.mesh_edges import ViewEdgeSamples as ViewEdgeSamples
    from arview.rendering.mesh_edges import sample_edges as sample_edges
    from arview.rendering.mesh_edges import sample_visible_edges as sample_visible_edges
    from arview.rendering.rasterizer import fill_buffers as fill_buffers
    from arview.rendering.rasterizer import rasterise as rasterise
    from arview.rendering.raycast import Hierarchy as Hierarchy
    from arview.rendering.raycast import RayCaster as RayCaster
    from arview.rendering.raycast import cast_ray as cast_ray
    from arview.rendering.renderers import ZBufferRenderer as ZBufferRenderer
    from arview.rendering.renderers import choose_renderer as choose_renderer
    from arview.rendering.renderers import open_renderer as open_renderer
    from arview.rendering.rendering import Rendering as Rendering

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "mesh_edges": (
            "EDGE_CONTOUR",
            "EDGE_CREASE",
            "EDGE_ROUGH",
            "EDGE_SHARP",
            "EDGE_SILHOUETTE",
            "EdgeSamples",
            "MeshEdges",
            "ViewEdgeSamples",
            "sample_edges",
            "sample_visible_edges",
        ),
        "rasterizer": (
            "fill_buffers",
            "rasterise",
        ),
        "raycast": (
            "Hierarchy",
            "RayCaster",
            "cast_ray",
        ),
        "renderers": (
            "ZBufferRenderer",
            "choose_renderer",
            "open_renderer",
        ),
        "rendering": ("Rendering",),
    },
)
