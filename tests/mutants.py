"""Mutation testing: each mutant is one wrong change of the code, and the tests named with it must fail. Run by hand.

    python tests/mutants.py [--only WORD] [--check] [--timeout SECONDS]

Mutants are made in a copy of the tree; the tree itself is never changed. --check only tests that each old text occurs
once. Exit status 1 if a mutant survives or cannot be made.
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
BOUND, KERNELS, RELAXATION, SPECTRAL, TERMS, RUN, REPORT, LABELS, RESUME, STORE, PHANTOMS, MOONEY = (
    f"tests/test_{name}.py"
    for name in (
        "stability_bound", "kernels", "relaxation", "spectral_radius", "terms", "run", "report", "labels", "resume",
        "store", "phantoms", "mooney_rivlin",
    )
)  # fmt: skip
_FORMULAS = f"{BOUND}::test_bounds_and_forces_are_those_of_the_formulas"
BOXES, DISTORTED, DOMAINS = (f"{_FORMULAS}[{scene}]" for scene in ("boxes", "distorted", "domains"))
AUXETIC = f"{BOUND} -k auxetic"
HOURGLASS = f"{BOUND}::test_the_share_of_hourglass_control_is_its_largest_eigenvalue[boxes]"
_PLAIN = f"{KERNELS}::test_forces_energies_and_jacobians_are_those_of_the_plain_formulas"
VOXEL_FORCES, HEXAHEDRON_FORCES, DOMAIN_FORCES = (
    f"{_PLAIN}[{scene}-0.1-mean]" for scene in ("voxels", "distorted", "domains")
)
GRADIENT = f"{KERNELS}::test_forces_are_the_gradient_of_the_energies[voxels]"
WAVE = f"{RUN}::test_a_wave_keeps_its_energy_while_the_step_shortens"
STRETCHED = f"{RUN} -k homogeneous"
RANKS = f"{RUN}::test_one_two_and_four_ranks_agree_and_repeat"
HALO = f"{RUN} -k same_bits"
LEDGER = f"{TERMS} -k ledger"
CHECKPOINT, ROLLBACK = f"{TERMS} -k checkpoint", f"{TERMS} -k rollback"

#: File: name, old text, new text, and the tests that have to fail.
MUTANTS: dict[str, list[tuple[str, str, str, str]]] = {
    "mpitled/laws/neo_hookean.py": [
        ("bound: sqrt(2) dropped", "np.sqrt(square * 2)", "np.sqrt(square)", BOXES),
        ("bound: sqrt(2) is 2", "np.sqrt(square * 2)", "np.sqrt(square * 4)", BOXES),
        ("bound: no mu / J^2", "np.maximum(lam + mu / (J * J), 0)", "np.maximum(lam, 0)", BOXES),
        ("bound: initial stress with its sign", "mu + np.abs(q)", "mu + q", BOXES),
        ("bound: negative for auxetic cells", "np.maximum(lam + mu / (J * J), 0)", "lam + mu / (J * J)", AUXETIC),
        ("stress: lambda J", "J - 1) - mu / J\n        return", "J) - mu / J\n        return", BOXES),
        ("energy: sign of the logarithm", "0.5 - mu * np.log", "0.5 + mu * np.log", GRADIENT),
        ("energy: lambda doubled", "lam * (J - 1) * (J - 1)) * 0.5", "lam * (J - 1) * (J - 1) * 2) * 0.5", GRADIENT),
        ("mu: the misprint of eq. 4.3", "youngs_modulus / (2 *", "youngs_modulus * self.poissons_ratio / (2 *",
         STRETCHED),
    ],
    "mpitled/laws/mooney_rivlin.py": [
        ("energy: sign of the logarithm", "second - (c10", "second + (c10", GRADIENT),
        ("stress: sign in the cross product", "r * (a * N - d * L", "r * (a * N + d * L", GRADIENT),
        ("bound: half of F:F", "(square * 4 +", "(square * 2 +", BOXES),
        ("bound: half of |K|", "np.sqrt(of_cofactor * 8)", "np.sqrt(of_cofactor * 2)", BOXES),
        ("lambda counts that of the second invariant twice", "self.lam - 4 * self.c01", "self.lam",
         f"{MOONEY} -k simple_tension"),
    ],
    "mpitled/kernels/tensors.py": [
        ("stress: sign in the cofactor", "k1 = f * g - d * i", "k1 = d * i - f * g", VOXEL_FORCES),
        ("bound: sign of a cross term", "+ g2 * (K[0] * K[2]", "- g2 * (K[0] * K[2]", DISTORTED),
        ("bound: cross terms once", "        * 2\n", "", DISTORTED),
        ("bound: no hourglass share", "6, w)) + load(stiffness, w)", "6, w))", DISTORTED),
    ],
    "mpitled/kernels/lanes.py": [
        ("maximum is the minimum", 'builder.fcmp_ordered("<", a, b)', 'builder.fcmp_ordered(">", a, b)', AUXETIC),
        ("smallest J is the largest", '"<", args[1], args[0]', '">", args[1], args[0]', VOXEL_FORCES),
        ("forces of far nodes at near ones", "[n - 1 + lane for", "[n + lane for", VOXEL_FORCES),
        ("a lane too many", '"<", ir.Constant(numbers', '"<=", ir.Constant(numbers', VOXEL_FORCES),
    ],
    "mpitled/kernels/nodes.py": [
        ("scalar masses fall at once", "least_share * mass[0, n])", "0 * mass[0, n])", RELAXATION),
        ("tensors fall at once", "if 0 < trace < least else", "if trace < 0 else", RELAXATION),
        ("kinetic energy: prescribed dofs", "(v * v - w * w)", "(v * v - v * v)", f"{KERNELS} -k kinetic"),
        ("reactions: work not trapezoidal", "0.5 * (r + reaction[p])", "r", WAVE),
        ("reactions: no inertia", "r += (amplitude * full[p]", "now += (amplitude * full[p]", WAVE),
        ("longer step: same weight of forces", "(factor - 1) * dt2_over_m", "0 * dt2_over_m",
         f"{KERNELS} -k any_length"),
        ("relaxation: work doubled", "work += half * (\n            counted", "work += (\n            counted",
         f"{RUN} -k few_steps"),
        ("mass added without energy", "energy += 0.5 * dm * v * v", "energy += 0 * dm * v", f"{KERNELS} -k raised"),
        ("arcs are chords", "(np.cos(amplitude * angle) - 1) * arm", "amplitude * (np.cos(angle) - 1) * arm",
         f"{PHANTOMS} -k arcs"),
        ("iteration counts shared nodes twice", "if owned[n]:\n            old", "if True:\n            old",
         f"{KERNELS} -k iteration"),
        ("estimate: residual squared", "np.sqrt(change), np.sqrt(residual)", "np.sqrt(change), residual",
         f"{RELAXATION} -k norms"),
    ],
    "mpitled/cells/hexahedra.py": [
        ("hourglass limit removed", "np.minimum(lam + 2 * mu, HOURGLASS_LIMIT * mu)", "lam + 2 * mu", HOURGLASS),
    ],
    "mpitled/cells/voxel_runs.py": [
        ("bound: k for 8 k", "g) + k * 8", "g) + k", HOURGLASS),
        ("bound: 16 k for 8 k", "g) + k * 8", "g) + k * 16", HOURGLASS),
        ("no mass at far nodes", "required[first + i + U(1)] += asked", "pass", BOXES),
        ("J where no cell is", "J = select_first(n - w, J, ones)", "J = J * 1", f"{KERNELS} -k behind_a_run"),
        ("lanes without a cell have stress", "run, n - w, u[0])", "run, lanes, u[0])", VOXEL_FORCES),
        ("runs of two materials", "follows &= of[1:] == of[:-1]", "follows &= of[1:] == of[1:]", VOXEL_FORCES),
        ("second law ignored", "for law in dict.fromkeys(laws):", "for law in laws[:1]:", BOXES),
    ],
    "mpitled/cells/hexahedron_batches.py": [
        ("sign in a mode", "rst - (x * load(g[27], w)", "rst - (-x * load(g[27], w)", HEXAHEDRON_FORCES),
        ("last far node of a row without force", "fc[first + width(fc)] += last(far)", "pass", HEXAHEDRON_FORCES),
        ("cells of the first block", "(cells.first + rows)", "(0 * cells.first + rows)", "tests/test_blocks.py"),
    ],
    "mpitled/cells/support_domain_batches.py": [
        ("tensor: sign off the diagonal", "U(0), s * G[0] * G[2])", "U(0), -s * G[0] * G[2])", DOMAINS),
        ("tensor: no stabilisation", " + factor * load(stiffness, w)", "", DOMAINS),
        ("tensor: the last node's share", "sum_material = sum_material + _norm(", "sum_material = _norm(", DOMAINS),
        ("tensors and scalars", "if tensor is None:\n            ", "if True:\n            ", DOMAINS),
        ("stabilisation resists translation", "(number - affine[0])", "number", DOMAIN_FORCES),
        ("lanes left over have stress", "in_lanes(coefficient, 0)", "in_lanes(coefficient)", DOMAIN_FORCES),
    ],
    "mpitled/cells/packing.py": [
        ("second law ignored", "for law in dict.fromkeys(laws):", "for law in laws[:1]:", DOMAINS),
        ("border last", "np.argsort(~at_border", "np.argsort(at_border", HALO),
    ],
    "mpitled/parallel/subdomain.py": [
        ("block offset", "points, nodes, block.first_own, rows", "points, nodes, 0, rows", "tests/test_blocks.py"),
        ("held dofs do not count those that move", "np.concatenate([self.fixed, self.moving])", "self.fixed",
         STRETCHED),
    ],
    "mpitled/parallel/halo.py": [
        ("ranks add in another order", "(below if rank < world.rank else above)", "(above)", HALO),
        ("sums are not cleared", "self._total[:] = 0", "pass", HALO),
        ("one buffer for all exchanges", "self._turns.reverse()", "pass", HALO),
    ],
    "mpitled/terms/cell_forces.py": [
        ("J of the last step only", "if jacobian < s.smallest_jacobian:", "if True:", VOXEL_FORCES),
        ("border cells twice", "else slice(block.n_border, None)", "else slice(0, None)", HALO),
    ],
    "mpitled/terms/state.py": [
        ("load a step late", "loading_curve((self.time + self.time_step)", "loading_curve((self.time)",
         f"{KERNELS} -k any_length"),
    ],
    "mpitled/terms/motion.py": [
        ("work at shared nodes twice", "owned_only=True", "owned_only=False", RANKS),
        ("a single-precision run keeps old displacements", "(lambda s: None) if self._aliased",
         "(lambda s: None) if True",
         f"{RUN} -k single_precision"),
    ],
    "mpitled/terms/restart.py": [
        ("a rollback resets controls", "or declared.control:", "or False:", ROLLBACK),
        ("a rollback to rest restores all arrays", "self.to_rest and declared.single_precision",
         "self.to_rest", ROLLBACK),
        ("most of the smallest J", "float(numbers.min())", "float(numbers.max())", CHECKPOINT),
        ("sums on every rank", "if sub.rows.part == 0 else 0.0", "if sub.rows.part >= 0 else 0.0", CHECKPOINT),
    ],
    "mpitled/solver/stability_check.py": [
        ("a step of twice the length", "(s.time_step / (2 * safety))", "(s.time_step / (4 * safety))", BOXES),
    ],
    "mpitled/solver/central_difference.py": [
        ("held nodes ask for mass", "required[self.prescribed] = 0", "pass", f"{SPECTRAL} -k leaves_the_forces"),
        ("a shorter step is not taken", "min(self.longest, s.time_step / shrunk)", "self.longest", WAVE),
    ],
    "mpitled/solver/spectral_radius.py": [
        ("forces are left as they were tried", "apply(s, self._forces)\n        if not full", "if not full",
         f"{SPECTRAL} -k leaves_the_forces"),
        ("a stiffer mode is not looked for", "or self.skipped + 1 >= self.full_every", "",
         f"{SPECTRAL} -k in_full"),
    ],
    "mpitled/solver/dynamic_relaxation.py": [
        ("masses fall at once", "MAX_MASS_DROP = 0.9", "MAX_MASS_DROP = 0.0", RELAXATION),
        ("a growing estimate ends it", ">= CONVERGED_STEPS and shrinks)", ">= CONVERGED_STEPS)", RELAXATION),
        ("the smaller estimate counts", "self.distance = max(figures", "self.distance = min(figures", RELAXATION),
        ("converged at once", "self.converged_steps + self.between if", "CONVERGED_STEPS if", RELAXATION),
        ("half of critical damping", "damping = 2 * math.sqrt", "damping = math.sqrt", RELAXATION),
        ("stalls while the load grows", "self.n_checks_since_best += loaded",
         "self.n_checks_since_best += 1", RELAXATION),
        ("slow modes that come up late", "self.lowest < EIGENVALUE_DROP * self.best_lowest", "False", RELAXATION),
    ],
    "mpitled/solver/monitor.py": [
        ("turned cells pass", "if smallest <= 0:", "if smallest <= -9:", RELAXATION),
        ("energies out of balance pass", "BALANCE_LIMIT * largest +", "9 * largest +", RELAXATION),
        ("energies that are no numbers pass", "or (smallest > 0 and not finite)", "", RELAXATION),
        ("the first steps are judged", ">= FIRST_JUDGED_STEP", ">= 0", RELAXATION),
        ("a term's energy is not in the ledger", "{integrator, *(type(term) for term in step.terms)}", "{integrator}",
         LEDGER),
        ("internal energy is that of the first term", "lines | {\"internal\": self.total(figures, Side.STORED)",
         "lines | {\"internal\": figures[\"strain\"]", LEDGER),
    ],
    "mpitled/results/report.py": [
        ("first ring without its hexahedra", "on_seed[model.hexahedra].any(axis=1)", "[]", f"{REPORT} -k first_ring"),
        ("first ring without its domains", "outside[model.domains[ring_domains]] = False", "pass",
         f"{REPORT} -k first_ring"),
        ("balance of an open interface", " and not np.any(state.field[_open_edge_nodes(faces)])", "",
         f"{REPORT} -k rim_at_rest"),
        ("rim is everywhere", "edges[~np.isin(forth, back)]", "edges", f"{REPORT} -k balance"),
        ("6 mm is large", "LARGE = 5e-3", "LARGE = 6.5e-3", f"{REPORT} -k moved_far"),
        ("midline within a whole cell", "hexahedron_volumes.mean())) / 2", "hexahedron_volumes.mean())) * 2",
         f"{REPORT} -k midline"),
        ("volume of the mean radius", "- centre, axis=1) ** 3", "- centre, axis=1).mean() ** 3 * np.ones(2)",
         f"{REPORT} -k swelling"),
    ],
    "mpitled/meshing/label_image.py": [
        ("oblique limit times ten", "tilt.max() > 0.5 *", "tilt.max() > 5.0 *", f"{LABELS} -k oblique"),
        ("voxels half an edge off", "origin=(corner - edges / 2) * metre", "origin=corner * metre",
         f"{LABELS} -k anisotropic"),
        ("cavities stay", "    return ~outside[1:-1, 1:-1, 1:-1]", "    return mask", f"{LABELS} -k cavities"),
        ("sides swapped unnoticed", "if left > right:", "if left > 2 * right:", f"{LABELS} -k wrong_way"),
    ],
    "mpitled/meshing/labels.py": [
        ("void at the skull", 'replaceable = parts["tissue"] & head.interior',
         'replaceable = parts["tissue"] & head.solid',
         LABELS),
    ],
    "mpitled/meshing/head.py": [
        ("repairs with the emptiest cube", "-1.0, np.pad(share, 1)", "-1.0, 1 - np.pad(share, 1)",
         f"{LABELS} -k random"),
    ],
    "mpitled/store/partitions.py": [
        ("each rank owns all nodes", "(rows >= first_row) & (rows < end_row)", "rows >= 0", f"{STORE} -k parts_are"),
    ],
    "mpitled/store/files.py": [
        ("damage passes", 'item.attrs["checksum"] != checksum_of(item)', "False", f"{RESUME} -k damaged"),
        ("rows of gaps", "rows[first:last] - start, axis=0", "rows[first:last] - start - 1, axis=0",
         f"{STORE} -k rows_are"),
    ],
    "mpitled/store/checkpoints.py": [
        ("no checkpoint before the last", "os.replace(path, previous)", "path.unlink()", f"{RESUME} -k one_before"),
        ("nodes in the file's order", "rows)[order] for name", "rows) for name", f"{RESUME} -k any_order"),
    ],
    "mpitled/checksum.py": [
        ("places do not count", "_STEPS[: len(block)] + np", "0 * _STEPS[: len(block)] + np", f"{RESUME} -k checksum"),
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
                if file.split("/")[1] in ("kernels", "cells", "laws"):
                    for made in {*Path(environment["NUMBA_CACHE_DIR"]).glob("mpitled-*")} - caches:
                        shutil.rmtree(made)
            print(f"{time.perf_counter() - begin:6.0f} s  {file}: {name}: {result}", flush=True)
            found.setdefault(result.split()[0], []).append(name)
    print(", ".join(f"{len(names)} {result}" for result, names in found.items()))
    return 1 if found.keys() - {"killed", "slow", "can"} else 0


if __name__ == "__main__":
    sys.exit(main())
