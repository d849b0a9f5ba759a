"""Compilation with numba, the machine code kept on disk; named tuples passed to inner functions as one pointer.

numba passes each number of each array of a tuple as an argument of its own: a thousand of them to the functions of the
filter, of which each uses a few. Most of the time of their compilation went into these.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import re
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba
import numpy as np
from llvmlite import binding, ir
from numba.core import cgutils, environment, event, types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.datamodel import models
from numba.core.environment import Environment
from numba.core.options import DefaultOptions
from numba.core.runtime.nrt import rtsys
from numba.core.targetconfig import ConfigStack
from numba.core.typed_passes import NativeLowering
from numba.core.types.functions import BaseFunction
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, register_model

from railfix.core.errors import SettingsError
from railfix.kernels import FILTER_ALONE

Function = TypeVar("Function", bound=Callable[..., Any])
Tuple = TypeVar("Tuple")
#: Compiled functions of the modules that are imported.
COMPILED: Final[list[Any]] = []
_SLOT: Final = ir.IntType(64)
#: A module without functions.
_NOTHING: Final = binding.parse_assembly("").as_bitcode()
#: Types of named tuples by the order in which they were met.
_KNOWN: Final[dict[Any, int]] = {}
_OPTIONS: Final[dict[str, Any]] = {
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
    "fastmath": {"contract"},  # products are added without a rounding between
}


def _finish_unbuilt(library: Any) -> None:
    """End a library of numba that callers take in as it is."""
    library._finalize_dynamic_globals()
    library._verify_declare_only_symbols()
    library._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)  # type: ignore[no-untyped-call]
class _LoweringForCallers(NativeLowering):
    """Lowers a function to what its callers take in, without machine code of its own, which nothing would run.

    It would be made again with every caller: a third of the time that the recursion of the filter takes to compile.
    """

    _name = "lowering_for_callers"

    def run_pass(self, state: Any) -> bool:
        """Lower without the last steps.

        numba knows a function by what it would run: here a method of a list that nobody else has.
        """
        state.flags.no_compile = True
        changed: bool = super().run_pass(state)  # type: ignore[no-untyped-call]
        library = state.library
        library._optimize_final_module = lambda: None
        library._finalize_final_module = lambda: _finish_unbuilt(library)
        state.cr = state.cr._replace(cfunc=[].append)
        state.targetctx.insert_user_function(state.cr.cfunc, state.cr.fndesc, [state.library])
        return changed


class _InnerCompiler(CompilerBase):
    """The passes of numba, with `_LoweringForCallers`."""

    def define_pipelines(self) -> list[PassManager]:
        """Return the passes."""
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)  # type: ignore[no-untyped-call]
        manager.passes = [(_LoweringForCallers if p is NativeLowering else p, text) for p, text in manager.passes]
        manager.finalize()
        return [manager]


#: Versions of numba whose inner workings `_InnerCompiler` and `_CodeOnDisk` are known to suit; others compile and load
#: in the usual way.
_SUITED: Final = ((0, 61), (0, 68))
_IS_SUITED: Final = _SUITED[0] <= tuple(int(part) for part in numba.__version__.split(".")[:2]) <= _SUITED[1]


@contextmanager
def keep_resolutions() -> Generator[None]:
    """Keep what numba finds for an operator or a function of its own and types of arguments.

    It would ask all implementations again at each use: a fifth of the time that compiling takes.
    """
    if not _IS_SUITED:
        yield
        return
    resolve = BaseFunction.get_call_type
    found: dict[Any, tuple[Any, Any]] = {}

    def resolve_once(self: Any, context: Any, args: Any, kws: Any) -> Any:
        # Of the options of a compilation only the counting of references differs between the kernels.
        counted = getattr(ConfigStack.top_or_none(), "nrt", None)  # type: ignore[no-untyped-call]
        key = (self.key, context, tuple(args), tuple(kws.items()), counted)
        known = found.get(key)
        if known is None:
            signature: Any = resolve(self, context, args, kws)
            known = found[key] = signature, self._impl_keys[signature.args]
        signature, self._impl_keys[signature.args] = known
        return signature

    BaseFunction.get_call_type = resolve_once  # type: ignore[method-assign]
    try:
        yield
    finally:
        BaseFunction.get_call_type = resolve  # type: ignore[method-assign]


#: The option is one of numba's own; a numba without it counts.
_UNCOUNTED: Final[dict[str, Any]] = {"_nrt": False} if hasattr(DefaultOptions, "_nrt") else {}
_INNER: Final[dict[str, Any]] = {
    "no_cpython_wrapper": True,
    **({"pipeline_class": _InnerCompiler} if _IS_SUITED else {}),
}


def kernel(function: Function) -> Function:
    """Compile a function of arrays at its first call, without the interpreter lock, and keep the code on disk.

    With ``NUMBA_DISABLE_JIT=1`` it stays plain Python. Divisions by zero give infinities and NaN as numpy's do. The
    code is kept beside the source, or in the user's cache folder where that cannot be written, or in
    ``NUMBA_CACHE_DIR``. It is compiled again when a file changes that it imports functions from, or the constants:
    numba itself looks at the function's own file alone.

    Raises
    ------
    SettingsError
        None of these folders can be written.
    """
    return _kernel(function, {})


def borrowing_kernel(function: Function) -> Function:
    """Compile a kernel that makes no array, without counting references to those that it is given."""
    return _kernel(function, _UNCOUNTED)


def _kernel(function: Function, options: dict[str, Any]) -> Function:
    if numba.config.DISABLE_JIT or _is_left(function):  # type: ignore[attr-defined]
        # Machine code does not warn: integers that wrap around, divisions by zero and NaN are meant.
        return np.errstate(all="ignore")(function)
    try:
        code = _CodeOnDisk(function)
    except RuntimeError as error:
        raise SettingsError(
            f"compiled kernels cannot be kept on disk ({error}); set NUMBA_CACHE_DIR to a folder that can be "
            "written, or NUMBA_DISABLE_JIT=1 (a hundred times slower)"
        ) from error
    made = numba.njit(**_OPTIONS, **options)(function)
    made._cache = code
    COMPILED.append(made)
    return cast(Function, made)


class _Index(IndexDataCacheFile):
    """Index of the code on disk, empty where an older railfix wrote it with types of arguments that are gone.

    numba unpickles the types before it looks whether the index is of this code.
    """

    def _load_index(self) -> dict[Any, str]:
        try:
            index: dict[Any, str] = super()._load_index()  # type: ignore[no-untyped-call]
        except (AttributeError, ImportError):
            return {}
        return index


@contextmanager
def _bare_environments() -> Generator[None]:
    """Load the constants of functions of numba itself without their modules, which compiling alone needs: 0.1 s."""
    rebuild = environment._rebuild_env

    def rebuild_bare(module: str, constants: list[Any], name: str) -> Any:
        if not module.startswith("numba.") or module in sys.modules or name in Environment._memo:
            return rebuild(module, constants, name)  # type: ignore[no-untyped-call]
        made = cast(Any, Environment)({"__name__": module})
        made.consts[:], made.env_name = constants, name
        Environment._memo[name] = made
        return made

    environment._rebuild_env = rebuild_bare
    try:
        yield
    finally:
        environment._rebuild_env = rebuild


class _MachineCode(CompileResultCacheImpl):
    """Machine code of a function; the form that callers take in is read when one of them is compiled.

    numba reads both, and names all their functions one by one: three quarters of the time that the code takes to load.
    """

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Make the function from what was kept of it."""
        if not _IS_SUITED:
            return super().rebuild(target_context, payload)  # type: ignore[no-untyped-call]
        (name, kind, (code, for_callers)), described, *others = payload
        called_by = {described.llvm_func_name, described.llvm_cpython_wrapper_name}
        target_context.codegen()._engine._defined_symbols |= called_by
        made: Any = super().rebuild(target_context, ((name, kind, (code, _NOTHING)), described, *others))  # type: ignore[no-untyped-call]
        made.library._get_module_for_linking = partial(binding.parse_bitcode, for_callers)
        return made


