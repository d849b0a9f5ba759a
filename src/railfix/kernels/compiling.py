"""Compilation with numba, and cache of the machine code on disk.

The cache is in ``NUMBA_CACHE_DIR`` if it is set, otherwise in the source folder, or in the user's cache folder if the
source folder is not writable. numba recompiles a function only when the file that defines the function changes.
`_remove_outdated` therefore also checks the files of the functions that a function calls.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import pickle
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba
import numpy as np

from railfix.core.errors import SettingsError
from railfix.core.staged_files import stage_file

Function = TypeVar("Function", bound=Callable[..., Any])
#: Compiled functions of the imported modules.
COMPILED: Final[list[Any]] = []
#: Options of numba: divisions by zero result in infinity or NaN, as in numpy, and multiply-adds may be fused.
OPTIONS: Final[dict[str, Any]] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}
_PACKAGE: Final = Path(__file__).parent


def is_plain() -> bool:
    """Return True if kernels remain plain Python."""
    return os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")


def kernel(function: Function) -> Function:
    """Compile a function on arrays at its first call, to run without the interpreter lock, and cache the machine code.

    With ``NUMBA_DISABLE_JIT=1``, the function remains plain Python.

    Raises
    ------
    SettingsError
        If no cache folder is writable.
    """
    if is_plain():
        # Integer overflow, division by zero and NaN are intended, and cause no warnings in machine code.
        return np.errstate(all="ignore")(function)
    try:
        compiled = numba.njit(cache=True, **OPTIONS)(function)
    except RuntimeError as error:
        raise SettingsError(
            f"compiled kernels cannot be stored on disk ({error}); set NUMBA_CACHE_DIR to a folder that can be "
            "written, or NUMBA_DISABLE_JIT=1 (a hundred times slower)"
        ) from error
    _remove_outdated(Path(compiled.stats.cache_path), function.__module__.removeprefix("railfix.kernels."))
    COMPILED.append(compiled)
    return cast(Function, compiled)


def inner(function: Function) -> Function:
    """Compile a function that only kernels call, as part of the calling kernels."""
    if is_plain():
        return function
    return cast(Function, numba.njit(**OPTIONS)(function))


def inlined(function: Function) -> Function:
    """Compile a small function into its callers (`inline` of numba).

    An ordinary call counts references to array arguments, which takes longer than the small function itself.
    """
    if is_plain():
        return function
    return cast(Function, numba.njit(inline="always", **OPTIONS)(function))


@cache
def _files(package: Path, module: str) -> set[Path]:
    """Return the files of a module or subpackage, and all files of `railfix.kernels` that these files import."""
    path = package / f"{module.replace('.', '/')}.py"
    if not path.exists():
        return set(path.with_suffix("").glob("*.py"))
    imported = re.findall(r"^from railfix\.kernels\.([\w.]+) import", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {path}.union(*(_files(package, name) for name in imported))


@cache
def _tuples(package: Path) -> bytes:
    """Return the named tuples of each file; numba cannot load cached code for a tuple class that changed its file."""
    named = re.compile(rb"^class \w+\(NamedTuple\)", re.MULTILINE)
    files = ((path, named.findall(path.read_bytes())) for path in sorted(package.parent.rglob("*.py")))
    return b"\n".join(
        b" ".join([str(path.relative_to(package.parent)).encode(), *found]) for path, found in files if found
    )


@cache
def compute_stamp(package: Path, module: str) -> str:
    """Return a hash of the source files, constants and named tuples on which a module's machine code depends."""
    files = [*sorted(_files(package, module)), package.parent / "core" / "constants.py"]
    return hashlib.sha256(b"".join([*(path.read_bytes() for path in files), _tuples(package)])).hexdigest()


@cache
def _remove_outdated(folder: Path, module: str) -> None:
    """Remove a module's machine code from a numba cache folder if it was compiled from different sources."""
    stamp, file = compute_stamp(_PACKAGE, module), folder / f"{module}.sha256"
    if file.exists() and file.read_text(encoding="ascii") == stamp:
        return
    announce_compilation()
    for code in folder.glob(f"{module.rpartition('.')[2]}.*.nb?"):
        code.unlink(missing_ok=True)
    with stage_file(file, what="stamp of compiled kernels") as temporary:
        temporary.write_text(stamp, encoding="ascii")


@cache
def announce_compilation() -> None:
    """Report once, if standard error is a terminal, that kernels are being compiled."""
    if sys.stderr.isatty() and multiprocessing.parent_process() is None:
        sys.stderr.write("compiling kernels for this processor once: about a minute\n")


def _name(function: Any) -> str:
    return f"{function.py_func.__module__}.{function.py_func.__name__}"


def _record_file() -> Path:
    """Return the path of the record of argument types for the present sources of all kernels."""
    modules = sorted({function.py_func.__module__.removeprefix("railfix.kernels.") for function in COMPILED})
    stamps = [compute_stamp(_PACKAGE, module) for module in modules]
    name = hashlib.sha256("".join([*stamps, numba.__version__, sys.version]).encode()).hexdigest()
    return Path(min(function.stats.cache_path for function in COMPILED)) / f"compiled-{name[:16]}.pickle"


def record_compiled() -> None:
    """Record the argument types for which this process has compiled the kernels."""
    if not COMPILED:  # the kernels remain plain Python
        return
    file = _record_file()
    for earlier in file.parent.glob("compiled-*.pickle"):
        earlier.unlink(missing_ok=True)
    with stage_file(file, what="record of compiled kernels") as temporary:
        temporary.write_bytes(pickle.dumps({_name(function): function.signatures for function in COMPILED}))


def is_compiled() -> bool:
    """Return True if all kernels of these sources have been compiled on this machine, or remain plain Python."""
    return not COMPILED or _record_file().exists()


def load() -> None:
    """Load the machine code of all kernels if it is complete; otherwise, kernels are compiled at their first call."""
    if not COMPILED or not is_compiled():
        return
    types = pickle.loads(_record_file().read_bytes())
    for function in COMPILED:
        for signature in types[_name(function)]:
            function.compile(signature)
