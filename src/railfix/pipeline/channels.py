"""Channels of a log that the settings allow, computed once for each set of channels.

A log of a day has few sets of channels, and most live epochs have the same one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Strings, read_only
from railfix.core.constants import CLOCK_GROUP
from railfix.core.reasons import Reason
from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.observations import Observations
from railfix.gnss.signals import carrier_frequency_hz
from railfix.pipeline.config import Config
from railfix.pipeline.second_codes import noise_of
from railfix.positioning.normal_equations import clock_groups
from railfix.ranges.weights import SECOND_SIGNALS, channel_order

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
        systems = self._config.systems
        columns = channel_order(obs.satellite, obs.signal, systems=systems, signals=self._config.signals)
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
        wanted = SECOND_SIGNALS if self._config.frequencies == "two" else {}
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
        noise = np.array([[noise_of(other) for other in others] for others in signal.tolist()], dtype=np.float64)
        return {
            "second": read_only(second),
            "second_signal": read_only(signal),
            "second_ratio": read_only(np.where(second >= 0, ratio, 2.0)),
            "second_noise": read_only(noise.reshape(second.shape)),
            "pair_names": tuple(name for name, _ in pairs),
            "pair_groups": read_only(groups.astype(np.intp)),
        }
