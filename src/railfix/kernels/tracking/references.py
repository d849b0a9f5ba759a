"""Named tuples passed to inner functions as one pointer: numba passes each number of each array as an argument."""

from __future__ import annotations

from typing import Any, Final, TypeVar

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, intrinsic, lower_getattr_generic, register_model

from railfix.kernels.compiling import is_plain

Tuple = TypeVar("Tuple")
_SLOT: Final = ir.IntType(64)
#: Types of named tuples by the order in which they were met.
_KNOWN: Final[dict[Any, int]] = {}


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


by_reference: Final[Any] = _as_it_is if is_plain() else _by_reference