class _CodeOnDisk(FunctionCache):
    """Machine code of a function on disk, with the index of this package."""

    _impl_class = _MachineCode

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        module = function.__module__.removeprefix("railfix.kernels.")
        self._cache_file = _Index(  # type: ignore[no-untyped-call]
            self._cache_path, self._impl.filename_base, stamp(Path(__file__).parent, module)
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the code for types of arguments, None where there is none.

        numba first loads what it needs to compile, 0.15 s; a compilation loads that itself.
        """
        if not _IS_SUITED:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        rtsys.initialize(target_context)
        with _bare_environments(), self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


def _is_left(function: Callable[..., Any]) -> bool:
    """Return whether a function stays plain Python, in the process that compiles the filter alone."""
    shared = ("railfix.kernels.tracking", "railfix.kernels.sight")
    return FILTER_ALONE in os.environ and not function.__module__.startswith(shared)


def inner(function: Function) -> Function:
    """Compile a function that kernels alone call: it is part of their code, and python cannot call it."""
    if _is_left(function):
        return function
    # Python calls those that both have, where the kernels of single epochs are left as Python.
    options = _INNER if FILTER_ALONE not in os.environ else {}
    return cast(Function, numba.njit(**_OPTIONS, **options)(function))


def borrowing(function: Function) -> Function:
    """Compile an inner function that makes no array, without counting references to those that it is given.

    Each call would count every array of a tuple of work space up and down: a tenth of the time of the recursion.
    """
    return cast(Function, numba.njit(**_OPTIONS, **_INNER, **_UNCOUNTED)(function))


class _Announcement(event.Listener):
    """Writes a line to a terminal when the first function is compiled that is not on disk."""

    def __init__(self) -> None:
        self.said = False

    def on_start(self, event: Any) -> None:
        """Write the line, once, for functions of railfix."""
        ours = event.data["dispatcher"].py_func.__module__.startswith("railfix.")
        if ours and not self.said and sys.stderr.isatty() and multiprocessing.parent_process() is None:
            sys.stderr.write("compiling for this processor, once: about a minute\n")
            self.said = True

    def on_end(self, event: Any) -> None:
        """Nothing is written at the end of a compilation."""


ANNOUNCEMENT: Final = _Announcement()
event.register("numba:compile", ANNOUNCEMENT)  # type: ignore[no-untyped-call]


@cache
def _files(package: Path, module: str) -> set[Path]:
    """Return the file of a module of this package and those of all that it imports from the package."""
    path = package / f"{module.replace('.', '/')}.py"
    imported = re.findall(r"^from railfix\.kernels\.([\w.]+) import", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {path}.union(*(_files(package, name) for name in imported))


@cache
def stamp(package: Path, module: str) -> str:
    """Return the hash of all that the compiled code of a module depends on: its files, and the constants."""
    files = [*sorted(_files(package, module)), package.parent / "core" / "constants.py"]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


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


def missing() -> list[str]:
    """Return the names of the functions of `COMPILED` that there is no code of, neither in this process nor on disk."""
    return [
        function.py_func.__name__
        for function in COMPILED
        if not function.signatures and not function._cache._cache_file._load_index()
    ]


class Reference(types.Type):
    """Pointer to a named tuple in memory, with the tuples within it."""

    def __init__(self, values: types.NamedTuple) -> None:
        self.values = values
        number = _KNOWN.setdefault(values, len(_KNOWN))
        super().__init__(name=f"{values.instance_class.__name__}{number}")


register_model(Reference)(models.OpaqueModel)


@infer_getattr
class _Fields(AttributeTemplate):
    key = Reference

    def generic_resolve(self, reference: Reference, field: str) -> Any:  # type: ignore[override]
        """Return the type of a field: of a tuple a reference to it."""
        values = reference.values
        if field not in values.fields:
            return None
        kind = values.types[values.fields.index(field)]
        return Reference(kind) if isinstance(kind, types.NamedTuple) else kind


@lower_getattr_generic(Reference)  # type: ignore[no-untyped-call, untyped-decorator]
def _field(context: Any, builder: Any, reference: Reference, pointer: Any, field: str) -> Any:
    """Load a field, or compute the address of a tuple."""
    values = reference.values
    k = values.fields.index(field)
    whole = builder.bitcast(pointer, context.get_data_type(values).as_pointer())
    place = cgutils.gep_inbounds(builder, whole, 0, k)  # type: ignore[no-untyped-call]
    if isinstance(values.types[k], types.NamedTuple):
        return builder.bitcast(place, context.get_value_type(reference))
    return context.unpack_value(builder, values.types[k], place)


@intrinsic
def _by_reference(_: Any, values: Any) -> Any:
    """Store a tuple where it is called; the pointer is valid until that function ends."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_data_type(values)
        slots = cgutils.alloca_once(builder, _SLOT, size=context.get_abi_sizeof(kind) // 8 + 1)  # type: ignore[no-untyped-call]
        context.pack_value(builder, values, arguments[0], builder.bitcast(slots, kind.as_pointer()))
        return builder.bitcast(slots, context.get_value_type(signature.return_type))

    return Reference(values)(values), generate


def _as_it_is(values: Tuple) -> Tuple:
    return values


by_reference: Final[Any] = _as_it_is if numba.config.DISABLE_JIT else _by_reference  # type: ignore[attr-defined]
