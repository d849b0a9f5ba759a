"""Signs of interference, limits of the interference tests, and statistics of C/N0 and front-end gain."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Final, Literal

import numpy as np
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Bits, Codes, Datetimes, Floats, Integers, Masks, Strings, kernel_array
from railfix.core.channel_state import join_channels
from railfix.core.settings import Settings
from railfix.core.timescale import GPS_EPOCH, seconds


class Suspicion(IntEnum):
    """Most probable cause of the signs of interference at an epoch, as decided by `suspicion`."""

    NONE = 0
    JAMMING_SUSPECTED = 1
    SPOOFING_SUSPECTED = 2
    #: A common time-tag error explains the ranges of all satellites.
    TIME_TAGS = 3
    #: The 3-D positions have left the map; there is no sign of spoofing or of a time-tag error.
    LEFT_MAP = 4
    #: All positions of the last minute failed a check; the cause is unknown.
    CONTRADICTED = 5


class Sign(IntFlag):
    """Signs of interference; one epoch may have several."""

    NONE = 0
    #: The receiver reports jamming in UBX MON-RF, MON-HW or SEC-SIG (critical), or in SBF RFStatus (not cancelled).
    RECEIVER_JAMMING = 1 << 0
    #: The C/N0 of all satellites has fallen by nearly the same amount.
    CN0_FALL = 1 << 1
    #: The front-end gain of the receiver has fallen.
    GAIN_FALL = 1 << 2
    #: The receiver reports spoofing in UBX SEC-SIG (affirmed) or SBF RFStatus.
    RECEIVER_SPOOFING = 1 << 3
    #: All satellites have the same C/N0, which is typical of a single transmitter.
    EQUAL_CN0 = 1 << 4
    #: The code ranges of all satellites jump without a Doppler that explains it, or the clock drift jumps.
    CLOCK_JUMP = 1 << 5
    #: The 3-D velocity changes faster than a train can.
    SPEED_JUMP = 1 << 6
    #: The 3-D position moves farther than a train can.
    POSITION_JUMP = 1 << 7
    #: The positions or receiver clocks computed from two constellations differ.
    CONSTELLATIONS_PART = 1 << 8
    #: Consistent 3-D positions have left the map laterally.
    LEFT_MAP = 1 << 9
    #: The distance travelled according to GNSS deviates from the wheel distance.
    WHEEL_PARTS = 1 << 10
    #: A time-tag error that all ranges share explains their residuals.
    TIME_TAGS = 1 << 11
    #: All positions of the last minute failed a check.
    CONTRADICTED = 1 << 12


_SPOOFING: Final = (
    Sign.RECEIVER_SPOOFING | Sign.EQUAL_CN0 | Sign.CLOCK_JUMP | Sign.SPEED_JUMP | Sign.POSITION_JUMP
    | Sign.CONSTELLATIONS_PART | Sign.WHEEL_PARTS
)  # fmt: skip
_JAMMING: Final = Sign.RECEIVER_JAMMING | Sign.CN0_FALL | Sign.GAIN_FALL
CAUSES: Final = tuple(cause for cause in Sign if cause)  #: All signs but NONE, in the order of their bits.


class InterferenceLimits(Settings):
    """Limits of the interference tests.

    With the defaults, no sign occurs on the test recordings (``tests/references/results/interference.txt``).
    """

    use: Literal["on", "off"] = "on"
    least_satellites: int = Field(default=6, ge=5)  #: Minimum number of satellites in a comparison of satellites.
    #: Falls of C/N0 below its recent peak count as a sign if their median over all satellites is at least this.
    fall_db: float = Field(default=5.0, gt=0)
    #: Largest standard deviation, over the satellites, of C/N0 falls that are attributed to jamming. A jammer raises
    #: the noise of all channels equally; walls and roofs do not.
    spread_db: float = Field(default=1.5, gt=0)
    peak_decay_db_per_min: float = Field(default=1.0, gt=0)  #: Decay rate of each satellite's C/N0 peak.
    known_after_s: float = Field(default=10.0, ge=0)  #: Falls of a satellite's C/N0 are used after this tracking time.
    #: Falls of the front-end gain by less than this fraction of its recent peak are no sign. At receiver start-up, the
    #: gain falls by up to 14 % without interference.
    gain_fall: float = Field(default=0.3, gt=0, lt=1)
    #: Largest standard deviation, over the satellites, of C/N0 values that count as equal. On the test recordings, this
    #: standard deviation is at least 1.2 dB.
    equal_db: float = Field(default=0.8, gt=0)
    #: Jumps of the codes relative to the Dopplers, without whole milliseconds, count as a sign if at least this. Phone
    #: clocks step by 30 m without interference.
    clock_jump_m: float = Field(default=60.0, gt=0)
    drift_jump_mps: float = Field(default=10.0, gt=0)  #: Jumps of the clock drift by more than this count as a sign.
    speed_jump_mps: float = Field(default=5.0, gt=0)  #: Jumps of the 3-D velocity by more than this count as a sign.
    position_jump_m: float = Field(default=30.0, gt=0)  #: Jumps of the 3-D position by more than this count as a sign.
    #: 3-D positions closer to the line than this are no sign. A yard is about 100 m wide.
    off_map_m: float = Field(default=100.0, gt=0)
    #: Estimated time-tag errors below this are no sign. For correct time tags, the estimated error reaches 0.05 s in
    #: towns, and 0.13 s with a phone and seven satellites.
    tag_error_s: float = Field(default=0.1, gt=0)
    tag_sigmas: float = Field(default=6.0, gt=0)  #: Time-tag errors below this many sigmas are no sign.
    #: If all positions fail a check for this time, this counts as a sign of interference.
    contradicted_s: float = Field(default=60.0, gt=0)
    #: Jumps of clock drift, velocity and position by less than this many standard deviations are no sign. The limit
    #: also applies to the distance from the line minus `position_jump_m`.
    jump_sigmas: float = Field(default=10.0, gt=0)
    #: Positions and clocks of two constellations that differ by at least this many sigmas count as a sign.
    part_sigmas: float = Field(default=15.0, gt=0)
    #: Largest acceleration of a train. Only the part of a change that this acceleration cannot explain is a jump.
    acceleration_mps2: float = Field(default=2.0, gt=0)
    max_speed_mps: float = Field(default=100.0, gt=0)  #: Largest speed of a train.
    longest_gap_s: float = Field(default=10.0, gt=0)  #: Epochs further apart than this are not compared.
    largest_speed_sigma_mps: float = Field(default=2.0, gt=0)  #: Velocities with a larger sigma are not compared.
    largest_sigma_m: float = Field(default=30.0, gt=0)  #: Positions with a larger sigma are not compared.
    #: Time for which a fall of C/N0 or gain, equal C/N0, or a deviation from map or wheel must persist to be a sign.
    hold_s: float = Field(default=3.0, gt=0)
    part_hold_s: float = Field(default=10.0, gt=0)  #: A difference of two constellations is a sign after this time.
    wheel_window_s: float = Field(default=120.0, gt=0)  #: Window over which GNSS and wheel distances are compared.
    wheel_least_s: float = Field(default=60.0, gt=0)  #: Shorter windows (after a slip or a data gap) are not compared.
    wheel_m: float = Field(default=20.0, gt=0)  #: GNSS-wheel distance differences below this are no sign.
    wheel_sigmas: float = Field(default=6.0, gt=0)  #: GNSS-wheel differences below this many sigmas are no sign.
    #: Whether the filter's protection level covers slow spoofing along the track that the comparison with the wheel has
    #: not detected yet. With "on", the protection level is two to four times as large.
    wheel_level: Literal["on", "off"] = "off"
    #: With `wheel_level` on, the level is at least the GNSS-wheel distance difference plus this number of combined
    #: sigmas of the wheel distance and of the position at the window start. The default assumes that spoofing began
    #: within the window with a probability of 1e-7, and that the integrity risk is 1e-9.
    wheel_level_sigmas: float = Field(default=2.33, ge=0)
    #: Relative standard deviation of the wheel circumference before its estimation from positions.
    wheel_scale: float = Field(default=0.01, gt=0)
    #: Relative standard deviation of the change of the wheel circumference after its estimation (creep).
    wheel_change: float = Field(default=0.001, gt=0)
    #: Wheel acceleration above which a slip is assumed and the comparison restarts. Adhesion allows 1 to 1.5 m/s^2.
    wheel_acceleration_mps2: float = Field(default=1.6, gt=0)
    #: Suspected jamming, time-tag errors and positions off the map remain reported for this time after their last sign.
    jamming_release_s: float = Field(default=10.0, ge=0)
    #: Suspected spoofing stays reported for this time after the last sign. A jump is visible at one epoch only, but the
    #: cause of the jump persists.
    spoofing_release_s: float = Field(default=300.0, ge=0)


def cause_text(causes: Bits) -> Strings:
    """Return the lower-case names of each epoch's signs, joined by ``+``; empty where there is no sign."""
    words, which = np.unique(causes, return_inverse=True)
    texts = ["+".join(str(cause.name).lower() for cause in CAUSES if cause & word) for word in words.tolist()]
    return np.array(texts, dtype=np.str_)[which.reshape(causes.shape)] if texts else np.zeros(causes.shape, "<U1")


