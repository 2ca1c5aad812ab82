"""Brain deformation by tumour growth: coupled FE/EFG, Total Lagrangian Explicit Dynamics, on MPI ranks.

In Python: `load_deck`, `build_model`, `run`, `open_result` and `open_sweep`, see `mpitled.interface`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mpitled.errors import InputError, InterruptedRun, MpitledError, UnstableError

if TYPE_CHECKING:
    from mpitled.deck import load_deck
    from mpitled.interface import build_model, open_result, open_sweep, run

__version__ = "0.1.0"
__all__ = [
    "InputError", "InterruptedRun", "MpitledError", "UnstableError", "__version__", "build_model", "load_deck",
    "open_result", "open_sweep", "run",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Modules come with the first use of what they hold: the command must start at once."""
    if name in __all__:
        from mpitled import interface

        return getattr(interface, name)
    raise AttributeError(f"module 'mpitled' has no attribute '{name}'")


def __dir__() -> list[str]:
    """For completion: what is meant to be used, though it has not been yet."""
    return sorted(__all__)
