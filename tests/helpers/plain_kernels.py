"""Kernels as plain Python, and the arrays of the filter's made by hand."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any, cast

import numba  # noqa: F401 (it reads NUMBA_DISABLE_JIT when it is imported, and must not read that of `plain`)
import numpy as np
import pytest

from railfix import kernels
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking import layout
from railfix.tracking import TrackingLimits
from railfix.tracking.bank import KINDS, OTHERS
from railfix.tracking.packing import _pack_sources, pack_parameters
from railfix.tracking.state import HYPOTHESIS, MONITORS


def _compiled_modules() -> list[str]:
    """Modules with compiled functions: compiled or not, they are imported together."""
    kept = (".index", ".layout", ".constants", ".compiling")
    return [name for name in sys.modules if name.startswith("railfix.kernels.") and not name.endswith(kept)]


@cache
def plain(name: str) -> ModuleType:
    """A module of `railfix.kernels` that the compiler has left alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NUMBA_DISABLE_JIT", "1")
        for attribute, value in list(vars(kernels).items()):
            if isinstance(value, ModuleType):
                patch.setattr(kernels, attribute, value)  # an import sets it
        for module in _compiled_modules():
            patch.delitem(sys.modules, module)
        found = import_module(f"railfix.kernels.{name}")
        for module in _compiled_modules():
            del sys.modules[module]
    return found


def named_tuple(kind: type, **values: Any) -> Any:
    """A tuple of the kernels of which only some fields are used."""
    fields = cast(Any, kind)._fields
    return kind(**{name: values.get(name) for name in fields})


def given(limits: TrackingLimits) -> layout.Given:
    """What the recursion reads, settings alone."""
    rows = {"epoch": np.ones(1, dtype=layout.EPOCH), "line": np.zeros(1, dtype=layout.LINE)}
    return cast(layout.Given, named_tuple(layout.Given, parameters=pack_parameters(limits, 0.0), **rows))


def kernel_state(
    place_m: Any,
    sigma_m: Any,
    log_probability: Any,
    limits: TrackingLimits,
    names: Sequence[str] = (),
    **monitors: float,
) -> layout.State:
    """Hypotheses at places, and sub-filters by the names of their sources, those of satellites first.

    `OTHERS` come after these; places and sigmas are those of the hypotheses and then of the sub-filters named, which
    run.
    """
    listed = [*names, *OTHERS] if names else []
    count, satellites = len(log_probability), sum(name not in KINDS for name in names)
    x, P = np.zeros((count + len(listed), ix.SATELLITES)), np.zeros((count + len(listed), ix.SATELLITES, ix.SATELLITES))
    x[: len(place_m), ix.ARC], P[: len(place_m), ix.ARC, ix.ARC] = place_m, np.square(sigma_m)
    hypothesis, values = np.zeros(count, dtype=HYPOTHESIS), np.zeros(1, dtype=MONITORS)
    hypothesis["log_probability"], values["hypotheses"] = log_probability, count
    for name, value in monitors.items():
        values[name] = value
    source = _pack_sources(listed, limits)
    source["running"][: len(place_m) - count] = True
    return layout.State(x, P, hypothesis, values, np.zeros(satellites), np.zeros(len(ix.CLOCKS), dtype=bool), source)
