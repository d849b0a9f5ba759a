"""Sensor samples of a chunk as measurements of the filter at the epochs of an antenna."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Final, TypeVar

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Masks, copy_with
from railfix.core.settings import Settings
from railfix.core.timescale import seconds, timedelta
from railfix.motion.samples import (
    BaliseReadings,
    GroundUnits,
    InertialSamples,
    ListedBalises,
    RadarSpeeds,
    SensorSamples,
    StationRanges,
    TachometerPulses,
)
from railfix.motion.slip import MotionState, SlipLimits
from railfix.motion.tachometer import LEAST_SPEED_MPS, TachometerLimits, distance_m, faults_until, window_start
from railfix.pipeline.balises import BaliseLimits, BaliseState, balise_epochs
from railfix.pipeline.passed_features import FeatureSearch, FeatureState, PassedFeature, RateSeries, ahead_m
from railfix.pipeline.sensed_motion import CARRIED, REACH, SensedMotion, SensedState, nothing_sensed, sensed_motion
from railfix.track.trajectory import Trajectory
from railfix.tracking import RangeEpochs, SensorEpochs

#: No distance and no mean force is computed for longer intervals between epochs than this [s].
_LONGEST_S: Final = 5.0
#: An interval has a mean only if at least this fraction of its samples is finite.
_COMPLETE: Final = 0.9
#: Standard deviation of the inertial speed during a slip, a stop or a start [m/s].
_CARRY_SIGMA_MPS: Final = 0.1
#: Standard deviation of the gradient's mean over one metre: 1 mrad, due to pitch oscillations of the body.
_GRADIENT_NOISE: Final = 1e-3
#: Standard deviation of the curvature's mean over one metre, due to oscillations of the body's heading [1/m].
_CURVATURE_NOISE_1PM: Final = 1e-4
#: Correlation length of map errors [m], equal to `railfix.kernels.tracking.constants.MAP_CORRELATION_M`. With map
#: errors of 0.3 m, features are located to some metres at best; with map errors of 0.05 m, to half a metre.
_MAP_LENGTH_M: Final = 50.0

Samples = TypeVar("Samples", TachometerPulses, InertialSamples, RadarSpeeds, StationRanges, BaliseReadings)


@dataclass(frozen=True, kw_only=True)
class LineReferences:
    """Line features, ground units and balises to which sensor measurements refer."""

    features: FeatureSearch | None = None
    units: GroundUnits | None = None
    balises: ListedBalises | None = None


#: Minimum standard deviation of a two-way range [m]. P2 3.3 measured 0.19 to 0.24 m; this minimum is larger because of
#: echoes and drifts of the unit's reply delay.
_RANGE_SIGMA_M: Final = 0.5


class SensorLimits(Settings):
    """Settings of the on-board sensors in the filter."""

    tachometer: TachometerLimits = Field(default_factory=TachometerLimits)
    #: Detection of slip and slide by tachometer and inertial unit together.
    slip: SlipLimits = Field(default_factory=SlipLimits)
    #: Distance by which the ranging unit is ahead of the vehicle's middle or, without vehicle file, of the antenna.
    range_ahead_m: float = 0.0
    range_right_m: float = 0.0  #: Distance of the vehicle's ranging unit to the right of the antenna's path.
    range_above_m: float = 0.0  #: Height of the vehicle's ranging unit above the antenna.

    balise: BaliseLimits = Field(default_factory=BaliseLimits)
    #: After an outage, codes are used again when three consecutive single-epoch positions are within this number of
    #: sigmas of the dead-reckoned position.
    return_sigmas: float = Field(default=4.0, gt=0)
    #: After an outage, codes are used again after this time in any case.
    return_s: float = Field(default=60.0, ge=0)
    #: Standard deviation of the wheel distance between two epochs, due to creep of a braked or driven wheel; the pulse
    #: quantisation is added.
    wheel_sigma_m: float = Field(default=0.01, gt=0)
    #: Usual interval of radar speed samples.
    radar_step_s: float = Field(default=0.1, gt=0)
    #: Standard deviation of one radar speed; the errors of the samples between two epochs are independent.
    radar_sigma_mps: float = Field(default=0.1, gt=0)
    #: Standard deviation of a mean force between two epochs, due to the sensor's noise, pitching of the body (1 mrad is
    #: 0.01 m/s2) and errors of the map's gradient.
    force_sigma_mps2: float = Field(default=0.05, gt=0)


@dataclass(frozen=True, kw_only=True)
class SensorState:
    """Samples and states needed by the next chunk."""

    time: np.datetime64  #: Time tag of the last epoch; NaT before the first epoch.
    samples: SensorSamples
    motion: SensedState = field(default_factory=SensedState)
    features: FeatureState = field(default_factory=FeatureState)
    balises: BaliseState = field(default_factory=BaliseState)

    @classmethod
    def empty(cls) -> SensorState:
        """Return the state before the first epoch."""
        return cls(time=np.datetime64("NaT", "ns"), samples=SensorSamples())


def with_samples(state: SensorState, samples: SensorSamples | None) -> SensorState:
    """Return the state with samples added for the next epoch."""
    return replace(state, samples=state.samples.merge(samples)) if samples else state


def waiting_samples(state: SensorState, samples: SensorSamples) -> SensorState:
    """Return the state of an antenna that has no epoch in this chunk; the samples are kept for its next epoch."""
    state = with_samples(state, samples)
    newest = max(rows.time[-1] for rows in state.samples.tables.values() if len(rows))
    oldest = newest - REACH - timedelta(np.asarray(_LONGEST_S))
    return replace(state, samples=state.samples.between(oldest, newest))


def sensor_epochs(
    samples: SensorSamples | None,
    time: Datetimes,
    trajectory: Trajectory,
    state: SensorState,
    *,
    limits: SensorLimits,
    sine_at: Callable[[Floats], Floats] | None = None,
    sources: Container[str] = ("wheel", "radar", "force", "feature", "balise", "range"),
    references: LineReferences | None = None,
) -> tuple[SensorEpochs, SensedMotion, SensorState]:
    """Return distances and forces between the epochs, the combined motion of wheel and inertial unit, and the new
    state.

    `samples` has the samples since the previous chunk; `time` has the antenna's epochs, shape (T,). The trajectory
    determines the direction of the front; the function `sine_at`, None for an unknown line, returns the sine of the
    gradient at arc lengths. `sources` has the requested names among `wheel`, `radar`, `force`, `feature`, `balise` and
    `range`; `references` has features of the line, ground units and listed balises.
    """
    if not (samples or state.samples):
        last = time[-1] if len(time) else state.time
        return SensorEpochs(), nothing_sensed(len(time)), copy_with(state, time=last)
    state = with_samples(state, samples)
    if not len(time):
        return SensorEpochs(), nothing_sensed(0), state
    pulses, inertial = state.samples.tachometer, state.samples.inertial
    radar, ranging, balises = state.samples.radar, state.samples.ranging, state.balises
    first = time[0] if np.isnat(state.time) else state.time
    edges = np.concatenate([[first], time])
    facing = trajectory.front_sign
    span = seconds(np.diff(edges))
    usable = (span > 0.0) & (span <= _LONGEST_S)
    values: dict[str, Any] = {}
    # samples after the last epoch belong to the next chunk, so that results do not depend on the division into chunks
    heard = int(np.searchsorted(pulses.time, edges[-1], side="right"))
    wheel = heard > 0 and "wheel" in sources
    force = len(inertial) > 0 and bool(inertial.time[0] <= edges[-1]) and "force" in sources
    sensed, motion, passing = nothing_sensed(len(time)), state.motion, state.features
    if force and "wheel" in sources and (pulses.direction[:heard] != 0).all():
        sensed, rates, motion = sensed_motion(
            pulses,
            inertial,
            edges,
            trajectory,
            sine_at or (lambda arc_m: np.full(arc_m.shape, np.nan)),
            motion,
            tachometer=limits.tachometer,
            limits=limits.slip,
        )
        if rates is not None and references is not None and references.features is not None:
            noise = _with_map(trajectory)
            passed, passing = references.features.locate(rates, facing, motion.sigma_m, passing, noise=noise)
            values |= _places(passed, rates, time)
    if wheel:
        values |= _wheel_values(pulses, edges, sensed, limits, known=~_silent("tachometer", samples, len(time)))
    if len(radar) and "radar" in sources:
        mean, share = _mean_between(radar.time, radar.speed_mps, edges)
        known = usable & (share >= _COMPLETE) & ~_silent("radar", samples, len(time))
        sigma = limits.radar_sigma_mps * np.sqrt(np.maximum(span, limits.radar_step_s) * limits.radar_step_s)
        values |= {"radar_m": np.where(known, mean * span, np.nan), "radar_sigma_m": sigma}
    if force:
        mean, share = _mean_between(inertial.time, inertial.force_mps2[:, 0], edges)
        known = usable & (share >= _COMPLETE) & ~_silent("inertial", samples, len(time))
        values |= {
            "force_mps2": np.where(known, mean - sensed.swing_mps2, np.nan),
            "force_sigma_mps2": np.full(len(time), limits.force_sigma_mps2),
        }
    # positive toward rising chainage
    values |= {name: facing * values[name] for name in ("wheel_m", "radar_m", "force_mps2") if name in values}
    if len(ranging) and "range" in sources and references is not None and references.units is not None:
        values["ranges"] = _ranges(ranging, edges, references.units, ranging_lever_m(trajectory, limits))
    if len(state.samples.balises) and "balise" in sources and references is not None and references.balises:
        values["balises"], balises = balise_epochs(
            state.samples.balises, edges, references.balises, trajectory, balises, limits.balise
        )
    kept = _latest_samples(state.samples, edges[-1], limits)
    state = SensorState(time=time[-1], samples=kept, motion=motion, features=passing, balises=balises)
    return SensorEpochs(**values), sensed, state


def _wheel_values(
    pulses: TachometerPulses, edges: Datetimes, sensed: SensedMotion, limits: SensorLimits, *, known: Masks
) -> dict[str, Any]:
    """Return the forward wheel distances of the intervals, their sigmas, and whether the direction was measured.

    The distances are computed from pulses if these are usable and marked in `known`, and from the inertial unit in the
    states `CARRIED`; otherwise they are NaN.
    """
    span = seconds(np.diff(edges))
    usable = (span > 0.0) & (span <= _LONGEST_S)
    distance = np.diff(distance_m(pulses, edges, limits=limits.tachometer))
    carried = np.isin(sensed.state, CARRIED)
    known = (
        known
        & usable
        & (edges[:-1] >= pulses.time[0])
        & ~(np.abs(distance) < LEAST_SPEED_MPS * np.maximum(span, 1e-9))
        & (np.diff(faults_until(pulses, edges)) == 0)
        & ~carried
        & (sensed.state != MotionState.EXPIRED)
    )
    speed_sigma = np.where(carried, _CARRY_SIGMA_MPS * (sensed.state != MotionState.STANDING), sensed.doubt_mps)
    quantum = limits.tachometer.pulse_m / np.sqrt(6.0)
    return {
        "wheel_m": np.where(known, distance, np.where(carried & usable, sensed.distance_m, np.nan)),
        "wheel_sigma_m": np.sqrt(limits.wheel_sigma_m**2 + quantum**2 + (speed_sigma * span) ** 2),
        "wheel_sign": "unknown" if (pulses.direction == 0).all() else "measured",
    }


def _latest_samples(samples: SensorSamples, end: np.datetime64, limits: SensorLimits) -> SensorSamples:
    """Return the samples that the next chunk needs."""
    pulses, inertial, radar, ranging = samples.tachometer, samples.inertial, samples.radar, samples.ranging
    return SensorSamples(
        tachometer=_latest(pulses, _find_first_needed(pulses, end - REACH, limits)),
        inertial=_latest(inertial, np.searchsorted(inertial.time, end - REACH, side="right") - 1),
        radar=_latest(radar, np.searchsorted(radar.time, end, side="right") - 1),
        ranging=_latest(ranging, np.searchsorted(ranging.time, end, side="right")),
        balises=_latest(samples.balises, np.searchsorted(samples.balises.time, end, side="right")),
    )


def _with_map(trajectory: Trajectory) -> tuple[float, float]:
    """Return the standard deviations of gradient and curvature over one metre, map errors included.

    A map error sigma over a length L causes curvature errors ``sqrt(3) sigma / L^2`` and gradient errors ``sigma / L``,
    both correlated over about L. The equivalent white noise over one metre is larger by the factor ``sqrt(L)``.
    """
    gradient = trajectory.sigma_height_m / np.sqrt(_MAP_LENGTH_M)
    curvature = np.sqrt(3.0) * trajectory.sigma_plan_m / _MAP_LENGTH_M**1.5
    return float(np.hypot(_GRADIENT_NOISE, gradient)), float(np.hypot(_CURVATURE_NOISE_1PM, curvature))


def _places(passed: Iterable[PassedFeature], rates: RateSeries, time: Datetimes) -> dict[str, Floats]:
    """Return the antenna positions from passed features, at the first epoch after each passing."""
    place, sigma = np.full(len(time), np.nan), np.full(len(time), np.nan)
    at = rates.arc_at(time)
    for feature in passed:
        epoch = int(np.searchsorted(time, rates.known[feature.tick]))
        place[epoch], sigma[epoch] = at[epoch] + feature.correction_m, feature.sigma_m
    return {"place_m": place, "place_sigma_m": sigma}


def ranging_lever_m(trajectory: Trajectory, limits: SensorLimits) -> Floats:
    """Return the ranging unit's position relative to the antenna: along, right of and above the path (3,) [m]."""
    facing = trajectory.front_sign
    along = facing * limits.range_ahead_m - ahead_m(trajectory)
    return np.array([along, facing * limits.range_right_m, limits.range_above_m])


