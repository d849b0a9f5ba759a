"""A simulated receiver: its channels, their constants, and the noise and lock state carried between chunks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.constants import CARRIER_FREQUENCY, FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.gnss.navigation import KeplerRecords
from railfix.gnss.observations import ObservationHeader
from railfix.simulate.errors.common import CommonErrors
from railfix.simulate.errors.processes import satellite_key
from railfix.simulate.errors.settings import InterSystemSettings
from railfix.simulate.noise import CarriedNoise, CodeSmoothing, TrackingNoise
from railfix.simulate.satellites import newest_record
from railfix.simulate.scenario import Scenario

#: Signals of each constellation, the first one first.
SIGNALS: Final = {"G": ("1C", "2L"), "J": ("1C", "2L"), "E": ("1C", "7Q"), "C": ("2I", "6I")}
#: Streams of random numbers: white noise, correlated noise, cycle slips, satellites' power.
_WHITE, _CARRIED, _SLIPS, _POWER = 2, 3, 4, 6


class Receiver:
    """One receiver's channels (satellite and signal of each), and its state that is carried between chunks.

    The satellites are the columns of the sky, in alphabetical order.
    """

    def __init__(
        self,
        scenario: Scenario,
        antenna: str,
        header: ObservationHeader,
        *,
        channels: Sequence[tuple[str, str]],
        satellites: Sequence[str],
        common_errors: CommonErrors,
    ) -> None:
        errors, number = scenario.errors, scenario.receivers.index(antenna)
        self.antenna, self.header = antenna, header
        self.names, self.signals = (np.array(part) for part in zip(*channels, strict=True))
        self.column = np.searchsorted(satellites, self.names)
        frequency = np.array([CARRIER_FREQUENCY[n[0]][g[0]] for n, g in channels])
        self.wavelength_m = SPEED_OF_LIGHT / frequency
        #: Ionospheric delay relative to that on L1.
        self.scale = (FREQUENCY_L1 / frequency) ** 2
        self.second = np.array([g != SIGNALS[n[0]][0] for n, g in channels])
        self.group_delay_error_m = common_errors.group_delay_m(self.names.tolist(), self.signals.tolist())
        offsets = [errors.intersystem.get(name[0], InterSystemSettings()) for name, _ in channels]
        self.offset_m = np.array([o.offset_m + (o.rear_difference_m if antenna == "rear" else 0.0) for o in offsets])
        self.offset_drift_mps = np.array([o.drift_mps for o in offsets])
        sigma = scenario.receiver.cn0_satellite_sigma_db
        #: Difference of each satellite's C/N0 from the mean, the same for both receivers.
        self.cn0_offset_db = sigma * np.array(
            [np.random.default_rng([scenario.seed, _POWER, *satellite_key(n)]).standard_normal() for n in self.names]
        )
        self._rng = np.random.default_rng([scenario.seed, _WHITE, number])
        # Integer ambiguity of each channel.
        self.ambiguity = self._rng.integers(-2_000_000, 2_000_000, len(channels)).astype(np.float64)
        self.carried = CarriedNoise(
            errors.noise,
            key=(scenario.seed, _CARRIED, number),
            channels=len(channels),
            interval_s=scenario.interval_s,
        )
        self.smoothing = CodeSmoothing(
            scenario.receiver.code_smoothing_s, channels=len(channels), interval_s=scenario.interval_s
        )
        self.tracking = TrackingNoise(
            errors.tracking,
            key=(scenario.seed, _SLIPS, number),
            channels=len(channels),
            interval_s=scenario.interval_s,
        )

    def white(self, epochs: int) -> Floats:
        """White noise of code, phase, Doppler and C/N0 for the next epochs, shape (T, M, 4)."""
        return self._rng.standard_normal((epochs, len(self.names), 4))


def group_delay_s(records: KeplerRecords, satellite: str, signal: str, time: Datetimes) -> Floats:
    """Group delay of a signal's code against the broadcast clock, shape (T,) [s].

    GPS and QZSS: TGD on L1, scaled by (f1/f)^2 on L2 (IS-GPS-200, 20.3.3.3.3.2). Galileo I/NAV: BGD E5b/E1
    likewise (OS SIS ICD, 5.1.5). BeiDou: TGD1 on B1I, none on B3I, which the clock refers to.
    """
    row = newest_record(records, satellite, time)
    letter = satellite[0]
    frequency = CARRIER_FREQUENCY[letter]
    if letter == "C":
        return np.where(signal[0] == "2", records.group_delay_1_s[row], 0.0)
    delay = records.group_delay_2_s if letter == "E" else records.group_delay_1_s
    return np.asarray(delay[row] * (frequency["1"] / frequency[signal[0]]) ** 2)
