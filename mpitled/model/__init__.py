"""The discrete model, and how it is built from a deck and a mesh."""

from mpitled.model.model import WARNING, Model

__all__ = ["WARNING", "Model"]
