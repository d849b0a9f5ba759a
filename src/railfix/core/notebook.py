"""HTML for objects in a notebook, and short descriptions of values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats

_MAX_CHARACTERS: Final = 100


class NotebookTable:
    """Base of dataclasses that notebooks show as a table with the `repr` as caption and one row per field.

    Dataclasses with ``repr=False`` have the `repr` defined here, which lists the fields and the shapes of arrays.
    """

    def __repr__(self) -> str:
        shown = [
            f"{name} {value.shape}" if isinstance(value, np.ndarray) else name
            for name in (item.name for item in fields(self))  # type: ignore[arg-type]
            for value in [getattr(self, name)]
        ]
        return f"<{type(self).__name__}: {_cut(', '.join(shown))}>"

    def _repr_html_(self) -> str:
        if not is_dataclass(self):
            raise TypeError(f"{type(self).__name__} is not a dataclass")
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(item.name)}</th>"
            f"<td style='text-align:left'>{escape(value_text(getattr(self, item.name)))}</td></tr>"
            for item in fields(self)
        )
        return f"<table><caption>{escape(repr(self))}</caption>{rows}</table>"


def html_table(rows: Sequence[Mapping[str, str]], *, caption: str) -> str:
    """Return rows of strings as an HTML table; the keys of the first row are the header."""
    heads = "".join(f"<th>{escape(name)}</th>" for name in rows[0]) if rows else ""
    body = "".join(f"<tr>{''.join(f'<td>{escape(text)}</td>' for text in row.values())}</tr>" for row in rows)
    return f"<table><caption>{escape(caption)}</caption><tr>{heads}</tr>{body}</table>"


def html_list(lines: Sequence[str]) -> str:
    """Return lines as an HTML list; "" if there are no lines."""
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>" if lines else ""


def median_text(values: Floats) -> str:
    """Return the median of the finite values with two decimals; a dash if there is no finite value."""
    finite = values[np.isfinite(values)]
    return f"{np.median(finite):.2f}" if finite.size else "-"


def value_text(value: Any) -> str:
    """Describe a value briefly: an array by type, shape and range, a container by its items or keys.

    >>> value_text(np.array([1.0, np.nan, 3.0]))
    'float64 (3), 1 to 3, 33 % NaN'
    """
    if isinstance(value, np.ndarray):
        return _array_text(value)
    if isinstance(value, str):
        return _cut(value)
    if isinstance(value, Mapping | tuple | list):
        kinds = sorted(map(str, value)) if isinstance(value, Mapping) else list(map(str, value))
        return _cut(", ".join(kinds)) if kinds else "none"
    return _cut(repr(value))


def time_span_text(time: Datetimes) -> str:
    """Return the first and last of ascending times, as in ``2024-03-05 03:10:00 to 03:16:40``; "" without times."""
    known = time[~np.isnat(time)]
    if not known.size:
        return ""
    first, last = (str(t.astype("datetime64[s]")).split("T") for t in (known[0], known[-1]))
    return f"{' '.join(first)} to {last[1] if first[0] == last[0] else ' '.join(last)}"


def plural(number: int | Sized, noun: str) -> str:
    """Return a count (or the length of a container) with its noun, as in ``1 epoch`` or ``2,000 epochs``."""
    count = number if isinstance(number, int) else len(number)
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _array_text(values: np.ndarray[Any, Any]) -> str:
    text = f"{values.dtype.name} ({', '.join(map(str, values.shape))})"
    if not values.size:
        return text
    if values.dtype.kind == "M":
        return f"{text}, {time_span_text(values.ravel())}"
    if values.dtype.kind == "f":
        known = values[np.isfinite(values)]
        absent = f", {100.0 * np.isnan(values).mean():.0f} % NaN" if np.isnan(values).any() else ""
        return text + (f", {known.min():.6g} to {known.max():.6g}" if known.size else "") + absent
    if values.dtype.kind in "iu":
        return f"{text}, {values.min()} to {values.max()}"
    if values.dtype.kind == "b":
        return f"{text}, {int(values.sum())} true"
    return _cut(f"{text}, {', '.join(np.unique(values).tolist())}")


def _cut(text: str) -> str:
    return text if len(text) <= _MAX_CHARACTERS else text[: _MAX_CHARACTERS - 4] + " ..."
