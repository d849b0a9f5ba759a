"""Compilation with numba, the machine code kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from railfix.core.errors import SettingsError

Function = TypeVar("Function", bound=Callable[..., Any])


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
        return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
    except RuntimeError as error:
        raise SettingsError(
            f"compiled kernels cannot be kept on disk ({error}); set NUMBA_CACHE_DIR to a folder that can be "
            "written, or RAILFIX_KERNELS=numpy"
        ) from error
