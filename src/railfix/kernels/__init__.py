"""Functions on arrays, compiled with numba: the filter along the track, and the single-epoch stages.

A module of this package is imported at the first use of one of its functions (``kernels.ranges.misfits``), because
numba takes half a second to load. The functions operate on arrays and numbers only, and the modules import nothing of
railfix except this package and `railfix.core`. With ``NUMBA_DISABLE_JIT=1`` the functions are plain Python, for a
debugger and for tests.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from railfix.kernels import hypotheses, level, model, off_tangent, ranges, reading, robust, screens, search, windows

__all__ = ["hypotheses", "level", "model", "off_tangent", "ranges", "reading", "robust", "screens", "search", "windows"]

#: Modules with the kernels of the filter.
_FILTER_MODULES: Final = ("tracking.recursion", "tracking.velocity")


def __getattr__(name: str) -> Any:
    """Import a module of kernels at its first use."""
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
    """Load the machine code of all kernels, so that no epoch is delayed by loading."""
    _import_all().load()


def is_compiled() -> bool:
    """Return whether this machine has the machine code of all kernels; missing kernels are compiled at their first
    call.
    """
    compiled: bool = _import_all().is_compiled()
    return compiled


def record_compiled() -> None:
    """Record that this process has compiled all kernels, and their argument types."""
    _import_all().record_compiled()
