"""Conversion of state, settings and sensor measurements to arrays of the recursion, and of results to a state."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from railfix.core.arrays import Datetimes
from railfix.core.constants import CLOCK_GROUP
from railfix.core.timescale import seconds
from railfix.kernels.tracking import constants, layout
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Records
from railfix.tracking import bank
from railfix.tracking.epochs import SensorEpochs
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.state import HYPOTHESIS, MONITORS, Bank, Monitors, TrackState

#: Minimum of the parameter `map_branch_m`, in standard deviations of the map across the line.
_BRANCH_SIGMAS = 3.0


@lru_cache(maxsize=8)
def pack_parameters(limits: TrackingLimits, sigma_plan_m: float) -> Records:
    """Return a record, shape (1,), of the numeric settings and the risk budget of the protection level."""
    budget = bank.budget(limits)
    values = {name: value for name, value in dict(limits).items() if isinstance(value, (int, float))}
    values["map_branch_m"] = max(constants.MAP_BRANCH_M, _BRANCH_SIGMAS * sigma_plan_m)
    values |= {"level_risk": budget.risk, "level_k": budget.k, "level_k_speed": budget.k_speed}
    record = np.zeros(1, dtype=layout.record_of({name: type(value) for name, value in values.items()}))
    for name, value in values.items():
        record[name] = value
    return record


def pack_sensors(sensors: SensorEpochs, time: Datetimes) -> Records:
    """Return records `layout.SENSOR`, shape (T, C), with columns for wheel, radar, force, position, balises, ranges."""
    ranges = sensors.ranges
    columns = ix.RANGE_COLUMN + (0 if ranges is None else ranges.range_m.shape[1])
    packed = np.zeros((len(time), columns), dtype=layout.SENSOR)
    packed["value"], packed["sigma"] = np.nan, 1.0
    packed["unsigned"][:, ix.WHEEL_COLUMN] = sensors.wheel_sign == "unknown"
    for column, (value, sigma) in enumerate((
        (sensors.wheel_m, sensors.wheel_sigma_m),
        (sensors.radar_m, sensors.radar_sigma_m),
        (sensors.force_mps2, sensors.force_sigma_mps2),
        (sensors.place_m, sensors.place_sigma_m),
    )):  # fmt: skip
        if value is not None and sigma is not None:
            packed["value"][:, column], packed["sigma"][:, column] = value, sigma
    if sensors.balises is not None:
        balises, own = sensors.balises, packed[:, ix.PLACE_COLUMN + 1 : ix.RANGE_COLUMN]
        own["value"], own["sigma"] = balises.place_m, balises.sigma_m
        own["age_s"] = np.where(np.isfinite(balises.place_m), seconds(time[:, None] - balises.time), 0.0)
    if ranges is not None:
        own = packed[:, ix.RANGE_COLUMN :]
        own["value"], own["sigma"], own["age_s"] = ranges.range_m, ranges.sigma_m, ranges.age_s
        own["unit_ecef_m"], own["lever_m"] = ranges.unit_ecef_m, ranges.lever_m
    return packed


def list_sources(state: TrackState) -> list[str]:
    """Return the names of the sources that sub-filters exclude, in the order of the recursion."""
    return [*state.satellite.tolist(), *ix.CLOCKS, *bank.SENSORS.values(), *bank.OTHERS]


def pack_state(state: TrackState, limits: TrackingLimits, *, levels: bool) -> layout.State:
    """Return a copy of the state as arrays of the recursion. Sub-filters are included only if `levels` is True."""
    names = list_sources(state) if levels else []
    count, width = state.mean.shape
    x, P = np.zeros((count + len(names), width)), np.zeros((count + len(names), width, width))
    x[:count], P[:count] = state.mean, state.covariance
    source = _pack_sources(names, limits)
    if names and state.bank is not None:
        kept = [k for k, name in enumerate(state.bank.without) if name in names]
        at = np.array([names.index(state.bank.without[k]) for k in kept], dtype=np.intp)
        source["running"][at], source["contradicted_s"][at] = True, state.bank.contradicted_s[kept]
        x[count + at], P[count + at] = state.bank.mean[kept], state.bank.covariance[kept]
    monitors = np.zeros(1, dtype=MONITORS)
    for name, value in vars(state.monitors).items():
        monitors[name] = value
    monitors["hypotheses"] = count
    return layout.State(
        x, P, state.hypothesis.astype(HYPOTHESIS), monitors, state.code_bias.copy(), state.offset_known.copy(), source
    )


def _pack_sources(names: list[str], limits: TrackingLimits) -> Records:
    """Return records `layout.SOURCE`, shape (B,), with the fault probability and factors K of each source."""
    source = np.zeros(len(names), dtype=layout.SOURCE)
    if names:
        given, kinds = bank.budget(limits), [bank.KINDS.get(name, bank.SourceKind.SATELLITE) for name in names]
        satellites = names[: kinds.count(bank.SourceKind.SATELLITE)]
        for field, values in (("prior", given.prior), ("k", given.k_fault), ("k_speed", given.k_speed_fault)):
            source[field] = np.array(values)[kinds]
        source["clock"][: len(satellites)] = [ix.CLOCKS.index(CLOCK_GROUP[name[0]]) for name in satellites]
    return source


def unpack_state(state: TrackState, packed: layout.State) -> None:
    """Update the state from the arrays of the recursion."""
    monitors: Any = packed.monitors[0]
    first, count = len(packed.hypothesis), int(monitors["hypotheses"])
    state.mean, state.covariance = packed.x[:count].copy(), packed.P[:count].copy()
    state.hypothesis = packed.hypothesis[:count].copy()
    state.monitors = Monitors(**{name: float(monitors[name]) for name in vars(state.monitors)})
    state.code_bias, state.offset_known = packed.code_bias, packed.offset_known
    if len(packed.source):
        running, names = packed.source["running"].nonzero()[0], list_sources(state)
        state.bank = Bank(
            without=tuple(names[k] for k in running),
            mean=packed.x[first + running],
            covariance=packed.P[first + running],
            contradicted_s=packed.source["contradicted_s"][running],
        )
