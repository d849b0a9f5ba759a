"""A simulated receiver: its channels, their constants, and the noise and lock state carried between chunks."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.constants import CARRIER_FREQUENCY, FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.gnss.navigation import KeplerRecords
from railfix.gnss.observations import ObservationHeader
from railfix.simulate.errors.common import CommonErrors
from railfix.simulate.errors.processes import ClockWalk, satellite_key
from railfix.simulate.errors.settings import InterSystemSettings
from railfix.simulate.noise import CarriedNoise, CodeSmoothing, TrackingNoise
from railfix.simulate.satellites import newest_record
from railfix.simulate.scenario import ANTENNAS, Scenario

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


#: Stream of random numbers of the walks.
_WALK = 5


class ReceiverClocks:
    """Clocks of all receivers of a scenario over time."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario

    def _line(self, receiver: str) -> tuple[float, float]:
        """Bias at the start [s] and drift [s/s] of a receiver."""
        settings = self._scenario.receiver
        bias, drift = settings.clock_bias_s, settings.clock_drift
        if receiver not in ANTENNAS:
            return 0.37 * bias, 0.55 * drift
        if receiver == ANTENNAS[0] or settings.clocks == "common":
            return bias, drift
        return -0.61 * bias, 0.83 * drift

    def bias_s(self, receiver: str, tag_s: Floats) -> Floats:
        """Tag minus GPS time at tags counted from the start, shape (T,) [s]."""
        bias, drift = self._line(receiver)
        value = bias + drift * tag_s
        walk = self._walk(receiver)
        if walk is not None:
            value = value + walk.at(np.ravel(tag_s))[:, 0].reshape(np.shape(tag_s)) / SPEED_OF_LIGHT
        steps = self._scenario.receiver.clock_steps == "millisecond"
        return value - np.rint(value * 1e3) * 1e-3 if steps else value

    def drift(self, receiver: str) -> float:
        """Constant drift [s/s]."""
        return self._line(receiver)[1]

    def rate_mps(self, receiver: str, tag_s: Floats) -> Floats:
        """Rate at tags, steps left out, shape (T,) [m/s]."""
        even = np.full(np.shape(tag_s), SPEED_OF_LIGHT * self.drift(receiver))
        walk = self._walk(receiver)
        return even if walk is None else even + walk.rate(tag_s)[:, 0]

    def _walk(self, receiver: str) -> ClockWalk | None:
        """Random walk of a receiver's clock, the same for both antennas where their clock is common."""
        common = self._scenario.receiver.clocks == "common" and receiver in ANTENNAS
        return self._walks[ANTENNAS[0] if common else receiver]

    @cached_property
    def _walks(self) -> dict[str, ClockWalk | None]:
        scenario, walk = self._scenario, self._scenario.errors.clock
        if walk.walk_m_per_sqrt_s == 0.0 and walk.frequency_walk_mps_per_sqrt_s == 0.0:
            return dict.fromkeys(scenario.receivers)
        return {
            name: ClockWalk(
                (scenario.seed, _WALK, number),
                walk=walk.walk_m_per_sqrt_s,
                frequency_walk=walk.frequency_walk_mps_per_sqrt_s,
                interval_s=scenario.interval_s,
                duration_s=scenario.duration_s,
            )
            for number, name in enumerate(scenario.receivers)
        }