def _ranges(ranging: StationRanges, edges: Datetimes, units: GroundUnits, lever_m: Floats) -> RangeEpochs:
    """Assign each range to the next epoch."""
    index = {str(name): k for k, name in enumerate(units.name)}
    unit = np.array([index.get(str(name), -1) for name in ranging.station], dtype=np.intp)
    epoch = np.searchsorted(edges, ranging.time, side="left") - 1
    rows = np.flatnonzero((unit >= 0) & (epoch >= 0) & (epoch < len(edges) - 1))
    epoch = epoch[rows]
    slot = np.arange(len(rows)) - np.searchsorted(epoch, epoch)
    shape = (len(edges) - 1, int(slot.max(initial=-1)) + 1)
    values, sigmas, ages = (np.full(shape, np.nan) for _ in range(3))
    places = np.full((*shape, 3), np.nan)
    values[epoch, slot] = ranging.range_m[rows]
    stated = ranging.sigma_m[rows]
    sigmas[epoch, slot] = np.where(np.isfinite(stated), np.maximum(stated, _RANGE_SIGMA_M), _RANGE_SIGMA_M)
    ages[epoch, slot] = seconds(edges[1:][epoch] - ranging.time[rows])
    places[epoch, slot] = units.ecef_m[unit[rows]]
    return RangeEpochs(range_m=values, sigma_m=sigmas, age_s=ages, unit_ecef_m=places, lever_m=lever_m)


