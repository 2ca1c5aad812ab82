"""Kernels as templates: written once for all constitutive laws, and compiled for the one that a scene has."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

from numba import njit
from numba.core import config

from mpitled.kernels.lanes import FAST
from mpitled.laws import Law

#: Number of the law's coefficients in a compiled template.
N_COEFFICIENTS = 0

_PACKAGE = Path(__file__).parents[1]


def law_stress(F, K, J, c):  # type: ignore[no-untyped-def]
    """`Law.stress` in a compiled template."""
    raise NotImplementedError


def law_energy(H, F, K, J, c):  # type: ignore[no-untyped-def]
    """`Law.energy` in a compiled template."""
    raise NotImplementedError


def law_tangent_bound(F, K, J, c):  # type: ignore[no-untyped-def]
    """`Law.tangent_bound` in a compiled template."""
    raise NotImplementedError


@contextmanager
def cached_by_source() -> Iterator[None]:
    """Numba's cache on the disk, apart for each state of the sources of kernels.

    Numba itself does not see a change in a module that a kernel imports.
    """
    settings: Any = config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(Path(before or _PACKAGE / "kernels" / "__pycache__") / f"mpitled-{_digest()}")
    try:
        yield
    finally:
        settings.CACHE_DIR = before


@cache
def _digest() -> str:
    digest = hashlib.sha256()
    for folder in ("kernels", "cells", "laws"):
        for path in sorted((_PACKAGE / folder).glob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def inline(function: Any) -> Any:
    """Decorator of a function that kernels call."""
    with cached_by_source():
        return njit(fastmath=FAST, error_model="numpy", cache=True, forceinline=True)(function)


def kernel(function: Any) -> Any:
    """Decorator of a kernel that knows no law."""
    with cached_by_source():
        return njit(fastmath=FAST, error_model="numpy", cache=True, nogil=True)(function)


def inline_template(function: Any) -> Any:
    """Decorator of a function that a kernel template calls, and that calls the law's formulas itself.

    It calls them by the names `law_stress`, `law_energy` and `law_tangent_bound`, and counts `N_COEFFICIENTS`.
    """
    function.__dict__["is_inline_template"] = True
    return function


class CompiledKernel:
    """A kernel of cells; calls go through this class so that a dry run can trace them."""

    __slots__ = ("function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function: Any = function

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


@cache
def compile_for(template: Any, law: type[Law]) -> CompiledKernel:
    """The kernel of a template with the formulas of a law.

    The functions are those of the modules with other globals, and not closures: numba finds closures in its cache on
    the disk in no later process.
    """
    formulas = {f"law_{name}": inline(getattr(law, name)) for name in ("stress", "energy", "tangent_bound")}
    names = formulas | {"N_COEFFICIENTS": law.n_coefficients}
    return CompiledKernel(kernel(_with_globals(template, law, names)))


def _with_globals(function: FunctionType, law: type[Law], names: dict[str, Any]) -> FunctionType:
    """The function with these global names, and with the inline templates that it calls compiled for them."""
    own = function.__globals__
    called = {
        name: inline(_with_globals(own[name], law, names))
        for name in function.__code__.co_names
        if getattr(own.get(name), "is_inline_template", False)
    }
    made = FunctionType(function.__code__, own | names | called, function.__name__, function.__defaults__)
    made.__qualname__ = f"{function.__qualname__}_{law.name.replace('-', '_')}"
    made.__module__ = function.__module__
    made.__doc__ = function.__doc__
    return made
