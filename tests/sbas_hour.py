"""Protection levels along a line over Japan for an hour of MSAS messages: geometry alone, no receiver.

``python tests/sbas_hour.py [FOLDER]`` with the recordings beside the checkout prints the tables of
``docs/integrity-recordings.md``, and writes a picture to the folder. The line is the great circle from Tokyo to Osaka,
a point a kilometre; every ten seconds each satellite of the navigation file that MSAS corrects (issues of data
matched) gives a range of its own sigma, and the level is that of a train at the point.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from conftest import ROOT
from railfix.antenna import Trajectory
from railfix.clock_elimination import Ranges, clock_groups
from railfix.config import parse_config
from railfix.constants import FREQUENCY_L1
from railfix.error_model import ErrorModel, read_error_model
from railfix.geodesy import ecef_from_geodetic, elevation_azimuth, geodetic_from_ecef, range_with_rotation
from railfix.measurement import CodeNoise, code_sigma_m
from railfix.orbits import satellite_states
from railfix.preparation import SOMEWHERE_ABOVE_M
from railfix.protecting import risk_of
from railfix.protection import along_track_level, sbas_level
from railfix.raim import constrained_model
from railfix.rinex import read_navigation
from railfix.sbas import SatelliteState, SbasCorrections, read_sbas, sigma_tropo_m
from railfix.sbas_use import corrected_satellites, sbas_delays
from railfix.track_map import Track

#: Latitude, longitude [deg] of the ends.
TOKYO: Final = (35.681, 139.767)
OSAKA: Final = (34.733, 135.500)
HEIGHT_M: Final = 50.0
GPS: Final = np.array([f"G{number:02d}" for number in range(1, 33)])
MASKS_DEG: Final = (5.0, 15.0, 20.0)
ALARM_LIMITS_M: Final = (10.0, 20.0, 40.0)
#: The messages have to come first: masks, types 7 and 10, grid [s].
WARM_UP_S: Final = 600.0
#: C/N0 that an error model is asked with: an open sky [dB-Hz].
OPEN_SKY_DBHZ: Final = 42.0

#: Sigma and largest bias of what multipath and receiver add, by elevation and azimuth from the direction of travel.
Local = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def by_noise(elevation_deg: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Default noise settings at their reference C/N0: 1 m at the zenith by 1/sin(elevation), and a floor of 1 m."""
    sigma = code_sigma_m(np.full(elevation_deg.shape, np.nan), elevation_deg, noise=CodeNoise())
    return sigma, np.zeros(sigma.shape)


def by_model(model: ErrorModel) -> Local:
    """An error model of local errors at the C/N0 of an open sky."""
    return lambda elevation, azimuth: model.at(elevation, azimuth, OPEN_SKY_DBHZ)


@dataclass(frozen=True)
class Sky:
    """What MSAS and navigation file give at T epochs for K satellites, wherever the receiver is."""

    engine: SbasCorrections
    time: np.ndarray
    satellite: np.ndarray
    fixes: object
    position_ecef_m: np.ndarray
    good: np.ndarray  # (T, K) corrected


@dataclass(frozen=True)
class Levels:
    """Levels of T epochs at P points; NaN without a position."""

    mask_deg: float
    used: np.ndarray  # (P, T)
    dilution: np.ndarray  # (P, T) sigma along the line for ranges of 1 m
    fault_free_m: np.ndarray  # (P, T) K sigma of the whole risk
    level_m: np.ndarray  # (P, T) with local faults
    variance_m2: np.ndarray  # (P, T, 5) of the position: flt, ionosphere, troposphere, local, map


def great_circle(spacing_m: float = 1000.0) -> Trajectory:
    """Level line from Tokyo to Osaka, the direction of rising chainage."""
    ends = np.array([ecef_from_geodetic(*end, HEIGHT_M) for end in (TOKYO, OSAKA)])
    unit = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    angle = np.arccos(unit[0] @ unit[1])
    part = np.linspace(0.0, 1.0, round(angle * 6.371e6 / spacing_m) + 1)[:, None]
    points = (np.sin((1.0 - part) * angle) * unit[0] + np.sin(part * angle) * unit[1]) / np.sin(angle)
    latitude, longitude, _ = geodetic_from_ecef(points * 6.371e6)
    return Trajectory.from_track(Track.from_ecef(ecef_from_geodetic(latitude, longitude, np.full(len(part), HEIGHT_M))))


def sky(data: Path, *, step_s: int = 10) -> Sky:
    """Corrected satellites of the hour."""
    folder = data / "sbas" / "msas_20250215"
    log, navigation = read_sbas(folder / "046r_sbas_prn137.txt"), read_navigation(folder / "046r_rnx.nav")
    engine = SbasCorrections(log)
    time = log.time[0] + np.arange(0, 3600, step_s) * np.timedelta64(1, "s")
    fixes = engine.satellites(time, GPS, navigation)
    # A range for the time of transmission: its error of a few ms moves a satellite by metres.
    states = satellite_states(
        time, GPS, np.full(len(GPS), "1C"), np.full(fixes.state.shape, 2.3e7), navigation, record=fixes.record
    )
    states, _ = corrected_satellites(states, fixes)
    good = (fixes.state == SatelliteState.OK) & ~states.unhealthy & ~states.too_old & ~states.no_record
    return Sky(engine, time, GPS, fixes, states.position_ecef_m, good)


