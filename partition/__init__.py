"""Cuts a mesh of blocks of cells into parts of equal cost: cells -> weighted graph -> METIS -> tables."""

from partition.graph import Block, CellGraph, cell_graph
from partition.metis import cut
from partition.parts import PartFigures, PartTables, figures, tables

__all__ = ["Block", "CellGraph", "PartFigures", "PartTables", "cell_graph", "cut", "figures", "tables"]
