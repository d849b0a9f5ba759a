"""Charts, pictures and tables as lines of text with their numbers, to compare them with a reviewed reference."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib.colors import to_hex

REFERENCES = Path(__file__).resolve().parents[1] / "references" / "described"
#: Longer arrays are described by their number, first, last, smallest, largest value and sum.
_LISTED = 40


def _number(value: float) -> str:
    """Return a number to six digits and to 1e-5: what lies below is rounding of coordinates."""
    return f"{round(value, 5) + 0.0:.6g}"


def _label(text: str) -> str:
    """Return a label of matplotlib, blank for one that it makes itself."""
    return "" if text.startswith("_") else text


def _array(values: np.ndarray) -> str:
    flat = values.ravel()
    if values.ndim == 2 and np.issubdtype(values.dtype, np.integer) and values.size > _LISTED:  # cells of a chart
        found = " ".join(f"{row},{column}:{values[row, column]}" for row, column in np.argwhere(values))
        return f"{values.shape[0]} by {values.shape[1]} cells: {found}"
    if values.dtype.kind not in "fiu":
        return " | ".join(str(value) for value in flat)
    if len(flat) <= _LISTED:
        return " ".join(_number(float(value)) for value in flat)
    known = np.round(flat[np.isfinite(flat)].astype(float), 5)
    ends = " ".join(_number(v) for v in (float(flat[0]), float(flat[-1]), known.min(), known.max(), known.sum()))
    return f"{len(flat)} values, {len(known)} finite; first, last, smallest, largest, sum {ends}"


def describe(value: Any, name: str = "") -> Iterator[str]:
    """Yield lines on a value: data classes and tables field by field, arrays and numbers to six digits."""
    head = f"{name}: " if name else ""
    if is_dataclass(value) and not isinstance(value, type):
        yield f"{head}{type(value).__name__}"
        for item in fields(value):
            inner = getattr(value, item.name)
            if not isinstance(inner, np.ndarray) and inner == item.default:
                continue
            yield from (f"  {line}" for line in describe(inner, item.name))
    elif isinstance(value, pl.DataFrame):
        for column in value.columns:
            yield from describe(value[column].to_list(), f"{head}{column}")
    elif isinstance(value, np.ndarray):
        yield head + _array(value)
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from describe(inner, f"{head}{key}")
    elif isinstance(value, Iterable) and not isinstance(value, str):
        inner = list(value)
        if inner and all(is_dataclass(one) for one in inner):
            for one in inner:
                yield from describe(one, name)
        else:
            yield head + " | ".join("\n".join(describe(one)) for one in inner)
    else:
        yield head + (_number(value) if isinstance(value, float) else str(value).replace("\n", " / "))


def describe_axes(axes: Any) -> Iterator[str]:
    """Yield lines on what matplotlib axes show: labels, scales, set ranges, and each line, area and text in them."""
    yield f"axes {axes.get_title()!r}, {axes.get_xlabel()!r} {axes.get_xscale()}, {axes.get_ylabel()!r}"
    linear = f", linear up to {axes.yaxis.get_transform().linthresh:.6g}" if axes.get_yscale() == "symlog" else ""
    yield f"  {axes.get_yscale()}{linear}; aspect {axes.get_aspect()} {axes.get_adjustable()}"
    yield f"  shown {axes.get_visible()}"
    for axis in "xy":
        if not getattr(axes, f"get_autoscale{axis}_on")():
            yield from describe(getattr(axes, f"get_{axis}lim")(), f"  {axis} range")
    yield f"  grid {[axis.get_gridlines()[0].get_visible() for axis in (axes.xaxis, axes.yaxis)]}"
    for line in axes.lines:
        face = line.get_markerfacecolor()
        look = [to_hex(line.get_color()), line.get_linestyle(), _number(line.get_linewidth()), line.get_marker()]
        look += [_number(line.get_markersize()), face if face == "none" else to_hex(face)]
        look += [_number(line.get_markeredgewidth()), f"rasterized {line.get_rasterized()}"]
        yield f"  line {_label(line.get_label())!r} {' '.join(map(str, look))}"
        yield from describe(np.asarray(line.get_xdata()), "    x")
        yield from describe(np.asarray(line.get_ydata()), "    y")
    for area in axes.collections:
        kind = type(area).__name__.removeprefix("FillBetween")
        drawn = f"{area.get_linewidths().tolist()}{', rasterized' * bool(area.get_rasterized())}"
        yield f"  {kind} {_label(area.get_label())!r} alpha {area.get_alpha()}, {drawn}"
        for path in area.get_paths() if area.get_array() is None else ():
            yield from describe(np.unique(path.vertices.astype(float), axis=0), "    path")
        if area.get_array() is not None:
            yield from describe(np.ma.filled(area.get_array(), 0).astype(int), "    cells")
            yield f"    colours {area.get_cmap().name} from {area.norm.vmin}"
    for patch in axes.patches:
        extent = patch.get_extents().transformed(axes.transData.inverted()).bounds
        colour = to_hex(patch.get_facecolor(), keep_alpha=True)
        yield f"  patch {_label(patch.get_label())!r} {colour} {_array(np.array(extent))}"
    for text in axes.texts:
        place = np.asarray(getattr(text, "xy", text.get_position()), float)
        yield f"  text {text.get_text()!r} {_array(place)} {text.get_ha()} {text.get_color()} {text.get_fontsize():g}"
        if hasattr(text, "xyann"):
            yield f"    drawn at {_array(np.asarray(text.xyann, float))}, arrow {text.arrow_patch is not None}"
    yield f"  legend {[text.get_text() for text in legend.get_texts()] if (legend := axes.get_legend()) else None}"
    if axes.yaxis.get_major_formatter().__class__.__name__ == "FixedFormatter":
        yield f"  ticks {[label.get_text() for label in axes.get_yticklabels()]}"


def describe_figure(figure: Any) -> Iterator[str]:
    """Yield lines on a matplotlib figure: its size, heading and axes."""
    yield f"figure {_array(np.asarray(figure.get_size_inches()))} {figure.get_suptitle()!r}"
    for axes in figure.axes:
        place = axes.get_subplotspec()
        yield f"in {place.rowspan.start}, {place.colspan.start} of {place.get_gridspec().get_geometry()}"
        yield from describe_axes(axes)


def page_text(document: str, hidden: Mapping[str, str]) -> list[str]:
    """Return the text of a page without its scripts, a line per row of a table (``#`` before a number) and element.

    Patterns of `hidden` differ between runs and are replaced.
    """
    text = re.sub(r"<(script|style)\b(?![^>]*json).*?</\1>", "", document, flags=re.DOTALL)
    text = re.sub(r"<script[^>]*json.*?</script>", "", text, flags=re.DOTALL)
    for word, other in hidden.items():
        text = re.sub(word, other, text)
    text = re.sub(r"\n(?=<td)", "", text)
    text = re.sub(r'<td class="n">|<th scope="col" class="n">', " # ", text)
    text = re.sub(r"<td>|<th\b[^>]*>", " | ", text)
    text = re.sub(r"<(figure|a|details|circle|tr|section|table|div|text)\b([^>]*)>", r"\n[\1\2] ", text)
    lines = (" ".join(re.sub(r"<[^>]+>", " ", line).split()) for line in text.splitlines())
    return [line for line in lines if line and not re.fullmatch(r"\[(div|tr|details|text|table)[^\]]*\]", line)]


def _text(parts: Iterable[Iterable[str]]) -> str:
    """Return descriptions one after the other, apart by a blank line where they have several lines."""
    texts = ["\n".join(str(line) for line in part) for part in parts]
    return "".join(f"{text}\n\n" if "\n" in text else f"{text}\n" for text in texts)


def check_described(name: str, parts: Iterable[Iterable[str]]) -> None:
    """Compare descriptions with the reference of a name, line by line."""
    assert _text(parts).splitlines() == (REFERENCES / f"{name}.txt").read_text(encoding="utf-8").splitlines()


def write_described(cases: Mapping[str, Callable[[Path], Iterable[Iterable[str]]]], names: Sequence[str]) -> None:
    """Write the references of all cases, or of those with these names."""
    REFERENCES.mkdir(exist_ok=True)
    for name in names or cases:
        with tempfile.TemporaryDirectory() as folder:
            (REFERENCES / f"{name}.txt").write_text(_text(cases[name](Path(folder))), encoding="utf-8")
