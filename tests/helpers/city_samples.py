"""Errors of codes and C/N0 of simulated surroundings and of recorded cities, and figures that compare them.

The kinds of `railfix.simulate.environment.structures` are not fitted; the scenario `city` is calibrated on the Hong
Kong recordings with some seeds; Berlin, the Pixel and other seeds are for validation.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

import recordings_score
import recordings_truth
from railfix.core.arrays import Floats, Masks, Strings
from railfix.core.constants import CLOCK_GROUP
from railfix.core.geodesy import range_with_rotation
from railfix.core.reasons import Reason
from railfix.evaluate import interpolate_reference
from railfix.pipeline.results import AntennaResult
from railfix.ranges.range_sigma import CodeNoise, code_sigma_m
from railfix.simulate import LineSettings, RunSettings, Scenario, Simulation, SkySettings
from railfix.simulate.environment import ElectrificationSettings, Environment, EnvironmentSettings, SectionSettings
from railfix.simulate.environment.settings import Kind
from railfix.simulate.scenario_file import load_recipe

#: Constellations that both sides have.
SYSTEMS: Final = "GJEC"
#: Length of the simulated line [m], its cruising speed [m/s], and seeds that are put together.
LENGTH_M: Final = 4000.0
CRUISE_MPS: Final = 40.0 / 3.6
SEEDS: Final = (1, 2, 3)
#: Seeds of `city` that it was calibrated with, and others that were not looked at before it was.
CALIBRATION_SEEDS: Final = tuple(range(1, 13))
VALIDATION_SEEDS: Final = tuple(range(101, 113))
#: Reasons for which a code is not compared.
NO_RANGE: Final = int(
    Reason.UNHEALTHY
    | Reason.NO_EPHEMERIS
    | Reason.EPHEMERIS_TOO_OLD
    | Reason.IMPLAUSIBLE_CODE
    | Reason.OTHER_SIGNAL_TAKEN
    | Reason.NO_CORRECTION
)
#: Elevations below this are left out of the errors [deg].
MASK_DEG: Final = 10.0


@dataclass(frozen=True)
class Sample:
    """Codes less true range, and what goes with them, shapes (T, K); NaN where not tracked."""

    name: str
    satellite: Strings
    residual_m: Floats
    elevation_deg: Floats
    cn0_dbhz: Floats
    in_view: Masks | None = None

    def errors_m(self) -> Floats:
        """Residuals less one clock an epoch and one offset a constellation, shape (T, K).

        Clocks are medians weighted by the elevation and C/N0 of the satellites, so that they follow the
        clear ones; the same for recordings and simulations.
        """
        weight = 1.0 / code_sigma_m(self.cn0_dbhz, self.elevation_deg, noise=CodeNoise()) ** 2
        group = np.array([CLOCK_GROUP[str(name)[0]] for name in self.satellite])
        letters = sorted(set(group.tolist()), key=lambda letter: letter != "G")
        clocks = {g: weighted_median(self.residual_m[:, group == g], weight[:, group == g]) for g in letters}
        apart = {g: clocks[g] - clocks["G"] for g in letters}
        offset = {g: float(np.nanmedian(a)) if np.isfinite(a).any() else np.nan for g, a in apart.items()}
        tied = self.residual_m - np.array([offset[g] for g in group])
        return tied - weighted_median(tied, weight)[:, None]


def weighted_median(value: Floats, weight: Floats) -> Floats:
    """Weighted median along the last axis; NaN where there is nothing."""
    there = np.isfinite(value) & np.isfinite(weight)
    order = np.argsort(np.where(there, value, np.inf), axis=1)
    share = np.cumsum(np.take_along_axis(np.where(there, weight, 0.0), order, axis=1), axis=1)
    middle = np.argmax(share >= 0.5 * share[:, -1:], axis=1)
    found = np.take_along_axis(value, np.take_along_axis(order, middle[:, None], axis=1), axis=1)[:, 0]
    return np.where(there.any(axis=1), found, np.nan)


@dataclass(frozen=True)
class Figures:
    """What is compared."""

    codes: int
    p50_m: float
    p95_m: float
    over_20_m: float
    late_over_20_m: float
    early_over_20_m: float
    tracked: float
    p99_m: float
    over_50_m: float
    beyond_5_sigma: float
    two_faults: float
    pair_ratio: float
    correlation_1_s: float
    correlation_10_s: float


def figures(sample: Sample) -> Figures:
    """Figures of the codes above the mask."""
    error = sample.errors_m()
    high = sample.elevation_deg >= MASK_DEG
    e = error[np.isfinite(error) & high]
    tracked = np.nan
    if sample.in_view is not None:
        tracked = float(np.isfinite(sample.residual_m[high & sample.in_view]).mean())
    size = np.abs(e)
    return Figures(
        codes=len(e),
        p50_m=float(np.median(size)),
        p95_m=float(np.percentile(size, 95)),
        over_20_m=float((size > 20.0).mean()),
        late_over_20_m=float((e > 20.0).mean()),
        early_over_20_m=float((e < -20.0).mean()),
        tracked=tracked,
        p99_m=float(np.percentile(size, 99)),
        over_50_m=float((size > 50.0).mean()),
        **joint_figures(sample, error, np.isfinite(error) & high),
    )


def joint_figures(sample: Sample, error: Floats, used: Masks) -> dict[str, float]:
    """Figures of several codes together.

    Faults are errors over 20 m: share of the epochs with two or more, and the mean number of pairs of
    faults in an epoch over that of independent faults of the same share. Correlation of one code's errors, clipped
    at 50 m, after 1 s and 10 s. Share of errors beyond 5 sigma of the receiver's code noise.
    """
    fault = used & (np.abs(error) > 20.0)
    count, codes = fault.sum(axis=1), used.sum(axis=1)
    share = fault.sum() / used.sum()
    pairs = share**2 * (codes * (codes - 1)).mean()
    sigma = code_sigma_m(sample.cn0_dbhz, sample.elevation_deg, noise=CodeNoise())
    clipped = np.clip(error, -50.0, 50.0)

    def correlation(lag: int) -> float:
        both = used[:-lag] & used[lag:]
        return float(np.corrcoef(clipped[:-lag][both], clipped[lag:][both])[0, 1])

    return {
        "beyond_5_sigma": float((np.abs(error) > 5.0 * sigma)[used].mean()),
        "two_faults": float((count >= 2).mean()),
        "pair_ratio": float((count * (count - 1)).mean() / pairs) if pairs > 0.0 else np.nan,
        "correlation_1_s": correlation(1),
        "correlation_10_s": correlation(10),
    }


def city_scenario(seed: int, *, duration_s: float = 780.0) -> Scenario:
    """The scenario `city` with another seed, other structures and another sky."""
    changes = {"seed": seed, "place_seed": seed, "duration_s": duration_s}
    start = np.datetime64("2024-03-05T00:10:00", "ns") + np.timedelta64(5 * seed, "h")
    return load_recipe("city").scenario(changes=changes).replaced(start=start)


def city(name: str = "city", *, seeds: tuple[int, ...] = CALIBRATION_SEEDS) -> Sample:
    """The scenario `city` over several seeds, structures and skies, with all of its errors."""
    parts = []
    for seed in seeds:
        scenario = city_scenario(seed)
        for piece in Simulation(scenario).pieces("front"):
            elevation = piece.geometry.elevation_deg
            parts.append(
                Sample(
                    name,
                    piece.observations.satellite,
                    piece.observations.code_m - piece.clean_code_m + piece.error_m,
                    elevation,
                    piece.observations.cn0_dbhz,
                    elevation >= scenario.sky.cutoff_deg,
                )
            )
    return together(f"sim. {name}", parts)


def cn0_by_elevation(sample: Sample) -> Floats:
    """Mean, p5 and p95 of C/N0 per 10 deg of elevation, shape (9, 3) [dB-Hz]; NaN below 30 values."""
    table = np.full((9, 3), np.nan)
    for k in range(9):
        inside = (sample.elevation_deg >= 10.0 * k) & (sample.elevation_deg < 10.0 * (k + 1))
        c = sample.cn0_dbhz[inside & np.isfinite(sample.residual_m) & np.isfinite(sample.cn0_dbhz)]
        if len(c) >= 30:
            table[k] = c.mean(), np.percentile(c, 5), np.percentile(c, 95)
    return table


def environment(kind: Kind, *, seed: int) -> Environment:
    """An electrified line that is of one kind from end to end."""
    settings = EnvironmentSettings(
        electrification=ElectrificationSettings(), sections=(SectionSettings(from_m=0.0, to_m=LENGTH_M, kind=kind),)
    )
    return Environment(settings, line_length_m=LENGTH_M, seed=seed)


def simulated(kind: Kind | Literal["none"], *, seeds: tuple[int, ...] = SEEDS, duration_s: float = 780.0) -> Sample:
    """A train at 40 km/h at most, 1 Hz, on a line that is of one kind from end to end."""
    parts = []
    for seed in seeds:
        scenario = Scenario(
            seed=seed,
            # Another sky for each seed.
            start=np.datetime64("2024-03-05T00:10:00", "ns") + np.timedelta64(5 * seed, "h"),
            duration_s=duration_s,
            rate_hz=1.0,
            line=LineSettings(length_m=LENGTH_M),
            run=RunSettings(cruise_mps=CRUISE_MPS, stand_s=30.0),
            sky=SkySettings(systems=SYSTEMS),
            multipath=() if kind == "none" else (environment(kind, seed=seed),),
        )
        for piece in Simulation(scenario).pieces("front"):
            observed = piece.observations
            parts.append(
                Sample(
                    kind,
                    observed.satellite,
                    observed.code_m - piece.clean_code_m,
                    piece.geometry.elevation_deg,
                    observed.cn0_dbhz,
                    piece.geometry.elevation_deg >= scenario.sky.cutoff_deg,
                )
            )
    return together(f"sim. {kind}", parts)


def together(name: str, parts: list[Sample]) -> Sample:
    """Epochs of several samples one below the other, columns by satellite."""
    satellites = np.array(sorted({str(s) for part in parts for s in part.satellite}))
    tables = []
    for part in parts:
        column = np.searchsorted(satellites, part.satellite)
        views = np.zeros(part.residual_m.shape) if part.in_view is None else part.in_view.astype(np.float64)
        table = np.full((*part.residual_m.shape[:1], len(satellites), 4), np.nan)
        table[:, column] = np.stack([part.residual_m, part.elevation_deg, part.cn0_dbhz, views], axis=-1)
        tables.append(table)
    whole = np.concatenate(tables)
    return Sample(name, satellites, whole[..., 0], whole[..., 1], whole[..., 2], whole[..., 3] == 1.0)


def recorded(name: str, antenna: AntennaResult, truth: recordings_truth.Truth) -> Sample:
    """A recording's corrected codes against its reference trajectory."""
    columns = antenna.columns
    satellite, reason = antenna.satellite[columns], antenna.reason[:, columns]
    place = interpolate_reference(antenna.time, *truth)
    distance, _ = range_with_rotation(antenna.corrected.satellites.position_ecef_m, place[:, None, :])
    residual = np.where(reason & NO_RANGE == 0, antenna.corrected_code_m[:, columns] - distance, np.nan)
    wanted = np.array([str(s)[0] in SYSTEMS for s in satellite])
    return Sample(
        name,
        satellite[wanted],
        residual[:, wanted],
        antenna.elevation_deg[:, columns][:, wanted],
        antenna.cn0_dbhz[:, columns][:, wanted],
    )


def recordings(data: Path) -> list[Sample]:
    """UrbanNav TST with both receivers, that `city` is calibrated on."""
    truth, samples = recordings_truth.urbannav_truth(data / "kinematic" / "urbannav_tst"), []
    for name, run in (
        ("Hong Kong F9P", recordings_score.urbannav_f9p),
        ("Hong Kong M8T", recordings_score.urbannav_m8t),
    ):
        antenna = run(data).result
        assert antenna is not None
        samples.append(recorded(name, antenna, truth))
    return samples
