"""Encoding of a live state as JSON and arrays, and decoding without executing any content.

Plain values, arrays, containers, enumerations, named tuples, settings and data classes of this package can be encoded.
Settings and data classes are decoded by calls of their constructors, so that the constructors' checks apply to the
values from the file.
"""

from __future__ import annotations

import io
import json
from base64 import b64decode, b64encode
from collections import Counter, OrderedDict, deque
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from importlib import import_module
from types import MappingProxyType
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np

from railfix.core.settings import Settings

#: Container classes, by the names used for them in the file.
_MAPPINGS: Final[dict[str, Any]] = {
    "dict": dict, "proxy": MappingProxyType, "counter": Counter, "ordered": OrderedDict,
}  # fmt: skip
_SEQUENCES: Final[dict[str, Any]] = {"list": list, "tuple": tuple, "set": set, "frozenset": frozenset}


class StateFormatError(ValueError):
    """Error: a value cannot be part of a state, or bytes are not an encoded state."""


def encode(value: Any) -> bytes:
    """Return a state as the bytes of a NumPy archive.

    Raise StateFormatError if the state contains an unsupported value.
    """
    arrays: list[np.ndarray[Any, Any]] = []
    tree = json.dumps(_encode(value, arrays))
    file = io.BytesIO()
    np.savez(file, tree=np.frombuffer(tree.encode(), dtype=np.uint8), **{f"a{k}": a for k, a in enumerate(arrays)})  # type: ignore[arg-type]  # its stub has allow_pickle
    return file.getvalue()


def decode(data: bytes) -> Any:
    """Return the state from bytes encoded by `encode`; raise StateFormatError if they are not a state."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            return _decode(json.loads(stored["tree"].tobytes()), stored)
    except (BadZipFile, KeyError, ValueError, TypeError, OSError, EOFError, AttributeError, ImportError) as error:
        raise StateFormatError(f"{type(error).__name__}: {error}") from None


def _encode(value: Any, arrays: list[np.ndarray[Any, Any]]) -> Any:
    if value is None or type(value) in (bool, int, float, str):
        return value

    def put(array: np.ndarray[Any, Any]) -> int:
        if array.dtype.hasobject:
            raise StateFormatError("an array of objects cannot be part of a state")
        arrays.append(array)
        return len(arrays) - 1

    def each(values: Any) -> list[Any]:
        return [_encode(one, arrays) for one in values]

    kind = type(value)
    if isinstance(value, Enum):
        return {"enum": _name(kind), "value": _encode(value.value, arrays)}
    if isinstance(value, np.ndarray):
        return {"array": put(value)}
    if isinstance(value, np.generic):
        return {"scalar": put(np.asarray(value))}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {"tuple of": _name(kind), "values": each(value)}
    for name, container in _MAPPINGS.items():
        if kind is container:
            return {name: [[_encode(key, arrays), _encode(one, arrays)] for key, one in value.items()]}
    for name, container in _SEQUENCES.items():
        if kind is container:
            return {name: each(value)}
    if kind is bytes:
        return {"bytes": b64encode(value).decode("ascii")}
    if kind is deque:
        return {"deque": each(value), "most": value.maxlen}
    if kind is slice:
        return {"slice": each((value.start, value.stop, value.step))}
    if isinstance(value, Settings):
        return {"settings": _name(kind), "values": value.model_dump(mode="json", exclude_unset=True)}
    if _is_value(kind):
        return {"of": _name(kind), "fields": {f.name: _encode(getattr(value, f.name), arrays) for f in fields(value)}}
    raise StateFormatError(f"{kind.__module__}.{kind.__qualname__} cannot be part of a state")


def _decode(tree: Any, stored: Mapping[str, Any]) -> Any:
    if not isinstance(tree, dict):
        return tree
    (name, content), *rest = tree.items()
    more = dict(rest)

    def each(values: Any) -> list[Any]:
        return [_decode(one, stored) for one in values]

    if name == "array":
        return stored[f"a{content}"]
    if name == "scalar":
        return stored[f"a{content}"][()]
    if name == "enum":
        return _find(content, lambda found: issubclass(found, Enum))(_decode(more["value"], stored))
    if name == "tuple of":
        return _find(content, lambda found: issubclass(found, tuple))(*each(more["values"]))
    if name in _MAPPINGS:
        return _MAPPINGS[name]({_decode(key, stored): _decode(one, stored) for key, one in content})
    if name in _SEQUENCES:
        return _SEQUENCES[name](each(content))
    if name == "bytes":
        return b64decode(content)
    if name == "deque":
        return deque(each(content), more["most"])
    if name == "slice":
        return slice(*each(content))
    if name == "settings":
        return _find(content, lambda found: issubclass(found, Settings)).model_validate(more["values"])
    if name == "of":
        values = {field: _decode(one, stored) for field, one in more["fields"].items()}
        return _find(content, _is_value)(**values)
    raise StateFormatError(f"{name} is not a type that a state can contain")


def _is_value(kind: Any) -> bool:
    """Return whether a class is a data class of this package."""
    return isinstance(kind, type) and is_dataclass(kind) and kind.__module__.split(".")[0] == "railfix"


def _name(kind: Any) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _find(name: str, fits: Any) -> Any:
    """Return the class of this package that has the given name.

    Raise StateFormatError if there is no class of this name for which `fits` returns True.
    """
    module, _, own = str(name).partition(":")
    if module.split(".")[0] == "railfix" and own.isidentifier():
        found = getattr(import_module(module), own, None)
        if isinstance(found, type) and found.__module__ == module and fits(found):
            return found
    raise StateFormatError(f"{name} cannot be part of a state")
