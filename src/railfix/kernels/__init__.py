"""Compiled functions of arrays, with numba: the filter along the track, and the stages of single epochs.

A module of this package is imported when one of its functions is first asked for (``kernels.ranges.misfits``): numba
takes half a second to load. They see arrays and numbers alone, and import nothing of railfix but this package and
`railfix.core`. With ``NUMBA_DISABLE_JIT=1`` they are plain Python, for a debugger and for tests.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from railfix.kernels import hypotheses, level, model, off_tangent, ranges, reading, robust, screens, search, windows

__all__ = ["hypotheses", "level", "model", "off_tangent", "ranges", "reading", "robust", "screens", "search", "windows"]

#: The compiled function of the filter.
FILTER: Final = "advance"
#: Environment variable of the process that compiles the filter alone: it leaves the kernels of single epochs as Python.
FILTER_ALONE: Final = "RAILFIX_COMPILE_FILTER_ALONE"
#: Where the recursion of the filter is.
_FILTER_MODULE: Final = "tracking.recursion"
#: Where the velocities are that it takes.
_VELOCITY_MODULE: Final = "tracking.velocity"


def __getattr__(name: str) -> Any:
    """Import a module of kernels at its first use."""
    if name not in __all__:
        raise AttributeError(f"module 'railfix.kernels' has no attribute {name!r}")
    return import_module(f"railfix.kernels.{name}")


def numba_version() -> str:
    """Return numba with its version."""
    return f"numba {version('numba')}"


def _import_all() -> Any:
    """Import all kernels, and return the module that compiles them."""
    for module in (_FILTER_MODULE, _VELOCITY_MODULE, *__all__):
        import_module(f"railfix.kernels.{module}")
    return import_module("railfix.kernels.compiling")


def load() -> int:
    """Load all compiled functions, so that none is loaded while epochs wait; return how many.

    Those that this machine has no code of (`missing`) are compiled at their first call.
    """
    loaded: int = _import_all().load()
    return loaded


def missing() -> list[str]:
    """Return the names of the functions that this machine has no code of."""
    names: list[str] = _import_all().missing()
    return names


def suppress_announcement() -> None:
    """Leave out the line on compilation: the caller has printed it."""
    import_module("railfix.kernels.compiling").ANNOUNCEMENT.said = True
