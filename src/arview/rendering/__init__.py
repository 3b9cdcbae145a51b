"""Rendering: depth, normals, components and shaded views of a model; rays against its mesh."""
