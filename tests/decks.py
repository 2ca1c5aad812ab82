"""Small decks for the tests, in every supported format."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from mpitled.mesh import grid_points, structured_hexahedra

#: Two hexahedra side by side along x, in millimetres, flat, with sparse and unordered numbers.
FLAT = """*HEADING
two cubes
*NODE, NSET=everything
 10, 0., 0., 0.
 20, 1., 0., 0.
 30, 2., 0., 0.
 15, 0., 1., 0.
 25, 1., 1., 0.
 35, 2., 1., 0.
*NODE
 110, 0., 0., 1.
 120, 1., 0., 1.
 130, 2., 0., 1.
 115, 0., 1., 1.
 125, 1., 1., 1.
 135, 2., 1., 1.
*ELEMENT, TYPE=C3D8R, ELSET=solid
 7, 10, 20, 25, 15, 110, 120, 125, 115
 3, 20, 30, 35, 25, 120, 130, 135, 125
*NSET, NSET=left
 10, 15, 110, 115
*NSET, NSET=right, GENERATE
 30, 35, 5
 130, 135, 5
*SURFACE, TYPE=ELEMENT, NAME=top
 solid, S2
*SOLID SECTION, ELSET=solid, MATERIAL=brain
*MATERIAL, NAME=brain
*DENSITY
 1e-9,
*ELASTIC
 3e-3, 0.49
*BOUNDARY
 left, 1, 3
*STEP
*STATIC
*BOUNDARY
 right, 1, 1, 0.25
*END STEP
"""

#: A cube as a part with two instances, one translated and rotated.
ASSEMBLY = """*Heading
** Job name: Job-1 Model name: Model-1
*Preprint, echo=NO, model=NO, history=NO, contact=NO
*Part, name=Cube
*Node
      1,           0.,           0.,           0.
      2,           1.,           0.,           0.
      3,           1.,           1.,           0.
      4,           0.,           1.,           0.
      5,           0.,           0.,           1.
      6,           1.,           0.,           1.
      7,           1.,           1.,           1.
      8,           0.,           1.,           1.
*Element, type=C3D8R
1, 1, 2, 3, 4, 5, 6, 7, 8
*Nset, nset=base, generate
 1,  4,  1
*Elset, elset=Set-1, internal
 1,
** Section: Section-1
*Solid Section, elset=Set-1, material="Grey Matter"
,
*End Part
**
*Assembly, name=Assembly
*Instance, name=Cube-1, part=Cube
*End Instance
*Instance, name=Cube-2, part=Cube
         10.,           0.,           0.
         10.,           0.,           0.,          10.,           0.,           1.,          90.
*End Instance
*Nset, nset=_PickedSet4, internal, instance=Cube-1
 5, 6,
 7, 8
*Nset, nset=_PickedSet4, internal, instance=Cube-2
 5, 6, 7, 8
*Nset, nset="both bases"
 Cube-1.base, Cube-2.base
*Elset, elset=_Surf-1_S2, internal, instance=Cube-2, generate
 1, 1, 1
*Surface, type=ELEMENT, name=Surf-1
_Surf-1_S2, S2
*End Assembly
*Material, name="Grey Matter"
*Density
1000.,
*Hyperelastic, neo hooke
500., 1e-4
*Boundary
"both bases", ENCASTRE
*Step, name=Step-1, nlgeom=YES
*Static
0.1, 1.
*Boundary
_PickedSet4, 3, 3, -0.1
*Output, field, variable=PRESELECT
*End Step
"""

#: A nodes-only or tetrahedral cloud: a cube cut in six.
CLOUD = """*NODE
 1, 0, 0, 0
 2, 1, 0, 0
 3, 1, 1, 0
 4, 0, 1, 0
 5, 0, 0, 1
 6, 1, 0, 1
 7, 1, 1, 1
 8, 0, 1, 1
*ELEMENT, TYPE=C3D4, ELSET=cloud
 1, 1, 2, 3, 7
 2, 1, 3, 4, 7
 3, 1, 4, 8, 7
 4, 1, 8, 5, 7
 5, 1, 5, 6, 7
 6, 1, 6, 2, 7
"""

#: FLAT as two files: the second is included.
INCLUDING = "*INCLUDE, INPUT=mesh/nodes.inp\n" + FLAT[FLAT.index("*ELEMENT") :]
INCLUDED = FLAT[: FLAT.index("*ELEMENT")]

#: The mesh of FLAT for LS-DYNA, in fixed columns.
DYNA = """$# LS-DYNA keyword file
*KEYWORD
*TITLE
two cubes
*PARAMETER
R    young      3e-3R     pois      0.49
*NODE
$#   nid               x               y               z      tc      rc
      10             0.0             0.0             0.0       0       0
      20             1.0             0.0             0.0
      30             2.0             0.0             0.0
      15             0.0             1.0             0.0
      25             1.0             1.0             0.0
      35             2.0             1.0             0.0
     110             0.0             0.0             1.0
     120             1.0             0.0             1.0
     130             2.0             0.0             1.0
     115             0.0             1.0             1.0
     125             1.0             1.0             1.0
     135             2.0             1.0             1.0
