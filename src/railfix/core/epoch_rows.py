"""Selection and concatenation of epochs in nested dataclasses of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numpy as np

from railfix.core.arrays import Indices

Value = TypeVar("Value")
#: Names of the fields that have no row per epoch, because they depend only on the channels.
_OF_CHANNELS: Final = frozenset({"satellite", "signal", "frequency_hz", "channels", "columns", "header"})
EVERY: Final = slice(None)  #: Slice of all rows.


class OnDemand:
    """Base of dataclasses whose fields are evaluated at first access, because few fields are used in each epoch."""

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            own = self.__dict__
            if "_later" not in own or name not in _members(self.__class__):
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            return own.setdefault(name, own["_later"](name))

    def __getstate__(self) -> dict[str, Any]:
        """Return the values of all fields for pickling."""
        return {name: getattr(self, name) for name in _members(cast(Any, type(self)))}


@cache
def _members(kind: Any) -> dict[str, bool]:
    """Return, for each field of a dataclass, whether the field can have rows; an empty dictionary for other types."""
    return {f.name: f.name not in _OF_CHANNELS for f in fields(kind)} if is_dataclass(kind) else {}


@cache
def _defaults(kind: Any) -> tuple[str, ...]:
    """Return the fields of a dataclass that have a default."""
    return tuple(name for name in _members(kind) if hasattr(kind, name))


def join_epochs(values: Sequence[Value]) -> Value:
    """Concatenate arrays by rows, also arrays in dataclasses or tuples; other values are taken from the first item."""
    first: Any = values[0]
    if len(values) == 1:
        return values[0]
    if type(first) is tuple:
        return cast(Value, tuple(_join(column) for column in zip(*cast(Any, values), strict=True)))
    return cast(Value, _join(values))


def _join(values: Sequence[Any]) -> Any:
    first = values[0]
    if first.__class__ is np.ndarray:
        return np.concatenate(values)
    if not (has_rows := _members(first.__class__)):
        return first
    return _make(
        type(first),
        {n: _join([getattr(v, n) for v in values]) if rows else getattr(first, n) for n, rows in has_rows.items()},
    )


def take_epochs(value: Value, rows: slice | Indices) -> Value:
    """Return selected rows of an array, or of all arrays in a dataclass and in dataclasses nested in it."""
    return value if rows is EVERY else cast(Value, _take_epochs(value, rows))


def _take_epochs(value: Any, rows: slice | Indices) -> Any:
    if value.__class__ is np.ndarray:
        return value[rows]
    if not (has_rows := _members(value.__class__)):
        return value
    own, members = value.__dict__, dict[str, Any]()
    if isinstance(value, OnDemand):
        members = {n: item[rows] for n, item in own.items() if item.__class__ is np.ndarray and has_rows[n]}
        for name in _defaults(cast(Any, value.__class__)):  # a default would make the field seem evaluated
            members[name] = _take_epochs(own[name], rows)
        members["_later"] = lambda n: _take_epochs(getattr(value, n), rows) if has_rows[n] else getattr(value, n)
        return _make(type(value), members)
    for name, of_rows in has_rows.items():
        item = own[name]
        if of_rows and item is not None:
            item = item[rows] if item.__class__ is np.ndarray else _take_epochs(item, rows)
        members[name] = item
    return _make(type(value), members)


def _make(kind: Any, members: dict[str, Any]) -> Any:
    """Return a dataclass with given field values, without calling ``__init__``."""
    instance = object.__new__(kind)
    instance.__dict__.update(members)
    return instance
