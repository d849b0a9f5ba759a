"""Reference run curve: place over running time of one direction, for simulated running by place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from railfix.core.arrays import Floats, freeze_arrays


@dataclass(frozen=True, kw_only=True)
class ReferenceCurve:
    """Reference run of one direction."""

    direction: int  #: Direction against chainage.
    running_s: Floats  #: Running time without the standing times at stations, strictly rising; shape (N,).
    chainage_m: Floats  #: Front of the train, strictly rising or, with direction -1, falling; shape (N,).
    stations_m: Floats  #: Stopping places of the front, in the order of the run; shape (K,).

    def __post_init__(self) -> None:
        freeze_arrays(self)
        ahead = self.direction * np.diff(self.chainage_m)
        if self.direction not in (-1, 1) or len(ahead) < 1 or not (ahead > 0).all():
            raise ValueError("chainage_m rises strictly in the direction of the run, which is -1 or 1")
        if not (np.diff(self.running_s) > 0).all():
            raise ValueError("running_s rises strictly")

    @classmethod
    def between_stations(
        cls, stations_m: Floats, *, speed_mps: float, acceleration_mps2: float = 0.5, step_s: float = 1.0
    ) -> Self:
        """Return the curve of a run that starts and stops at each station with an even acceleration.

        Parameters
        ----------
        stations_m : ndarray, shape (K,) [m]
            In the order of the run.
        speed_mps : float [m/s]
            Highest speed; less is reached where the stations are near each other.
        acceleration_mps2 : float [m/s^2]
        step_s : float [s]
            Step of the table.
        """
        direction = 1 if stations_m[-1] > stations_m[0] else -1
        time, place, start = [np.zeros(1)], [stations_m[:1]], 0.0
        for origin, way in zip(stations_m[:-1], np.abs(np.diff(stations_m)), strict=True):
            peak = min(speed_mps, float(np.sqrt(acceleration_mps2 * way)))
            total = peak / acceleration_mps2 + way / peak
            t = np.append(np.arange(step_s, total - 0.5 * step_s, step_s), total)
            ramp = peak / acceleration_mps2
            covered = np.select(
                [t < ramp, t < total - ramp],
                [0.5 * acceleration_mps2 * t**2, peak * (t - 0.5 * ramp)],
                way - 0.5 * acceleration_mps2 * (total - t) ** 2,
            )
            time.append(start + t)
            place.append(origin + direction * covered)
            start += total
        return cls(
            direction=direction,
            running_s=np.concatenate(time),
            chainage_m=np.concatenate(place),
            stations_m=stations_m,
        )

    def simulated_m(self, from_m: float, elapsed_s: float) -> float:
        """Return the place a running time after a place, at most the next station: by place, not by timetable."""
        at = np.interp(self.direction * from_m, self.direction * self.chainage_m, self.running_s)
        place = float(np.interp(at + max(elapsed_s, 0.0), self.running_s, self.chainage_m))
        ahead = self.direction * (self.stations_m - from_m)
        left = ahead[ahead > 1.0]
        limit = float(left.min()) if len(left) else 0.0
        return from_m + self.direction * min(max(self.direction * (place - from_m), 0.0), limit)

    def station_at(self, chainage_m: float, *, within_m: float = 25.0) -> int | None:
        """Return the number of the station at a place, None between stations."""
        distance = np.abs(self.stations_m - chainage_m)
        nearest = int(distance.argmin())
        return nearest if distance[nearest] <= within_m else None

    def progress(self, chainage_m: float) -> tuple[int, float]:
        """Return the section, by its first station, and the progress in it in running direction [%].

        P5 3.1: a train reports the station at a station, else the section and the progress, its length being 100 %.
        """
        along = self.direction * self.stations_m
        section = int(np.clip(np.searchsorted(along, self.direction * chainage_m, side="right") - 1, 0, len(along) - 2))
        share = (self.direction * chainage_m - along[section]) / (along[section + 1] - along[section])
        return section, float(np.clip(100.0 * share, 0.0, 100.0))
