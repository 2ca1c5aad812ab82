"""What the report says of a run itself."""

from __future__ import annotations

import resource
from collections.abc import Mapping
from dataclasses import dataclass

from mpitled.parallel.halo import Halo
from mpitled.solver.integrator import Integrator
from mpitled.solver.monitor import RATIOS, Monitor
from mpitled.terms.cell_forces import CellForces


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFigures:
    """Figures of a run at full load; times in s, energies in J."""

    ranks: int
    steps: int
    resumed_at_step: int
    time_step_s: float
    recoveries: int
    seconds: dict[str, float]  # of each phase
    term_seconds: dict[str, float]  # of each term of the loop
    cells: dict[str, int]
    nodes: int
    cell_updates_per_second: float
    halo_share: float  # of the loop, on the rank with the most
    imbalance: float  # the longest computing time of a rank over the mean, less 1
    peak_memory_bytes: list[int]  # of each rank
    min_jacobian: float  # of all steps
    added_mass_kg: float
    energy_J: dict[str, float]
    kinetic_to_internal: dict[str, float]


def run_figures(
    integrator: Integrator,
    monitor: Monitor,
    halo: Halo | None,
    *,
    resumed_at_step: int,
    n_rollbacks: int,
    seconds: Mapping[str, float],
    term_seconds: Mapping[str, float],
) -> RunFigures:
    """Figures of all ranks. halo: of the forces; seconds: by phase, with that of the "loop". Collective."""
    state, rows, world = integrator.state, integrator.sub.rows, integrator.world
    loop = max(seconds["loop"], 1e-9)
    halo_seconds = sum(halo.seconds.values()) if halo else 0.0
    of_cells = {term.name for term in integrator.step.terms if isinstance(term, CellForces)}
    computing = sum(term_seconds.get(name, 0.0) for name in of_cells)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    hexahedra, domains, halo_shares, computed, peaks = world.gather(
        [rows.n_own_hexahedra, rows.n_own_domains, halo_seconds / loop, computing, peak]
    ).T
    ledger = monitor.ledger
    figures = monitor.figures or dict.fromkeys((*(f.name for f in ledger.figures), *RATIOS), float("nan"))
    return RunFigures(
        ranks=world.size,
        steps=state.step,
        resumed_at_step=resumed_at_step,
        time_step_s=state.time_step,
        recoveries=n_rollbacks,
        seconds=dict(seconds),
        term_seconds=dict(term_seconds),
        cells={"hexahedra": int(hexahedra.sum()), "support_domains": int(domains.sum())},
        nodes=rows.n_nodes,
        cell_updates_per_second=(hexahedra.sum() + domains.sum()) * (state.step - resumed_at_step) / loop,
        halo_share=float(halo_shares.max()),
        imbalance=float(computed.max() / max(computed.mean(), 1e-9) - 1),
        peak_memory_bytes=[int(p) for p in peaks],
        min_jacobian=figures["min_jacobian"],
        added_mass_kg=figures["added_mass_kg"],
        energy_J=ledger.report(figures),
        kinetic_to_internal={
            "largest_after_10_percent": monitor.largest_kinetic_ratio,
            "at_end": figures["kinetic_ratio"],
        },
    )
