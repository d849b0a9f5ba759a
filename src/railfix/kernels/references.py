"""Named tuples of many arrays, passed between inner functions as one pointer.

numba passes each number of each array of a tuple as an argument of its own: a thousand of them to the functions of the
filter, of which each uses a few. Most of the time of their compilation went into these.
"""

from __future__ import annotations

from typing import Any, Final, TypeVar

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, register_model

Tuple = TypeVar("Tuple")
_SLOT: Final = ir.IntType(64)
#: Types of named tuples by the order in which they were met.
_KNOWN: Final[dict[Any, int]] = {}


class Reference(types.Type):
    """Pointer to the numbers of a named tuple, one a slot of 8 bytes, those of a tuple within it among them."""

    def __init__(self, values: types.NamedTuple) -> None:
        self.values = values
        number = _KNOWN.setdefault(values, len(_KNOWN))
        super().__init__(name=f"{values.instance_class.__name__}{number}")


register_model(Reference)(models.OpaqueModel)


def _leaves(llvm_type: Any) -> int:
    """Return the number of numbers of a value."""
    if isinstance(llvm_type, ir.ArrayType):
        return int(llvm_type.count) * _leaves(llvm_type.element)
    return sum(_leaves(part) for part in llvm_type) if isinstance(llvm_type, ir.LiteralStructType) else 1


def _parts(llvm_type: Any) -> list[Any]:
    """Return the types of the parts of a value, none of a number."""
    if isinstance(llvm_type, ir.ArrayType):
        return [llvm_type.element] * int(llvm_type.count)
    return list(llvm_type) if isinstance(llvm_type, ir.LiteralStructType) else []


def _store(builder: Any, value: Any, slots: Any, at: int) -> int:
    """Store the numbers of a value from a slot on; return the slot after them."""
    parts = _parts(value.type)
    for k in range(len(parts)):
        at = _store(builder, builder.extract_value(value, k), slots, at)
    if parts:
        return at
    builder.store(value, builder.bitcast(builder.gep(slots, [_SLOT(at)]), value.type.as_pointer()))
    return at + 1


def _load(builder: Any, llvm_type: Any, slots: Any, at: int) -> Any:
    """Load a value from a slot on."""
    parts, value = _parts(llvm_type), llvm_type(ir.Undefined)
    for k, part in enumerate(parts):
        value = builder.insert_value(value, _load(builder, part, slots, at), k)
        at += _leaves(part)
    if parts:
        return value
    return builder.load(builder.bitcast(builder.gep(slots, [_SLOT(at)]), llvm_type.as_pointer()))


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
def _field(context: Any, builder: Any, reference: Reference, slots: Any, field: str) -> Any:
    """Load a field, or compute the address of a tuple."""
    values = reference.values
    k = values.fields.index(field)
    at = sum(_leaves(context.get_value_type(kind)) for kind in values.types[:k])
    slots = builder.bitcast(slots, _SLOT.as_pointer())
    if isinstance(values.types[k], types.NamedTuple):
        return builder.bitcast(builder.gep(slots, [_SLOT(at)]), context.get_value_type(reference))
    return _load(builder, context.get_value_type(values.types[k]), slots, at)


@intrinsic
def _by_reference(_: Any, values: Any) -> Any:
    """Store a tuple where it is called; the pointer is valid until that function ends."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (value,) = arguments
        slots = cgutils.alloca_once(builder, _SLOT, size=_leaves(value.type))  # type: ignore[no-untyped-call]
        _store(builder, value, slots, 0)
        return builder.bitcast(slots, context.get_value_type(signature.return_type))

    return Reference(values)(values), generate


def _as_it_is(values: Tuple) -> Tuple:
    return values


by_reference: Final[Any] = _as_it_is if numba.config.DISABLE_JIT else _by_reference  # type: ignore[attr-defined]
