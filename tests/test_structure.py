"""The structure of the code: the order of folders, the importers of libraries, docstrings, and files at the top."""

from __future__ import annotations

import ast
import graphlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ENVIRONMENT, ROOT
from scenes import block, pulled

from mpitled import deck
from mpitled.results import figures

PACKAGES = ("mpitled", "partition")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
#: The folders and top modules of `mpitled`. Each imports only earlier names of this list.
ORDER = [
    "errors", "atomic", "lock", "checksum", "resources", "hdf5_validation", "hdf5", "toml",
    "laws", "mesh", "kernels", "cells", "deck", "meshing", "readers", "model", "store", "parallel", "terms", "solver",
    "results", "export", "info", "scaffold", "job", "preview", "batch", "interface", "commands", "cli", "__main__",
]  # fmt: skip
#: Each library may be imported by one module, or by the modules of one package, only.
OWNERS = {
    "h5py": ("mpitled.hdf5", "mpitled.store"),
    "mpi4py": ("mpitled.parallel.halo",),
    "pymetis": ("partition.metis",),
    "pyvista": ("mpitled.results",),
    "xarray": ("mpitled.interface",),
    "argcomplete": ("mpitled.cli",),
}
TOP = {
    "pyproject.toml", "mpitled", "partition", "tests", "jobs", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"
}  # fmt: skip


def name_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def imports(path: Path) -> set[str]:
    """Names of all modules that a file imports, also inside functions; for `from a import b` both a and a.b."""
    names = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            assert node.module is not None
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def test_folders_import_only_earlier_folders():
    """The order of `ORDER` is total: it also excludes cycles between folders."""
    graph: dict[str, set[str]] = {}
    for path in MODULES:
        if path.is_relative_to(ROOT / "mpitled") and path != ROOT / "mpitled" / "__init__.py":
            imported = {name.split(".")[1] for name in imports(path) if name.startswith("mpitled.")}
            graph.setdefault(name_of(path).split(".")[1], set()).update(imported & set(ORDER))
    assert set(graph) <= set(ORDER), "give each new folder a place in ORDER"
    edges = [(folder, other) for folder, imported in graph.items() for other in imported - {folder}]
    assert [(folder, other) for folder, other in edges if ORDER.index(folder) < ORDER.index(other)] == []


def test_modules_import_without_cycles():
    ours = {name_of(path) for path in MODULES}
    # Python imports a package before its modules: this import is not an edge of the graph.
    graph = {name_of(path): (imports(path) & ours) - {"mpitled", name_of(path)} for path in MODULES}
    order = list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError, which names the cycle
    assert set(order) - {"mpitled"} == ours - {"mpitled"}
    assert [name for name, imported in graph.items() if "mpitled.cli" in imported] == ["mpitled.__main__"]


def test_partition_does_not_import_mpitled():
    for path in MODULES:
        if path.is_relative_to(ROOT / "partition"):
            assert not {name for name in imports(path) if name.partition(".")[0] == "mpitled"}, path


def test_libraries_have_one_importer():
    importers: dict[str, set[str]] = {}
    for path in MODULES:
        for name in imports(path):
            importers.setdefault(name.partition(".")[0], set()).add(name_of(path))
    for library, owners in OWNERS.items():
        assert importers[library]
        prefixes = tuple(f"{owner}." for owner in owners)
        assert {name for name in importers[library] if not f"{name}.".startswith(prefixes)} == set()
    assert len(importers.get("meshio", ())) <= 1
    # The first reads images, the second writes images.
    assert importers["nibabel"] == {"mpitled.meshing.label_image", "mpitled.results.images"}
    assert not {"tests", "conftest", "pytest", "hypothesis", "vtk", "pandas"} & set(importers)


def loaded(code: str, *arguments: object) -> set[str]:
    """First parts of the names of all modules that code loads in a new interpreter."""
    head = "import atexit, sys; atexit.register(lambda: print(*{m.partition('.')[0] for m in sys.modules}))"
    command = [sys.executable, "-c", f"{head}\n{code}", *map(str, arguments)]
    done = subprocess.run(command, env=ENVIRONMENT, cwd=ROOT, timeout=120, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def test_command_starts_without_large_libraries():
    modules = loaded("import mpitled.cli")
    assert "mpitled" in modules
    libraries = {"numpy", "pydantic", "scipy", "tomlkit", "numba", "h5py", "mpi4py", "pymetis", "meshio", "matplotlib"}
    assert not modules & {*libraries, "partition"}


SCENE = f"""{block((20, 20, 20), (5, 5, 5), "core")}{pulled(0.1)}
[solver]
method = "quasi-static"
load_time = 0.1
[output]
frames = 1
"""


def test_one_rank_needs_neither_metis_nor_a_halo(tmp_path):
    deck = tmp_path / "scene.toml"
    deck.write_text(SCENE)
    code = "from mpitled.cli import main; main(sys.argv[1:])"
    modules = loaded(code, "run", "-q", deck, "--out", tmp_path / "out")
    assert (tmp_path / "out" / "result.vtkhdf").exists()
    assert {"numba", "h5py"} <= modules
    assert not modules & {"pymetis", "mpi4py", "meshio"}


def test_modules_and_public_names_have_docstrings():
    missing = []
    for path in MODULES:
        module = tree(path)
        if not ast.get_docstring(module):
            missing.append(name_of(path))
        for node in module.body:
            named = isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
            if named and not ast.get_docstring(node):
                missing.append(f"{name_of(path)}.{node.name}")
    missing += [name_of(path) for path in (ROOT / "tests").glob("*.py") if not ast.get_docstring(tree(path))]
    assert missing == []


def test_top_of_the_repository_holds_only_known_files():
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a clone")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    top = {line.partition("/")[0] for line in listed.splitlines()}
    assert {name for name in top if not name.startswith(".")} <= TOP


@pytest.mark.parametrize(
    ("name", "expected", "code"),
    [
        ("deck", deck.markdown_table, "from mpitled import deck; print(deck.markdown_table())"),
        ("figures", figures.guide_table, "from mpitled.results import figures; print(figures.guide_table())"),
    ],
)
def test_tables_of_the_guide_are_up_to_date(name, expected, code):
    readme = (ROOT / "jobs" / "README.md").read_text(encoding="utf-8")
    _, table = readme.split(f"<!-- {name} table -->\n")
    table, _ = table.split(f"<!-- end of {name} table -->")
    assert table.strip() == expected().strip(), f"python -c '{code}' prints the table for the guide"
