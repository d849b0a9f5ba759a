"""Second codes of the satellites, and their combination with the first."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks, changed
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.gnss.orbits import SatelliteStates
from railfix.gnss.orbits.prepared_records import group_delay_s, group_delay_sigma_m, unhealthy
from railfix.positioning.two_frequencies import SecondCodes, TwoFrequencyState, combine_codes
from railfix.ranges.atmosphere import thin_shell_obliquity
from railfix.ranges.weights import PLAUSIBLE_CODE_M, code_sigma_m
from railfix.screens import Screened, Verdict

if TYPE_CHECKING:
    from railfix.pipeline.channels import Channels
    from railfix.pipeline.config import Config
    from railfix.pipeline.corrected_ranges import CorrectedRanges
    from railfix.pipeline.received import Received

#: Signals with ten times the chip rate of L1 C/A, by constellation and band.
_FAST: Final = ("G5", "J5", "E5", "E7", "C5", "C6")
#: Their noise and multipath at the same C/N0: 0.4 on a phone (L5 against L1), 0.8 on an F9P (E5b against E1).
_FAST_NOISE: Final = 0.5
#: Key of the verdict.
NAME: Final = "two_frequencies"


def second_codes(
    obs: Observations,
    channels: Channels,
    states: SatelliteStates,
    received: Received,
    elevation_deg: Floats,
    ionosphere_m: Floats,
    troposphere_m: Floats,
    config: Config,
) -> SecondCodes | None:
    """Return the second code of each satellite, corrected as the first one; None where no channel has one.

    The first signal of the order of preference that is observed, healthy and has a group delay. Satellite and clock
    are those of the first code, and so is the record that the group delay belongs to; where that record lacks a part of
    it and another message of the satellite has it, the other's.
    """
    second = channels.second
    if not second.size:
        return None
    shape = states.record.shape
    code, cn0, delay_sigma = np.full((3, *shape), np.nan)
    column, rank = np.full(shape, -1), np.zeros(shape, dtype=np.intp)
    for choice in range(second.shape[1]):
        at = second[:, choice]
        observed = np.where(at >= 0, obs.code_m[:, at], np.nan)
        delay, sigma, sick = _delays(received.navigation, channels, states, choice)
        usable = (observed > PLAUSIBLE_CODE_M[0]) & (observed < PLAUSIBLE_CODE_M[1]) & np.isfinite(delay) & ~sick
        here = usable & (column < 0)
        code = np.where(here, observed - delay, code)
        cn0 = np.where(here, obs.cn0_dbhz[:, at], cn0)
        delay_sigma = np.where(here, sigma, delay_sigma)
        column, rank = np.where(here, at, column), np.where(here, choice, rank)
    channel = np.arange(shape[1])
    ratio = channels.second_ratio[channel, rank]
    noise = code_sigma_m(cn0, elevation_deg, noise=config.noise.replaced(floor_sigma_m=0.0))
    return SecondCodes(
        code_m=code + states.clock_m - ratio * ionosphere_m - troposphere_m,
        noise_m=noise * channels.second_noise[channel, rank],
        cn0_dbhz=cn0,
        delay_sigma_m=delay_sigma,
        ratio=ratio,
        pair=channel * second.shape[1] + rank,
        column=column,
    )


def noise_of(signal: str) -> float:
    """Return noise and multipath of a signal ("G5Q") over those of L1 C/A at the same C/N0."""
    return _FAST_NOISE if signal[:2] in _FAST else 1.0


def combined(
    ranges: CorrectedRanges, config: Config, ionosphere_sigma_m: float, state: TwoFrequencyState
) -> tuple[CorrectedRanges, TwoFrequencyState]:
    """Return the ranges with two codes combined, and weighted down where the two disagree."""
    second = ranges.second
    if second is None:
        return ranges, state
    usable = ranges.reason == 0
    noise = np.sqrt(np.maximum(ranges.sigma_m**2 - config.noise.floor_sigma_m**2, 1e-4))
    vertical = np.hypot(config.nominal.ionosphere_sigma_m, ionosphere_sigma_m)
    found, state = combine_codes(
        ranges.time,
        np.where(usable, ranges.corrected_code_m, np.nan),
        noise,
        second,
        vertical * thin_shell_obliquity(ranges.elevation_deg),
        (ranges.channels.pair_names, ranges.channels.pair_groups),
        state,
        config.two_frequencies,
    )
    joint = np.isfinite(found.share)
    magnified = np.where(joint, np.abs(1.0 - found.share) + np.abs(found.share), 1.0)
    ranges = changed(
        ranges,
        corrected_code_m=np.where(joint, found.code_m, ranges.corrected_code_m),
        sigma_m=np.where(joint, np.sqrt(ranges.sigma_m**2 + found.variance_m2), ranges.sigma_m),
        bound_sigma_m=ranges.bound_sigma_m * magnified,
        bias_m=ranges.bias_m * magnified,
        combined=found,
    )
    screened = Screened(metric=found.difference_m, reject=found.suspected)
    verdict = Verdict(name=NAME, reason=Reason.USED, screened=screened, error_m=found.difference_m)
    return ranges.judged([verdict]), state


def _delays(
    navigation: Navigation, channels: Channels, states: SatelliteStates, choice: int
) -> tuple[Floats, Floats, Masks]:
    """Return group delay and its sigma [m], and ill health of a choice of second signals, shapes (T, K)."""
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
    """Return group delay, its standard deviation and ill health of a signal by record, shape (n,) [m].

    GPS, QZSS and BeiDou: the clocks of all messages refer to the same signals, so that a delay which a record lacks is
    that of the satellite's record of another message with the nearest reference time.
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
