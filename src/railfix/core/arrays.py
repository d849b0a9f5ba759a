"""Types of the arrays that functions take and return, by what their elements are; read-only views."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Instance = TypeVar("Instance")
#: Real numbers in the unit that the name of the array ends with; NaN where absent.
Floats = NDArray[np.float64]
#: Complex numbers.
Complexes = NDArray[np.complex128]
#: Counts and identifiers.
Integers = NDArray[np.int64]
#: Positions in another array.
Indices = NDArray[np.intp]
#: Members of an `IntEnum`, for example `railfix.core.reasons.Status`.
Codes = NDArray[np.int8]
#: Members of an `IntFlag`, for example `railfix.core.reasons.Reason`.
Bits = NDArray[np.int64]
#: Conditions; True in a reject mask means rejected.
Masks = NDArray[np.bool_]
#: Instants, GPS time; NaT where absent.
Datetimes = NDArray[np.datetime64]
#: Raw bytes of a file.
Bytes = NDArray[np.uint8]
#: Names, for example of satellites.
Strings = NDArray[np.str_]


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only view of an array; the caller's own array stays writable."""
    view = array.view()
    view.flags.writeable = False
    return view


def freeze_arrays(instance: DataclassInstance) -> None:
    """Replace the array fields of a dataclass by read-only views; to be called in its `__post_init__`."""
    vars(instance).update({n: read_only(v) for n, v in vars(instance).items() if isinstance(v, np.ndarray)})


class FrozenArrays:
    """Base of dataclasses that freeze their arrays: they are read-only in copies and in other processes, too.

    A compiled function is compiled anew for arrays that can be written.
    """

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        vars(self).update({n: read_only(v) if isinstance(v, np.ndarray) else v for n, v in state.items()})


def changed(instance: Instance, **values: Any) -> Instance:
    """Return a copy of a frozen dataclass with some fields changed, without ``__init__``.

    In a live epoch `dataclasses.replace` takes 20 us. Only for classes without ``__post_init__`` and cached properties.
    """
    copy = object.__new__(type(instance))
    vars(copy).update(vars(instance), **values)
    return copy
