"""Simulated surroundings beside recorded cities: errors of the codes and C/N0 by elevation, printed.

Run ``python tests/studies/urban_comparison.py`` with the recordings beside the checkout; without them only the
simulated columns are printed. The kinds of `railfix.simulate.environment.structures` are not fitted; the
scenario `city` is calibrated on the Hong Kong recordings with some seeds, Berlin and the Pixel and other seeds are for
validation: ``python tests/studies/urban_comparison.py calibration`` prints them side by side.
``python tests/studies/urban_comparison.py speed`` prints the processor time.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, Final, Literal

import numpy as np

import paths
import recordings_score
import recordings_truth
from integrity_campaign import Played
from railfix.core.arrays import Floats, Masks, Strings
from railfix.core.constants import CLOCK_GROUP
from railfix.core.geodesy import range_with_rotation
from railfix.core.reasons import Reason
from railfix.evaluate import interpolate_reference
from railfix.pipeline.config import parse_config
from railfix.pipeline.results import AntennaResult
from railfix.ranges.range_sigma import CodeNoise, code_sigma_m
from railfix.simulate import LineSettings, RunSettings, Scenario, Simulation, SkySettings, write_run
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
#: Bands of elevation [deg] and of C/N0 [dB-Hz] of the calibration's table.
BANDS_DEG: Final = ((10.0, 20.0), (20.0, 30.0), (30.0, 40.0), (40.0, 50.0), (50.0, 60.0), (60.0, 90.0))
BANDS_DBHZ: Final = ((10.0, 18.0), (18.0, 26.0), (26.0, 34.0), (34.0, 60.0))
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
    interval_s: float = 1.0

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
    three_faults: float
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

    Faults are errors over 20 m: shares of the epochs with two and three or more, and the mean number of pairs of
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
        "three_faults": float((count >= 3).mean()),
        "pair_ratio": float((count * (count - 1)).mean() / pairs) if pairs > 0.0 else np.nan,
        "correlation_1_s": correlation(round(1.0 / sample.interval_s)),
        "correlation_10_s": correlation(round(10.0 / sample.interval_s)),
    }


def faults_by_elevation(sample: Sample) -> Floats:
    """Share of codes over 20 m, and p25, p50 and p75 of the late ones, per 10 deg of elevation, shape (9, 4)."""
    error, table = sample.errors_m(), np.full((9, 4), np.nan)
    for k in range(9):
        inside = (sample.elevation_deg >= 10.0 * k) & (sample.elevation_deg < 10.0 * (k + 1))
        e = error[inside & np.isfinite(error)]
        if len(e) >= 100:
            table[k, 0] = (np.abs(e) > 20.0).mean()
            if (e > 20.0).sum() >= 20:
                table[k, 1:] = np.percentile(e[e > 20.0], [25, 50, 75])
    return table


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


def calibration_figures(sample: Sample) -> dict[str, tuple[str, Floats]]:
    """What `city` is calibrated by: format of a value, and the values; NaN where there are too few codes."""
    error, f = sample.errors_m(), figures(sample)
    used, rows = np.isfinite(error) & (sample.elevation_deg >= MASK_DEG), {}

    def quantiles(values: Floats, parts: list[float]) -> Floats:
        return np.percentile(values, parts) if len(values) >= 20 else np.full(len(parts), np.nan)

    for low, high in BANDS_DEG:
        inside = used & (sample.elevation_deg >= low) & (sample.elevation_deg < high)
        name, late = f"{low:.0f}-{high:.0f} deg", error[inside & (error > 20.0)]
        rows[f"C/N0 p5, p50, p95 [dB-Hz], {name}"] = "{:.0f}", quantiles(sample.cn0_dbhz[inside], [5, 50, 95])
        share = 100.0 * len(late) / inside.sum() if inside.sum() >= 100 else np.nan
        rows[f"late over 20 m [%], {name}"] = "{:.1f}", np.array([share])
        rows[f"their delay p25, p50, p75 [m], {name}"] = "{:.0f}", quantiles(late, [25, 50, 75])
    for low, high in BANDS_DBHZ:
        inside = used & (sample.cn0_dbhz >= low) & (sample.cn0_dbhz < high)
        rows[f"error p5, p50, p95 [m], {low:.0f}-{high:.0f} dB-Hz"] = "{:.0f}", quantiles(error[inside], [5, 50, 95])
    rows["error p50, p95, p99 [m]"] = "{:.3g}", np.array([f.p50_m, f.p95_m, f.p99_m])
    shares = f.over_20_m, f.over_50_m, f.early_over_20_m, f.beyond_5_sigma
    rows["over 20 m, over 50 m, early over 20 m, beyond 5 sigma [%]"] = "{:.2g}", 100.0 * np.array(shares)
    rows["epochs with two, with three over 20 m [%]"] = "{:.0f}", 100.0 * np.array([f.two_faults, f.three_faults])
    rows["pairs over independent"] = "{:.2f}", np.array([f.pair_ratio])
    rows["correlation after 1 s, 10 s"] = "{:.2f}", np.array([f.correlation_1_s, f.correlation_10_s])
    return rows


def print_calibration(data: Path) -> None:
    """Calibration and validation of `city` in one table, and the spread of single seeds."""
    columns = recordings(data)
    columns[2:2] = [
        replace(city(seeds=seeds), name=f"city, seeds {seeds[0]}-{seeds[-1]}")
        for seeds in (CALIBRATION_SEEDS, VALIDATION_SEEDS)
    ]
    tables = [calibration_figures(sample) for sample in columns]
    print("| | " + " | ".join(sample.name for sample in columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for name, (form, _) in tables[0].items():
        cells = [" ".join("-" if np.isnan(v) else form.format(v) for v in table[name][1]) for table in tables]
        print(f"| {name} | " + " | ".join(cells) + " |")
    print("\n| single seeds of the validation, least to largest | |\n|---|---|")
    alone = [figures(city(seeds=(seed,))) for seed in VALIDATION_SEEDS]
    for name in ("p95_m", "p99_m", "over_20_m", "over_50_m", "beyond_5_sigma", "two_faults", "pair_ratio"):
        values = [getattr(f, name) for f in alone]
        print(f"| {name} | {min(values):.3g} to {max(values):.3g} |")


def city_errors_m(settings: dict[str, Any], seeds: tuple[int, ...] = VALIDATION_SEEDS) -> Floats:
    """Errors of the front antenna along the line of `city`; NaN without a position."""
    errors = []
    for seed in seeds:
        played = Played.of(city_scenario(seed))
        for chunk in played.results(settings):
            found, piece = chunk["front"]
            errors.append(found.chainage_m - played.true_chainage_m(piece))
    return np.concatenate(errors)


def print_positions(data: Path) -> None:
    """Errors along the line of the scenario and of recordings, without and with all screens."""
    print("\n| positions along the line | screens | epochs | rate % | p50 m | p95 m | largest m | over 20 m % |")
    print("|---" * 8 + "|")
    runs = (recordings_score.urbannav_f9p, recordings_score.urbannav_m8t, recordings_score.gsdc)
    for title, screens in (("elevation", {"screens": ["elevation"]}), ("all", {})):
        settings = {"elevation": {"mask_deg": 15.0}, "protection": "off", **screens}
        found = [(o.name, o.error_m) for o in (run(data, parse_config(settings)) for run in runs)]
        found.append((f"city, seeds {VALIDATION_SEEDS[0]}-{VALIDATION_SEEDS[-1]}", city_errors_m(settings)))
        for name, error in found:
            size = np.abs(error[np.isfinite(error)])
            p50, p95 = np.percentile(size, [50, 95])
            print(
                f"| {name} | {title} | {len(error)} | {100 * len(size) / len(error):.1f} | {p50:.2f} | {p95:.1f} "
                f"| {size.max():.0f} | {100 * (size > 20.0).mean():.2f} |"
            )


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
        electrification=ElectrificationSettings(),
        sections=(SectionSettings(from_m=0.0, to_m=LENGTH_M, kind=kind),),
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
    distance, _ = range_with_rotation(antenna.satellites.position_ecef_m, place[:, None, :])
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
    """UrbanNav TST with both receivers, smartLoc Berlin, the Pixel of the Google challenge."""
    kinematic = data / "kinematic"
    samples = []
    for name, run in (
        ("Hong Kong F9P", recordings_score.urbannav_f9p),
        ("Hong Kong M8T", recordings_score.urbannav_m8t),
    ):
        antenna = run(data).result
        assert antenna is not None
        samples.append(recorded(name, antenna, recordings_truth.urbannav_truth(kinematic / "urbannav_tst")))
    log = recordings_score.smartloc_ranges(kinematic / "smartloc_berlin")
    place = interpolate_reference(log.time, *recordings_truth.smartloc_truth(kinematic / "smartloc_berlin"))
    distance, _ = range_with_rotation(log.sat_ecef_m, place[:, None, :])
    wanted = np.array([str(s)[0] in SYSTEMS for s in log.satellite])
    samples.append(
        Sample(
            "Berlin M8T",
            log.satellite[wanted],
            (log.code_m - distance)[:, wanted],
            log.elevation_deg[:, wanted],
            log.cn0_dbhz[:, wanted],
            interval_s=0.2,
        )
    )
    antenna = recordings_score.gsdc(data).result
    assert antenna is not None
    samples.append(recorded("California Pixel", antenna, recordings_truth.gsdc_truth(kinematic / "gsdc_pixel5_a")))
    return samples


def print_tables(samples: list[Sample]) -> None:
    """All tables, a sample a row."""
    print(
        "| codes above 10 deg | codes | p50 m | p95 m | p99 m | over 20 m % | over 50 m % | late > 20 m % | tracked % |"
    )
    print("|---" * 9 + "|")
    for sample in samples:
        f = figures(sample)
        tracked = "-" if np.isnan(f.tracked) else f"{100 * f.tracked:.0f}"
        print(
            f"| {sample.name} | {f.codes} | {f.p50_m:.2f} | {f.p95_m:.1f} | {f.p99_m:.0f} | {100 * f.over_20_m:.1f} "
            f"| {100 * f.over_50_m:.1f} | {100 * f.late_over_20_m:.1f} | {tracked} |"
        )
    print(
        "\n| faults over 20 m | beyond 5 sigma % | epochs with 2 % | with 3 % | pairs over independent "
        "| correlation after 1 s | after 10 s |"
    )
    print("|---" * 7 + "|")
    for sample in samples:
        f = figures(sample)
        print(
            f"| {sample.name} | {100 * f.beyond_5_sigma:.2f} | {100 * f.two_faults:.0f} | {100 * f.three_faults:.0f} "
            f"| {f.pair_ratio:.2f} | {f.correlation_1_s:.2f} | {f.correlation_10_s:.2f} |"
        )
    head = " | ".join(f"{10 * k}-{10 * k + 10} deg" for k in range(9))
    print(f"\n| C/N0: mean (p5 to p95) | {head} |")
    print("|---" * 10 + "|")
    for sample in samples:
        cells = ["-" if np.isnan(row[0]) else "{:.0f} ({:.0f}-{:.0f})".format(*row) for row in cn0_by_elevation(sample)]
        print(f"| {sample.name} | " + " | ".join(cells) + " |")
    print(f"\n| share over 20 m %: late ones p50 (p25 to p75) m | {head} |")
    print("|---" * 10 + "|")
    for sample in samples:
        cells = []
        for share, low, middle, high in faults_by_elevation(sample):
            late = "" if np.isnan(low) else f": {middle:.0f} ({low:.0f}-{high:.0f})"
            cells.append("-" if np.isnan(share) else f"{100 * share:.0f}{late}")
        print(f"| {sample.name} | " + " | ".join(cells) + " |")


def print_speed() -> None:
    """Processor time of a run's files without surroundings, and of the surroundings alone."""
    scenario = Scenario(duration_s=400.0, line=LineSettings(length_m=LENGTH_M), sky=SkySettings(systems=SYSTEMS))
    simulation = Simulation(scenario)
    (piece, *_) = simulation.pieces("front", chunk_epochs=scenario.epochs)
    signals = 2 * piece.geometry.elevation_deg.size
    began = process_time()
    with TemporaryDirectory() as folder:
        write_run(scenario, folder)
    whole = process_time() - began
    print(f"files of a clean run: {1e6 * whole / signals:.1f} us a channel and epoch")
    for kind in ("open", "suburban", "urban"):
        began = process_time()
        environment(kind, seed=1)(piece.geometry)
        alone = 2.0 * (process_time() - began)
        print(f"{kind}: {1e6 * alone / signals:.1f} us more, {100 * alone / whole:.0f} %")


def main() -> int:
    data = paths.DATA
    if sys.argv[1:] == ["speed"]:
        print_speed()
        return 0
    if sys.argv[1:] == ["calibration"]:
        print_calibration(data)
        print_positions(data)
        return 0
    samples = [simulated(kind) for kind in ("none", "open", "suburban", "urban", "station", "canyon")]
    samples += [city(), replace(city(seeds=VALIDATION_SEEDS), name="sim. city, other seeds")]
    if data.is_dir():
        samples += recordings(data)
    print_tables(samples)
    return 0


if __name__ == "__main__":
    sys.exit(main())
