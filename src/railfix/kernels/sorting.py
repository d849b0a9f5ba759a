"""Sorting within kernels, for the few values of an epoch."""

from __future__ import annotations

from railfix.core.arrays import Floats
from railfix.kernels.compiling import inner


@inner
def insert(ordered: Floats, count: int, value: float) -> None:
    """Put a value in its place among the first `count` of a rising array."""
    at = count
    while at > 0 and ordered[at - 1] > value:
        ordered[at] = ordered[at - 1]
        at -= 1
    ordered[at] = value
