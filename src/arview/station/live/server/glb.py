"""The CAD model as GLB for the page: for each component a node with its mesh and one with its design edges."""

from __future__ import annotations

import numpy as np

from arview.cad import Model
from arview.rendering.mesh_edges import mesh_edges


def model_glb(model: Model) -> bytes:
    """GLB of a model, in mm in the model frame.

    Component i is node ``c<i>``, a mesh whose faces share no vertices so that its normals are flat, and node ``e<i>``,
    its creases and borders as LINES. Units and axes deviate from glTF (metres, +Y up); the page expects this.
    """
    import trimesh
    from trimesh.path.entities import Line

    edges = mesh_edges(model)
    scene = trimesh.Scene()
    for index, component in enumerate(model.components):
        corners = component.vertices_in_model[component.faces].reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        mesh = trimesh.Trimesh(corners, faces, process=False)
        mesh.vertex_normals = np.repeat(mesh.face_normals, 3, axis=0)
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(
                baseColorFactor=[*component.color, 1.0], metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True
            )
        )
        scene.add_geometry(mesh, node_name=f"c{index}", geom_name=f"c{index}")
        ends = edges.ends[edges.is_crease & (edges.component == index)]
        if len(ends):
            points = edges.vertices_in_model[ends].reshape(-1, 3)
            lines = [Line([2 * k, 2 * k + 1]) for k in range(len(ends))]
            path = trimesh.path.Path3D(lines, points, process=False)
            scene.add_geometry(path, node_name=f"e{index}", geom_name=f"e{index}")
    return bytes(scene.export(file_type="glb", include_normals=True))
