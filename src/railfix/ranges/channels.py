"""Selection of the channels of a log, by constellation and by preference of signals."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks, Strings, read_only
from railfix.core.constants import CLOCK_GROUP
from railfix.core.reasons import Reason
from railfix.gnss.observations import carrier_frequency_hz

#: Codes outside these limits are implausible [m]; receiver clock offsets up to 33 ms are allowed for.
PLAUSIBLE_CODE_M: Final = (1e7, 1e8)


#: Signals near L1 in order of preference, as RINEX 3 codes without the type letter.
DEFAULT_SIGNALS: Final[Mapping[str, tuple[str, ...]]] = {
    "G": ("1C", "1W", "1P", "1X", "1L", "1S"),
    "J": ("1C", "1X", "1L", "1S", "1Z"),
    "E": ("1C", "1X", "1B", "1Z", "1A"),
    "C": ("2I", "2X", "2Q"),
    "R": ("1C", "1P"),
}

#: Second signals in order of preference. L2 comes before L5 for GPS and QZSS, because LNAV lacks the group delay of L5
#: (`railfix.ranges.second_codes.group_delay_sigma_m`).
SECOND_SIGNALS: Final[Mapping[str, tuple[str, ...]]] = {
    "G": ("2L", "2X", "2S", "2W", "5Q", "5X", "5I"),
    "J": ("2L", "2X", "2S", "5Q", "5X", "5I"),
    "E": ("5Q", "5X", "5I", "7Q", "7X", "7I"),
    "C": ("7I", "7Q", "7X", "6I", "6Q", "6X", "5P", "5X", "5D"),
}

#: First and second signals of the ionosphere-free codes that SBAS on L5 corrects, by constellation.
DFMC_SIGNALS: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]] = {
    "G": (("1C",), ("5Q", "5X", "5I")),
    "E": (("1C", "1X", "1B"), ("5Q", "5X", "5I")),
    "C": (("1P", "1X", "1D"), ("5P", "5X", "5D")),
}

#: Signals with ten times the chip rate of L1 C/A, by constellation and band.
_FAST: Final = ("G5", "J5", "E5", "E7", "C5", "C6")
#: Noise and multipath of the `_FAST` signals relative to L1 C/A at the same C/N0. Measured ratios are 0.4 on a phone
#: (L5 to L1) and 0.8 on an F9P (E5b to E1).
_FAST_NOISE: Final = 0.5


def relative_noise(signal: str) -> float:
    """Return the noise and multipath of a signal such as "G5Q", relative to L1 C/A at the same C/N0."""
    return _FAST_NOISE if signal[:2] in _FAST else 1.0


def clock_groups(system: Sequence[str] | Strings) -> tuple[slice, ...]:
    """Return one slice per receiver clock; raise ValueError if the channels of a clock are not adjacent."""
    clocks = [CLOCK_GROUP[str(letter)] for letter in system]
    starts = [i for i, clock in enumerate(clocks) if i == 0 or clock != clocks[i - 1]]
    if len({clocks[i] for i in starts}) != len(starts):
        raise ValueError(f"channels of one clock must be adjacent, got {clocks}")
    return tuple(slice(a, b) for a, b in pairwise([*starts, len(clocks)]))


def channel_order(
    satellite: Strings, signal: Strings, *, systems: Sequence[str], signals: Mapping[str, Sequence[str]]
) -> Indices:
    """Return the indices of usable channels, sorted by clock, satellite and preference of `signals`, shape (K,)."""
    keys = []
    for i, (name, code) in enumerate(zip(satellite.tolist(), signal.tolist(), strict=True)):
        letter = name[0]
        preference = signals.get(letter, ())
        if letter in systems and code in preference:
            keys.append((CLOCK_GROUP[letter], name, preference.index(code), i))
    return np.array([key[-1] for key in sorted(keys)], dtype=np.intp)


def first_available(satellite: Strings, available: Masks) -> Masks:
    """Return a mask (T, K) of each satellite's first available channel at each epoch."""
    starts = np.flatnonzero(np.append(True, satellite[1:] != satellite[:-1])) if len(satellite) else np.empty(0, int)
    if len(starts) == len(satellite):
        return available.copy()
    count = np.cumsum(available, axis=1)
    before = np.where(starts > 0, count[:, starts - 1], 0)
    offset = np.repeat(before, np.diff(np.append(starts, len(satellite))), axis=1)
    return np.asarray(available & (count - offset == 1))


