"""Channels of a log that the settings allow, and the second codes of their satellites.

Computed once for each set of channels: a log of a day has few, and most live epochs have the same one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks, Strings, read_only
from railfix.core.constants import CLOCK_GROUP, SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.gnss.orbits import SatelliteStates
from railfix.gnss.orbits.prepared_records import group_delay_s, group_delay_sigma_m, unhealthy
from railfix.pipeline.config import Config
from railfix.pipeline.received import Received
from railfix.positioning.normal_equations import clock_groups
from railfix.positioning.two_frequencies import SecondCodes
from railfix.ranges.corrected import DFMC_SIGNALS, PLAUSIBLE_CODE_M, SECOND_SIGNALS, channel_order, code_sigma_m

#: Signals with ten times the chip rate of L1 C/A, by constellation and band.
_FAST: Final = ("G5", "J5", "E5", "E7", "C5", "C6")
#: Their noise and multipath at the same C/N0: 0.4 on a phone (L5 against L1), 0.8 on an F9P (E5b against E1).
_FAST_NOISE: Final = 0.5


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
    code, cn0, delay_m, delay_sigma = np.full((4, *shape), np.nan)
    column, rank = np.full(shape, -1), np.zeros(shape, dtype=np.intp)
    for choice in range(second.shape[1]):
        at = second[:, choice]
        observed = np.where(at >= 0, obs.code_m[:, at], np.nan)
        delay, sigma, sick = _delays(received.navigation, channels, states, choice)
        usable = (observed > PLAUSIBLE_CODE_M[0]) & (observed < PLAUSIBLE_CODE_M[1]) & np.isfinite(delay) & ~sick
        here = usable & (column < 0)
        code = np.where(here, observed - delay, code)
        cn0 = np.where(here, obs.cn0_dbhz[:, at], cn0)
        delay_m, delay_sigma = np.where(here, delay, delay_m), np.where(here, sigma, delay_sigma)
        column, rank = np.where(here, at, column), np.where(here, choice, rank)
    channel = np.arange(shape[1])
    ratio = channels.second_ratio[channel, rank]
    noise = code_sigma_m(cn0, elevation_deg, noise=config.noise.replaced(floor_sigma_m=0.0))
    return SecondCodes(
        code_m=code + states.clock_m - ratio * ionosphere_m - troposphere_m,
        noise_m=noise * channels.second_noise[channel, rank],
        cn0_dbhz=cn0,
        group_delay_m=delay_m,
        delay_sigma_m=delay_sigma,
        ratio=ratio,
        pair=channel * second.shape[1] + rank,
        column=column,
    )


def missing_notes(received: Received, config: Config, second: SecondCodes | None) -> tuple[str, ...]:
    """Return notes where no navigation record is known, and where two frequencies are asked for and one is used."""
    known, notes = received.navigation, []
    if known.precise is None and not len(known.kepler) and not len(known.glonass):
        notes.append("no navigation record is known; give navigation to EpochProcessor or to process")
    if config.frequencies == "two" and second is None:
        why = "SBAS on L1 corrects one" if config.sbas else "no satellite has a second code"
        why = why if received.base is None else "a base station subtracts errors of one"
        notes.append(f"frequencies: two asked for, one used: {why}")
    return tuple(notes)


def relative_noise(signal: str) -> float:
    """Return noise and multipath of a signal ("G5Q") over those of L1 C/A at the same C/N0."""
    return _FAST_NOISE if signal[:2] in _FAST else 1.0


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


#: Sets of channels remembered.
_REMEMBERED: Final = 64


@dataclass(frozen=True, kw_only=True)
class Channels:
    """M channels of a log, and the K of them that settings allow."""

    #: Where they stand in the observations, those of one clock side by side, a satellite's best signal first; shape
    #: (K,).
    columns: Indices
    #: Shape (K,).
    satellite: Strings
    signal: Strings
    groups: tuple[slice, ...]  #: Channels of one receiver clock.
    clocks: tuple[str, ...]  #: Letter of each receiver clock.
    clock: Strings  #: Letter of the receiver clock of each channel, shape (K,).
    frequency_hz: Floats  #: Shape (K,).
    every_frequency_hz: Floats  #: Shape (M,).
    left_out: Integers  #: Reason of the channels that settings leave out, 0 for the others; shape (M,).
    member: Integers  #: 1 where a channel is of a satellite, S satellites; shape (M, S).
    #: Columns of the second signals of each channel's satellite, in order of preference; -1 for none. P is 0 with one
    #: frequency; shape (K, P).
    second: Indices
    #: Signal with the letter of the constellation, square of the first frequency over it, and its noise over that of L1
    #: C/A; shape (K, P).
    second_signal: Strings
    second_ratio: Floats
    second_noise: Floats
    pair_names: tuple[str, ...]  #: Satellite and both signals, length K P.
    pair_groups: Integers  #: Number of the pairs with one delay in the receiver, shape (K P,).

    @cached_property
    def names(self) -> Strings:
        """Satellite and signal, shape (K,)."""
        return np.char.add(self.satellite, self.signal)

    @cached_property
    def clock_number(self) -> Indices:
        """Number of the receiver clock of each channel, shape (K,)."""
        return np.array([self.clocks.index(letter) for letter in self.clock.tolist()], dtype=np.intp)


class ChannelBook:
    """Channels of observations under some settings, computed once for each set of channels."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._known: dict[tuple[object, ...], Channels] = {}

    def of(self, obs: Observations, navigation: Navigation) -> Channels:
        """Return the channels of some observations; GLONASS frequencies are those of the log, then of the records."""
        glonass = {**glonass_channels(navigation), **obs.header.glonass_channel}
        key = (
            obs.satellite.tobytes(),
            obs.signal.tobytes(),
            obs.satellite.dtype.str,
            obs.signal.dtype.str,
            tuple(glonass.items()),
        )
        channels = self._known.get(key)
        if channels is None:
            while len(self._known) >= _REMEMBERED:
                self._known.pop(next(iter(self._known)))
            channels = self._known[key] = self._select(obs, glonass)
        return channels

    def _select(self, obs: Observations, glonass: Mapping[str, int]) -> Channels:
        systems, signals = self._config.systems, self._config.signals
        if self._config.dual_frequency_sbas:
            signals = {name: (*DFMC_SIGNALS.get(name, ((),))[0], *own) for name, own in signals.items()}
        columns = channel_order(obs.satellite, obs.signal, systems=systems, signals=signals)
        unwanted = np.isin(obs.satellite, self._config.exclude) | np.isin(obs.system, self._config.exclude)
        columns = columns[~unwanted[columns]]
        satellite, signal = obs.satellite[columns], obs.signal[columns]
        groups = clock_groups(satellite.astype("<U1"))
        left_out = np.where(np.isin(obs.system, systems), Reason.OTHER_SIGNAL_TAKEN, Reason.SYSTEM_NOT_SELECTED)
        left_out[columns] = Reason.USED
        left_out[unwanted] = Reason.EXCLUDED_BY_SETTING
        names, which = np.unique(obs.satellite, return_inverse=True)
        frequency = carrier_frequency_hz(obs.satellite, obs.signal, glonass)
        letters = [CLOCK_GROUP[name[0]] for name in satellite.tolist()]
        return Channels(
            columns=read_only(columns),
            satellite=read_only(satellite),
            signal=read_only(signal),
            groups=groups,
            clocks=tuple(letters[group.start] for group in groups),
            clock=read_only(np.array(letters, dtype="<U1")),
            frequency_hz=read_only(frequency[columns]),
            every_frequency_hz=read_only(frequency),
            left_out=read_only(left_out.astype(np.int64)),
            member=read_only((which[:, None] == np.arange(len(names))).astype(np.int64)),
            **self._second(obs, columns, frequency),
        )

    def _second(self, obs: Observations, columns: Indices, frequency_hz: Floats) -> dict[str, Any]:
        """Return the second signals of the channels (`Channels`)."""
        wanted: Mapping[str, Sequence[str]] = SECOND_SIGNALS if self._config.frequencies == "two" else {}
        if self._config.dual_frequency_sbas:
            wanted = {letter: second for letter, (_, second) in DFMC_SIGNALS.items()}
        of_satellite: dict[str, dict[str, int]] = {}
        for i, (name, signal) in enumerate(zip(obs.satellite.tolist(), obs.signal.tolist(), strict=True)):
            of_satellite.setdefault(name, {})[signal] = i
        rows = []
        for column in columns.tolist():
            own = of_satellite[name := str(obs.satellite[column])]
            order = [own[signal] for signal in wanted.get(name[0], ()) if signal in own]
            rows.append([i for i in order if frequency_hz[i] < frequency_hz[column]])
        width = max(map(len, rows), default=0)
        second = np.array([row + [-1] * (width - len(row)) for row in rows], dtype=np.intp).reshape(len(rows), width)
        letter = np.char.add(obs.satellite.astype("<U1"), obs.signal)
        signal = np.where(second >= 0, letter[second], "") if width else np.empty(second.shape, dtype="<U3")
        # BeiDou-2 (C01 to C16) and BeiDou-3 differ by metres in a receiver
        kind = ["C3" if name[0] == "C" and name > "C16" else name[0] for name in obs.satellite[columns].tolist()]
        pairs = [
            (f"{satellite} {first} {other[1:]}", f"{group} {first} {other[1:]}")
            for satellite, first, group, others in zip(
                obs.satellite[columns].tolist(), obs.signal[columns].tolist(), kind, signal.tolist(), strict=True
            )
            for other in others
        ]
        _, groups = np.unique(np.array([group for _, group in pairs], dtype="<U12"), return_inverse=True)
        ratio = (frequency_hz[columns][:, None] / frequency_hz[second]) ** 2 if width else np.empty(second.shape)
        noise = np.array([[relative_noise(other) for other in others] for others in signal.tolist()], dtype=np.float64)
        return {
            "second": read_only(second),
            "second_signal": read_only(signal),
            "second_ratio": read_only(np.where(second >= 0, ratio, 2.0)),
            "second_noise": read_only(noise.reshape(second.shape)),
            "pair_names": tuple(name for name, _ in pairs),
            "pair_groups": read_only(groups.astype(np.intp)),
        }
