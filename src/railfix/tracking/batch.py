r"""Places along a line by a robust least-squares fit of all epochs together: a second opinion on the filter.

Nothing of the filter is used: no hypotheses, no learnt scales, no sensors. The unknowns are place s, speed v, clock b
and its drift d at each epoch and one offset o for each constellation; codes P, range rates R and the motion are
fitted::

    P_ki = range_i(s_k) + b_k + o_c + noise          R_ki = u_i . (V_i - v_k t(s_k)) + d_k + noise
    s_k+1 - s_k = dt (v_k + v_k+1) / 2 + noise       v_k+1 - v_k = noise (white acceleration of density q)

Codes and rates have Student's t errors, fitted by reweighting (P. J. Huber and E. M. Ronchetti, 2009, chapter 7).
Errors of codes last a minute: with 2 tau / dt epochs to one independent error each has that much less information.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.timescale import seconds
from railfix.track.trajectory import Trajectory
from railfix.tracking.epochs import GnssEpochs

#: Epochs of one fit, and of those on either side that are fitted with it and left to the next.
_PIECE, _OVERLAP = 900, 120
#: Degrees of freedom of the errors; correlation times of codes and rates [s]; standard deviation of a rate [m/s].
_FREEDOM: Final = 4.0
_CODE_S, _RATE_S = 60.0, 10.0
_RATE_MPS: Final = 0.1
#: Density of the acceleration [m^2/s^3]: 1 m/s^2 that changes within half a second.
_ACCELERATION: Final = 1.0
#: Standard deviation of what nothing measures: it keeps the matrix regular [m, m/s].
_LOOSE: Final = 1e5
_ROUNDS: Final = 40
_CONVERGED_M: Final = 1e-3
#: Half the length over which the direction of the line is taken [m], and columns of the covariance at a time.
_STEP_M: Final = 2.0
_BLOCK: Final = 128


@dataclass(frozen=True, kw_only=True)
class BatchTrack:
    """Places of T epochs by all measurements together."""

    time: Datetimes  #: Shape (T,).
    #: Arc length and its standard deviation; NaN in a piece without codes; shape (T,).
    arc_m: Floats
    sigma_m: Floats
    speed_mps: Floats  #: Shape (T,).


def fit_batch(epochs: GnssEpochs, trajectory: Trajectory, near_m: Floats | None = None) -> BatchTrack:
    """Fit places to all epochs of a log, in overlapping pieces of a quarter of an hour at one epoch a second.

    Parameters
    ----------
    epochs : GnssEpochs
        T epochs; `near_ecef_m`, where there is such, gives the first guess. A second or more apart.
    trajectory : Trajectory
    near_m : ndarray, shape (T,), optional [m]
        Another first guess; the better fit of the two is returned.
    """
    count = len(epochs)
    arc, sigma, speed = np.full((3, count), np.nan)
    starts = [_first_guess(epochs, trajectory)] + ([] if near_m is None else [_fill(near_m)])
    for begin in range(0, count, _PIECE):
        first, last = max(begin - _OVERLAP, 0), min(begin + _PIECE + _OVERLAP, count)
        own = slice(begin - first, min(begin + _PIECE, count) - first)
        piece = epochs.take(slice(first, last))
        if len(piece) < 2 or not np.isfinite(piece.code_m).any():
            continue
        fits = [_Fit(piece, trajectory, start[first:last]) for start in starts if np.isfinite(start[first:last]).all()]
        if fits:
            best = min(fits, key=lambda fit: fit.cost)
            rows = slice(begin, begin + _PIECE)
            arc[rows], speed[rows] = best.arc_m[own], best.speed_mps[own]
            sigma[rows] = np.hypot(best.sigma_m(own), trajectory.sigma_plan_m)
    return BatchTrack(time=epochs.time, arc_m=arc, sigma_m=sigma, speed_mps=speed)


def _first_guess(epochs: GnssEpochs, trajectory: Trajectory) -> Floats:
    """Return the places of the line nearest to positions without it, between them by time."""
    if epochs.near_ecef_m is None:
        return np.full(len(epochs), np.nan)
    known = np.flatnonzero(np.isfinite(epochs.near_ecef_m).all(axis=1))
    arc = np.full(len(epochs), np.nan)
    arc[known] = trajectory.nearest(epochs.near_ecef_m[known])[0]
    return _fill(arc)


def _fill(arc_m: Floats) -> Floats:
    known = np.flatnonzero(np.isfinite(arc_m))
    return np.interp(np.arange(len(arc_m)), known, arc_m[known]) if len(known) else arc_m


class _Fit:
    """The fit of one piece; `arc_m`, `speed_mps` and the cost when it has converged."""

    def __init__(self, epochs: GnssEpochs, trajectory: Trajectory, start_m: Floats) -> None:
        self._epochs, self._trajectory, self._count = epochs, trajectory, len(epochs)
        self._step_s = np.maximum(seconds(np.diff(epochs.time)), 1e-3)
        usual = float(np.median(self._step_s)) if self._count > 1 else 1.0
        self._clocks = np.unique(epochs.clock)
        placed = np.isfinite(epochs.sat_ecef_m).all(axis=2)
        moving = placed & np.isfinite(epochs.sat_velocity_mps).all(axis=2)
        self._code = np.nonzero(placed & np.isfinite(epochs.code_m) & np.isfinite(epochs.code_sigma_m))
        self._rate = np.nonzero(moving & np.isfinite(epochs.rate_mps))
        sizes = len(self._code[0]), len(self._rate[0])
        self._sigma = np.concatenate([epochs.code_sigma_m[self._code], np.full(sizes[1], _RATE_MPS)])
        self._share = 1.0 / np.repeat([1.0 + 2.0 * _CODE_S / usual, 1.0 + 2.0 * _RATE_S / usual], sizes)
        self._motion, self._loose = self._motion_rows()
        self.arc_m, self.speed_mps = start_m.copy(), np.gradient(start_m, seconds(epochs.time - epochs.time[0]))
        self._rest = np.zeros(2 * self._count + len(self._clocks))
        self._solve()

    def _motion_rows(self) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        """Return the rows of the motion and those that keep the matrix regular, over their standard deviations."""
        n, k = self._count, np.arange(self._count - 1)
        size = 4 * n + len(self._clocks)
        place = 1.0 / np.sqrt(_ACCELERATION * self._step_s**3 / 12.0)
        speed = 1.0 / np.sqrt(_ACCELERATION * self._step_s)
        values = [place, -place, -0.5 * place * self._step_s, -0.5 * place * self._step_s, speed, -speed]
        columns = [k + 1, k, n + k, n + k + 1, n + k + 1, n + k]
        rows = [k, k, k, k, k + n - 1, k + n - 1]
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return sparse.csr_matrix(entries, shape=(2 * (n - 1), size)), sparse.csr_matrix(sparse.identity(size) / _LOOSE)

    def _line(self) -> tuple[Floats, Floats]:
        """Return the points of the line at the places, straight on beyond its ends, and its directions there."""
        path = self._trajectory
        inside = np.clip(self.arc_m, _STEP_M, path.arc_m[-1] - _STEP_M)
        tangent = path.at_arc(inside + _STEP_M) - path.at_arc(inside - _STEP_M)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        on = np.clip(self.arc_m, 0.0, path.arc_m[-1])
        return path.at_arc(on) + (self.arc_m - on)[:, None] * tangent, tangent

    def _equations(self) -> tuple[Floats, sparse.csr_matrix]:
        """Return residuals of codes and rates without their clocks' start, and their derivatives, over the sigmas."""
        n, (k, i), (j, h) = self._count, self._code, self._rate
        point, tangent = self._line()
        drift = self._rest[n : 2 * n]
        sight, distance = _sight(self._epochs.sat_ecef_m[k, i], point[k])
        offset = 2 * n + np.searchsorted(self._clocks, self._epochs.clock[i])
        code = self._epochs.code_m[k, i] - distance - self._rest[k] - self._rest[offset]
        along = -(sight * tangent[k]).sum(axis=1)
        view, _ = _sight(self._epochs.sat_ecef_m[j, h], point[j])
        moving = self._epochs.sat_velocity_mps[j, h]
        spin = EARTH_ROTATION_RATE / SPEED_OF_LIGHT * (moving[:, 0] * point[j, 1] - moving[:, 1] * point[j, 0])
        slope = -(view * tangent[j]).sum(axis=1)
        rate = self._epochs.rate_mps[j, h] - (view * moving).sum(axis=1) - spin - slope * self.speed_mps[j] - drift[j]
        row, other = np.arange(len(k)), len(k) + np.arange(len(j))
        one, unit = np.ones(len(k)), np.ones(len(j))
        values = np.concatenate([along, one, one, slope, unit])
        rows = np.concatenate([row, row, row, other, other])
        columns = np.concatenate([k, 2 * n + k, 2 * n + offset, n + j, 3 * n + j])
        matrix = sparse.csr_matrix((values, (rows, columns)), shape=(len(self._sigma), 4 * n + len(self._clocks)))
        return np.concatenate([code, rate]) / self._sigma, sparse.diags(1.0 / self._sigma) @ matrix

    def _start_clocks(self) -> None:
        """Clocks by the medians of the residuals of each epoch, offsets by those over all of them."""
        n, (k, i), (j, _) = self._count, self._code, self._rate
        residual = self._equations()[0] * self._sigma
        self._rest[:n] = _medians(residual[: len(k)], k, n)
        self._rest[n : 2 * n] = _medians(residual[len(k) :], j, n)
        rest = residual[: len(k)] - self._rest[k]
        own = np.searchsorted(self._clocks, self._epochs.clock[i])
        self._rest[2 * n :] = _medians(rest, own, len(self._clocks))

    def _solve(self) -> None:
        n = self._count
        self._start_clocks()
        for _ in range(_ROUNDS):
            residual, design = self._equations()
            weight = (_FREEDOM + 1.0) / (_FREEDOM + residual**2) * self._share
            state = np.concatenate([self.arc_m, self.speed_mps, self._rest])
            weighted = design.T @ sparse.diags(weight)
            normal = weighted @ design + self._motion.T @ self._motion + self._loose.T @ self._loose
            right = weighted @ residual - self._motion.T @ (self._motion @ state)
            self._factor = splu(normal.tocsc())
            change = self._factor.solve(right)
            change[:n] = np.clip(change[:n], -200.0, 200.0)  # the line bends
            self.arc_m, self.speed_mps = self.arc_m + change[:n], self.speed_mps + change[n : 2 * n]
            self._rest = self._rest + change[2 * n :]
            if np.abs(change[:n]).max() < _CONVERGED_M:
                break
        residual, _ = self._equations()
        state = np.concatenate([self.arc_m, self.speed_mps, self._rest])
        fit = 0.5 * (_FREEDOM + 1.0) * self._share * np.log1p(residual**2 / _FREEDOM)
        self.cost = float(fit.sum() + 0.5 * ((self._motion @ state) ** 2).sum())

    def sigma_m(self, rows: slice) -> Floats:
        """Return the standard deviations of places: the inverse of the matrix of the last round."""
        wanted = np.arange(self._count)[rows]
        variance = np.empty(len(wanted))
        for first in range(0, len(wanted), _BLOCK):
            part = wanted[first : first + _BLOCK]
            unit = np.zeros((4 * self._count + len(self._clocks), len(part)))
            unit[part, np.arange(len(part))] = 1.0
            variance[first : first + _BLOCK] = self._factor.solve(unit)[part, np.arange(len(part))]
        return np.sqrt(variance)


