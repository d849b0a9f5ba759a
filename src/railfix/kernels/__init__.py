"""Compiled alternatives to the hottest functions of arrays, with numba (``pip install railfix[fast]``).

A function of arrays that is worth compiling stands in numpy where it belongs and is decorated with `compiled_by`, which
names a module of this package that has a function of the same name, arguments and results. The numpy function is the
reference: it is what runs without numba, and tests hold both equal. Which of the two run is chosen once, when this
package is imported: the compiled ones where numba is installed, unless the environment variable ``RAILFIX_KERNELS``
says ``numpy``; ``numba`` asks for them and fails where they cannot run. ``run.json`` names the choice ("kernels").

Modules of this package are imported at the first call of one of their functions, so that numba costs nothing where it
is not used. They see arrays and numbers alone, and import nothing of railfix but this package and `railfix.core`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, wraps
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any, Final, Literal, ParamSpec, TypeVar

from railfix.core.errors import SettingsError

#: Environment variable that chooses the kernels: "auto" (as if not set), "numpy" or "numba".
VARIABLE: Final = "RAILFIX_KERNELS"

Arguments = ParamSpec("Arguments")
Returned = TypeVar("Returned")


def choose(asked: str, *, installed: bool) -> Literal["numpy", "numba"]:
    """Return the kernels to run.

    Parameters
    ----------
    asked : str
        Value of `VARIABLE`; empty where it is not set.
    installed : bool
        Whether numba is.

    Raises
    ------
    SettingsError
        The value is unknown, or asks for numba where it is not installed.
    """
    if asked not in ("", "auto", "numpy", "numba"):
        raise SettingsError(f"{VARIABLE} is {asked!r}, expected auto, numpy or numba")
    if asked == "numba" and not installed:
        raise SettingsError(f"{VARIABLE} asks for numba, which is not installed; pip install 'railfix[fast]'")
    return "numba" if installed and asked != "numpy" else "numpy"


#: Kernels of this process.
CHOSEN: Final = choose(os.environ.get(VARIABLE, ""), installed=find_spec("numba") is not None)
#: Compiled functions by the name of their reference, as (reference, module of this package).
REGISTERED: Final[dict[str, tuple[Callable[..., Any], str]]] = {}


def kernels_in_use() -> str:
    """Return the kernels of this process in words: "numpy", or "numba" with its version."""
    return CHOSEN if CHOSEN == "numpy" else f"numba {version('numba')}"


@cache
def compiled(name: str) -> Callable[..., Any]:
    """Return the compiled function of a registered name; imports numba and its module of this package."""
    function: Callable[..., Any] = getattr(import_module(f"railfix.kernels.{REGISTERED[name][1]}"), name)
    return function


def load() -> int:
    """Load all compiled functions, so that none is loaded while epochs wait; return how many, 0 with numpy.

    Those that have never run on this machine (`missing`) are compiled at their first call.
    """
    if CHOSEN == "numpy":
        return 0
    for module in {"tracking.recursion", *(module for _, module in REGISTERED.values())}:
        import_module(f"railfix.kernels.{module}")
    loaded: int = import_module("railfix.kernels.compiling").load()
    return loaded


def missing() -> list[str]:
    """Return the names of the compiled functions that `load` found nothing of; none with numpy."""
    if CHOSEN == "numpy":
        return []
    names: list[str] = import_module("railfix.kernels.compiling").missing()
    return names


def compiled_by(module: str) -> Callable[[Callable[Arguments, Returned]], Callable[Arguments, Returned]]:
    """Return a decorator that runs the function of the same name in a module of this package, where numba is chosen.

    The decorated function takes arrays and numbers by position and returns arrays, as the compiled one does.
    ``__wrapped__`` of the result is the reference.

    Parameters
    ----------
    module : str
        Name within this package.
    """

    def decorate(reference: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
        name = reference.__name__
        if name in REGISTERED:
            raise ValueError(f"a kernel {name} is registered already, by {REGISTERED[name][0].__module__}")
        REGISTERED[name] = (reference, module)

        @wraps(reference)
        def chosen(*arguments: Arguments.args, **named: Arguments.kwargs) -> Returned:
            function = reference if CHOSEN == "numpy" else compiled(name)
            result: Returned = function(*arguments, **named)
            return result

        return chosen

    return decorate
