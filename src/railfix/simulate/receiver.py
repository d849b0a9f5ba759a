"""Simulated receiver: channels, clocks, time-correlated noise and loss of lock.

The state is continued from chunk to chunk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from railfix.core.arrays import Bytes, Floats, Masks
from railfix.core.constants import CARRIER_FREQUENCY, FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.gnss.observations import ObservationHeader
from railfix.simulate.errors import ClockWalk, CommonErrors, satellite_key
from railfix.simulate.scenario import ANTENNAS, ReceiverSettings, Scenario
from railfix.simulate.settings import InterSystemSettings, NoiseSettings, TrackingSettings


class CarriedNoise:
    """Time-correlated noise of the channels of a receiver, continued from chunk to chunk.

    `key` is the seed of the receiver. The noise does not depend on the length of the chunks.
    """

    def __init__(self, settings: NoiseSettings, *, key: Sequence[int], channels: int, interval_s: float) -> None:
        self._settings = settings
        self._code = _FirstOrder((*key, 0), channels, interval_s / settings.code_correlation_time_s)
        self._cn0 = _FirstOrder((*key, 1), channels, interval_s / settings.cn0_wander_time_s)

    def code(self, white: Floats) -> Floats:
        """Return code noise of standard deviation 1, shape (T, M).

        `white` is the white noise from which the uncorrelated part is computed, shape (T, M).
        """
        share = self._settings.code_correlated_share
        if share == 0.0:
            return white
        return np.asarray(np.sqrt(1.0 - share) * white + np.sqrt(share) * self._code.next(len(white)))

    def cn0_db(self, epochs: int) -> Floats | float:
        """Return the variation of C/N0 over the next epochs, shape (T, M) [dB], or 0 if its sigma is 0."""
        sigma = self._settings.cn0_wander_sigma_db
        return 0.0 if sigma == 0.0 else sigma * self._cn0.next(epochs)


class _FirstOrder:
    """Autoregressive process of order 1 and standard deviation 1, ``x[k] = rho x[k-1] + sqrt(1 - rho^2) w[k]``."""

    def __init__(self, key: Sequence[int], channels: int, steps_a_time: float) -> None:
        self._rng = np.random.default_rng(list(key))
        self._rho = float(np.exp(-steps_a_time))
        self._state = self._rho * self._rng.standard_normal((1, channels))

    def next(self, epochs: int) -> Floats:
        white = np.sqrt(1.0 - self._rho**2) * self._rng.standard_normal((epochs, self._state.shape[1]))
        series, self._state = lfilter([1.0], [1.0, -self._rho], white, axis=0, zi=self._state)
        return np.asarray(series)


class CodeSmoothing:
    """Low-pass filter of code errors: ``y[k] = y[k-1] + (1 - exp(-dt / time)) (x[k] - y[k-1])``.

    The filter restarts whenever a signal is acquired. With a time constant of 0, errors are not filtered.
    """

    def __init__(self, time_s: float, *, channels: int, interval_s: float) -> None:
        self._keep = float(np.exp(-interval_s / time_s)) if time_s > 0.0 else 0.0
        self._state = np.full(channels, np.nan)

    def next(self, error_m: Floats, lost: Masks) -> Floats:
        """Return the filtered errors of the next epochs, shape (T, M); errors of lost signals are not filtered."""
        if self._keep == 0.0:
            return error_m
        smoothed, keep = error_m.copy(), self._keep
        locked = np.zeros((len(error_m) + 2, error_m.shape[1]), dtype=np.int8)
        locked[1:-1] = ~lost
        change = np.diff(locked, axis=0)
        for channel in np.flatnonzero((~lost).any(axis=0)):
            starts, ends = (np.flatnonzero(change[:, channel] == sign) for sign in (1, -1))
            for first, last in zip(starts.tolist(), ends.tolist(), strict=True):
                x = error_m[first:last, channel]
                before = self._state[channel] if first == 0 and np.isfinite(self._state[channel]) else x[0]
                smoothed[first:last, channel] = lfilter([1.0 - keep], [1.0, -keep], x, zi=[keep * before])[0]
        self._state = np.where(lost[-1], np.nan, smoothed[-1])
        return smoothed


@dataclass(frozen=True, kw_only=True)
class LockState:
    """Lock state of the channels of a receiver over T epochs."""

    lost: Masks  #: True where the signal is not tracked, shape (T, M).
    #: Whole cycles by which the phase has slipped since the start, shape (T, M); 0.0 without simulated slips.
    slip_cycles: Floats | float
    loss_of_lock: Bytes  #: Loss-of-lock indicator; bit 0 is set at the first epoch after a loss; shape (T, M).


class TrackingNoise:
    """Loss of lock and re-acquisition of the channels of a receiver, continued from chunk to chunk."""

    def __init__(self, settings: TrackingSettings, *, key: Sequence[int], channels: int, interval_s: float) -> None:
        self._settings = settings
        self._wait = int(np.ceil(settings.reacquisition_s / interval_s - 1e-9))
        self._salt = np.random.default_rng(list(key)).integers(0, 2**63, channels, dtype=np.uint64)
        # Number of epochs since the signal was last not trackable; before the start, the signal is assumed trackable.
        self._since = np.full(channels, self._wait + 1, dtype=np.int64)
        self._seen = np.zeros(channels, dtype=np.bool_)
        self._present = np.zeros(channels, dtype=np.bool_)
        self._losses = np.zeros(channels, dtype=np.uint64)
        self._weak = np.zeros(channels, dtype=np.bool_)

    def too_weak(self, cn0_dbhz: Floats) -> Masks:
        """Return whether signals are too weak to be tracked, shape (T, M).

        A signal that falls below the threshold remains too weak until it reaches the re-acquisition C/N0.
        """
        threshold, again = self._settings.threshold_dbhz, self._settings.reacquisition_dbhz
        if threshold is None:
            return np.zeros(cn0_dbhz.shape, dtype=np.bool_)
        weak = cn0_dbhz < threshold
        if again is None:
            return np.asarray(weak)
        # The later of two events determines the state: C/N0 falls below the threshold, or reaches the re-acquisition
        # C/N0. Without an event, the state before the first epoch is kept.
        epoch = np.arange(1, len(cn0_dbhz) + 1)[:, None]
        fallen = np.maximum.accumulate(np.where(weak, epoch, np.where(self._weak, 0, -1)), axis=0)
        risen = np.maximum.accumulate(
            np.where(cn0_dbhz >= max(again, threshold), epoch, np.where(self._weak, -1, 0)), axis=0
        )
        state = fallen > risen
        self._weak = state[-1]
        return np.asarray(state)

    def follow(self, bad: Masks) -> LockState:
        """Return the lock state over the next epochs; `bad` marks signals that are not trackable, shape (T, M)."""
        epoch = np.arange(1, len(bad) + 1, dtype=np.int64)[:, None]
        last_bad = np.maximum.accumulate(np.where(bad, epoch, -self._since), axis=0)
        since = epoch - last_bad
        lost = bad | (since <= self._wait)
        here = np.concatenate([self._present[None], ~lost])
        seen = np.maximum.accumulate(np.concatenate([self._seen[None], ~lost]), axis=0)
        back = here[1:] & ~here[:-1] & seen[:-1]
        losses = self._losses + np.cumsum(back, axis=0, dtype=np.uint64)
        self._since = np.minimum(since[-1], self._wait + 1)
        self._present, self._seen, self._losses = here[-1], seen[-1], losses[-1]
        if self._settings.slips == "none":
            return LockState(lost=lost, slip_cycles=0.0, loss_of_lock=np.zeros(bad.shape, dtype=np.uint8))
        return LockState(lost=lost, slip_cycles=_cycles(self._salt, losses), loss_of_lock=back.astype(np.uint8))


def _cycles(salt: NDArray[np.uint64], losses: NDArray[np.uint64]) -> Floats:
    """Return the phase offsets after a number of losses of lock [cycles]; 0 without a loss.

    The offsets are pseudo-random whole numbers from -2e6 to 2e6 (splitmix64).
    """
    mixed = salt + losses * np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed ^= mixed >> np.uint64(31)
    cycles = (mixed % np.uint64(4_000_001)).astype(np.float64) - 2_000_000.0
    return np.where(losses == 0, 0.0, cycles)


#: First and second signal of each constellation if `ReceiverSettings.second` is "L2".
SIGNALS: Final = {"G": ("1C", "2L"), "J": ("1C", "2L"), "E": ("1C", "7Q"), "C": ("2I", "6I")}
#: First and second signal of each constellation if `ReceiverSettings.second` is "L5".
_WITH_L5: Final = {"G": ("1C", "5Q"), "J": ("1C", "5Q"), "E": ("1C", "5Q"), "C": ("1P", "5P")}
#: Seeds of random streams: white noise, correlated noise, cycle slips, C/N0 differences between satellites.
_WHITE, _CARRIED, _SLIPS, _POWER = 2, 3, 4, 6


def list_signals(letter: str, settings: ReceiverSettings) -> tuple[str, ...]:
    """Return the signals of a constellation that a receiver observes, as RINEX band and attribute such as "1C"."""
    return (_WITH_L5 if settings.has_l5 else SIGNALS)[letter][: settings.signals_per_satellite]


class Receiver:
    """M channels of a receiver (satellite and signal, in alphabetical order), with state continued between chunks."""

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
        #: Ratio of the ionospheric delay on each channel's frequency to the delay on L1.
        self.scale = (FREQUENCY_L1 / frequency) ** 2
        self.second = np.array([g != list_signals(n[0], scenario.receiver)[0] for n, g in channels])
        self.group_delay_error_m = common_errors.group_delay_m(self.names.tolist(), self.signals.tolist())
        offsets = [errors.intersystem.get(name[0], InterSystemSettings()) for name, _ in channels]
        self.offset_m = np.array([o.offset_m + (o.rear_difference_m if antenna == "rear" else 0.0) for o in offsets])
        self.offset_drift_mps = np.array([o.drift_mps for o in offsets])
        sigma = scenario.receiver.cn0_satellite_sigma_db
        #: Constant C/N0 offset of each channel's satellite, equal for all receivers.
        self.cn0_offset_db = sigma * np.array(
            [np.random.default_rng([scenario.seed, _POWER, *satellite_key(n)]).standard_normal() for n in self.names]
        )
        self._rng = np.random.default_rng([scenario.seed, _WHITE, number])
        # Integer ambiguity of each channel.
        self.ambiguity = self._rng.integers(-2_000_000, 2_000_000, len(channels)).astype(np.float64)
        self.carried = CarriedNoise(
            errors.noise, key=(scenario.seed, _CARRIED, number), channels=len(channels), interval_s=scenario.interval_s
        )
        self.smoothing = CodeSmoothing(
            scenario.receiver.code_smoothing_s, channels=len(channels), interval_s=scenario.interval_s
        )
        self.tracking = TrackingNoise(
            errors.tracking, key=(scenario.seed, _SLIPS, number), channels=len(channels), interval_s=scenario.interval_s
        )

    def white(self, epochs: int) -> Floats:
        """Return the white noise of code, phase, Doppler and C/N0 for the next epochs, shape (T, M, 4)."""
        return self._rng.standard_normal((epochs, len(self.names), 4))


_WALK = 5  #: Seed of the random stream for the walks of the receiver clocks.


class ReceiverClocks:
    """Clock biases and drifts of all receivers of a scenario over time."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario

    def _line(self, receiver: str) -> tuple[float, float]:
        """Return the clock bias at the start [s] and the constant drift [s/s] of a receiver."""
        settings = self._scenario.receiver
        bias, drift = settings.clock_bias_s, settings.clock_drift
        if receiver not in ANTENNAS:
            return 0.37 * bias, 0.55 * drift
        if receiver == ANTENNAS[0] or settings.clocks == "common":
            return bias, drift
        return -0.61 * bias, 0.83 * drift

    def bias_s(self, receiver: str, tag_s: Floats) -> Floats:
        """Return the clock bias (time tag minus GPS time) at time tags counted from the start, shape (T,) [s]."""
        bias, drift = self._line(receiver)
        value = bias + drift * tag_s
        walk = self._walk(receiver)
        if walk is not None:
            value = value + walk.at(np.ravel(tag_s))[:, 0].reshape(np.shape(tag_s)) / SPEED_OF_LIGHT
        steps = self._scenario.receiver.clock_steps == "millisecond"
        return value - np.rint(value * 1e3) * 1e-3 if steps else value

    def rate_mps(self, receiver: str, tag_s: Floats) -> Floats:
        """Return the clock drift, without millisecond steps, at time tags counted from the start, shape (T,) [m/s]."""
        even = np.full(np.shape(tag_s), SPEED_OF_LIGHT * self._line(receiver)[1])
        walk = self._walk(receiver)
        return even if walk is None else even + walk.rate(tag_s)[:, 0]

    def _walk(self, receiver: str) -> ClockWalk | None:
        """Return the random walk of a receiver's clock, None without a walk; antennas with a common clock share one
        walk.
        """
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
