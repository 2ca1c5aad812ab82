"""Cuts a mesh of hexahedra and support domains into parts of equal cost: cells -> weighted graph -> METIS -> tables."""

from partition.graph import CellGraph, cell_graph
from partition.metis import cut
from partition.parts import PartFigures, PartTables, figures, tables

__all__ = ["CellGraph", "PartFigures", "PartTables", "cell_graph", "cut", "figures", "tables"]