def suspicion(causes: Bits) -> Codes:
    """Return the `Suspicion` of each epoch from its signs.

    If several suspicions are possible, the first in a fixed order is returned. A time-tag error comes first, because it
    displaces positions and clocks as a spoofer does. Spoofing comes before LEFT_MAP, because leaving the map explains
    neither jumps nor equal C/N0.
    """
    order = (
        (Sign.TIME_TAGS, Suspicion.TIME_TAGS), (_SPOOFING, Suspicion.SPOOFING_SUSPECTED),
        (Sign.LEFT_MAP, Suspicion.LEFT_MAP), (Sign.CONTRADICTED, Suspicion.CONTRADICTED),
        (_JAMMING, Suspicion.JAMMING_SUSPECTED),
    )  # fmt: skip
    kinds = np.array([0, *(int(kind) for _, kind in order)], dtype=np.int8)
    shown = np.stack([(causes & int(signs)) != 0 for signs, _ in order])
    return kinds[np.where(shown.any(axis=0), shown.argmax(axis=0) + 1, 0)]


_NEVER: Final = np.datetime64("NaT", "ns")


@dataclass(frozen=True, kw_only=True)
class HeldState:
    """State, at the end of a chunk, of C conditions that have holding and release times."""

    time: np.datetime64 = field(default_factory=lambda: _NEVER)  #: Time of the last epoch; NaT before the first.
    #: Time for which each condition has been continuously true, shape (C,).
    run_ns: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    #: Last time at which each condition had been true for its holding time, shape (C,); NaT if never.
    last: Datetimes = field(default_factory=lambda: np.zeros(0, dtype="datetime64[ns]"))


