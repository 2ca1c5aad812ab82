"""The discrete model, and how it is built from a deck and a mesh."""

from mpitled.model.model import WARNING, CellBlock, Model, ModelFigures, empty_block

__all__ = ["WARNING", "CellBlock", "Model", "ModelFigures", "empty_block"]
