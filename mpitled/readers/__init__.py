"""Readers of mesh files of other programs."""
