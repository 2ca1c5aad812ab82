"""Kernels of nodes: updates, masses, work and energy, the power iteration, and buffers of the halo."""

from __future__ import annotations

import numpy as np
from numba import njit
from numba import uint64 as U

from mpitled.kernels.templates import inline, kernel
from mpitled.kernels.tensors import cofactor


@njit(cache=True)
def rotate_prescribed(path, full, turns, amplitude):  # type: ignore[no-untyped-def]
    """path (n,) <- displacements, m, of dofs on the arcs of `loading.turn` at a share of the full load."""
    for p in range(path.size):
        angle, arm, across = turns[p, 0], turns[p, 1], turns[p, 2]
        arc = (np.cos(amplitude * angle) - 1) * arm + np.sin(amplitude * angle) * across
        end = (np.cos(angle) - 1) * arm + np.sin(angle) * across
        path[p] = amplitude * (full[p] - end) + arc


@kernel
def reaction_work(u, u_prev, f, dt2_over_m, dofs, full, amplitude, reaction):  # type: ignore[no-untyped-def]
    """Work (J) of the reactions at moving dofs over the last step, by the trapezoidal rule; renews the reactions.

    A reaction is f + m a, where a is the central difference with the next prescribed displacement (4.2.1: the displaced
    nodes take u_max d(t + dt)). If dt2_over_m (dt^2 / m, s^2/kg) is None, prescribed dofs have no mass. dofs, full
    (n,): 3 node + direction, and m at full load.
    """
    work = 0.0
    for p in range(dofs.size):
        node = dofs[p] // 3
        c = dofs[p] % 3
        now = u[c, node]
        before = u_prev[c, node]
        r = f[c, node]
        if dt2_over_m is not None:
            r += (amplitude * full[p] - 2 * now + before) / dt2_over_m[node]
        work += 0.5 * (r + reaction[p]) * (now - before)
        reaction[p] = r
    return work