@dataclass(frozen=True, kw_only=True)
class Channels:
    """The M channels of a log, and the K channels selected by the settings."""

    #: Columns of the selected channels in the observations, shape (K,). Channels that share a receiver clock are
    #: adjacent. The channels of a satellite are in order of preference.
    columns: Indices
    #: Satellite and signal of each selected channel, shape (K,).
    satellite: Strings
    signal: Strings
    groups: tuple[slice, ...]  #: For each receiver clock, the slice of its channels.
    clocks: tuple[str, ...]  #: Letter of each receiver clock (`CLOCK_GROUP`).
    clock: Strings  #: Letter of the receiver clock of each channel, shape (K,).
    frequency_hz: Floats  #: Carrier frequency of each selected channel, shape (K,).
    every_frequency_hz: Floats  #: Carrier frequency of each channel of the log, shape (M,).
    left_out: Integers  #: Reason why a channel is not selected, shape (M,); 0 for selected channels.
    member: Integers  #: 1 where a channel belongs to one of the S satellites, else 0; shape (M, S).
    #: Columns, in the observations, of the second signals of each channel's satellite in order of preference, shape (K,
    #: P); -1 where the log has no such signal. P is 0 if no second signals are wanted, else at least 1.
    second: Indices
    second_signal: Strings  #: Second signals with constellation letter ("G5Q"); "" for none; shape (K, P).
    second_ratio: Floats  #: Squared ratio of the first to the second frequency, shape (K, P).
    second_noise: Floats  #: Noise of the second signals relative to L1 C/A at equal C/N0, shape (K, P).
    pair_names: tuple[str, ...]  #: Satellite and signals of each pair of first and second code, length K * P.
    pair_groups: Integers  #: Group of each pair, shape (K * P,). The pairs of a group share a receiver delay.

    @cached_property
    def names(self) -> Strings:
        """Name of each channel: satellite and signal, shape (K,)."""
        return np.char.add(self.satellite, self.signal)

    @cached_property
    def clock_number(self) -> Indices:
        """Index in `clocks` of the receiver clock of each channel, shape (K,)."""
        return np.array([self.clocks.index(letter) for letter in self.clock.tolist()], dtype=np.intp)