def levels(above: Sky, line: Trajectory, local: Local, *, mask_deg: float, every: int = 1) -> Levels:
    """Levels at the points of a line, one after the other."""
    risk = risk_of(parse_config({"sbas": ["messages"]}))
    found = []
    for point in range(0, len(line.ecef_m), every):
        arc, section = line.arc_m[point], min(point, len(line.length_m) - 1)
        place = np.broadcast_to(line.ecef_m[point], (len(above.time), 3))
        elevation, azimuth = elevation_azimuth(above.position_ecef_m, place)
        frequency = np.full(len(above.satellite), FREQUENCY_L1)
        air = sbas_delays(above.engine, above.fixes, above.time, place, above.position_ecef_m, frequency)
        heading = line.body_azimuth_deg(np.array([arc]))[0]
        local_sigma, bias = local(elevation, azimuth - heading)
        sigma = np.hypot(air.sigma_m, local_sigma)
        used = above.good & (elevation >= mask_deg) & np.isfinite(sigma) & (air.reason == 0)
        satellites = np.where(used[..., None], above.position_ecef_m, SOMEWHERE_ABOVE_M)
        ranges = Ranges(
            sat_ecef_m=satellites,
            code_m=np.where(used, range_with_rotation(satellites, place[:, None, :])[0], 0.0),
            weight=np.where(used, 1.0 / np.where(used, sigma, 1.0) ** 2, 0.0),
            groups=clock_groups([name[0] for name in above.satellite.tolist()]),
        )
        enough = used.sum(axis=1) >= 3
        arcs = np.where(enough, arc, np.nan)
        model = constrained_model(ranges, line, arcs, section=np.full(len(arcs), section))
        level = along_track_level(
            model, [name[0] for name in above.satellite.tolist()], risk=risk, bias_m=np.where(used, bias, 0.0)
        )
        gain = np.einsum("tkj,tj->tk", model.design, model.covariance_m2[:, 0]) * model.root_weight
        tropo = np.where(used, sigma_tropo_m(elevation), 0.0)
        iono = np.where(used, _uire(above, place, elevation, azimuth), 0.0)
        own = np.where(used, local_sigma, 0.0)
        flt = np.where(used, np.sqrt(np.maximum(air.sigma_m**2 - iono**2 - tropo**2, 0.0)), 0.0)
        parts = np.stack([(np.where(used, gain, 0.0) ** 2 * s**2).sum(axis=1) for s in (flt, iono, tropo, own)], axis=1)
        rest = model.covariance_m2[:, 0, 0] - parts.sum(axis=1)
        found.append(
            (
                used.sum(axis=1),
                np.sqrt((np.where(used, gain, 0.0) ** 2).sum(axis=1)) + np.where(enough, 0.0, np.nan),
                sbas_level(model, k=risk.sample_k),
                level.level_m,
                np.concatenate([parts, rest[:, None]], axis=1),
            )
        )
    return Levels(mask_deg, *(np.stack(part) for part in zip(*found, strict=True)))


