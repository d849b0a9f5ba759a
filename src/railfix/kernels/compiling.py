"""Compilation with numba, the machine code kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numba

from railfix.core.errors import SettingsError

Function = TypeVar("Function", bound=Callable[..., Any])
#: Compiled functions of the modules that are imported.
COMPILED: Final[list[Any]] = []


def kernel(function: Function) -> Function:
    """Compile a function of arrays at its first call, without the interpreter lock, and keep the code on disk.

    Divisions by zero give infinities and NaN as numpy's do. The code is kept beside the source, or in the user's cache
    folder where that cannot be written, or in ``NUMBA_CACHE_DIR``.

    Raises
    ------
    SettingsError
        None of these folders can be written.
    """
    try:
        made = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError as error:
        raise SettingsError(
            f"compiled kernels cannot be kept on disk ({error}); set NUMBA_CACHE_DIR to a folder that can be "
            "written, or RAILFIX_KERNELS=numpy"
        ) from error
    COMPILED.append(made)
    return cast(Function, made)


def load() -> int:
    """Load the code on disk of all functions of `COMPILED`; return how many types of arguments it is for.

    numba has no call for this: the index of its cache names them.
    """
    loaded = 0
    for function in COMPILED:
        for signature, *_ in function._cache._cache_file._load_index():
            function.compile(signature)
            loaded += 1
    return loaded