*ELEMENT_SOLID
$#   eid     pid      n1      n2      n3      n4      n5      n6      n7      n8
       7       1      10      20      25      15     110     120     125     115
       3       1      20      30      35      25     120     130     135     125
*PART
$# title
solid
$#     pid     secid       mid
         1         1         1
*SECTION_SOLID
         1         1
*MAT_ELASTIC_TITLE
brain
         1      1e-9    &young     &pois
*SET_NODE_LIST_TITLE
left
         1       0.0       0.0       0.0       0.0
        10        15       110       115
*SET_NODE_LIST_GENERATE_TITLE
right
         2       0.0       0.0       0.0       0.0
        30        35       130       135
*BOUNDARY_SPC_SET_ID
         1the left side
         1         0         1         1         1         0         0         0
*BOUNDARY_PRESCRIBED_MOTION_SET
         2         1         2         5      0.25         0       0.0       0.0
*DEFINE_CURVE
         5         0       1.0       1.0       0.0       0.0         0         0
                 0.0                 0.0
                 1.0                 1.0
*END
"""

#: DYNA with commas.
DYNA_COMMAS = re.sub(r"(?m)^(?: +(?:[\d.e+-]+|&\w+))+$", lambda line: ",".join(line[0].split()), DYNA)
DYNA_COMMAS = DYNA_COMMAS.replace("R    young      3e-3R     pois      0.49", "R    young,3e-3,R     pois,0.49")


def numbers(rows: NDArray[np.generic]) -> str:
    return "".join(", ".join(map(repr, row)) + "\n" for row in rows.tolist())


def void_decks() -> dict[str, str]:
    """A block of 5 x 5 x 5 hexahedra of 1 mm without the middle 3 x 3 x 3, a cloud in this void, and its grid."""
    shape, middle = (5, 5, 5), (3, 3, 3)
    points, cells = grid_points(shape, (5.0, 5.0, 5.0)), structured_hexahedra(shape)
    centre = points[cells].mean(axis=1)
    kept = cells[(np.abs(centre - 2.5) > 1.5).any(axis=1)]
    used = np.unique(kept)
    rows = np.concatenate([np.arange(1, len(kept) + 1)[:, None], kept + 1], axis=1)
    outer = used[((points[used] == 0) | (points[used] == 5)).any(axis=1)] + 1
    fe = "*NODE\n" + "".join(f"{n + 1}, {x!r}, {y!r}, {z!r}\n" for n, (x, y, z) in zip(used, points[used].tolist()))  # noqa: B905
    fe += "*ELEMENT, TYPE=C3D8, ELSET=tissue\n" + numbers(rows) + "*NSET, NSET=skull\n" + numbers(outer[:, None])
    fe += "*BOUNDARY\nskull, PINNED\n"
    inner = grid_points(middle, (3.0, 3.0, 3.0)) + 1.0
    moved = np.random.default_rng(3).uniform(-0.2, 0.2, inner.shape)
    moved[((inner == 1) | (inner == 4)).any(axis=1)] = 0.0
    inner = inner + moved
    efg = "*NODE\n" + "".join(f"{i}, {x!r}, {y!r}, {z!r}\n" for i, (x, y, z) in enumerate(inner.tolist(), 1))
    at = (np.stack(np.meshgrid(*[np.arange(6)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / 2 + 1.0
    grid = "x,y,z,volume\n" + numbers(np.column_stack([at, np.full(len(at), 0.125)]))
    scene = """[mesh]
fe = "fe.inp"
efg = "efg.inp"
integration_points = "grid.csv"
unit = "mm"
[material.brain]
youngs_modulus = 3000.0
poissons_ratio = 0.49
[[displaced]]
nodes = "skull"
directions = ["x"]
displacement = [0.0]
"""
    return {"fe.inp": fe, "efg.inp": efg, "grid.csv": grid, "scene.toml": scene}


#: Files of each kind; the first file is the one that is read.
KINDS: dict[str, dict[str, str]] = {
    "flat": {"deck.inp": FLAT},
    "assembly": {"deck.inp": ASSEMBLY},
    "cloud": {"deck.inp": CLOUD},
    "include": {"deck.inp": INCLUDING, "mesh/nodes.inp": INCLUDED},
    "dyna": {"deck.k": DYNA},
    "dyna, commas": {"deck.k": DYNA_COMMAS},
    "dyna, include": {
        "deck.k": "*KEYWORD\n*INCLUDE\nmesh.k\n" + DYNA[DYNA.index("*PART") :],
        "mesh.k": DYNA[: DYNA.index("*PART")] + "*END\n",
    },
}
