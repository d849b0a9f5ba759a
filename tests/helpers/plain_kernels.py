"""Kernels as plain Python, and the arrays of the filter's made by hand."""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any, cast

import numpy as np
import pytest

from railfix import kernels
from railfix.kernels.tracking import layout, references
from railfix.tracking import TrackingLimits
from railfix.tracking.bank import OTHERS, SENSORS, SourceKind, budget, classify_source
from railfix.tracking.filter import _parameters
from railfix.tracking.handover import _work_space


def _compiled_modules() -> list[str]:
    """Modules with compiled functions: compiled or not, they are imported together."""
    kept = (".layout", ".constants", ".compiling", ".references")
    return [name for name in sys.modules if name.startswith("railfix.kernels.") and not name.endswith(kept)]


@cache
def plain(name: str) -> ModuleType:
    """A module of `railfix.kernels` that the compiler has left alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NUMBA_DISABLE_JIT", "1")
        patch.setattr(references, "by_reference", references._as_it_is)
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


def parameters(limits: TrackingLimits) -> layout.Parameters:
    return _parameters(limits, limits.map_branch_m)


def work_space(hypotheses: int, sources: int = 0) -> layout.Work:
    return _work_space(4, len(SENSORS), 12, hypotheses, sources)[1]


def memory(
    place_m: np.ndarray, sigma_m: np.ndarray, log_probability: np.ndarray, **scalars: float
) -> layout.KernelState:
    """Hypotheses at places; scalars by their names in the layout."""
    count = len(place_m)
    mean, covariance = np.zeros((count, 12)), np.zeros((count, 12, 12))
    mean[:, layout.ARC], covariance[:, layout.ARC, layout.ARC] = place_m, sigma_m**2
    values = np.zeros(layout.MOTION_MISFIT + 1)
    values[layout.HYPOTHESES] = count
    for name, value in scalars.items():
        values[getattr(layout, name)] = value
    made = named_tuple(
        layout.KernelState,
        mean=mean,
        covariance=covariance,
        log_probability=log_probability.copy(),
        log_code=np.zeros(count),
        log_recent=np.zeros(count),
        scalars=values,
    )
    return cast(layout.KernelState, made)


def subfilters(names: list[str], place_m: Any, sigma_m: Any, limits: TrackingLimits, weak_s: Any = 0.0) -> Any:
    """Running sub-filters at places, those of satellites first; the last ones, `OTHERS`, not running."""
    given, kinds = budget(limits), [classify_source(name) for name in (*names, *OTHERS)]
    size = len(kinds)
    mean, covariance = np.zeros((size, 12)), np.zeros((size, 12, 12))
    mean[: len(names), layout.ARC], covariance[: len(names), layout.ARC, layout.ARC] = place_m, np.square(sigma_m)
    return named_tuple(
        layout.Subfilters,
        running=np.arange(size) < len(names),
        mean=mean,
        covariance=covariance,
        weak_s=np.where(np.arange(size) < len(names), np.resize(weak_s, size), 0.0),
        prior=np.array(given.prior)[kinds],
        k=np.array(given.k_fault)[kinds],
        clock=np.zeros(kinds.count(SourceKind.SATELLITE), dtype=np.intp),
    )