def _uire(above: Sky, place: np.ndarray, elevation: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    latitude, longitude, _ = geodetic_from_ecef(place)
    return above.engine.ionosphere(above.time, latitude, longitude, elevation, azimuth).sigma_uire_m


# ---- tables and picture -------------------------------------------------------------------------------------


def warm(above: Sky) -> np.ndarray:
    """Epochs after the first ten minutes."""
    return above.time >= above.time[0] + np.timedelta64(int(WARM_UP_S), "s")


def row(name: str, one: Levels, late: np.ndarray) -> str:
    """Satellites, levels and availability with one mask."""
    used, level, alone = one.used[:, late], one.level_m[:, late], one.fault_free_m[:, late]
    share = " ".join(f"{100.0 * np.mean(level <= limit):6.1f}" for limit in ALARM_LIMITS_M)
    without = " ".join(f"{100.0 * np.mean(alone <= limit):6.1f}" for limit in ALARM_LIMITS_M)
    return (
        f"{name:22s} {one.mask_deg:4.0f}  {used.min():2d} {np.median(used):4.1f} {used.max():3d}  "
        f"{_three(one.dilution[:, late])}  {_three(alone)}  {without}  {_three(level)}  {share}  "
        f"{100.0 * np.mean(~np.isfinite(level)):6.2f}"
    )


HEAD: Final = (
    f"{'local errors':22s} mask  used min/med/max  dilution 50/95/max   K sigma 50/95/max m   avail % 10/20/40 m   "
    "with local faults 50/95/max m  avail % 10/20/40 m  none %"
)


def _three(values: np.ndarray) -> str:
    good = values[np.isfinite(values)]
    return f"{np.percentile(good, 50):6.1f} {np.percentile(good, 95):6.1f} {good.max():7.1f}"


def parts_row(name: str, one: Levels, late: np.ndarray) -> str:
    """What the variance of the position consists of, and of the worst twentieth of the levels."""
    variance, level = one.variance_m2[:, late].reshape(-1, 5), one.level_m[:, late].ravel()
    worst = level >= np.nanpercentile(np.where(np.isfinite(level), level, np.nan), 95)
    words = []
    for which in (np.isfinite(level), worst & np.isfinite(level)):
        share = 100.0 * variance[which].sum(axis=0) / variance[which].sum()
        words.append(" ".join(f"{s:5.1f}" for s in share) + f"   {one.used[:, late].ravel()[which].mean():4.1f}")
    return f"{name:22s} {one.mask_deg:4.0f}  {words[0]}    {words[1]}"


def states_text(above: Sky, late: np.ndarray) -> str:
    """Satellites above 5 degrees at the middle of the line, by what MSAS says of them."""
    line = great_circle(100_000.0)
    place = np.broadcast_to(line.ecef_m[len(line.ecef_m) // 2], (len(above.time), 3))
    elevation, _ = elevation_azimuth(above.position_ecef_m, place)
    counts = Counter(above.fixes.state[late][elevation[late] >= 5.0].tolist())
    return ", ".join(f"{SatelliteState(s).name} {n}" for s, n in counts.most_common())


def picture(found: list[Levels], above: Sky, line: Trajectory, folder: Path) -> Path:
    """Levels over time (median and 5 to 95 % of the line) and along the line (of the time)."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (over_time, along) = plt.subplots(2, 1, figsize=(10, 8), constrained_layout=True)
    minute = (above.time - above.time[0]) / np.timedelta64(60, "s")
    chainage = np.linspace(0.0, line.arc_m[-1] / 1000.0, found[0].level_m.shape[0])
    for one in found:
        value = np.where(np.isfinite(one.level_m), one.level_m, np.nan)
        late = value[:, warm(above)]
        for axis, x, low, middle, high in (
            (over_time, minute, *np.nanpercentile(value, (5, 50, 95), axis=0)),
            (along, chainage, *np.nanpercentile(late, (5, 50, 95), axis=1)),
        ):
            (drawn,) = axis.plot(x, middle, label=f"mask {one.mask_deg:.0f} deg")
            axis.fill_between(x, low, high, color=drawn.get_color(), alpha=0.2, linewidth=0)
    for axis, label in ((over_time, "minute of the log"), (along, "km from Tokyo")):
        for limit in ALARM_LIMITS_M:
            axis.axhline(limit, color="black", linewidth=0.6, linestyle=":")
        axis.set(yscale="log", xlabel=label, ylabel="protection level along the line [m]")
    over_time.legend()
    path = folder / "sbas_hour.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def main() -> int:
    """Print the tables, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help="for the picture")
    parser.add_argument("--model", type=Path, help="error model of local errors, as well")
    parser.add_argument("--spacing-km", type=float, default=1.0)
    options = parser.parse_args()
    data = ROOT.parent / "shared" / "data"
    if not data.is_dir():
        print(f"the real recordings are not at {data}", file=sys.stderr)
        return 1
    line, above = great_circle(1000.0 * options.spacing_km), sky(data)
    late = warm(above)
    print(f"{len(line.ecef_m)} points on {line.arc_m[-1] / 1000.0:.0f} km, {late.sum()} epochs after ten minutes")
    print(*above.engine.notes, sep="\n")
    print(f"above 5 deg in the middle of the line: {states_text(above, late)}")
    locals_ = {"noise settings": by_noise}
    if options.model:
        locals_["error model, open sky"] = by_model(read_error_model(options.model))
    found = {
        (name, mask): levels(above, line, local, mask_deg=mask) for name, local in locals_.items() for mask in MASKS_DEG
    }
    print(HEAD)
    for (name, _), one in found.items():
        print(row(name, one, late))
    print("variance of the position, %: fast and long-term, ionosphere, troposphere, local, map; satellites used")
    print(f"{'local errors':22s} mask  all epochs                             the 5 % with the largest levels")
    for (name, _), one in found.items():
        print(parts_row(name, one, late))
    first = found["noise settings", MASKS_DEG[1]]
    begin = np.argmax(np.isfinite(first.level_m).any(axis=0))
    print(f"first level {(above.time[begin] - above.time[0]) / np.timedelta64(1, 's'):.0f} s after the first message")
    if options.folder:
        print(
            f"wrote {picture([one for (n, _), one in found.items() if n == 'noise settings'], above, line, options.folder)}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