def select_channels(
    satellite: Strings,
    signal: Strings,
    *,
    systems: Sequence[str] = ("G", "J", "E", "C"),
    signals: Mapping[str, Sequence[str]] = DEFAULT_SIGNALS,
    exclude: Collection[str] = (),
    second_signals: Mapping[str, Sequence[str]] | None = None,
    glonass_channel: Mapping[str, int] | None = None,
) -> Channels:
    """Select the channels of a log by constellation (P1 3.3) and signal.

    Parameters
    ----------
    satellite, signal : ndarray of str, shape (M,)
        Channels of the log. Signals are RINEX 3 codes without the type letter ("1C").
    systems : sequence of str
        Letters of the constellations: G GPS, J QZSS, E Galileo, C BeiDou, R GLONASS.
    signals : mapping of str to sequence of str
        Signals of each constellation in order of preference.
    exclude : collection of str
        Satellites that are left out; a letter leaves out a constellation.
    second_signals : mapping of str to sequence of str, optional
        Second-frequency signals of each constellation in order of preference; none by default.
    glonass_channel : mapping of str to int, optional
        Frequency numbers of GLONASS satellites.

    Raises
    ------
    ValueError
        A letter of `systems` is not the letter of a constellation.
    """
    if unknown := [letter for letter in systems if letter not in CLOCK_GROUP]:
        raise ValueError(
            f"systems names {unknown[0]!r}, which is not a constellation; known are {', '.join(CLOCK_GROUP)}"
        )
    glonass = glonass_channel or {}
    system = satellite.astype("<U1")
    columns = channel_order(satellite, signal, systems=systems, signals=signals)
    unwanted = np.isin(satellite, list(exclude)) | np.isin(system, list(exclude))
    columns = columns[~unwanted[columns]]
    chosen = satellite[columns]
    groups = clock_groups(chosen.astype("<U1"))
    left_out = np.where(np.isin(system, systems), Reason.OTHER_SIGNAL_TAKEN, Reason.SYSTEM_NOT_SELECTED)
    left_out[columns] = Reason.USED
    left_out[unwanted] = Reason.EXCLUDED_BY_SETTING
    names, which = np.unique(satellite, return_inverse=True)
    frequency = carrier_frequency_hz(satellite, signal, glonass)
    letters = [CLOCK_GROUP[name[0]] for name in chosen.tolist()]
    return Channels(
        columns=read_only(columns),
        satellite=read_only(chosen),
        signal=read_only(signal[columns]),
        groups=groups,
        clocks=tuple(letters[group.start] for group in groups),
        clock=read_only(np.array(letters, dtype="<U1")),
        frequency_hz=read_only(frequency[columns]),
        every_frequency_hz=read_only(frequency),
        left_out=read_only(left_out.astype(np.int64)),
        member=read_only((which[:, None] == np.arange(len(names))).astype(np.int64)),
        **_second_channels(satellite, signal, columns, frequency, second_signals or {}),
    )


def _second_channels(
    every_satellite: Strings,
    every_signal: Strings,
    columns: Indices,
    frequency_hz: Floats,
    wanted: Mapping[str, Sequence[str]],
) -> dict[str, Any]:
    """Return the fields of `Channels` that describe second signals."""
    of_satellite: dict[str, dict[str, int]] = {}
    for i, (name, signal) in enumerate(zip(every_satellite.tolist(), every_signal.tolist(), strict=True)):
        of_satellite.setdefault(name, {})[signal] = i
    rows = []
    for column in columns.tolist():
        own = of_satellite[name := str(every_satellite[column])]
        order = [own[signal] for signal in wanted.get(name[0], ()) if signal in own]
        rows.append([i for i in order if frequency_hz[i] < frequency_hz[column]])
    width = max(map(len, rows), default=0) or int(bool(wanted))
    second = np.array([row + [-1] * (width - len(row)) for row in rows], dtype=np.intp).reshape(len(rows), width)
    letter = np.char.add(every_satellite.astype("<U1"), every_signal)
    signals = np.where(second >= 0, letter[second], "") if width else np.empty(second.shape, dtype="<U3")
    satellite, first = every_satellite[columns].tolist(), every_signal[columns].tolist()
    # the receiver delays of BeiDou-2 (C01 to C16) and BeiDou-3 differ by metres
    kind = ["C3" if name[0] == "C" and name > "C16" else name[0] for name in satellite]
    pairs = [
        (f"{name} {own} {other[1:]}", f"{group} {own} {other[1:]}")
        for name, own, group, others in zip(satellite, first, kind, signals.tolist(), strict=True)
        for other in others
    ]
    _, groups = np.unique(np.array([group for _, group in pairs], dtype="<U12"), return_inverse=True)
    ratio = (frequency_hz[columns][:, None] / frequency_hz[second]) ** 2 if width else np.empty(second.shape)
    noise = np.array([[relative_noise(other) for other in others] for others in signals.tolist()], dtype=np.float64)
    return {
        "second": read_only(second),
        "second_signal": read_only(signals),
        "second_ratio": read_only(np.where(second >= 0, ratio, 2.0)),
        "second_noise": read_only(noise.reshape(second.shape)),
        "pair_names": tuple(name for name, _ in pairs),
        "pair_groups": read_only(groups.astype(np.intp)),
    }
