"""Functions on arrays, compiled with numba, for the filter along the track and for the single-epoch stages.

A module of this package is imported when one of its functions is first used (``kernels.ranges.misfits``), because numba
takes half a second to load. The functions operate only on arrays and numbers. The modules import nothing of railfix
except this package and `railfix.core`. With ``NUMBA_DISABLE_JIT=1``, the functions are plain Python, for a debugger and
for tests.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from railfix.kernels import hypotheses, level, model, off_tangent, ranges, reading, robust, screens, search, windows

__all__ = ["hypotheses", "level", "model", "off_tangent", "ranges", "reading", "robust", "screens", "search", "windows"]

#: Modules that have the kernels of the filter along the track.
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
    """Load the machine code of all kernels now, so that loading delays no epoch."""
    _import_all().load()


def is_compiled() -> bool:
    """Return whether the machine code of all kernels is on this machine.

    Other kernels are compiled at the first call.
    """
    compiled: bool = _import_all().is_compiled()
    return compiled


def record_compiled() -> None:
    """Record that this process has compiled all kernels, and with which argument types."""
    _import_all().record_compiled()
