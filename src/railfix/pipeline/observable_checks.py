"""Check of signs and units of Dopplers and carrier phases against satellite range rates.

A satellite's motion changes its range by up to 800 m/s, much more than a train or a receiver clock does. The factor,
the ratio of a constellation's Dopplers or phase changes to the computed range rates, should be 1. It is -1 if the sign
is wrong, and the wavelength if the log has metres in place of cycles.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.array_functions import masked_median
from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings, copy_with
from railfix.core.channel_state import join_channels
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.timescale import seconds
from railfix.gnss.observations import Observations
from railfix.ranges.corrected import CorrectedRanges

#: A satellite contributes to a factor if its range rate differs from the constellation's median by at least this [m/s].
_LEAST_RATE_MPS: Final = 100.0
#: A factor requires at least this number of satellites, and one more because the median rate is subtracted.
_LEAST_SATELLITES: Final = 3
#: With at least this number of satellites, a factor is valid even if one satellite deviates from it. With only four
#: satellites, a cycle slip of one satellite changes the ratios of all satellites.
_MANY: Final = 6
#: A satellite deviates from the factor if its own ratio differs from the median by more than this.
_SPREAD: Final = 0.3
#: Dopplers or phases are removed if their factor differs from 1 by more than this; train speed also affects the factor.
_RIGHT: Final = 0.5
#: Phase changes are not computed over more than this time [s].
_LONGEST_S: Final = 35.0
_KINDS: Final = ("Dopplers", "phases")
_UNITS: Final = ("Hz", "cycles")
_NAMES: Final = {"G": "GPS", "J": "QZSS", "E": "Galileo", "C": "BeiDou", "R": "GLONASS"}


@dataclass(frozen=True, kw_only=True)
class ObservableState:
    """State of the checks of one antenna after a chunk."""

    #: Last factors of Dopplers and of phases, NaN before the first factor; shape (2, L).
    factor: Floats = field(default_factory=lambda: np.empty((2, 0)))
    #: Constellation letters, shape (L,); "" stands for all constellations together.
    letter: Strings = field(default_factory=lambda: np.zeros(0, dtype="<U1"))
    #: Names, phases and range rates of the channels at the last epoch used for factors, shape (K,) each.
    channel: Strings = field(default_factory=lambda: np.zeros(0, dtype="<U6"))
    phase_m: Floats = field(default_factory=lambda: np.zeros(0))
    rate_mps: Floats = field(default_factory=lambda: np.zeros(0))
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))


def check_observables(
    corrected: CorrectedRanges, state: ObservableState
) -> tuple[CorrectedRanges, list[str], ObservableState]:
    """Remove Dopplers and phases of wrong sign or unit; return ranges, a note on each fault, and the state.

    The estimated ratio of observed to computed values of a constellation applies until the next estimate. Before the
    first estimate, the ratio of all constellations together applies.
    """
    second = corrected.time.astype("datetime64[s]")
    chosen = np.diff(second, prepend=np.array([state.time], dtype=second.dtype)) != np.timedelta64(0, "s")
    sight = corrected.satellites.position_ecef_m[chosen] - corrected.near_ecef_m[chosen, None, :]
    sight = sight / np.linalg.norm(sight, axis=2, keepdims=True)
    rate = (sight * corrected.satellites.velocity_ecef_mps[chosen]).sum(axis=2)
    wavelength = SPEED_OF_LIGHT / corrected.frequency_hz
    phase = wavelength * corrected.observations.phase_cycles[:, corrected.columns]
    names, time = corrected.channels.names, corrected.time[chosen]
    changes, after = _phase_rates(time, names, phase[chosen], rate, state)
    letters = corrected.satellite.astype("<U1")
    bad: dict[int, Masks] = {}
    notes: list[str] = []
    before = dict(zip(state.letter.tolist(), state.factor.T.tolist(), strict=True))
    factors = {letter: before.get(letter, [np.nan, np.nan]) for letter in {**before, **dict.fromkeys(["", *letters])}}
    doppler = -wavelength * corrected.doppler_hz
    for kind, (all_of_kind, observed, expected) in enumerate(((doppler, doppler[chosen], rate), (phase, *changes))):
        wrong, found = np.zeros(all_of_kind.shape, dtype=np.bool_), {}
        for letter in ["", *np.unique(letters).tolist()]:
            own = (letters == letter) | (letter == "")
            found[letter] = _held(rate_factor(observed[:, own], expected[:, own]), factors[letter][kind], chosen)
            factors[letter][kind] = float(found[letter][-1]) if len(chosen) else factors[letter][kind]
            factor = np.where(np.isnan(found[letter]), found[""], found[letter])
            off = (np.abs(factor - 1.0) > _RIGHT) & np.isfinite(all_of_kind[:, own]).any(axis=1)
            if letter and off.any():
                wrong[:, own] = off[:, None]
                notes.append(_sentence(kind, letter, float(np.median(factor[off])), float(np.median(wavelength[own]))))
        if wrong.any():
            bad[kind] = wrong
    if bad:
        corrected = _without(corrected, letters, bad)
    last = copy_with(after, letter=np.array(list(factors), dtype="<U1"), factor=np.array(list(factors.values())).T)
    return corrected, notes, last


def rate_factor(observed_mps: Floats, expected_mps: Floats) -> Floats:
    """Return the ratio of observed to computed satellite rates, shape (T,); NaN where it cannot be determined.

    The rates of one constellation have shape (T, K); their median over the satellites is subtracted at each epoch. The
    factor is the median of the satellites' ratios.
    """
    known = np.isfinite(observed_mps) & np.isfinite(expected_mps)
    few = known.sum(axis=1) <= _LEAST_SATELLITES
    observed, expected = (
        np.where(known, each, np.nan) - masked_median(each, known)[:, None] for each in (observed_mps, expected_mps)
    )
    clear = known & (np.abs(np.nan_to_num(expected)) >= _LEAST_RATE_MPS)
    ratio = np.where(clear, observed, np.nan) / np.where(clear, expected, 1.0)
    factor = masked_median(ratio, clear)
    near = clear & (np.abs(ratio - factor[:, None]) <= _SPREAD)
    count = clear.sum(axis=1)
    unclear = few | (count < _LEAST_SATELLITES) | (near.sum(axis=1) < count - (count >= _MANY))
    return np.where(unclear, np.nan, factor)


def _held(factor: Floats, before: float, chosen: Masks) -> Floats:
    """Return the last known factor of the chosen epochs up to each epoch (T,); at first, the value of `before`."""
    values = np.concatenate([[before], factor])
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return np.asarray(values[last][np.cumsum(chosen)])


def _phase_rates(
    time: Datetimes, channel: Strings, phase_m: Floats, rate_mps: Floats, state: ObservableState
) -> tuple[tuple[Floats, Floats], ObservableState]:
    """Return phase rates and mean range rates since the previous epoch [m/s], shape (T, K) each, and the state."""
    if not len(time):
        return (phase_m, rate_mps), state
    joined = join_channels(channel, [state.channel])
    phase, rate = (
        np.concatenate([joined.arrange(before, np.nan)[None], joined.widen(now, np.nan)])
        for before, now in ((state.phase_m, phase_m), (state.rate_mps, rate_mps))
    )
    interval = seconds(np.diff(time, prepend=np.array([state.time], dtype=time.dtype)))
    interval = np.where(interval <= _LONGEST_S, interval, np.nan)
    change, mean = np.diff(phase, axis=0) / interval[:, None], 0.5 * (rate[1:] + rate[:-1])
    known = slice(0, joined.present)
    after = ObservableState(channel=channel, phase_m=phase_m[-1], rate_mps=rate_mps[-1], time=time[-1])
    return (change[:, known], mean[:, known]), after


def _without(corrected: CorrectedRanges, letters: Strings, bad: dict[int, Masks]) -> CorrectedRanges:
    """Remove Dopplers and phases; `bad` has a mask (T, K) for each faulty kind (0: Dopplers, 1: phases)."""
    obs: Observations = corrected.observations
    of_channel: Indices = (obs.satellite.astype("<U1")[:, None] == letters).astype(np.intp)
    values = {"doppler_hz": obs.doppler_hz, "phase_cycles": obs.phase_cycles}
    for kind, name in enumerate(values):
        if kind in bad:
            values[name] = np.where(bad[kind].astype(np.intp) @ of_channel.T > 0, np.nan, values[name])
    doppler = np.where(bad[0], np.nan, corrected.doppler_hz) if 0 in bad else corrected.doppler_hz
    return copy_with(corrected, observations=copy_with(obs, **values), doppler_hz=doppler)


def _sentence(kind: int, letter: str, factor: float, wavelength_m: float) -> str:
    """Return a sentence on the fault of a constellation's Dopplers or phases."""
    if abs(factor + 1.0) <= _RIGHT:
        wrong = "have the wrong sign"
    elif abs(abs(factor) - wavelength_m) < 0.1:
        metres = "metres a second" if kind == 0 else "metres"
        wrong = f"are in {metres}, not in {_UNITS[kind]}{', and have the wrong sign' if factor < 0.0 else ''}"
    else:
        wrong = f"are {factor:.2g} times the values computed from satellite motion: their unit is not {_UNITS[kind]}"
    return f"the {_KINDS[kind]} of {_NAMES.get(letter, letter)} {wrong}; they are not used"
