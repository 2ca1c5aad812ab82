"""Partition a mesh into parts of equal cost: blocks of cells -> weighted graph -> METIS -> tables of the parts."""

from partition.graph import Block, CellGraph, cell_graph
from partition.metis import cut
from partition.parts import PartFigures, PartTables, figures, tables

__all__ = ["Block", "CellGraph", "PartFigures", "PartTables", "cell_graph", "cut", "figures", "tables"]
