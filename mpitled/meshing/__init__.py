"""Geometry made here: hexahedra from label images and shapes, and the mesh-free cloud."""
