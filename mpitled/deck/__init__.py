"""The deck: one TOML file for each scene. The schema declares every key once."""

from mpitled.deck.describe import Home, expected, homes, json_schema, keys_of, markdown_table, unit_of
from mpitled.deck.load import OF_MESHES, keys, load_deck
from mpitled.deck.record import (
    canonical,
    changes_physics,
    difference,
    differences,
    model_key,
    program,
    recorded,
    scene_key,
)
from mpitled.deck.schema import (
    GEOMETRIES,
    Block,
    Cloud,
    Cylinder,
    Deck,
    Displaced,
    Ellipsoid,
    Fixed,
    Hexahedra,
    Labels,
    MaterialSection,
    MeshFiles,
    Output,
    Partition,
    Solver,
    Sphere,
    Support,
    Tumour,
)

__all__ = [
    "GEOMETRIES", "OF_MESHES", "Block", "Cloud", "Cylinder", "Deck", "Displaced", "Ellipsoid", "Fixed", "Hexahedra",
    "Home", "Labels", "MaterialSection", "MeshFiles", "Output", "Partition", "Solver", "Sphere", "Support", "Tumour",
    "canonical", "changes_physics", "difference", "differences", "expected", "homes", "json_schema", "keys",
    "load_deck", "markdown_table", "model_key", "program", "recorded", "scene_key", "unit_of",
]  # fmt: skip
