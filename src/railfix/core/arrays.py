"""Types of the arrays that functions accept and return, by element; dataclasses of arrays."""

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
Floats = NDArray[np.float64]  #: Real numbers in the unit at the end of the array's name; NaN where absent.
Complexes = NDArray[np.complex128]  #: Complex numbers.
Integers = NDArray[np.int64]  #: Counts and identifiers.
Indices = NDArray[np.intp]  #: Positions in another array.
Codes = NDArray[np.int8]  #: Members of an `IntEnum`, for example `railfix.core.reasons.Status`.
Bits = NDArray[np.int64]  #: Members of an `IntFlag`, for example `railfix.core.reasons.Reason`.
Masks = NDArray[np.bool_]  #: Conditions; True in a reject mask means rejected.
Datetimes = NDArray[np.datetime64]  #: Instants, GPS time; NaT where absent.
Bytes = NDArray[np.uint8]  #: Raw bytes of a file.
Strings = NDArray[np.str_]  #: Names, for example of satellites.


def copy_with(instance: Instance, **values: Any) -> Instance:
    """Copy a frozen dataclass with changes, without ``__init__``, ``__post_init__`` and cached properties."""
    copy = object.__new__(type(instance))
    copy.__dict__.update(instance.__dict__, **values)
    return copy


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view of an array; the caller's own array stays writable."""
    view = array.view()
    view.flags.writeable = False
    return view


def kernel_array(array: NDArray[Any]) -> Floats:
    """Return a read-only view of numbers in C order: kernels are compiled once for all callers."""
    flags = array.flags
    if flags.c_contiguous and not flags.writeable and array.dtype == np.float64:
        return array
    return read_only(np.ascontiguousarray(array, dtype=np.float64))


def masked_median(values: Floats, known: Masks) -> Floats:
    """Return the median of the known values of each row, shape (T,); NaN for a row without any."""
    if not values.shape[1]:
        return np.full(len(values), np.nan)
    ordered, count = np.sort(np.where(known, values, np.inf), axis=1), known.sum(axis=1)
    rows = np.arange(len(values))
    low, high = ordered[rows, np.maximum(count - 1, 0) // 2], ordered[rows, np.minimum(count // 2, values.shape[1] - 1)]
    return np.where(count > 0, 0.5 * (low + high), np.nan)


def freeze_arrays(instance: DataclassInstance) -> None:
    """Replace the array fields of a dataclass by read-only views; to be called in its `__post_init__`."""
    vars(instance).update({n: read_only(v) for n, v in vars(instance).items() if isinstance(v, np.ndarray)})


def freeze_rows(instance: DataclassInstance, of: str, first: str = "time") -> None:
    """Freeze the arrays of a dataclass with one row per item; ValueError where one is longer or shorter."""
    rows = len(vars(instance)[first])
    for name, value in vars(instance).items():
        if isinstance(value, np.ndarray) and len(value) != rows:
            raise ValueError(f"{name} has {len(value)} {of}, {first} has {rows}")
    freeze_arrays(instance)


class FrozenArrays:
    """Base of dataclasses that freeze their arrays, also in copies and other processes: kernels compile once."""

    def __post_init__(self) -> None:
        freeze_arrays(cast("DataclassInstance", self))

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        vars(self).update({n: read_only(v) if isinstance(v, np.ndarray) else v for n, v in state.items()})


def _row_arrays(instance: DataclassInstance) -> dict[str, NDArray[Any]]:
    values = {item.name: getattr(instance, item.name) for item in fields(instance)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def take_rows(instance: Rows, rows: NDArray[Any] | slice) -> Rows:
    """Return a dataclass with some rows of each of its arrays, and its other fields."""
    return replace(instance, **{name: value[rows] for name, value in _row_arrays(instance).items()})


def join_rows(parts: Sequence[Rows]) -> Rows:
    """Return a dataclass with the rows of several dataclasses concatenated, and the other fields of the first.

    ValueError: they do not have the same arrays.
    """
    if len(parts) == 1:
        return parts[0]
    tables = [_row_arrays(part) for part in parts]
    if any(table.keys() != tables[0].keys() for table in tables):
        raise ValueError(f"rows with other arrays than {', '.join(tables[0])}")
    return replace(parts[0], **{name: np.concatenate([table[name] for table in tables]) for name in tables[0]})


def patch_rows(result: Rows, rows: Indices, part: Rows) -> Rows:
    """Return a dataclass of arrays with some rows replaced, by index; every field has the rows on axis 0."""
    values = {}
    for item in fields(result):
        values[item.name] = array = np.array(getattr(result, item.name))
        array[rows] = getattr(part, item.name)
    return copy_with(result, **values)


class RowArrays:
    """Base of dataclasses whose arrays have one row per item of a common axis."""

    def take(self, rows: NDArray[Any] | slice) -> Self:
        """Return selected rows, by mask, index or slice, with the other fields unchanged."""
        return take_rows(self, rows)  # type: ignore[type-var]


def places_in_groups(counts: NDArray[Any]) -> tuple[Indices, Indices]:
    """Return the group of each row, given the number of rows of each group, and its index in the group from 0.

    >>> places_in_groups(np.array([2, 0, 3]))
    (array([0, 0, 2, 2, 2]), array([0, 1, 0, 1, 2]))
    """
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - np.repeat(np.cumsum(counts) - counts, counts)


def cheapest_path(costs: Sequence[Floats], steps: Iterable[Floats]) -> list[int]:
    """Return one choice per layer (dynamic programming) with the least sum of node costs and step costs.

    `costs` of the choices of a layer, shape (n,); step costs from the previous layer, shape (n, n before).
    """
    total, came = costs[0], list[Indices]()
    for cost, step in zip(costs[1:], steps, strict=True):
        reached = total + step
        came.append(reached.argmin(axis=1))
        total = reached.min(axis=1) + cost
    path = [int(total.argmin())]
    for before in reversed(came):
        path.append(int(before[path[-1]]))
    return path[::-1]


def channel_sums(values: Floats) -> Floats:
    """Return sums over the channels, axis 1, in their order, so that channels of zeros leave each sum exactly as it is.

    The sums of a whole log, with the channels of all its epochs, therefore equal the sums of its single epochs.
    """
    return np.asarray(np.cumsum(values, axis=1)[:, -1]) if values.shape[1] else values.sum(axis=1)


def medians(values: Floats) -> Floats:
    """Return the medians along the last axis, ignoring NaN; NaN where all are NaN."""
    *shape, width = values.shape
    if not width:
        return np.full(shape, np.nan)
    rows = values.reshape(-1, width).copy()
    rows.sort()  # NaN last
    count, row = (rows == rows).sum(axis=1), np.arange(len(rows))
    low, high = rows[row, np.maximum(count - 1, 0) // 2], rows[row, np.minimum(count // 2, width - 1)]
    return np.asarray((low + high) / 2.0).reshape(shape)


def over_blocks(function: Callable[[Indices], None], blocks: Iterable[Indices]) -> None:
    """Call a function for blocks of rows, several at a time: kernels and numpy release the interpreter lock."""
    if len(every := list(blocks)) == 1:
        return function(every[0])
    with ThreadPoolExecutor() as threads:
        list(threads.map(function, every))  # raises the function's exception
