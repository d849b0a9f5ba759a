"""Channels of a log that the settings allow, computed once for each set of channels.

A log of a day has few sets of channels, and most live epochs have the same one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Strings, read_only
from railfix.core.constants import CLOCK_GROUP
from railfix.core.reasons import Reason
from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.observations import Observations
from railfix.gnss.signals import carrier_frequency_hz
from railfix.pipeline.config import Config
from railfix.positioning.normal_equations import clock_groups
from railfix.ranges.weights import channel_order

#: Sets of channels remembered.
_REMEMBERED: Final = 64


@dataclass(frozen=True, kw_only=True)
class Channels:
    """M channels of a log, and the K of them that settings allow.

    Attributes
    ----------
    columns : ndarray of int, shape (K,)
        Where they stand in the observations, those of one clock side by side, a satellite's best signal first.
    satellite, signal : ndarray of str, shape (K,)
    groups : tuple of slice
        Channels of one receiver clock.
    clocks : tuple of str
        Letter of each receiver clock.
    clock : ndarray of str, shape (K,)
        Letter of the receiver clock of each channel.
    frequency_hz : ndarray, shape (K,) [Hz]
    every_frequency_hz : ndarray, shape (M,) [Hz]
    left_out : ndarray of int64, shape (M,)
        Reason of the channels that settings leave out, 0 for the others.
    member : ndarray of int64, shape (M, S)
        1 where a channel is of a satellite, S satellites.
    """

    columns: Indices
    satellite: Strings
    signal: Strings
    groups: tuple[slice, ...]
    clocks: tuple[str, ...]
    clock: Strings
    frequency_hz: Floats
    every_frequency_hz: Floats
    left_out: Integers
    member: Integers


class ChannelBook:
    """Channels of observations under some settings, computed once for each set of channels.

    Parameters
    ----------
    config : Config
    """

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
        )
