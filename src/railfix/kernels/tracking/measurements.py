"""Which measurements an epoch has, their variances, and the clocks that begin with them."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.algebra import insert, median, middle, restart
from railfix.kernels.tracking.constants import (
    BIAS_INFLATED,
    DIRECTION_MPS,
    FIRST_OFFSET_M2,
    STEPPED,
    STILL_MPS,
    UNKNOWN_CLOCK,
)
from railfix.kernels.tracking.layout import (
    CODE_CLOCK,
    CODED,
    DIRECTION,
    DRIFT,
    HYPOTHESES,
    OF_EPOCH,
    PHASE_CLOCK,
    RANGE_ROW,
    SCALE_DOPPLER,
    SCALE_PHASE,
    SPEED,
    WHEEL_ROW,
    Active,
    Epochs,
    KernelState,
    Outputs,
    Parameters,
    Rows,
    Work,
)
from railfix.kernels.tracking.learning import is_faulty

#: Times since that differ by less are equal: their rounding depends on where a chunk begins [s].
TIE_S = 1e-6


@borrowing
def code_interval_s(epochs: Epochs, t: int, parameters: Parameters, state: KernelState, outputs: Outputs) -> float:
    """Time that the codes of an epoch stand for [s]; 0 where they are not used, as others were within the period.

    Their variances are settled with it, those of codes that are left out are inflated.
    """
    dt, since, coded = epochs.interval_s[t], epochs.time_s[t] - state.scalars[CODED], False
    for k in range(epochs.has.shape[2]):
        coded = coded or epochs.has[0, t, k]
    if not coded:
        return float(dt)
    recent = epochs.motion_measured[t] and since < parameters.code_period_s - 0.5 * dt - TIE_S
    code_s = 0.0 if recent else min(max(since, dt), max(parameters.code_period_s, dt))
    for k in range(epochs.has.shape[2]):
        if recent:
            epochs.has[0, t, k] = False
            continue
        epochs.variance[0, t, k] /= min(code_s, 1.0)
        slot = epochs.slot[k]
        if slot >= 0 and epochs.has[0, t, k] and not epochs.fresh[t, slot]:
            outputs.faulty[t, k] = is_faulty(state.code_bias[slot])
            if outputs.faulty[t, k]:
                epochs.variance[0, t, k] *= BIAS_INFLATED
    return float(code_s)


@borrowing
def choose_rows(epochs: Epochs, t: int, rows: Rows) -> None:
    """List the channels of each kind of measurement."""
    counts = rows.counts
    for kind in range(4):
        counts[kind] = 0
    for k in range(epochs.has.shape[2]):
        if epochs.has[0, t, k]:
            rows.codes[counts[0]] = k
            counts[0] += 1
        if epochs.has[1, t, k]:
            rows.phases[counts[1]] = k
            counts[1] += 1
        if epochs.has[2, t, k]:
            rows.dopplers[counts[2]] = k
            counts[2] += 1


@borrowing
def choose_sensors(epochs: Epochs, t: int, state: KernelState, rows: Rows, work: Work) -> None:
    """List the sensors that have measured; a wheel without a sign needs a direction, a range to a unit a speed."""
    count = int(state.scalars[HYPOTHESES])
    for kind in range(epochs.sensor.shape[1]):
        known = math.isfinite(epochs.sensor[t, kind])
        known = known and (kind < RANGE_ROW or abs(work.mean[0, SPEED]) >= STILL_MPS)
        if kind == WHEEL_ROW and epochs.unsigned and state.scalars[DIRECTION] == 0.0:
            for h in range(count):
                known = known and abs(work.mean[h, SPEED]) > DIRECTION_MPS
        if known:
            rows.sensors[rows.counts[3]] = kind
            rows.counts[3] += 1


@borrowing
def write_variances(epochs: Epochs, t: int, state: KernelState, rows: Rows, variance: Floats) -> None:
    """Write the variances of the measurements, with what has been learnt of phases and Dopplers."""
    nc, nph, nd = rows.counts[0], rows.counts[1], rows.counts[2]
    for i in range(nc):
        variance[i] = epochs.variance[0, t, rows.codes[i]]
    for i in range(nph):
        variance[nc + i] = epochs.variance[1, t, rows.phases[i]] * math.exp(state.scalars[SCALE_PHASE])
    for i in range(nd):
        variance[nc + nph + i] = epochs.variance[2, t, rows.dopplers[i]] * math.exp(state.scalars[SCALE_DOPPLER])
    for j in range(rows.counts[3]):
        variance[nc + nph + nd + j] = epochs.sensor_sigma[t, rows.sensors[j]] ** 2


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
        work.restarted[h, 2] = True
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
    """Take the median of each kind of innovation into its clock; clocks that have stepped restart."""
    mean, spread, value = work.mean, work.spread, work.value
    n = mean.shape[1] - OF_EPOCH
    work.restarted[h, 0] = work.restarted[h, 1] = work.restarted[h, 2] = False
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
                work.restarted[h, kind - 1] = True
        begin = end
