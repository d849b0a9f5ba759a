"""The filter along the track as a textbook Kalman filter: filterpy on the filter's own equations.

One hypothesis, normal errors, a straight line, satellites at rest, clocks of GPS and Galileo. The design comes from
differences of ranges; prediction, update and smoother are filterpy's (R. Labbe, https://github.com/rlabbe/filterpy).
The figures of the model are those of docs/filter-equations.md, written again; Singer's noise is the integral.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter, rts_smoother

from railfix.tracking import GnssEpochs, Line, SensorEpochs, TrackingLimits

#: Unknowns: arc length, speed, acceleration, arc length before, change of the phases' clock, its drift, map right and
#: up, clock of the codes, displacement of the map right, up and along, wheel, error of the Dopplers, of the codes'
#: place, offsets of the two constellations from that clock; then one error a satellite.
S, V, A, S0, B, D, MR, MU, CLOCK, QR, QU, QA, WHEEL, W, Z, GPS, GALILEO, X = range(18)
#: The earth's rotation [rad/s] over the speed of light [m/s].
TURN_PER_M = 7.2921151467e-5 / 299_792_458.0
#: Clocks: random walk of a drift [m/s per square root of s]; offset of two constellations: at first [m], walk.
CLOCK_WALK_MPS, OFFSET_PRIOR_M, OFFSET_WALK_M = 0.5, 30.0, 0.02
#: Slow errors: of each code, of all codes' place [s], of Dopplers, at rest [m/s] and per speed; walk of the phases.
CODE_CORRELATION_S, CODE_CORRELATION_M, SLOW_CODE_S = 60.0, 100.0, 7200.0
DOPPLER_ERROR_MPS, DOPPLER_ERROR_SHARE, DOPPLER_CORRELATION_S, PHASE_WALK_M = 0.01, 0.02, 10.0, 0.03
#: The map: roughness [m] and its length [m], lengths [m per square root of m], its offset's length [m].
MAP_ROUGHNESS_M, MAP_CORRELATION_M, MAP_SCALE_M, MAP_ABSOLUTE_M = 0.3, 50.0, 0.03, 500.0
START_SIGMA_M = 30.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(40)
#: The step of the differences [m]; a new linearisation where the place moves by more than this [m].
STEP_M, MOVED_M = 10.0, 2.0


def response(dt: np.ndarray, tau_s: float) -> np.ndarray:
    """Position, speed and acceleration a while after an impulse of the acceleration, shape (3, K)."""
    x = dt / tau_s
    return np.stack([tau_s**2 * (x + np.expm1(-x)), -tau_s * np.expm1(-x), np.exp(-x)])


def singer(dt: float, sigma_mps2: float, tau_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition, and the integral of the noise over the responses to it."""
    step = np.column_stack([[1.0, 0.0, 0.0], [dt, 1.0, 0.0], response(np.array([dt]), tau_s)[:, 0]])
    inside = response(0.5 * dt * (_NODES + 1.0), tau_s)
    return step, 2.0 * sigma_mps2**2 / tau_s * (inside * (0.5 * dt * _WEIGHTS)) @ inside.T


@dataclass(frozen=True)
class Kalman:
    """Filtered and smoothed states, shapes (T, N) and (T, N, N), and innovations of the codes, shape (T, K)."""

    mean: np.ndarray
    covariance: np.ndarray
    smoothed_mean: np.ndarray
    smoothed_covariance: np.ndarray
    code_innovation: np.ndarray


