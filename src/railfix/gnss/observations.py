"""Carrier frequencies, and observations of one receiver as read-only arrays.

Axis 0 is time, and axis 1 is the channel: one signal of one satellite. Absent values are NaN; 0 is a measured value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Floats, Indices, Masks, Strings, copy_with, freeze_arrays
from railfix.core.constants import CARRIER_FREQUENCY, GLONASS_STEP
from railfix.core.notebook import NotebookTable, plural, time_span_text
from railfix.core.timescale import gps_time


def carrier_frequency_hz(
    satellite: Strings, signal: Strings, glonass_channel: Mapping[str, int] | None = None
) -> Floats:
    """Return the carrier frequency of each channel, shape (M,) [Hz].

    Parameters
    ----------
    satellite, signal : ndarray of str, shape (M,)
        Names such as "R05", and signals such as "1C".
    glonass_channel : mapping of str to int, optional
        Frequency channel of GLONASS satellites.

    Returns
    -------
    ndarray, shape (M,) [Hz]
        NaN where the constellation has no such band, or a GLONASS channel is unknown.
    """
    channels = np.array([(glonass_channel or {}).get(name, np.nan) for name in satellite.tolist()], dtype=np.float64)
    return frequency_by_name_hz(np.char.add(satellite.astype("<U1"), signal), channels)


def frequency_by_name_hz(name: Strings, glonass_channel: Floats) -> Floats:
    """Return the carrier frequency [Hz] of signals such as "G1C", shape (..., M); NaN where it is unknown."""
    frequency = np.full(glonass_channel.shape, np.nan)
    for text in np.unique(name).tolist():
        letter, band = text[:1], text[1:2]
        chosen = name == text
        frequency[..., chosen] = CARRIER_FREQUENCY.get(letter, {}).get(band, np.nan)
        if letter == "R" and band in GLONASS_STEP:
            frequency[..., chosen] += glonass_channel[..., chosen] * GLONASS_STEP[band]
    return frequency


@dataclass(frozen=True, kw_only=True)
class ObservationHeader:
    """Header of an observation log."""

    version: float = float("nan")  #: RINEX version, NaN if the log is not a RINEX file.
    marker: str = ""
    receiver: str = ""  #: Receiver type, as in the file.
    antenna: str = ""  #: Antenna type, as in the file.
    #: APPROX POSITION XYZ [m], NaN if absent or all zero; shape (3,).
    approximate_ecef_m: Floats = field(default_factory=lambda: np.full(3, np.nan))
    #: Antenna height, and eccentricities east and north [m]; shape (3,).
    antenna_delta_hen_m: Floats = field(default_factory=lambda: np.zeros(3))
    interval_s: float = float("nan")  #: INTERVAL [s], NaN when absent.
    #: Frequency channels of GLONASS satellites ("R05" -> 1).
    glonass_channel: Mapping[str, int] = field(default_factory=dict)

    leap_seconds: int | None = None
    #: Signals declared for each constellation, as RINEX 3 codes without the type letter ("1C", "2W").
    signals: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    #: Whether time tags, codes and phases are already corrected for the receiver clock (RCV CLOCK OFFS APPL).
    receiver_clock_applied: bool = False


@dataclass(frozen=True, kw_only=True)
class Observations(NotebookTable):
    """Raw observations of one receiver, T epochs by M channels."""

    time: Datetimes  #: Receiver time tags in GPS time, not rounded, strictly rising; shape (T,).
    satellite: Strings  #: Satellite of each channel, such as "G01" or "J02"; shape (M,).
    #: RINEX 3 observation code of each channel without the type letter, such as "1C" or "2I"; shape (M,). RINEX 2 codes
    #: are mapped: C1 -> "1C", P1 -> "1P" (GLONASS) or "1W" (GPS), P2 -> "2W"/"2P", and so on.
    signal: Strings
    code_m: Floats  #: Pseudorange, shape (T, M).
    phase_cycles: Floats  #: Carrier phase, shape (T, M).
    doppler_hz: Floats  #: Doppler shift, positive when the satellite approaches; shape (T, M).
    cn0_dbhz: Floats  #: Carrier-to-noise density; NaN if only a signal strength of 1 to 9 is known; shape (T, M).
    loss_of_lock: Bytes  #: RINEX loss-of-lock indicator of the phase, 0 where blank or absent; shape (T, M).
    #: Whether an epoch must not be differenced with the previous epoch: after a power failure (epoch flag 1), with a
    #: moving antenna or at a new site (flags 2 and 3), or if a new file begins here after a gap; shape (T,).
    break_before: Masks
    #: Interference indicated by the receiver: 0 none, 1 jamming, 2 spoofing, 3 both; shape (T,).
    receiver_alarm: Bytes = field(default_factory=lambda: np.zeros(0, dtype=np.uint8))
    #: Front-end gain, in the receiver's unit, NaN where unknown; shape (T,).
    front_end_gain: Floats = field(default_factory=lambda: np.zeros(0))
    header: ObservationHeader = field(default_factory=ObservationHeader)
    #: Messages (file, line, fault) on faulty parts of the file, which were skipped: at most `MAX_PROBLEMS` messages,
    #: then one message with the number of further faults. Selected epochs (`log[10:20]`) have no messages.
    problems: tuple[str, ...] = ()
    problem_count: int = 0  #: Number of all faults, with and without a message.
    #: Number of skipped items by kind: malformed epochs and satellite lines, duplicate epochs, external events,
    #: satellites of unknown or unselected constellations.
    skipped: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        epochs, channels = len(self.time), len(self.satellite)
        if len(self.signal) != channels:
            raise ValueError(f"signal has {len(self.signal)} channels, satellite has {channels}")
        if not len(self.receiver_alarm):
            object.__setattr__(self, "receiver_alarm", np.zeros(epochs, dtype=np.uint8))
        if not len(self.front_end_gain):
            object.__setattr__(self, "front_end_gain", np.full(epochs, np.nan))
        for name in ("break_before", "receiver_alarm", "front_end_gain"):
            if len(getattr(self, name)) != epochs:
                raise ValueError(f"{name} has {len(getattr(self, name))} epochs, time has {epochs}")
        for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock"):
            shape = getattr(self, name).shape
            if shape != (epochs, channels):
                raise ValueError(f"{name} has shape {shape}, expected {(epochs, channels)} (epochs, channels)")
        freeze_arrays(self)

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        satellites = np.unique(self.satellite)
        systems = "".join(np.unique(self.system).tolist())
        text = f"{plural(self, 'epoch')} {time_span_text(self.time)}, {plural(self.satellite, 'channel')}"
        marker = f' "{self.header.marker}"' if self.header.marker else ""
        return f"<Observations{marker}: {text} of {plural(satellites, 'satellite')} ({systems})>"

    @property
    def system(self) -> Strings:
        """Constellation letter of each channel, shape (M,)."""
        return self.satellite.astype("<U1")

    def __getitem__(self, key: slice | tuple[slice, str | Sequence[str]]) -> Observations:
        """Select epochs (views), or epochs and satellites (copies): ``log[:60]``, ``log["06:34":"06:35", "G06"]``.

        Bounds are epoch indices, or times: ``datetime64``, "2021-05-17T06:34:12", or a time of day (on the next day if
        over 12 h before the first epoch). The upper bound is excluded. Satellites are one or several names ("G06") or
        constellations ("G").

        Raises
        ------
        KeyError
            The log does not have the satellite or constellation, or a bound is not a time.
        """
        rows, names = key if isinstance(key, tuple) else (key, None)
        if not isinstance(rows, slice):
            raise KeyError(f"{rows!r} is not a range of epochs such as log[10:20]; select satellites by log[:, 'G01']")
        start, stop = (
            bound if bound is None or hasattr(bound, "__index__") else self._epoch_at(bound)
            for bound in (rows.start, rows.stop)
        )
        epochs = slice(start, stop, rows.step)
        channels = slice(None) if names is None else self._find_channels([names] if isinstance(names, str) else names)
        arrays = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
        part = copy_with(
            self, time=self.time[epochs], satellite=self.satellite[channels], signal=self.signal[channels],
            **{name: getattr(self, name)[epochs][:, channels] for name in arrays},
            break_before=self.break_before[epochs], receiver_alarm=self.receiver_alarm[epochs],
            front_end_gain=self.front_end_gain[epochs], problems=(), problem_count=0, skipped={},
        )  # fmt: skip
        if names is not None:
            freeze_arrays(part)
        return part

    def _epoch_at(self, bound: str | datetime | np.datetime64) -> int:
        """Return the index of the first epoch at or after a time; raise KeyError if the bound is not a time."""
        text = str(bound).replace(" ", "T")
        try:
            if "-" in text or not len(self):
                time = gps_time(text)
            else:
                day = self.time[0].astype("datetime64[D]")
                time = gps_time(f"{day}T{text}")
                time += np.timedelta64(1, "D") if time < self.time[0] - np.timedelta64(12, "h") else np.timedelta64(0)
        except ValueError:
            raise KeyError(f"{bound!r} is not a GPS time; expected hh:mm, hh:mm:ss or yyyy-mm-ddThh:mm:ss") from None
        return int(np.searchsorted(self.time, time))

    def _find_channels(self, names: Sequence[str]) -> Indices:
        """Return the channels of satellites or constellations; raise KeyError if one of them is absent."""
        found = np.zeros(len(self.satellite), dtype=np.bool_)
        for name in names:
            own = (self.system if len(name) == 1 else self.satellite) == name
            if not own.any():
                raise KeyError(f"no {name} among the satellites {' '.join(np.unique(self.satellite).tolist())}")
            found |= own
        return np.flatnonzero(found)
