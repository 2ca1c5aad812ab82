"""How the code hangs together: imports go one way, libraries have one importer, names are explained, nothing strays."""

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
#: Libraries that one module (or the modules of one package) alone may import, at its head or inside of a function.
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
    """Every module that a file imports, anywhere in it, also for type checkers alone; `from a import b` may be a.b."""
    names = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            assert node.module is not None
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def test_imports_go_one_way():
    ours = {name_of(path) for path in MODULES}
    # That a package is there before its modules is no direction of knowledge.
    graph = {name_of(path): (imports(path) & ours) - {"mpitled", name_of(path)} for path in MODULES}
    order = list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError, which names the cycle
    assert set(order) - {"mpitled"} == ours - {"mpitled"}
    assert not graph["mpitled.errors"]  # the ground
    assert [name for name, known in graph.items() if "mpitled.cli" in known] == ["mpitled.__main__"]  # the top


def test_the_partition_knows_nothing_of_mpitled():
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
    # One reads, the other writes.
    assert importers["nibabel"] == {"mpitled.meshing.label_image", "mpitled.results.images"}
    assert not {"tests", "conftest", "pytest", "hypothesis", "vtk", "pandas"} & set(importers)


def loaded(code: str, *arguments: object) -> set[str]:
    """Top names of all modules that are there at the end of a fresh interpreter."""
    report = (
        "import atexit, sys; atexit.register(lambda: print(*{m.partition('.')[0] for m in sys.modules}, sep='\\n'))"
    )
    command = [sys.executable, "-c", f"{report}\n{code}", *map(str, arguments)]
    done = subprocess.run(command, env=ENVIRONMENT, cwd=ROOT, timeout=120, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def test_the_command_starts_without_compilers_and_libraries():
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


def test_every_module_and_every_public_name_says_what_it_is():
    silent = []
    for path in MODULES:
        module = tree(path)
        if not ast.get_docstring(module):
            silent.append(name_of(path))
        for node in module.body:
            named = isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
            if named and not ast.get_docstring(node):
                silent.append(f"{name_of(path)}.{node.name}")
    silent += [name_of(path) for path in (ROOT / "tests").glob("*.py") if not ast.get_docstring(tree(path))]
    assert silent == []


def test_nothing_strays_at_the_top_of_the_repository():
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
