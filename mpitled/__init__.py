"""Brain deformation by tumour growth: coupled FE/EFG, Total Lagrangian Explicit Dynamics, on MPI ranks."""

__version__ = "0.1.0"
