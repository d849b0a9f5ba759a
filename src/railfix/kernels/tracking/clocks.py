"""Clocks near an epoch's before its update."""

from __future__ import annotations

import math

from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.algebra import insert, median, middle, restart
from railfix.kernels.tracking.constants import FIRST_OFFSET_M2, STEPPED, UNKNOWN_CLOCK
from railfix.kernels.tracking.layout import (
    CODE_CLOCK,
    DRIFT,
    OF_EPOCH,
    PHASE_CLOCK,
    Active,
    Epochs,
    KernelState,
    Rows,
    Work,
)


@borrowing
def _start_code_clocks(epochs: Epochs, active: Active, state: KernelState, rows: Rows, work: Work, h: int) -> None:
    """Take the median innovation of the codes into their clock, and those of new constellations into their offsets.

    At the first epoch the first constellation is that of the clock.
    """
    mean, value, ordered, known = work.mean, work.value, work.ordered, state.offset_known
    n, nc, first, some = mean.shape[1] - OF_EPOCH, rows.counts[0], epochs.offset[rows.codes[0]], False
    for g in range(len(known)):
        some = some or known[g]
    if not some:
        unknown = active.offset[first]
        work.spread[h, unknown, unknown] = FIRST_OFFSET_M2
        work.anew[h, 2] = True
    size = 0
    for i in range(nc):
        if known[epochs.offset[rows.codes[i]]]:
            insert(ordered, size, value[h, i])
            size += 1
    begun = size == 0
    for i in range(nc):
        if begun and epochs.offset[rows.codes[i]] == first:
            insert(ordered, size, value[h, i])
            size += 1
    clock = middle(ordered, size)
    mean[h, n + CODE_CLOCK] += clock
    for g in range(len(known)):
        own = clock
        if not known[g] and not (begun and g == first):
            size = 0
            for i in range(nc):
                if epochs.offset[rows.codes[i]] == g:
                    insert(ordered, size, value[h, i])
                    size += 1
            if size > 0:
                own = middle(ordered, size)
                mean[h, active.offset[g]] += own - clock
        for i in range(nc):
            if epochs.offset[rows.codes[i]] == g:
                value[h, i] -= own


@borrowing
def start_clocks(epochs: Epochs, active: Active, state: KernelState, rows: Rows, work: Work, h: int) -> None:
    """Take the median of each kind of innovation into its clock; clocks that have stepped begin anew."""
    mean, spread, value = work.mean, work.spread, work.value
    n = mean.shape[1] - OF_EPOCH
    work.anew[h, 0] = work.anew[h, 1] = work.anew[h, 2] = False
    if rows.counts[0] > 0:
        _start_code_clocks(epochs, active, state, rows, work, h)
    begin = rows.counts[0]
    for kind in range(1, 3):
        end = begin + rows.counts[kind]
        if end > begin:
            away = median(value, h, begin, end - begin, work.ordered)
            unknown = n + PHASE_CLOCK if kind == 1 else DRIFT
            own_variance = spread[h, unknown, unknown]
            stepped = own_variance > UNKNOWN_CLOCK**2
            stepped = stepped or abs(away) > STEPPED * math.sqrt(own_variance + 0.25)
            if stepped:
                mean[h, unknown] += away
                for i in range(begin, end):
                    value[h, i] -= away
                restart(spread, unknown, UNKNOWN_CLOCK**2, h)
                work.anew[h, kind - 1] = True
        begin = end
