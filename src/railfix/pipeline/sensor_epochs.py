"""Sensor samples of a chunk as measurements of the filter at the epochs of an antenna."""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, TypeVar

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.motion.samples import InertialSamples, RadarSpeeds, SensorSamples, TachometerPulses
from railfix.motion.slip import MotionState, SlipLimits
from railfix.motion.tachometer import TachometerLimits, faults_until, way_m, window_start
from railfix.pipeline.sensed_motion import CARRIED, REACH, SensedMotion, SensedState, nothing_sensed, sensed_motion
from railfix.track.trajectory import Trajectory
from railfix.tracking import SensorEpochs

#: Longest time between epochs over which a way or a mean force is taken [s].
_LONGEST_S: Final = 5.0
#: Share of the samples of an interval that must be there for its mean.
_COMPLETE: Final = 0.9

Samples = TypeVar("Samples", TachometerPulses, InertialSamples, RadarSpeeds)


class SensorLimits(Settings):
    """Noise of the sensors as the filter sees them.

    Attributes
    ----------
    tachometer : TachometerLimits
    slip : SlipLimits
        Of the detection of slip and slide by tachometer and inertial unit together.
    carry_sigma_mps : float
        Of the speed that the inertial unit carries through a slip, a stop or a start.
    wheel_sigma_m : float
        Of a way between two epochs beside the pulse: creep of a braked or driven wheel.
    radar_sigma_mps, radar_step_s : float
        Of one speed, and the usual time between two.
    force_sigma_mps2 : float
        Of a mean force between two epochs: pitching of the body beside the sensor's noise (1 mrad is 0.01 m/s2),
        and the map's gradient.
    """

    tachometer: TachometerLimits = Field(default_factory=TachometerLimits)
    slip: SlipLimits = Field(default_factory=SlipLimits)
    carry_sigma_mps: float = Field(default=0.1, gt=0)
    wheel_sigma_m: float = Field(default=0.01, gt=0)
    radar_sigma_mps: float = Field(default=0.1, gt=0)
    radar_step_s: float = Field(default=0.1, gt=0)
    force_sigma_mps2: float = Field(default=0.05, gt=0)


@dataclass(frozen=True, kw_only=True)
class SensorState:
    """Samples that the next chunk still needs.

    Attributes
    ----------
    time : datetime64[ns]
        Last epoch; NaT before the first.
    samples : SensorSamples
    motion : SensedState
    """

    time: np.datetime64
    samples: SensorSamples
    motion: SensedState = field(default_factory=SensedState)

    @classmethod
    def empty(cls) -> SensorState:
        """State before the first epoch."""
        return cls(time=np.datetime64("NaT", "ns"), samples=SensorSamples())


