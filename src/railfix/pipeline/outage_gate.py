"""Gate of codes after an outage, until single-epoch positions agree with the dead-reckoned position."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.timescale import seconds
from railfix.pipeline.sensor_epochs import SensorLimits
from railfix.tracking import Line

#: An interval of at least this length without codes counts as an outage [s].
_OUTAGE_S: Final = 2.0
#: After an outage, codes are used once this number of consecutive positions agree with dead reckoning.
_AGREEING: Final = 3
#: Standard deviation of the sensor distance since the start of a block of epochs, as a fraction of the distance.
_DISTANCE_SHARE: Final = 0.01
#: Minimum standard deviation of a single-epoch position at the end of a tunnel, where the portal causes multipath [m].
_LEAST_SIGMA_M: Final = 2.0
_NEVER: Final = np.datetime64("NaT", "ns")


@dataclass(frozen=True, kw_only=True)
class ReturnState:
    """State of the gate after a chunk."""

    time: np.datetime64 = _NEVER  #: Last epoch whose codes were used; NaT before the first.
    place_m: float = float("nan")  #: Dead-reckoned position at the last epoch; NaN without a sensor distance.
    sigma_m: float = float("nan")  #: Standard deviation of the filter position from which dead reckoning started.
    distance_m: float = 0.0  #: Sensor distance since dead reckoning started.
    returned: np.datetime64 = _NEVER  #: First epoch with codes after an outage; NaT if codes are used.
    agreeing: int = 0  #: Number of consecutive positions that have agreed since `returned`.


def gated_codes(
    time: Datetimes,
    observed: Masks,
    distance_m: Floats,
    place_m: Floats,
    sigma_m: Floats,
    state: ReturnState,
    line: Line,
    limits: SensorLimits,
) -> tuple[Masks, ReturnState]:
    """Return the epochs whose codes are not yet used, shape (T,), and the state for the next chunk.

    After an outage, single-epoch positions are compared with the position dead-reckoned by the sensors: codes are used
    again from the third consecutive position within `SensorLimits.return_sigmas` combined standard deviations, or after
    `SensorLimits.return_s` in any case. Without a sensor distance no code is rejected.

    `observed` marks epochs with codes, `distance_m` is the sensor distance since the previous epoch, `place_m` and
    `sigma_m` are single-epoch positions and sigmas; shape (T,) each, NaN where missing. `state` has the filter's
    position at the epoch before the first.
    """
    refused = np.zeros(len(time), dtype=np.bool_)
    distances = state.distance_m + np.cumsum(distance_m)
    coasted = state.place_m + np.cumsum(distance_m)
    spread = np.sqrt(state.sigma_m**2 + (_DISTANCE_SHARE * distances) ** 2 + np.maximum(sigma_m, _LEAST_SIGMA_M) ** 2)
    fits = np.abs(line.nearest_m(place_m, coasted) - coasted) <= limits.return_sigmas * spread
    last, returned, agreeing = state.time, state.returned, state.agreeing
    steps = seconds(np.diff(time, prepend=last if not np.isnat(last) else time[:1]))
    if np.isnat(returned) and observed.all() and steps.max(initial=0.0) < _OUTAGE_S:
        last, observed = time[-1] if len(time) else last, observed[:0]
    for k in observed.nonzero()[0].tolist():
        out = not np.isnat(last) and (not np.isnat(returned) or float(seconds(time[k] - last)) >= _OUTAGE_S)
        if out and np.isfinite(coasted[k]):
            returned = time[k] if np.isnat(returned) else returned
            agreeing = agreeing + 1 if fits[k] else 0
            refused[k] = agreeing < _AGREEING and float(seconds(time[k] - returned)) <= limits.return_s
        if not refused[k]:
            last, returned, agreeing = time[k], _NEVER, 0
    if not len(time):
        return refused, state
    return refused, replace(
        state,
        time=last,
        place_m=float(coasted[-1]),
        distance_m=float(distances[-1]),
        returned=returned,
        agreeing=agreeing,
    )