def hold_signs(
    time: Datetimes, signs: Masks, state: HeldState, *, hold_s: Floats, release_s: Floats
) -> tuple[Masks, Masks, HeldState]:
    """Apply holding and release times to conditions; return two masks, shape (T, C), and the state.

    The first mask marks conditions that have been true for at least their holding time. The second mask also marks
    conditions whose release time has not ended.

    `signs` has the shape (T, C), holding and release times have the shape (C,) [s]. An interval between epochs counts
    for at most half the holding time, so that one epoch after a gap is not sufficient. A condition with a holding time
    of 0 is active at once.
    """
    conditions = signs.shape[1]
    run, last = state.run_ns, state.last
    if not len(run):
        run, last = np.zeros(conditions, dtype=np.int64), np.full(conditions, _NEVER)
    if not len(time):
        return signs, signs, state
    first = time[0] if np.isnat(state.time) else state.time
    counts, stays, (run, latest) = kernels.screens.holds(
        time.astype(np.int64), np.ascontiguousarray(signs), int(first.astype(np.int64)), (run, last.view(np.int64)),
        np.round(hold_s * 1e9).astype(np.int64), kernel_array(release_s),
    )  # fmt: skip
    return counts, stays, HeldState(time=time[-1], run_ns=run, last=latest.view("datetime64[ns]"))