@inline
def _prescribe(u, fixed, dofs, full, amplitude, copied):  # type: ignore[no-untyped-def]
    for p in range(fixed.size):
        u[fixed[p] % 3, fixed[p] // 3] = 0
        if copied is not None:
            copied[fixed[p] % 3, fixed[p] // 3] = 0
    for p in range(dofs.size):
        u[dofs[p] % 3, dofs[p] // 3] = amplitude * full[p]
        if copied is not None:
            copied[dofs[p] % 3, dofs[p] // 3] = amplitude * full[p]


@kernel
def update(u, u_prev, f, dt2_over_m, fixed, dofs, full, amplitude, copied):  # type: ignore[no-untyped-def]
    """The central difference (eq. 3.3, with the square on dt that 3.2 lacks), then the prescribed dofs; clears f.

    dt2_over_m (n_nodes,) is dt^2 / m, s^2/kg. The new displacements overwrite u_prev; the caller swaps the two.
    fixed (n,) are the dofs that stay; dofs and full (m,) those that move. copied, if given, receives the new
    displacements in its own precision: the accelerations of a slow ramp would be lost in single precision.
    """
    for c in range(3):
        now = u[c]
        before = u_prev[c]
        fc = f[c]
        for n in range(U(dt2_over_m.size)):
            after = (now[n] - before[n]) + now[n] - dt2_over_m[n] * fc[n]
            before[n] = after
            fc[n] = 0
            if copied is not None:
                copied[c, n] = after
    _prescribe(u_prev, fixed, dofs, full, amplitude, copied)


@inline
def times(tensor, n, x, y, z):  # type: ignore[no-untyped-def]
    """Scalar n of (1, :), or symmetric tensor n of (6, :: xx, xy, xz, yy, yz, zz), times a vector."""
    if tensor.shape[0] == 1:
        m = tensor[0, n]
        return m * x, m * y, m * z
    return (
        tensor[0, n] * x + tensor[1, n] * y + tensor[2, n] * z,
        tensor[1, n] * x + tensor[3, n] * y + tensor[4, n] * z,
        tensor[2, n] * x + tensor[4, n] * y + tensor[5, n] * z,
    )


@kernel
def relax(u, u_prev, f, dt2_over_m, counted, fixed, dofs, full, amplitude, c1, c2, copied):  # type: ignore[no-untyped-def]
    """As `update`, with damping, and with scalars dt2_over_m (1, n_nodes) or tensors (6, n_nodes).

    u+ = u + c1 (u - u_prev) - c2 dt2_over_m f; with damping c per step c1 = (2 - c) / (2 + c), c2 = 2 / (2 + c).
    Returns the work (J) of the internal forces where counted (3, n_nodes) is true: each force times the mean of the
    steps before and after it.
    """
    half = 0.5
    work = 0.0
    for n in range(U(counted.shape[1])):
        fx = f[0, n]
        fy = f[1, n]
        fz = f[2, n]
        x = u[0, n] + c1 * (u[0, n] - u_prev[0, n])
        y = u[1, n] + c1 * (u[1, n] - u_prev[1, n])
        z = u[2, n] + c1 * (u[2, n] - u_prev[2, n])
        mx, my, mz = times(dt2_over_m, n, fx, fy, fz)
        x -= c2 * mx
        y -= c2 * my
        z -= c2 * mz
        work += half * (
            counted[0, n] * fx * (x - u_prev[0, n])
            + counted[1, n] * fy * (y - u_prev[1, n])
            + counted[2, n] * fz * (z - u_prev[2, n])
        )
        u_prev[0, n] = x
        u_prev[1, n] = y
        u_prev[2, n] = z
        f[0, n] = 0
        f[1, n] = 0
        f[2, n] = 0
        if copied is not None:
            copied[0, n] = x
            copied[1, n] = y
            copied[2, n] = z
    _prescribe(u_prev, fixed, dofs, full, amplitude, copied)
    return work


@njit(cache=True)
def change_step(u, u_prev, f, dt2_over_m, ratio):  # type: ignore[no-untyped-def]
    """Rewrite u_prev so that `update`, with the dt2_over_m of the new step, takes a step `ratio` times the last one.

    That is u+ = u + r (u - u_prev) - (1 + 1 / r) / 2 dt2_over_m f, the central difference with a variable step.
    """
    factor = 0.5 * (1 + 1 / ratio)
    for c in range(3):
        for n in range(dt2_over_m.size):
            now = u[c, n]
            u_prev[c, n] = now - ratio * (now - u_prev[c, n]) + (factor - 1) * dt2_over_m[n] * f[c, n]


@kernel
def kinetic_energy(u, u_prev, f, dt2_over_m, counted, held):  # type: ignore[no-untyped-def]
    """Kinetic energy (J) of the counted nodes at the middle of the two half steps around u.

    held (n,) are the prescribed dofs. Forces do not move them; their energy is that of the last half step.
    """
    half = u.dtype.type(0.5)
    twice = 0.0
    for c in range(3):
        now = u[c]
        before = u_prev[c]
        fc = f[c]
        for n in range(U(dt2_over_m.size)):
            v = now[n] - before[n] - half * dt2_over_m[n] * fc[n]
            twice += counted[n] * v * v / dt2_over_m[n]
    for p in range(held.size):
        n = held[p] // 3
        c = held[p] % 3
        v = u[c, n] - u_prev[c, n]
        w = v - half * dt2_over_m[n] * f[c, n]
        twice += counted[n] * (v * v - w * w) / dt2_over_m[n]
    return 0.5 * twice


@njit(error_model="numpy", cache=True)
def raise_mass(u, u_prev, dt2_over_m, required, counted, time_step):  # type: ignore[no-untyped-def]
    """Raise the mass of each node to the required one (n,), kg; the added mass (kg) and energy (J) at counted nodes.

    The nodes keep their velocity, so that 1/2 dm v^2 is added to the system.
    """
    added = 0.0
    energy = 0.0
    for n in range(required.size):
        dm = required[n] - time_step * time_step / dt2_over_m[n]
        if dm > 0:
            dt2_over_m[n] = time_step * time_step / required[n]
            if counted[n]:
                added += dm
                for c in range(3):
                    v = (u[c, n] - u_prev[c, n]) / time_step
                    energy += 0.5 * dm * v * v
    return added, energy


@njit(cache=True)
def limit_mass_decrease(mass, required, free, least_share):  # type: ignore[no-untyped-def]
    """mass <- required, scalars (1, n) or symmetric tensors (6, n), without the parts of prescribed dofs.

    free (3, n) is true at free dofs. A mass does not fall below `least_share` of what it was: cells that oscillate
    stiffen again before the next check.
    """
    for n in range(required.shape[1]):
        x = 1.0 if free[0, n] else 0.0
        y = 1.0 if free[1, n] else 0.0
        z = 1.0 if free[2, n] else 0.0
        if required.shape[0] == 1:
            mass[0, n] = max(required[0, n] * max(x, y, z), least_share * mass[0, n])
            continue
        xx = required[0, n] * x
        yy = required[3, n] * y
        zz = required[5, n] * z
        trace = xx + yy + zz
        least = least_share * (mass[0, n] + mass[3, n] + mass[5, n])
        s = least / trace if 0 < trace < least else 1.0
        mass[0, n] = s * xx
        mass[1, n] = s * required[1, n] * x * y
        mass[2, n] = s * required[2, n] * x * z
        mass[3, n] = s * yy
        mass[4, n] = s * required[4, n] * y * z
        mass[5, n] = s * zz


@njit(cache=True)
def invert_masses(mass, free, dt2_over_m):  # type: ignore[no-untyped-def]
    """dt2_over_m <- the inverse of masses (1, n), or of tensors (6, n), at free dofs, and 0 at the others."""
    for n in range(mass.shape[1]):
        if mass.shape[0] == 1:
            dt2_over_m[0, n] = 1 / mass[0, n] if mass[0, n] > 0 else 0.0
            continue
        x = 1.0 if free[0, n] else 0.0
        y = 1.0 if free[1, n] else 0.0
        z = 1.0 if free[2, n] else 0.0
        # Prescribed dofs take part in the inverse as ones.
        xx = mass[0, n] * x + 1 - x
        yy = mass[3, n] * y + 1 - y
        zz = mass[5, n] * z + 1 - z
        xy = mass[1, n] * x * y
        xz = mass[2, n] * x * z
        yz = mass[4, n] * y * z
        k0, k1, k2, _, k4, k5, _, _, k8, determinant = cofactor(xx, xy, xz, xy, yy, yz, xz, yz, zz)
        dt2_over_m[0, n] = x * k0 / determinant
        dt2_over_m[1, n] = x * y * k1 / determinant
        dt2_over_m[2, n] = x * z * k2 / determinant
        dt2_over_m[3, n] = y * k4 / determinant
        dt2_over_m[4, n] = y * z * k5 / determinant
        dt2_over_m[5, n] = z * k8 / determinant


@njit(cache=True)
def relaxation_norms(u, u_prev, f, mass, dt2_over_m, counted, u_last, f_last):  # type: ignore[no-untyped-def]
    """Energies and norms of a relaxation at dofs where counted (3, n) is true; renews u_last and f_last (3, n).

    Returns the kinetic energy; the work of the forces in the last half step (`relax` counts it with the next step);
    numerator and denominator of Rayleigh's quotient du . df / du . M du of the changes since u_last and f_last; the
    largest change in the last step, m; and the largest M^-1 f, m (the unit of time is a step).
    """
    kinetic = 0.0
    work = 0.0
    numerator = 0.0
    denominator = 0.0
    change = 0.0
    residual = 0.0
    for n in range(counted.shape[1]):
        x = counted[0, n]
        y = counted[1, n]
        z = counted[2, n]
        vx = x * (u[0, n] - u_prev[0, n])
        vy = y * (u[1, n] - u_prev[1, n])
        vz = z * (u[2, n] - u_prev[2, n])
        dx = x * (u[0, n] - u_last[0, n])
        dy = y * (u[1, n] - u_last[1, n])
        dz = z * (u[2, n] - u_last[2, n])
        fx = x * f[0, n]
        fy = y * f[1, n]
        fz = z * f[2, n]
        mx, my, mz = times(mass, n, vx, vy, vz)
        kinetic += 0.5 * (mx * vx + my * vy + mz * vz)
        work += 0.5 * (fx * vx + fy * vy + fz * vz)
        numerator += dx * (fx - f_last[0, n]) + dy * (fy - f_last[1, n]) + dz * (fz - f_last[2, n])
        mx, my, mz = times(mass, n, dx, dy, dz)
        denominator += mx * dx + my * dy + mz * dz
        change = max(change, vx * vx + vy * vy + vz * vz)
        ax, ay, az = times(dt2_over_m, n, fx, fy, fz)
        residual = max(residual, ax * ax + ay * ay + az * az)
        u_last[0, n] = u[0, n]
        u_last[1, n] = u[1, n]
        u_last[2, n] = u[2, n]
        f_last[0, n] = fx
        f_last[1, n] = fy
        f_last[2, n] = fz
    return kinetic, work, numerator, denominator, np.sqrt(change), np.sqrt(residual)


@kernel
def gather(values, nodes, some):  # type: ignore[no-untyped-def]
    """some (k, n) <- values (k, :) at the nodes (n,)."""
    for c in range(values.shape[0]):
        for i in range(U(nodes.size)):
            some[c, i] = values[c, nodes[i]]


@kernel
def add_gathered(values, nodes, some):  # type: ignore[no-untyped-def]
    """some (k, n) += values (k, :) at the nodes (n,)."""
    for c in range(values.shape[0]):
        for i in range(U(nodes.size)):
            some[c, i] += values[c, nodes[i]]


@kernel
def add(some, places, total):  # type: ignore[no-untyped-def]
    """total (k, :) at the places (n,) += some (k, n)."""
    for c in range(total.shape[0]):
        for i in range(U(places.size)):
            total[c, places[i]] += some[c, i]


@kernel
def scatter(some, nodes, values):  # type: ignore[no-untyped-def]
    """values (k, :) at the nodes (n,) <- some (k, n)."""
    for c in range(values.shape[0]):
        for i in range(U(nodes.size)):
            values[c, nodes[i]] = some[c, i]


@njit(cache=True)
def hash_random(mode, nodes):  # type: ignore[no-untyped-def]
    """mode (3, n) <- numbers in [-0.5, 0.5), a hash of the global node numbers (n,).

    They do not depend on the partition (the end of splitmix64; Steele, Lea and Flood 2014).
    """
    for c in range(3):
        for n in range(mode.shape[1]):
            x = np.uint64(3) * np.uint64(nodes[n]) + np.uint64(c) + np.uint64(0x9E3779B97F4A7C15)
            x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            x ^= x >> np.uint64(31)
            mode[c, n] = np.float64(x >> np.uint64(11)) * 2.0**-53 - 0.5


@njit(cache=True)
def perturb(u, mode, scale, u_cells):  # type: ignore[no-untyped-def]
    """u_cells (3, :) <- u + scale mode, at the nodes of mode (3, n).

    No fastmath: where u = 0, adding and subtracting the same must be exact.
    """
    for c in range(3):
        for n in range(U(mode.shape[1])):
            u_cells[c, n] = u[c, n] + scale * mode[c, n]


@kernel
def power_iteration(mode, f, at_rest, dt2_over_m, owned, reach, size):  # type: ignore[no-untyped-def]
    """An iteration: the mode (3, n), tried with the factor reach / size, becomes dt2_over_m times its response K mode.

    f, at_rest (3, :), N: forces with and without the mode. Returns sums over owned nodes, of response times mode over
    size and of response times the new mode; and the largest component of the new mode.
    """
    old = 0.0
    new = 0.0
    largest = 0.0
    per = 1 / reach
    for n in range(U(mode.shape[1])):
        x = per * (f[0, n] - at_rest[0, n])
        y = per * (f[1, n] - at_rest[1, n])
        z = per * (f[2, n] - at_rest[2, n])
        a, b, c = times(dt2_over_m, n, x, y, z)
        if owned[n]:
            old += mode[0, n] * x + mode[1, n] * y + mode[2, n] * z
            new += a * x + b * y + c * z
        largest = max(largest, max(abs(a), max(abs(b), abs(c))))
        mode[0, n] = a
        mode[1, n] = b
        mode[2, n] = c
    return old / size, new, largest