def _sight(sat_ecef_m: Floats, point_ecef_m: Floats) -> tuple[Floats, Floats]:
    """Return the unit vectors to satellites, and the ranges with the turn of the Earth while the signal travels."""
    way = sat_ecef_m - point_ecef_m
    distance = np.linalg.norm(way, axis=1)
    turn = sat_ecef_m[:, 0] * point_ecef_m[:, 1] - sat_ecef_m[:, 1] * point_ecef_m[:, 0]
    return way / distance[:, None], distance + EARTH_ROTATION_RATE / SPEED_OF_LIGHT * turn


def _medians(values: Floats, group: Indices, groups: int) -> Floats:
    """Return the median of the values of each group; 0 for one without."""
    order = np.lexsort((values, group))
    count = np.bincount(group, minlength=groups)
    middle = np.cumsum(count) - count + count // 2
    return np.where(count > 0, values[order][np.minimum(middle, len(values) - 1)] if len(values) else 0.0, 0.0)


def joined_epochs(parts: list[GnssEpochs]) -> GnssEpochs:
    """Return epochs of chunks one after the other; chunks may have other satellites."""
    channels = sorted({key for part in parts for key in _channels(part)})
    shapes: dict[str, Any] = {}
    for f in fields(GnssEpochs):
        values = [getattr(part, f.name) for part in parts]
        if f.name in ("satellite", "clock") or any(value is None for value in values):
            continue
        if values[0].ndim > 1 and f.name != "near_ecef_m":
            absent = False if values[0].dtype == np.bool_ else np.nan
            wide = []
            for part, value in zip(parts, values, strict=True):
                full = np.full((len(part), len(channels), *value.shape[2:]), absent, dtype=value.dtype)
                full[:, [channels.index(key) for key in _channels(part)]] = value
                wide.append(full)
            values = wide
        shapes[f.name] = np.concatenate(values)
    names = {"satellite": [key[0] for key in channels], "clock": [key[1] for key in channels]}
    shapes |= {name: np.array(value, dtype=np.str_) for name, value in names.items()}
    return GnssEpochs(**shapes)


def _channels(epochs: GnssEpochs) -> list[tuple[str, str, int]]:
    """Return the satellite, clock and number among equal ones of each channel."""
    seen: dict[tuple[str, str], int] = {}
    keys = []
    for satellite, clock in zip(epochs.satellite.tolist(), epochs.clock.tolist(), strict=True):
        number = seen[satellite, clock] = seen.get((satellite, clock), -1) + 1
        keys.append((satellite, clock, number))
    return keys