def _find_first_needed(pulses: TachometerPulses, end: np.datetime64, limits: SensorLimits) -> int:
    """Return the index of the first pulse that is needed for computing speeds after `end`."""
    last = int(np.searchsorted(pulses.time, end, side="right")) - 1
    if last < 1:
        return 0
    start = window_start(pulses.time, np.array([last], dtype=np.intp), limits.tachometer.window_s)
    return max(int(start[0]) - 5, 0)


def _mean_between(time: Datetimes, values: Floats, edges: Datetimes) -> tuple[Floats, Floats]:
    """Return the mean of the finite samples in each interval, and the fraction of the samples that are finite.

    An interval excludes its first edge and includes its last edge.
    """
    known = np.isfinite(values)
    total = np.concatenate([[0.0], np.cumsum(np.where(known, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(known)])
    at = np.searchsorted(time, edges, side="right")
    many, there = np.diff(at), np.diff(count[at])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.diff(total[at]) / there, np.where(many > 0, there / np.maximum(many, 1), 0.0)


def _silent(sensor: str, samples: SensorSamples | None, epochs: int) -> Masks:
    """Return a mask of intervals, true only for the last interval, if the sensor's samples stop before it ends."""
    last = np.arange(epochs) == epochs - 1
    return last if samples is not None and sensor in samples.silent else np.zeros(epochs, dtype=np.bool_)


def _latest(samples: Samples, first: int | np.integer[Any]) -> Samples:
    """Return the samples from an index on."""
    return samples.take(slice(max(int(first), 0), None))
