"""Tries mutants: each is one wrong change of the code, which the tests named with it have to notice. Run by hand.

    python tests/mutants.py [--only WORD] [--check] [--timeout SECONDS]

Each mutant is made in a copy of the tree, so that the tree itself is never touched. --check only looks whether each old
text is there once. Exit status 1 if a mutant survives, or cannot be made.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
BOUND, KERNELS, RELAXATION, RUN = (
    f"tests/test_{name}.py" for name in ("stability_bound", "kernels", "relaxation", "run")
)
REPORT, LABELS, RESUME, STORE = (f"tests/test_{name}.py" for name in ("report", "labels", "resume", "store"))
SHARPNESS, ESTIMATE, PHANTOMS = (f"tests/test_{name}.py" for name in ("sharpness", "estimate", "phantoms"))
FORCES = f"{KERNELS}::test_forces_energies_and_jacobians_are_those_of_the_plain_formulas"
WAVE = f"{RUN}::test_a_wave_keeps_its_energy_while_the_step_shortens"
RANKS = f"{RUN}::test_one_two_and_four_ranks_agree_and_repeat"
HALO = f"{RUN}::test_copies_of_shared_nodes_have_the_same_bits"

#: File: name, old text, new text, and the tests that have to fail.
MUTANTS: dict[str, list[tuple[str, str, str, str]]] = {
    "mpitled/kernels/stress.py": [
        ("bound: sqrt(2) dropped", "root((one + one) * square)", "root(square)", BOUND),
        ("bound: sqrt(2) is 2", "root((one + one) * square)", "(one + one) * root(square)", BOUND),
        ("bound: sign of a cross term", "+ g2 * (k0 * k2", "- g2 * (k0 * k2", BOUND),
        ("bound: no mu / J^2", "bound = (lam + mu / (J * J))", "bound = lam", BOUND),
        ("bound: initial stress with its sign", "(mu + magnitude(q)", "(mu + q", BOUND),
        ("bound: no hourglass share", "r[2] + load(stiffness, w)", "r[2]", BOUND),
        ("stress: sign in the cofactor", "k1 = f * g - d * i", "k1 = d * i - f * g", FORCES),
        ("stress: lambda J", "q = lam * (J - one) - mu / J\n    if n", "q = lam * J - mu / J\n    if n", FORCES),
        ("energy: lambda doubled", "energy + lam * (J", "energy + (one + one) * lam * (J", FORCES),
        ("lanes without a cell have stress", "q = first_of(n, q, mu)", "q = q * one", KERNELS),
    ],
    "mpitled/kernels/domains.py": [
        ("tensor: sqrt(2) dropped", "root((one + one) * square)", "root(square)", BOUND),
        ("tensor: sign off the diagonal", "U(0), s * G[0] * G[2])", "U(0), -s * G[0] * G[2])", BOUND),
        ("tensor: no mu / J^2", "(lam + mu / (J * J)) * sum_g", "lam * sum_g", BOUND),
        ("tensor: initial stress with its sign", "(mu + magnitude(q)", "(mu + q", BOUND),
        ("tensor: no stabilisation", " + factor * load(stiffness, w)", "", BOUND),
        ("stabilisation resists translation", "(number - affine[0])", "number", FORCES),
    ],
    "mpitled/kernels/hexahedra.py": [
        ("voxels: k for 8 k", "r[2] + eight * k", "r[2] + k", BOUND),
        ("voxels: 16 k for 8 k", "eight = u.dtype.type(8)", "eight = u.dtype.type(16)", BOUND),
        ("voxels: no mass at far nodes", "required[first + i + U(1)] += asked", "pass", KERNELS),
        ("voxels: J where no cell is", "first_of(n - w, p[9], ones)", "p[9]", KERNELS),
        ("hexahedra: sign in a mode", "rst - (x * load(g[27], w)", "rst - (-x * load(g[27], w)", FORCES),
    ],
    "mpitled/kernels/nodes.py": [
        ("scalar masses fall at once", "keep * mass[0, n])", "0 * mass[0, n])", RELAXATION),
        ("tensors fall at once", "if 0 < trace < least else", "if trace < 0 else", RELAXATION),
        ("kinetic energy: prescribed dofs", "(v * v - w * w)", "(v * v - v * v)", KERNELS),
        ("reactions: work not trapezoidal", "0.5 * (r + reaction[p])", "r", WAVE),
        ("reactions: no inertia", "r += (amplitude * full[p]", "now += (amplitude * full[p]", WAVE),
        ("longer step: no change of gain", "(gain - 1) * mobility[n]", "0 * mobility[n]", KERNELS),
        ("relaxation: work doubled", "work += half * (\n            counted", "work += (\n            counted", REPORT),
        ("mass added without energy", "energy += 0.5 * dm * v * v", "energy += 0 * dm * v", KERNELS),
        ("arcs are chords", "(np.cos(amplitude * angle) - 1) * arm", "amplitude * (np.cos(angle) - 1) * arm", PHANTOMS),
        ("iteration counts shared nodes twice", "if owned[n]:\n            old", "if True:\n            old", RANKS),
        ("estimate: residual squared", "np.sqrt(change), np.sqrt(residual)", "np.sqrt(change), residual", ESTIMATE),
    ],
    "mpitled/material.py": [
        ("hourglass limit removed", "np.minimum(lam + 2 * mu, _STIFFEST * mu)", "lam + 2 * mu", BOUND),
    ],
    "mpitled/parallel/subdomain.py": [
        ("runs of two materials", "follows &= of[1:] == of[:-1]", "follows &= of[1:] == of[1:]", FORCES),
    ],
    "mpitled/parallel/halo.py": [
        ("ranks add in another order", "(below if rank < world.rank else above)", "(above)", HALO),
        ("sums are not cleared", "self._total[:] = 0", "pass", HALO),
        ("one buffer for all exchanges", "self._turns.reverse()", "pass", HALO),
    ],
    "mpitled/solver/step.py": [
        ("J of the last step only", "s.f, *some)\n            s.smallest_jacobian = min(s.smallest_jacobian, J)",
         "s.f, *some)\n            s.smallest_jacobian = J", FORCES),
        ("load a step late", "loading_curve((self.time + self.time_step)", "loading_curve((self.time)", KERNELS),
        ("border cells twice", "*(slice(n, None) for n in borders)", "*(slice(0, None) for n in borders)", HALO),
    ],
    "mpitled/solver/stability_check.py": [
        ("a step of twice the length", "(s.time_step / (2 * safety))", "(s.time_step / (4 * safety))", KERNELS),
    ],
    "mpitled/solver/central_difference.py": [
        ("held nodes ask for mass", "required[self.prescribed] = 0", "pass", f"{RUN} {SHARPNESS}"),
        ("a shorter step is not taken", "min(self.longest, s.time_step / shrunk)", "self.longest", WAVE),
    ],
    "mpitled/solver/spectral_radius.py": [
        ("held dofs take part", "mode[self._held] = 0\n        size", "size", SHARPNESS),
        ("the share may fall", "max(self.share, found)", "found", SHARPNESS),
        ("a stiffer mode is not looked for", "or self.glances + 1 >= self.whole", "", SHARPNESS),
    ],
    "mpitled/solver/dynamic_relaxation.py": [
        ("masses fall at once", "KEEP = 0.9", "KEEP = 0.0", RELAXATION),
        ("a growing estimate ends it", ">= SETTLED and shrinks)", ">= SETTLED)", RELAXATION),
        ("the smaller estimate counts", "self.distance = max(figures", "self.distance = min(figures", RELAXATION),
        ("settled at once", "self.settled + self.between if", "SETTLED if", RELAXATION),
        ("half of critical damping", "damping = 2 * math.sqrt", "damping = math.sqrt", RELAXATION),
        ("stalls while the load grows", "self.waited += loaded", "self.waited += 1", RELAXATION),
        ("slow modes that come up late", "self.lowest < FALLEN * self.best_lowest", "False", RELAXATION),
    ],
    "mpitled/solver/monitor.py": [
        ("turned cells pass", "if smallest <= 0:", "if smallest <= -9:", RELAXATION),
        ("energies out of balance pass", "BALANCE_LIMIT * largest +", "9 * largest +", RELAXATION),
    ],
    "mpitled/solver/restart.py": [
        ("most of the smallest J", "float(numbers.min())", "float(numbers.max())", RESUME),
        ("sums on every rank", "if sub.rows.part == 0 else 0.0", "if sub.rows.part >= 0 else 0.0", RESUME),
    ],
    "mpitled/results/report.py": [
        ("first ring without its hexahedra", "on_seed[model.hexahedra].any(axis=1)", "[]", REPORT),
        ("first ring without its domains", "outside[model.domains[ring_domains]] = False", "pass", REPORT),
        ("balance of an open interface", "and not np.any(outcome.field[_rim(faces)])", "", REPORT),
        ("rim is everywhere", "edges[~np.isin(forth, back)]", "edges", REPORT),
        ("6 mm is large", "LARGE = 5e-3", "LARGE = 6.5e-3", REPORT),
        ("midline within a whole cell", "fe_volumes.mean())) / 2", "fe_volumes.mean())) * 2", REPORT),
        ("volume of the mean radius", "- centre, axis=1) ** 3", "- centre, axis=1).mean() ** 3 * np.ones(2)", REPORT),
    ],
    "mpitled/meshing/labels.py": [
        ("oblique limit times ten", "tilt.max() > 0.5 *", "tilt.max() > 5.0 *", LABELS),
        ("voxels half an edge off", "origin=(corner - edges / 2) * metre", "origin=corner * metre", LABELS),
        ("void at the skull", 'free = parts["tissue"] & head.deep', 'free = parts["tissue"] & head.solid', LABELS),
        ("cavities stay", "    return ~outside[1:-1, 1:-1, 1:-1]", "    return cells", LABELS),
        ("sides swapped unnoticed", "if left > right:", "if left > 2 * right:", LABELS),
        ("repairs with the emptiest cube", "-1.0, np.pad(share, 1)", "-1.0, 1 - np.pad(share, 1)", LABELS),
    ],
    "mpitled/store/partitions.py": [
        ("each rank owns all nodes", "(rows >= first_row) & (rows < end_row)", "rows >= 0", f"{STORE} {RANKS}"),
    ],
    "mpitled/store/files.py": [
        ("damage passes", 'thing.attrs["checksum"] != checksum_of(thing)', "False", RESUME),
        ("rows of gaps", "rows[first:last] - start, axis=0", "rows[first:last] - start - 1, axis=0", STORE),
    ],
    "mpitled/store/checkpoints.py": [
        ("no checkpoint before the last", "os.replace(path, previous)", "path.unlink()", RESUME),
        ("nodes in the file's order", "rows)[order] for name", "rows) for name", RESUME),
    ],
    "mpitled/checksum.py": [
        ("places do not count", "_STEPS[: len(some)] + np", "0 * _STEPS[: len(some)] + np", RESUME),
    ],
}  # fmt: skip


def fresh_copy() -> tuple[Path, dict[str, str]]:
    """A copy of what git knows, at the same place each time so that compiled kernels are found again."""
    base = Path(tempfile.gettempdir()) / f"mpitled-mutants-{os.getuid()}"
    tree = base / "tree"
    base.mkdir(exist_ok=True)
    lock = os.open(base / "lock", os.O_CREAT | os.O_RDWR)  # to the end of this process
    fcntl.flock(lock, fcntl.LOCK_EX)
    shutil.rmtree(tree, ignore_errors=True)
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in listed.splitlines():
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
    return tree, {**os.environ, "PYTHONPATH": str(tree), "NUMBA_CACHE_DIR": str(base / "cache")}


def outcome(tree: Path, environment: dict[str, str], tests: str, timeout: float) -> str:
    """Of the tests against the tree as it is: killed, survived, slow or broken."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests.split()]
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return "slow"
    failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
    by = f" by {failed[0].split(' - ')[0].removeprefix('FAILED ')}" if failed else ""
    return {0: "SURVIVED", 1: f"killed{by}"}.get(done.returncode, f"BROKEN: {done.stdout[-300:]}")


