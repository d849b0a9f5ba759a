"""Compiled functions, with numba.

The filter along the track (`railfix.kernels.tracking`) stands here alone. A function of arrays of single epochs that is
worth compiling stands in numpy where it belongs and is decorated with `compiled_by`, which names a module of this
package that has a function of the same name, arguments and results. The numpy function is the reference, and tests hold
both equal; it runs where the environment variable ``RAILFIX_KERNELS`` says ``numpy``. ``run.json`` names the choice
("kernels").

Modules of this package are imported at the first call of one of their functions. They see arrays and numbers alone, and
import nothing of railfix but this package and `railfix.core`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, wraps
from importlib import import_module
from importlib.metadata import version
from typing import Any, Final, Literal, ParamSpec, TypeVar

from railfix.core.errors import SettingsError

#: Environment variable that chooses the form of the stages of single epochs: "numba" (as if not set) or "numpy".
VARIABLE: Final = "RAILFIX_KERNELS"
#: The compiled function of the filter.
FILTER: Final = "advance"

Arguments = ParamSpec("Arguments")
Returned = TypeVar("Returned")


def choose(asked: str) -> Literal["numpy", "numba"]:
    """Return the form of the stages of single epochs.

    Parameters
    ----------
    asked : str
        Value of `VARIABLE`; empty where it is not set.

    Raises
    ------
    SettingsError
        The value is unknown.
    """
    if asked not in ("", "numpy", "numba"):
        raise SettingsError(f"{VARIABLE} is {asked!r}, expected numpy or numba")
    return "numpy" if asked == "numpy" else "numba"


#: Form of the stages of single epochs in this process.
CHOSEN: Final = choose(os.environ.get(VARIABLE, ""))
#: Compiled functions by the name of their reference, as (reference, module of this package).
REGISTERED: Final[dict[str, tuple[Callable[..., Any], str]]] = {}


def kernels_in_use() -> str:
    """Return the kernels of this process in words: numba with its version, "numpy" in front where stages run in it."""
    of_numba = f"numba {version('numba')}"
    return of_numba if CHOSEN == "numba" else f"numpy, filter {of_numba}"


@cache
def compiled(name: str) -> Callable[..., Any]:
    """Return the compiled function of a registered name; imports numba and its module of this package."""
    function: Callable[..., Any] = getattr(import_module(f"railfix.kernels.{REGISTERED[name][1]}"), name)
    return function


def _import_all() -> Any:
    """Import all kernels, and return the module that compiles them."""
    for module in {"tracking.recursion", *(module for _, module in REGISTERED.values())}:
        import_module(f"railfix.kernels.{module}")
    return import_module("railfix.kernels.compiling")


def load() -> int:
    """Load all compiled functions, so that none is loaded while epochs wait; return how many.

    Those that this machine has no code of (`missing`) are compiled at their first call.
    """
    loaded: int = _import_all().load()
    return loaded


def missing() -> list[str]:
    """Return the names of the functions in use that this machine has no code of."""
    names: list[str] = _import_all().missing()
    return names if CHOSEN == "numba" else [name for name in names if name == FILTER]


def announced() -> None:
    """Leave the line that tells of compilation away: the caller has told it."""
    import_module("railfix.kernels.compiling").ANNOUNCEMENT.said = True


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
