"""Mesh generation: hexahedra from label images and shapes, and the mesh-free cloud."""