def sensor_epochs(
    samples: SensorSamples | None,
    time: Datetimes,
    trajectory: Trajectory,
    state: SensorState,
    *,
    limits: SensorLimits,
    sine_at: Callable[[Floats], Floats] | None = None,
    sources: Container[str] = ("wheel", "radar", "force"),
) -> tuple[SensorEpochs, SensedMotion, SensorState]:
    """Return ways and forces between the epochs, the motion that wheel and inertia agree on, and the state to keep.

    Parameters
    ----------
    samples : SensorSamples or None
        Received since the chunk before.
    time : ndarray of datetime64[ns], shape (T,)
        Epochs of the antenna.
    trajectory : Trajectory
        Tells which way the front points.
    state : SensorState
    limits : SensorLimits
    sine_at : callable, optional
        Sine of the gradient at arc lengths; the line is unknown without.
    sources : container of str
        Which of `wheel`, `radar` and `force` are wanted.
    """
    samples = samples or SensorSamples()
    pulses = _together(state.samples.tachometer, samples.tachometer)
    inertial = _together(state.samples.inertial, samples.inertial)
    radar = _together(state.samples.radar, samples.radar)
    if not len(time):
        kept = SensorSamples(tachometer=pulses, inertial=inertial, radar=radar)
        return SensorEpochs(), nothing_sensed(0), replace(state, samples=kept)
    first = time[0] if np.isnat(state.time) else state.time
    edges = np.concatenate([[first], time])
    facing = 1.0 if trajectory.facing == "rising" else -1.0
    span = seconds(np.diff(edges))
    usable = (span > 0.0) & (span <= _LONGEST_S)
    values: dict[str, Any] = {}
    wheel, force = len(pulses) > 0 and "wheel" in sources, len(inertial) > 0 and "force" in sources
    sensed, motion = nothing_sensed(len(time)), state.motion
    if wheel and force and (pulses.direction != 0).any():
        sensed, motion = sensed_motion(
            pulses,
            inertial,
            edges,
            facing,
            sine_at or _unknown,
            motion,
            tachometer=limits.tachometer,
            limits=limits.slip,
        )
    if wheel:
        way = np.diff(way_m(pulses, edges, limits=limits.tachometer))
        known = (
            usable
            & (edges[:-1] >= pulses.time[0])
            & ~_slow(way, span, limits)
            & (np.diff(faults_until(pulses, edges)) == 0)
        )
        quantum = limits.tachometer.pulse_m / np.sqrt(6.0)
        carried = np.isin(sensed.state, CARRIED)
        known &= ~carried & (sensed.state != MotionState.EXPIRED)
        rolled = np.where(known, way, np.where(carried & usable, sensed.way_m, np.nan))
        speed_sigma = np.where(
            carried, limits.carry_sigma_mps * (sensed.state != MotionState.STANDING), sensed.doubt_mps
        )
        values |= {
            "wheel_m": facing * rolled,
            "wheel_sigma_m": np.sqrt(limits.wheel_sigma_m**2 + quantum**2 + (speed_sigma * span) ** 2),
            "wheel_sign": "unknown" if (pulses.direction == 0).all() else "measured",
        }
    if len(radar) and "radar" in sources:
        mean, share = _mean_between(radar.time, radar.speed_mps, edges)
        known = usable & (share >= _COMPLETE)
        sigma = limits.radar_sigma_mps * np.sqrt(np.maximum(span, limits.radar_step_s) * limits.radar_step_s)
        values |= {"radar_m": np.where(known, facing * mean * span, np.nan), "radar_sigma_m": sigma}
    if force:
        mean, share = _mean_between(inertial.time, inertial.force_mps2[:, 0], edges)
        known = usable & (share >= _COMPLETE)
        values |= {
            "force_mps2": np.where(known, facing * (mean - sensed.swing_mps2), np.nan),
            "force_sigma_mps2": np.full(len(time), limits.force_sigma_mps2),
        }
    kept = SensorSamples(
        tachometer=_latest(pulses, _needed(pulses, edges[-1] - REACH, limits)),
        inertial=_latest(inertial, np.searchsorted(inertial.time, edges[-1] - REACH, side="right") - 1),
        radar=_latest(radar, np.searchsorted(radar.time, edges[-1], side="right") - 1),
    )
    return SensorEpochs(**values), sensed, SensorState(time=time[-1], samples=kept, motion=motion)


def _unknown(arc_m: Floats) -> Floats:
    return np.full(arc_m.shape, np.nan)


def _slow(way: Floats, span: Floats, limits: SensorLimits) -> Masks:
    """Whether the wheel turned too slowly for a distance."""
    return np.asarray(np.abs(way) < limits.tachometer.least_speed_mps * np.maximum(span, 1e-9))


def _needed(pulses: TachometerPulses, end: np.datetime64, limits: SensorLimits) -> int:
    """First pulse that speeds after an instant may need."""
    last = int(np.searchsorted(pulses.time, end, side="right")) - 1
    if last < 1:
        return 0
    start = window_start(pulses.time, np.array([last], dtype=np.intp), limits.tachometer.window_s)
    return max(int(start[0]) - 5, 0)


def _mean_between(time: Datetimes, values: Floats, edges: Datetimes) -> tuple[Floats, Floats]:
    """Mean of the samples in each interval after its first edge, and the share of them that is finite."""
    known = np.isfinite(values)
    total = np.concatenate([[0.0], np.cumsum(np.where(known, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(known)])
    at = np.searchsorted(time, edges, side="right")
    many, there = np.diff(at), np.diff(count[at])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.diff(total[at]) / there, np.where(many > 0, there / np.maximum(many, 1), 0.0)


def _together(before: Samples, after: Samples) -> Samples:
    """Samples of both, in order of time."""
    values = {f.name: np.concatenate([getattr(before, f.name), getattr(after, f.name)]) for f in fields(before)}
    return type(before)(**values)


def _latest(samples: Samples, first: int) -> Samples:
    """Samples from an index on."""
    start = max(int(first), 0)
    return type(samples)(**{f.name: getattr(samples, f.name)[start:] for f in fields(samples)})
