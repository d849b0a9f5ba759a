"""Array types, and dataclasses of arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Instance = TypeVar("Instance")
Rows = TypeVar("Rows", bound="DataclassInstance")
Floats = NDArray[np.float64]  #: Real numbers, NaN where absent; the array's name ends with the unit.
Complexes = NDArray[np.complex128]  #: Complex numbers.
Integers = NDArray[np.int64]  #: Counts and identifiers.
Indices = NDArray[np.intp]  #: Indices into another array.
Codes = NDArray[np.int8]  #: Members of an `IntEnum`, for example `railfix.core.reasons.Status`.
Bits = NDArray[np.int64]  #: Members of an `IntFlag`, for example `railfix.core.reasons.Reason`.
Masks = NDArray[np.bool_]  #: Conditions; True in a rejection mask means rejected.
Datetimes = NDArray[np.datetime64]  #: GPS times; NaT where absent.
Bytes = NDArray[np.uint8]  #: Raw bytes of a file.
Strings = NDArray[np.str_]  #: Names, for example of satellites.


def copy_with(instance: Instance, **values: Any) -> Instance:
    """Copy a frozen dataclass with changed attributes, without calling ``__init__`` and ``__post_init__``.

    Values of cached properties are also copied.
    """
    copy = object.__new__(type(instance))
    copy.__dict__.update(instance.__dict__, **values)
    return copy


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view of an array; the array itself stays writable."""
    view = array.view()
    view.flags.writeable = False
    return view


def kernel_array(array: NDArray[Any]) -> Floats:
    """Return a read-only float64 view or copy in C order, so that a kernel is compiled for one array type only."""
    flags = array.flags
    if flags.c_contiguous and not flags.writeable and array.dtype == np.float64:
        return array
    return read_only(np.ascontiguousarray(array, dtype=np.float64))


def freeze_arrays(instance: DataclassInstance) -> None:
    """Replace the array fields of a dataclass by read-only views; to be called in `__post_init__`."""
    vars(instance).update({n: read_only(v) for n, v in vars(instance).items() if isinstance(v, np.ndarray)})


def freeze_rows(instance: DataclassInstance, of: str, first: str = "time") -> None:
    """Freeze the arrays of a dataclass; raise ValueError if an array differs from the array `first` in length.

    `of` is the noun for the rows in the error message, such as "epochs".
    """
    rows = len(vars(instance)[first])
    for name, value in vars(instance).items():
        if isinstance(value, np.ndarray) and len(value) != rows:
            raise ValueError(f"{name} has {len(value)} {of}, but {first} has {rows}")
    freeze_arrays(instance)


class FrozenArrays:
    """Base of dataclasses whose arrays are read-only, also after unpickling; see `kernel_array` for the reason."""

    def __post_init__(self) -> None:
        freeze_arrays(cast("DataclassInstance", self))

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        vars(self).update({n: read_only(v) if isinstance(v, np.ndarray) else v for n, v in state.items()})


def _row_arrays(instance: DataclassInstance) -> dict[str, NDArray[Any]]:
    values = {item.name: getattr(instance, item.name) for item in fields(instance)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def take_rows(instance: Rows, rows: NDArray[Any] | slice) -> Rows:
    """Return a copy of a dataclass with selected rows of each array; the fields that are not arrays are unchanged."""
    return replace(instance, **{name: value[rows] for name, value in _row_arrays(instance).items()})


def join_rows(parts: Sequence[Rows]) -> Rows:
    """Return a dataclass with the concatenated rows of several dataclasses of one type.

    Fields that are not arrays are taken from the first dataclass. Raise ValueError if the dataclasses do not have the
    same array fields.
    """
    if len(parts) == 1:
        return parts[0]
    tables = [_row_arrays(part) for part in parts]
    if any(table.keys() != tables[0].keys() for table in tables):
        raise ValueError(f"dataclasses with different array fields; expected {', '.join(tables[0])}")
    return replace(parts[0], **{name: np.concatenate([table[name] for table in tables]) for name in tables[0]})


def patch_rows(result: Rows, rows: Indices, part: Rows) -> Rows:
    """Return a copy of a dataclass of arrays in which the rows at given indices are replaced by the rows of `part`.

    Every field must be an array with the rows on axis 0.
    """
    values = {}
    for item in fields(result):
        values[item.name] = array = np.array(getattr(result, item.name))
        array[rows] = getattr(part, item.name)
    return copy_with(result, **values)


class RowArrays:
    """Base of dataclasses whose arrays have one row per item of a common axis."""

    def take(self, rows: NDArray[Any] | slice) -> Self:
        """Return the rows selected by a mask, indices or a slice; fields that are not arrays are unchanged."""
        return take_rows(self, rows)  # type: ignore[type-var]


def places_in_groups(counts: NDArray[Any]) -> tuple[Indices, Indices]:
    """Return the group of each row and the index of the row in its group, given the number of rows of each group.

    >>> places_in_groups(np.array([2, 0, 3]))
    (array([0, 0, 2, 2, 2]), array([0, 1, 0, 1, 2]))
    """
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)


def channel_sums(values: Floats) -> Floats:
    """Return the sums over the channels (axis 1), with the terms added in the order of the channels.

    Channels with the value 0 therefore do not change the rounding of a sum. The sum of an epoch is the same in a chunk
    with the channels of this epoch only and in a chunk with all channels of the log.
    """
    return np.asarray(np.cumsum(values, axis=1)[:, -1]) if values.shape[1] else values.sum(axis=1)


def over_blocks(function: Callable[[Indices], None], blocks: Iterable[Indices]) -> None:
    """Call a function for blocks of rows in parallel threads; kernels and numpy release the interpreter lock."""
    if len(every := list(blocks)) == 1:
        return function(every[0])
    with ThreadPoolExecutor() as threads:
        list(threads.map(function, every))  # raises the function's exception
