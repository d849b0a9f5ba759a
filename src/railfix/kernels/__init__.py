"""Numba-compiled functions on arrays for the along-track filter and for single-epoch positioning.

A module of this package is imported when one of its functions is first used, because numba takes half a second to load.
The functions operate only on arrays and numbers. Of railfix, the modules import only `railfix.core` and this package.
With ``NUMBA_DISABLE_JIT=1`` in the environment, the functions are plain Python, for a debugger and for tests.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from railfix.kernels import hypotheses, level, model, off_tangent, ranges, reading, robust, screens, search, windows

__all__ = ["hypotheses", "level", "model", "off_tangent", "ranges", "reading", "robust", "screens", "search", "windows"]

#: Modules with the kernels of the along-track filter.
_FILTER_MODULES: Final = ("tracking.recursion", "tracking.velocity")


def __getattr__(name: str) -> Any:
    """Import a kernel module at its first use."""
    if name not in __all__:
        raise AttributeError(f"module 'railfix.kernels' has no attribute {name!r}")
    return import_module(f"railfix.kernels.{name}")


def numba_version() -> str:
    """Return the name and version of numba."""
    return f"numba {version('numba')}"


def _import_all() -> Any:
    """Import all kernels, and return the module that compiles them."""
    for module in (*_FILTER_MODULES, *__all__):
        import_module(f"railfix.kernels.{module}")
    return import_module("railfix.kernels.compiling")


def load() -> None:
    """Load the machine code of all kernels in advance, so that loading does not delay an epoch."""
    _import_all().load()


def is_compiled() -> bool:
    """Return True if the machine code of all kernels is stored on this machine.

    Kernels without stored machine code are compiled at their first call.
    """
    compiled: bool = _import_all().is_compiled()
    return compiled


def record_compiled() -> None:
    """Record that this process has compiled all kernels, and the argument types used."""
    _import_all().record_compiled()
