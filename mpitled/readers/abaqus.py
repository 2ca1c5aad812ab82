"""Abaqus decks (.inp), as Abaqus/CAE, HyperMesh, Cubit, gmsh and CalculiX write them.

Keywords without influence on an elastic solid with prescribed displacements are skipped; a remark lists them, except
output and other common keywords. Keywords that change the mechanics are not supported: see `MeshFile.refused`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mpitled.errors import InputError
from mpitled.mesh import Floats, Ints
from mpitled.readers import meshfile, text
from mpitled.readers.assembly import Definitions, Entry, Material, Model, Scope, Set
from mpitled.readers.inp import COMMENT, Keyword, collect, fields
from mpitled.readers.meshfile import Cells, MeshFile
from mpitled.readers.text import Block, where

_SOLID = re.compile(r"C3D(\d+)[A-Z]*")
#: Kind of solid by its number of nodes; "other" is not supported because of nodes between the corners.
_SOLIDS = {
    4: "tetrahedron", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetrahedron",
    15: "other", 20: "other", 27: "other",
}  # fmt: skip

#: Keywords, without blanks, that are skipped without a remark: titles, output, and the solution of a step.
_HARMLESS = {
    "HEADING", "PREPRINT", "STATIC", "ENDSTEP", "RESTART", "OUTPUT", "NODEOUTPUT", "ELEMENTOUTPUT", "CONTACTOUTPUT",
    "ENERGYOUTPUT", "NODEPRINT", "ELPRINT", "CONTACTPRINT", "ENERGYPRINT", "NODEFILE", "ELFILE", "CONTACTFILE",
    "FILEFORMAT", "MONITOR",
}  # fmt: skip
#: Unsupported keywords that tie, load or move parts, beside CONTACT... and CONNECTOR...
_REFUSED = {
    "TIE", "MPC", "EQUATION", "COUPLING", "KINEMATICCOUPLING", "DISTRIBUTINGCOUPLING", "RIGIDBODY", "EMBEDDEDELEMENT",
    "SHELLTOSOLIDCOUPLING", "TRANSFORM", "SPRING", "DASHPOT", "MASS", "ROTARYINERTIA", "CONNECTORSECTION",
    "MODELCHANGE", "SUBMODEL", "CYCLICSYMMETRYMODEL", "FASTENER", "PRE-TENSIONSECTION", "GAP", "JOINT", "RELEASE",
    "IMPERFECTION", "USERELEMENT", "MATRIXASSEMBLE", "BASEMOTION",
}  # fmt: skip
#: Keywords that generate nodes or elements from others.
_GENERATING = {
    "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYMMETRICMODELGENERATION", "IMPORT", "SUBSTRUCTUREPROPERTY",
}  # fmt: skip
#: Keywords of loads, which are ignored with a warning.
_LOADS = {
    "CLOAD", "DLOAD", "DSLOAD", "TEMPERATURE", "INITIALCONDITIONS", "FOUNDATION", "INERTIARELIEF", "CFLUX", "DFLUX",
}  # fmt: skip
#: Options of materials that are neither linear elastic nor neo-Hookean.
_INELASTIC = {
    "PLASTIC", "VISCOELASTIC", "HYPERFOAM", "MOHRCOULOMB", "DRUCKERPRAGER", "CREEP", "USERMATERIAL", "CONCRETE",
    "HYPOELASTIC", "CLAYPLASTICITY", "CAPPLASTICITY", "CRUSHABLEFOAM", "DAMAGEINITIATION", "POROUSELASTIC",
    "ANISOTROPICHYPERELASTIC", "EOS", "MULLINSEFFECT", "BRITTLECRACKING", "JOINTEDMATERIAL", "DEFORMATIONPLASTICITY",
    "LOWDENSITYFOAM", "CASTIRONPLASTICITY", "SUPERELASTIC", "ACOUSTICMEDIUM", "CONCRETEDAMAGEDPLASTICITY",
}  # fmt: skip


def read(path: Path) -> MeshFile:
    """The mesh of an Abaqus deck. InputError, with file and line, if the deck is wrong."""
    return _Reader(path).read()


def files(path: Path) -> list[Path]:
    """The deck and all files that it includes."""
    opened: list[Path] = []
    collect(path, path.parent, [], (), opened)
    return opened


def is_solid(type_name: str) -> bool:
    """Whether an element of this type is a solid, supported or not."""
    return bool(_SOLID.fullmatch(type_name.upper()))


# --- keywords ------------------------------------------------------------------------------------------------------


class _Reader:
    def __init__(self, path: Path) -> None:
        self.keywords: list[Keyword] = []
        collect(path, path.parent, self.keywords, (), [])
        self.found = Definitions(path)
        self.scope = self.found.root
        self.system: tuple[Floats, Floats] | None = None  # rotation, origin
        self.material: Material | None = None
        self.step = 0
        self.skipped: dict[str, None] = {}

    def read(self) -> MeshFile:
        for keyword in self.keywords:
            self._handle(keyword)
            if keyword.name in ("NODE", "ELEMENT"):
                keyword.data.clear()  # frees the text
        self.keywords.clear()
        if self.scope is not self.found.root:
            kind = "PART" if any(self.scope is part for part in self.found.parts.values()) else "INSTANCE"
            self.found.unended = f"*{kind} {self.scope.name}"
        if self.skipped:
            skipped = meshfile.listed(self.skipped, 40)
            self.found.remarks.append(f"{self.found.path}: skipped, because the results do not depend on it: {skipped}")
        return Model(self.found).file()

    def _handle(self, keyword: Keyword) -> None:
        name = keyword.name
        handler = getattr(self, f"_{name.lower()}", None) if name in _HANDLED else None
        if handler:
            handler(keyword)
        elif name in _HARMLESS:
            pass
        elif name in _REFUSED or name.startswith(("CONTACT", "CONNECTOR")):
            self.found.refused.append(f"{keyword.origin}: {keyword.shown} changes the mechanics and cannot be computed")
        elif name in _GENERATING:
            keyword.fail("generates nodes or elements from others; let the preprocessor write them out")
        elif name in _LOADS:
            self.found.remarks.append(text.load_warning(keyword))
        elif name in _INELASTIC:
            if self.material:
                self.material.unusable = self.material.unusable or f"has {keyword.shown} ({keyword.origin})"
        elif name.endswith("SECTION") and keyword.parameters.get("ELSET"):
            self.scope.sections.append((keyword.parameters["ELSET"], "", keyword.origin))
        else:
            self.skipped[keyword.shown.upper()] = None

    # Parts and instances

    def _part(self, keyword: Keyword) -> None:
        self.scope = self.found.parts[keyword.need("NAME").casefold()] = Scope(keyword.need("NAME"))

    def _endpart(self, keyword: Keyword) -> None:
        self.scope, self.system = self.found.root, None

    def _assembly(self, keyword: Keyword) -> None:
        self.scope, self.found.assembly = self.found.root, keyword.parameters.get("NAME", "")

    def _endassembly(self, keyword: Keyword) -> None:
        self.scope = self.found.root

    def _instance(self, keyword: Keyword) -> None:
        if "LIBRARY" in keyword.parameters:
            keyword.fail("takes its part from a library; write the part into the deck")
        part, name = keyword.need("PART"), keyword.need("NAME")
        if part.casefold() not in self.found.parts:
            keyword.fail(f"names part {part}, which the deck does not define")
        if name.casefold() in self.found.instances:
            keyword.fail(f"is a second instance with the name {name}; rename one")
        self.scope = self.found.instances[name.casefold()] = self.found.parts[part.casefold()].copy(name)
        self.found.instanced.add(part.casefold())
        rows = keyword.numbers(2)
        self.scope.nodes.points = [_transformed(points, rows) for points in self.scope.nodes.points]

    _endinstance = _endpart

    # Nodes, elements and sets

    def _system(self, keyword: Keyword) -> None:
        rows = keyword.numbers(2)
        given = [value for _, row in rows for value in row][:9]
        origin, along, beside = np.pad(given, (0, 9 - len(given))).reshape(3, 3)
        if not given:
            self.system = None
        elif len(given) <= 3:
            self.system = np.eye(3), origin
        else:
            first = along - origin
            third = np.cross(first, beside - origin) if len(given) > 6 else np.cross(first, [-first[1], first[0], 0])
            if not (first.any() and third.any()):
                keyword.fail("has collinear points; correct them")
            first, third = first / np.linalg.norm(first), third / np.linalg.norm(third)
            self.system = np.stack([first, np.cross(third, first), third]), origin

    def _node(self, keyword: Keyword) -> None:
        tables = []
        for block in keyword.data:
            values, counts = text.separated(block, float, COMMENT, blank=0.0)
            tables.append(text.table(values, counts, 4))
        rows = np.concatenate(tables) if tables else np.empty((0, 4))
        ids = meshfile.as_ids(rows[:, 0], "node", keyword.origin)
        points = _cartesian(rows[:, 1:], keyword)
        if self.system:
            points = points @ self.system[0] + self.system[1]
        self.scope.nodes.add(ids, points, keyword.origin)
        if name := keyword.parameters.get("NSET"):
            self.scope.add("node", name, Entry("labels", ids, None, keyword.origin))

    def _element(self, keyword: Keyword) -> None:
        kind_name = keyword.need("TYPE")
        parts = [text.separated(block, int, COMMENT) for block in keyword.data]
        values, counts = (meshfile.joined(part[i] for part in parts) for i in (0, 1))
        del parts
        match = _SOLID.fullmatch(kind_name.upper())
        n_nodes = int(match[1]) if match else 0
        if n_nodes in _SOLIDS:
            rows = _regular(values, counts, n_nodes + 1, keyword)
            kind = _SOLIDS[n_nodes]
            nodes = rows[:, 1 : 1 + meshfile.SOLIDS.get(kind, n_nodes)]
            if kind == "other" and len(rows):
                self.found.refused.append(
                    f"{keyword.origin}: {len(rows)} elements of type {kind_name}, with nodes between the corners, "
                    "cannot be computed; mesh with C3D8"
                )
        else:
            kind = "other"
            rows = text.table(values, counts, int(counts.max(initial=1)), -1)
            nodes = rows[:, 1:]
        ids = meshfile.checked_ids(rows[:, 0], "element", keyword.origin).copy()
        self.scope.cells.append(Cells(kind, kind_name, ids, nodes, keyword.origin))
        if name := keyword.parameters.get("ELSET"):
            self.scope.add("cell", name, Entry("labels", ids, None, keyword.origin))

    def _nset(self, keyword: Keyword) -> None:
        self._any_set(keyword, "node", keyword.need("NSET"))
        if other := keyword.parameters.get("ELSET"):
            self.scope.add("node", keyword.need("NSET"), Entry("cells", f'"{other}"', None, keyword.origin))

    def _elset(self, keyword: Keyword) -> None:
        self._any_set(keyword, "cell", keyword.need("ELSET"))

    def _any_set(self, keyword: Keyword, kind: str, name: str) -> None:
        instance = keyword.parameters.get("INSTANCE")
        self.scope.sets[kind].setdefault(name.casefold(), Set(name))
        if "GENERATE" in keyword.parameters:
            for origin, entries in keyword.rows():
                first, last, step = (text.integer(e or "1", origin) for e in [*entries, "", "", ""][:3])
                last = last if len(entries) > 1 else first
                if step < 1 or last < first:
                    raise InputError(f"{origin}: {first}, {last}, {step} is no range; give first, last, increment")
                meshfile.checked_ids(np.array([first, last]), kind, origin)
                self.scope.add(kind, name, Entry("range", (first, last, step), instance, origin))
            return
        for block in keyword.data:
            for line, chunk in block.chunks():
                if numbers := text.parse(chunk, int, COMMENT):
                    self.scope.add(kind, name, Entry("labels", numbers[0], instance, keyword.origin))
                    continue
                for at, words in Block.of(block.path, line, chunk).lines(COMMENT):
                    origin = where(block.path, at)
                    for entry in filter(None, fields(words)):
                        if entry.isdecimal():
                            labels = np.array([text.integer(entry, origin)])
                            meshfile.checked_ids(labels, kind, origin)
                            self.scope.add(kind, name, Entry("labels", labels, instance, origin))
                        else:
                            self.scope.add(kind, name, Entry("set", entry, instance, origin))

    def _surface(self, keyword: Keyword) -> None:
        kind = keyword.parameters.get("TYPE", "ELEMENT").upper()
        if kind in ("ELEMENT", "NODE"):
            self.scope.surfaces[keyword.need("NAME")] = kind, list(keyword.rows())
        else:
            self.skipped[f"{keyword.shown.upper()}, TYPE={kind}"] = None

    # Materials and sections

    def _material(self, keyword: Keyword) -> None:
        name = keyword.need("NAME")
        self.material = self.found.materials[name.casefold()] = Material(name, keyword.origin)

    def _current_material(self, keyword: Keyword) -> Material:
        if not self.material:
            keyword.fail("belongs to no *MATERIAL; put one above it")
        return self.material

    def _elastic(self, keyword: Keyword) -> None:
        material = self._current_material(keyword)
        if keyword.parameters.get("TYPE", "ISOTROPIC")[:3].upper() != "ISO":
            material.unusable = f"has {keyword.shown}, TYPE={keyword.parameters['TYPE']} ({keyword.origin})"
            return
        rows = keyword.numbers(2)
        if not rows:
            keyword.fail("has no line with Young's modulus and Poisson's ratio")
        if len(rows) > 1:
            self.found.remarks.append(f"warning: {keyword.origin}: only the first row of {keyword.shown} is used")
        material.elastic = rows[0][1][0], (*rows[0][1], 0.0)[1]

    def _hyperelastic(self, keyword: Keyword) -> None:
        material = self._current_material(keyword)
        if "NEOHOOKE" not in keyword.parameters or "TESTDATAINPUT" in keyword.parameters:
            material.unusable = f"has {keyword.shown} other than NEO HOOKE with constants ({keyword.origin})"
            return
        rows = keyword.numbers(1)
        c10, d1 = ([*rows[0][1], 0.0, 0.0] if rows else [0.0, 0.0])[:2]
        if c10 <= 0 or d1 <= 0:
            problem = "is incompressible, D1 = 0" if c10 > 0 and d1 == 0 else f"has C10 = {c10:g}, D1 = {d1:g}"
            material.unusable = f"{problem} ({keyword.origin})"
            return
        mu, bulk = 2 * c10, 2 / d1
        material.elastic = 9 * bulk * mu / (3 * bulk + mu), (3 * bulk - 2 * mu) / (6 * bulk + 2 * mu)
        self.found.remarks.append(
            f"{keyword.origin}: material {material.name} has E = {material.elastic[0]:.6g} and nu = "
            f"{material.elastic[1]:.6g} from C10 and D1, by mu = 2 C10 and K = 2/D1 at small strain"
        )

    def _density(self, keyword: Keyword) -> None:
        rows = keyword.numbers(1)
        if self.material and rows:
            self.material.density = rows[0][1][0]

    def _solidsection(self, keyword: Keyword) -> None:
        material = keyword.need("MATERIAL")
        self.scope.sections.append((keyword.need("ELSET"), material, keyword.origin))

    # Steps

    def _step(self, keyword: Keyword) -> None:
        self.step += 1
        self.material = None

    def _boundary(self, keyword: Keyword) -> None:
        kind = keyword.parameters.get("TYPE", "DISPLACEMENT").upper()
        if kind != "DISPLACEMENT" or {"USER", "SUBMODEL"} & keyword.parameters.keys():
            how = f"TYPE={kind}" if "TYPE" in keyword.parameters else "USER"
            self.found.refused.append(
                f"{keyword.origin}: {keyword.shown} prescribes by {how}; only displacements can be prescribed"
            )
            return
        if keyword.parameters.get("OP", "").upper() == "NEW":
            self.found.boundaries = [(step, earlier) for step, earlier in self.found.boundaries if step == self.step]
        if amplitude := keyword.parameters.get("AMPLITUDE"):
            self.found.remarks.append(f"{keyword.origin}: amplitude {amplitude} is replaced by the loading curve")
        self.found.boundaries.append((self.step, keyword))


_HANDLED = {
    "PART", "ENDPART", "ASSEMBLY", "ENDASSEMBLY", "INSTANCE", "ENDINSTANCE", "SYSTEM", "NODE", "ELEMENT", "NSET",
    "ELSET", "SURFACE", "MATERIAL", "ELASTIC", "HYPERELASTIC", "DENSITY", "SOLIDSECTION", "STEP", "BOUNDARY",
}  # fmt: skip


def _transformed(points: Floats, rows: list[tuple[str, list[float]]]) -> Floats:
    """Points of an instance: the first row of its data is a translation, the second a rotation about an axis."""
    if rows:
        points = points + np.array([*rows[0][1], 0.0, 0.0, 0.0])[:3]
    if len(rows) > 1:
        origin, values = rows[1]
        axis = np.array(values[3:6]) - np.array(values[:3]) if len(values) == 7 else np.zeros(3)
        if not axis.any():
            raise InputError(f"{origin}: a rotation needs two points on its axis and an angle; correct it")
        x, y, z = axis / np.linalg.norm(axis)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angle = np.radians(values[6])
        rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        points = (points - values[:3]) @ rotation.T + values[:3]
    return points


def _cartesian(points: Floats, keyword: Keyword) -> Floats:
    """Points of *NODE in SYSTEM=R, C (r, theta, z) or S (r, theta, phi = latitude), with angles in degrees."""
    system = keyword.parameters.get("SYSTEM", "R").upper()
    if system == "R":
        return points
    r, theta, last = points.T
    theta = np.radians(theta)
    if system == "C":
        return np.stack([r * np.cos(theta), r * np.sin(theta), last], axis=1)
    if system == "S":
        phi = np.radians(last)
        return r[:, None] * np.stack([np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi)], axis=1)
    keyword.fail(f"has SYSTEM={system}; give R, C or S")


def _regular(values: Ints, counts: Ints, width: int, keyword: Keyword) -> Ints:
    """Rows (n, width) of elements; each row begins a new line and may continue on further lines."""
    ends = np.cumsum(counts)
    at_end = ends % width == 0
    if len(values) % width or np.count_nonzero(at_end) * width != len(values):
        row_ends = np.arange(width, len(values) + width, width)
        bad = int(np.argmax(~np.isin(row_ends, ends)))
        keyword.fail(
            f"has rows that are not {width} numbers, an element and its {width - 1} nodes; "
            f"the first is that of element {values[bad * width]}"
        )
    return values.reshape(-1, width)