@dataclass
class Oracle:
    """Equations of one case."""

    epochs: GnssEpochs
    sensors: SensorEpochs
    line: Line
    limits: TrackingLimits

    def __post_init__(self) -> None:
        self.point, axes = self.line.at(np.array([self.line.arc_m.mean()]))
        self.middle, self.axes = float(self.line.arc_m.mean()), axes[0]
        self.galileo = self.epochs.clock == "E"

    def place(self, arc_m: float) -> np.ndarray:
        return np.asarray(self.point[0] + (arc_m - self.middle) * self.axes[0])

    def straight(self, t: int, place: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(self.epochs.sat_ecef_m[t] - place, axis=1))

    def turned(self, t: int, place: np.ndarray) -> np.ndarray:
        """What the earth turns while the signals fly."""
        sat = self.epochs.sat_ecef_m[t]
        return TURN_PER_M * (sat[:, 0] * place[1] - sat[:, 1] * place[0])

    def distance(self, t: int, arc_m: float) -> np.ndarray:
        place = self.place(arc_m)
        return self.straight(t, place) + self.turned(t, place)

    def slopes(self, t: int, arc_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Change of the ranges with the place along, right and up, shape (3, K); that of the turning along, (K,).

        The filter takes the second, 3e-7, into account in Dopplers alone.
        """
        place, step = self.place(arc_m), STEP_M * self.axes
        ranges = [self.straight(t, place + s) - self.straight(t, place - s) for s in step]
        turning = self.turned(t, place + step[0]) - self.turned(t, place - step[0])
        return np.array(ranges) / (2.0 * STEP_M), turning / (2.0 * STEP_M)

    def start(self, arc_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Prior of a start at a place."""
        limits, count = self.limits, len(self.epochs.satellite)
        sigma = np.ones(X + count)
        sigma[[S, S0]] = START_SIGMA_M
        sigma[[V, A, D, B]] = 50.0, limits.acceleration_mps2, 1e3, 1e3
        sigma[[MR, MU]] = self.line.sigma_plan_m, self.line.sigma_height_m
        sigma[[CLOCK, WHEEL, W, Z]] = 1e3, 0.02, DOPPLER_ERROR_MPS, limits.slow_code_m
        sigma[[GPS, GALILEO]] = 0.01, OFFSET_PRIOR_M
        mean = np.zeros(X + count)
        mean[[S, S0]] = arc_m
        return mean, np.diag(sigma**2)

    def prediction(self, mean: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Transition and noise over an interval from a state."""
        limits, speed, size = self.limits, abs(mean[V]), len(mean)
        travel = speed * dt
        step, walked = singer(dt, limits.acceleration_mps2, limits.acceleration_s)
        kept = np.ones(size)
        kept[[B, CLOCK, QR, QU, QA]] = 0.0
        kept[[MR, MU]] = np.exp(-travel / MAP_ABSOLUTE_M)
        kept[[W, Z]] = np.exp(-dt / np.array([DOPPLER_CORRELATION_S, SLOW_CODE_S]))
        kept[X:] = np.exp(-dt / CODE_CORRELATION_S - travel / CODE_CORRELATION_M)
        transition = np.diag(kept)
        transition[:3, :3] = step
        transition[S0] = 0.0
        transition[S0, S] = 1.0
        transition[B, D] = dt
        sigma = np.zeros(size)
        sigma[[MR, MU]] = self.line.sigma_plan_m, self.line.sigma_height_m
        sigma[[W, Z]] = DOPPLER_ERROR_MPS + DOPPLER_ERROR_SHARE * speed, limits.slow_code_m
        sigma[X:] = 1.0
        variance = sigma**2 * (1.0 - kept**2)
        walk, least = CLOCK_WALK_MPS**2, 1e-6
        variance[[D, B, CLOCK]] = walk * dt, walk * dt**3 / 3.0 + least, 1e6
        variance[WHEEL], variance[[GPS, GALILEO]] = 5e-4**2 * dt, OFFSET_WALK_M**2 * dt
        length = MAP_SCALE_M**2 * travel + PHASE_WALK_M**2 * dt
        rough = 2.0 * MAP_ROUGHNESS_M**2 * (1.0 - np.exp(-travel / MAP_CORRELATION_M))
        variance[[QR, QU, QA]] = rough + 1e-8, rough + 1e-8, length + 1e-8
        noise = np.diag(variance)
        noise[:3, :3] += walked
        noise[[S, V], [S, V]] += least
        noise[S, S] += length
        noise[S, QA] = noise[QA, S] = -length
        noise[B, D] = noise[D, B] = walk * dt**2 / 2.0
        return transition, noise

    def rows(
        self, t: int, mean: np.ndarray, arc_m: float, before_m: float, dt: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Measurements less those computed at the mean, design and variances: codes, phases, Dopplers, sensors."""
        epochs, limits = self.epochs, self.limits
        count, (slope, turning) = len(epochs.satellite), self.slopes(t, arc_m)
        design, value, variance = [], [], []
        cn0 = np.minimum(np.where(np.isnan(epochs.cn0_dbhz[t]), 45.0, epochs.cn0_dbhz[t]), 50.0)
        weak = 10.0 ** ((45.0 - cn0) / 20.0)
        for k in np.flatnonzero(np.isfinite(epochs.code_m[t])):
            row, sigma = np.zeros(X + count), epochs.code_sigma_m[t, k]
            row[[S, Z]], row[[MR, MU]], row[CLOCK] = slope[0, k], slope[1:, k], 1.0
            row[GALILEO if self.galileo[k] else GPS], row[X + k] = 1.0, sigma
            design.append(row)
            computed = self.distance(t, arc_m)[k] + row @ mean - row[S] * arc_m
            value.append(epochs.code_m[t, k] - computed)
            variance.append((limits.code_white_share * sigma) ** 2)
        joined = np.isfinite(epochs.phase_m[t]) & np.isfinite(epochs.phase_m[t - 1]) if t else np.zeros(count, bool)
        for k in np.flatnonzero(joined):
            row = np.zeros(X + count)
            row[[S, QA]], row[S0], row[[QR, QU]], row[B] = slope[0, k], -slope[0, k], slope[1:, k], 1.0
            design.append(row)
            run = self.distance(t, arc_m)[k] - self.distance(t - 1, before_m)[k]
            computed = run + row @ mean - row[S] * (arc_m - before_m)
            value.append(epochs.phase_m[t, k] - epochs.phase_m[t - 1, k] - computed)
            variance.append(limits.phase_floor_m**2 + (limits.phase_zenith_m * weak[k]) ** 2)
        for k in np.flatnonzero(np.isfinite(epochs.rate_mps[t])):
            row = np.zeros(X + count)
            row[[V, W]], row[[QR, QU]], row[D] = slope[0, k] + turning[k], slope[1:, k] / dt, 1.0
            design.append(row)
            value.append(epochs.rate_mps[t, k] - row @ mean)
            variance.append(limits.doppler_floor_mps**2 + (limits.doppler_zenith_mps * weak[k]) ** 2)
        wheel, wheel_sigma = self.sensors.wheel_m, self.sensors.wheel_sigma_m
        if wheel is not None and wheel_sigma is not None and np.isfinite(wheel[t]):
            row = np.zeros(X + count)
            row[[S, S0, QA, WHEEL]] = 1.0, -1.0, 1.0, -wheel[t]
            design.append(row)
            value.append(wheel[t] - row @ mean)
            variance.append(wheel_sigma[t] ** 2)
        place, place_sigma = self.sensors.place_m, self.sensors.place_sigma_m
        if place is not None and place_sigma is not None and np.isfinite(place[t]):
            row = np.zeros(X + count)
            row[S] = 1.0
            design.append(row)
            value.append(place[t] - mean[S])
            variance.append(place_sigma[t] ** 2)
        return np.array(value), np.array(design).reshape(-1, X + count), np.array(variance)

    def with_clocks(self, t: int, mean: np.ndarray, covariance: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Clocks near this epoch's: that of the codes always, those of phases and Dopplers where they are not known."""
        mean, covariance = mean.copy(), covariance.copy()
        value, design, _ = self.rows(t, mean, mean[S], mean[S0], dt)
        code, phase, rate = (design[:, clock] == 1.0 for clock in (CLOCK, B, D))
        if code.any():
            gps = code & (design[:, GPS] == 1.0)
            mean[CLOCK] += np.median(value[gps if t == 0 else code])
            if t == 0:
                mean[GALILEO] = np.median(value[code & ~gps]) - np.median(value[gps])
        for used, clock in ((phase, B), (rate, D)):
            if used.any() and covariance[clock, clock] > 100.0**2:
                mean[clock] += np.median(value[used])
                covariance[clock] = covariance[:, clock] = 0.0
                covariance[clock, clock] = 100.0**2
        return mean, covariance

    def run(self, arc_m: float) -> Kalman:
        """Filter from a place and smooth."""
        epochs = self.epochs
        first, wide = self.start(arc_m)
        kalman = KalmanFilter(dim_x=len(first), dim_z=1)
        kalman.x, kalman.P = first, wide
        means, covariances, transitions, noises, innovations = [], [], [], [], []
        for t in range(len(epochs)):
            dt = 1.0 if t == 0 else float((epochs.time[t] - epochs.time[t - 1]) / np.timedelta64(1, "s"))
            if t:
                kalman.F, kalman.Q = self.prediction(kalman.x, dt)
                kalman.predict()
                transitions.append(kalman.F)
                noises.append(kalman.Q)
            mean, covariance = self.with_clocks(t, kalman.x, kalman.P, dt)
            kalman.x, kalman.P = mean, covariance
            innovation, point = None, (mean[S], mean[S0])
            while True:
                value, design, variance = self.rows(t, mean, *point, dt)
                innovation = value if innovation is None else innovation
                kalman.x, kalman.P = mean.copy(), covariance.copy()
                if len(value):
                    kalman.dim_z = len(value)
                    kalman.update(value + design @ mean, R=np.diag(variance), H=design)
                if abs(kalman.x[S] - point[0]) < MOVED_M:
                    break
                point = (kalman.x[S], kalman.x[S0])
            means.append(kalman.x.copy())
            covariances.append(kalman.P.copy())
            row = np.full(len(epochs.satellite), np.nan)
            has = np.isfinite(epochs.code_m[t])
            row[has] = innovation[: has.sum()]
            innovations.append(row)
        steps, walks = [*transitions, np.eye(len(first))], [*noises, np.eye(len(first))]
        smooth_mean, smooth_covariance, *_ = rts_smoother(np.array(means), np.array(covariances), steps, walks)
        return Kalman(
            np.array(means), np.array(covariances), smooth_mean, smooth_covariance, np.array(innovations)
        )  # fmt: skip
