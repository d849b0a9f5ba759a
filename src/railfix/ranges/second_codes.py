"""Second-frequency codes of each satellite, corrected like the first code."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks, copy_with
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.gnss.navigation import KeplerRecords, Navigation
from railfix.gnss.orbits import SatelliteStates
from railfix.gnss.orbits.prepared_records import P_CODES, group_delay_s, unhealthy
from railfix.ranges.channels import PLAUSIBLE_CODE_M, Channels
from railfix.ranges.corrected import CorrectedRanges, SecondCodes
from railfix.ranges.range_sigma import CodeNoise, code_sigma_m
from railfix.ranges.sources import CorrectionSource


def find_second_codes(corrected: CorrectedRanges, source: CorrectionSource, noise: CodeNoise) -> CorrectedRanges:
    """Return the ranges with the second code of each satellite, corrected like the first code.

    The second code is from the first signal, in order of preference, that is observed and healthy and has a group
    delay. Satellite position and clock are the same as for the first code, and the group delay is from the same record;
    where the record lacks a part of the group delay, a record of another message type is used. Where `source` requires
    second codes, satellites without a second code are rejected with the reason `sbas_no_ionosphere`.
    """
    channels = corrected.channels
    second = _correct_second_codes(corrected, source.navigation, noise) if channels.second.shape[1] else None
    if source.second == "required":
        alone = np.isnan(second.code_m) if second is not None else np.ones(corrected.reason.shape, dtype=bool)
        reason = np.where((corrected.reason == 0) & alone, int(Reason.SBAS_NO_IONOSPHERE), corrected.reason)
        corrected = copy_with(corrected, reason=reason)
    return copy_with(corrected, second=second)


def _correct_second_codes(corrected: CorrectedRanges, navigation: Navigation, noise: CodeNoise) -> SecondCodes:
    """Return the second code of each satellite, corrected like the first code."""
    obs, channels, states = corrected.observations, corrected.channels, corrected.satellites
    second = channels.second
    shape = states.record.shape
    code, cn0, delay_m, delay_sigma = np.full((4, *shape), np.nan)
    column, rank = np.full(shape, -1), np.zeros(shape, dtype=np.intp)
    for choice in range(second.shape[1]):
        at = second[:, choice]
        observed = np.where(at >= 0, obs.code_m[:, at], np.nan)
        delay, sigma, sick = _delays(navigation, channels, states, choice)
        usable = (observed > PLAUSIBLE_CODE_M[0]) & (observed < PLAUSIBLE_CODE_M[1]) & np.isfinite(delay) & ~sick
        here = usable & (column < 0)
        code = np.where(here, observed - delay, code)
        cn0 = np.where(here, obs.cn0_dbhz[:, at], cn0)
        delay_m, delay_sigma = np.where(here, delay, delay_m), np.where(here, sigma, delay_sigma)
        column, rank = np.where(here, at, column), np.where(here, choice, rank)
    channel = np.arange(shape[1])
    ratio = channels.second_ratio[channel, rank]
    sigma = code_sigma_m(cn0, corrected.elevation_deg, noise=noise.replaced(floor_sigma_m=0.0))
    return SecondCodes(
        code_m=code + states.clock_m - ratio * corrected.ionosphere_m - corrected.troposphere_m,
        noise_m=sigma * channels.second_noise[channel, rank],
        cn0_dbhz=cn0,
        group_delay_m=delay_m,
        delay_sigma_m=delay_sigma,
        ratio=ratio,
        pair=channel * second.shape[1] + rank,
        column=column,
    )


def _delays(
    navigation: Navigation, channels: Channels, states: SatelliteStates, choice: int
) -> tuple[Floats, Floats, Masks]:
    """Return the group delay and its sigma [m], and whether the chosen second signals are unhealthy, each (T, K)."""
    shape = states.record.shape
    delay, sigma = np.full(shape, np.nan), np.zeros(shape)
    sick = np.zeros(shape, dtype=bool)
    for signal in np.unique(channels.second_signal[:, choice]).tolist():
        if not signal:
            continue
        here = channels.second_signal[:, choice] == signal
        of_record = signal_delays(navigation, signal[1:])
        row = states.record[:, here]
        known = row >= 0
        values = (np.where(known, each[row], fill) for each, fill in zip(of_record, (np.nan, 0.0, True), strict=True))
        delay[:, here], sigma[:, here], sick[:, here] = values
    return delay, sigma, sick.astype(bool)


@lru_cache(maxsize=64)
def signal_delays(navigation: Navigation, signal: str) -> tuple[Floats, Floats, Masks]:
    """Return the group delay of a signal and its sigma [m], and whether the signal is unhealthy, for n records.

    For GPS, QZSS and BeiDou, the clocks of all message types refer to the same signals. A missing delay is therefore
    taken from the record of another message type that is nearest in time.
    """
    records = navigation.kepler
    clock = "ionosphere_free" if navigation.precise is not None else "broadcast"
    delay = SPEED_OF_LIGHT * group_delay_s(records, signal, clock=clock)  # type: ignore[arg-type]
    sigma = group_delay_sigma_m(records, signal)
    whole = np.isfinite(delay) & (sigma == 0.0)
    lacking = (
        ~whole & np.isin(records.satellite, records.satellite[whole]) & ~np.char.startswith(records.satellite, "E")
    )
    of_satellite: Mapping[str, Indices] = {
        name: np.flatnonzero(whole & (records.satellite == name)) for name in np.unique(records.satellite[lacking])
    }
    for i in np.flatnonzero(lacking):
        rows = of_satellite[records.satellite[i]]
        nearest = rows[np.argmin(np.abs(records.toe[rows] - records.toe[i]))]
        delay[i], sigma[i] = delay[nearest], 0.0
    return delay, sigma, unhealthy(records, signal)


#: Standard deviation of the group delay on L2 and L5 if the inter-signal corrections (ISC) are missing [m]. For GPS
#: satellites whose CNAV had ISC on 2025-02-15, the difference between TGD - ISC and the delay used without ISC has a
#: standard deviation of 0.24 m on L2C and 0.55 m on L5Q (`tests/gnss/test_group_delays.py`).
_WITHOUT_ISC_M: Final[Mapping[str, float]] = {"2": 0.3, "5": 0.6}


def group_delay_sigma_m(records: KeplerRecords, signal: str) -> Floats:
    """Return the sigma of the group delay, shape (n,) [m]; nonzero only for L2C and L5 with LNAV, which lacks ISC."""
    lacking = np.isin(records.satellite.astype("<U1"), ["G", "J"]) & (records.message == "LNAV")
    return np.where(lacking, _WITHOUT_ISC_M.get(signal[:1], 0.0) * (signal not in P_CODES), 0.0)