def main() -> int:
    parser = argparse.ArgumentParser(description="Tries mutants against the tests that have to notice them.")
    parser.add_argument("--only", default="", help="those with this word in name or file")
    parser.add_argument("--check", action="store_true", help="only look whether each can be made")
    parser.add_argument(
        "--timeout", type=float, default=900, help="seconds for the tests of one; longer counts as killed"
    )
    options = parser.parse_args()
    tree, environment = (ROOT, {}) if options.check else fresh_copy()
    found: dict[str, list[str]] = {}
    for file, mutants in MUTANTS.items():
        for name, old, new, tests in mutants:
            if options.only not in f"{file}: {name}":
                continue
            path, begin = tree / file, time.perf_counter()
            before = path.read_text() if path.is_file() else ""
            if before.count(old) != 1:
                result = f"LOST: the old text is there {before.count(old)} times"
            elif options.check:
                result = "can be made"
            else:
                caches = {*Path(environment["NUMBA_CACHE_DIR"]).glob("mpitled-*")}
                stamp = path.stat()
                path.write_text(before.replace(old, new))
                result = outcome(tree, environment, tests, options.timeout)
                path.write_text(before)
                os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
                if file.startswith("mpitled/kernels/"):
                    for made in {*Path(environment["NUMBA_CACHE_DIR"]).glob("mpitled-*")} - caches:
                        shutil.rmtree(made)
            print(f"{time.perf_counter() - begin:6.0f} s  {file}: {name}: {result}", flush=True)
            found.setdefault(result.split()[0], []).append(name)
    print(", ".join(f"{len(names)} {result}" for result, names in found.items()))
    return 1 if found.keys() - {"killed", "slow", "can"} else 0


if __name__ == "__main__":
    sys.exit(main())