_MINUTE_S: Final = 60.0
_GAIN_DECAY_PER_MIN: Final = 0.005  #: Relative decay of the gain peak per minute.
_LARGEST_DBHZ: Final = 100.0  #: A C/N0 peak that has decayed by this much is dropped [dB].
_LONGEST_SILENCE_S: Final = 60.0  #: After a longer gap, a satellite's tracking time starts anew [s].


@dataclass(frozen=True, kw_only=True)
class PowerState:
    """State of the C/N0 and gain statistics at the end of a chunk."""

    #: Satellite and signal, such as "G011C"; shape (K,).
    channel: Strings = field(default_factory=lambda: np.zeros(0, dtype="<U5"))
    #: C/N0 peak plus decay rate times time of the peak since the GPS epoch, shape (K,); -inf if never observed.
    peak_db: Floats = field(default_factory=lambda: np.zeros(0))
    #: Start of each channel's current tracking, in seconds since the GPS epoch, shape (K,); NaN if never tracked.
    first_s: Floats = field(default_factory=lambda: np.zeros(0))
    #: Last observation of each channel, in seconds since the GPS epoch, shape (K,); NaN if never observed.
    last_s: Floats = field(default_factory=lambda: np.zeros(0))
    gain: float = -np.inf  #: Logarithmic gain peak plus decay rate times time of the peak since the GPS epoch.


@dataclass(frozen=True, kw_only=True)
class PowerSigns:
    """C/N0 and gain statistics of T epochs. The C/N0 statistics are NaN where too few satellites are available."""

    fall_db: Floats  #: Median, over the satellites, of the fall of C/N0 below the recent peak, shape (T,).
    spread_db: Floats  #: Standard deviation, over the satellites, of the falls, shape (T,).
    difference_db: Floats  #: Standard deviation of C/N0 over the satellites, shape (T,).
    #: Fall of the gain as a fraction of its recent peak, shape (T,); NaN where the receiver does not report the gain.
    gain_fall: Floats


def power_signs(
    time: Datetimes, channel: Strings, cn0_dbhz: Floats, gain: Floats, state: PowerState, limits: InterferenceLimits
) -> tuple[PowerSigns, PowerState]:
    """Return the C/N0 and gain statistics of T epochs, and the state for the next chunk.

    `cn0_dbhz`, shape (T, K), has one signal per satellite at each epoch; `channel` names satellite and signal. `gain`,
    shape (T,), increases with the front-end gain and may have any unit; NaN where unknown. A satellite's recent peak
    decays by `peak_decay_db_per_min`, so that slow changes of elevation or obstruction are no sign, whereas a constant
    jammer remains visible for minutes.
    """
    now, decay = seconds(time - GPS_EPOCH), limits.peak_decay_db_per_min / _MINUTE_S
    young = None if not len(time) else decay * (now[0] - state.last_s) < _LARGEST_DBHZ
    joined = join_channels(channel, [state.channel], [young])
    before = (
        joined.arrange(state.peak_db, -np.inf),
        joined.arrange(state.first_s, np.nan),
        joined.arrange(state.last_s, np.nan),
    )
    fall, spread, difference, (peak, first, last) = kernels.screens.falls_of_cn0(
        now, kernel_array(joined.widen(cn0_dbhz, np.nan)), before, decay, _LONGEST_SILENCE_S, limits.known_after_s,
        limits.least_satellites,
    )  # fmt: skip
    logarithm, forgotten = np.log(np.where(gain > 0, gain, np.nan)), _GAIN_DECAY_PER_MIN / _MINUTE_S * now
    gains = np.fmax.accumulate(np.concatenate([[state.gain], logarithm + forgotten]))[1:]
    signs = PowerSigns(
        fall_db=fall, spread_db=spread, difference_db=difference,
        gain_fall=1.0 - np.exp(logarithm + forgotten - gains),
    )  # fmt: skip
    if not len(time):
        return signs, state
    after = PowerState(channel=joined.channel, peak_db=peak, first_s=first, last_s=last, gain=float(gains[-1]))
    return signs, after
