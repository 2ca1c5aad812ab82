"""The deck: one TOML file for each scene. The schema declares every key once."""
# ruff: noqa: F401, I001

from mpitled.deck.describe import Home, expected, homes, json_schema, keys_of, markdown_table, unit_of
from mpitled.deck.load import OF_MESHES, keys, load_deck
from mpitled.deck.record import canonical, changes_physics, difference, differences, recorded
from mpitled.deck.record import model_key, program, scene_key
from mpitled.deck.schema import GEOMETRIES, Block, Cloud, Cylinder, Deck, Displaced, Ellipsoid, Fixed, Hexahedra, Labels
from mpitled.deck.schema import MaterialSection, MeshFiles, Output, Partition, Solver, Sphere, Support, Tumour
