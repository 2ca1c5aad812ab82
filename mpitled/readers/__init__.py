"""Meshes made by other programs, read into one form."""
