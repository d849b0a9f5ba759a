"""One against two frequencies on the recordings that have two, printed as a table.

Run ``python tests/studies/frequencies_score.py`` with the recordings beside the checkout. The field of the ionosphere
was shaped with all of them in view but the phone and, for the satellites' rest, the town. What does not move has no
direction: the mean over lines of twelve directions is printed as well.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pyproj import Transformer

import paths
import recordings_truth
from railfix.core.arrays import Floats
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.evaluate import interpolate_reference, straight_distance
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.pipeline.along_track import on_line_m
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.run.processor_setup import make_processor
from railfix.track.trajectory import Trajectory
from recordings_score import straight_line, trajectory_of

#: First epochs, processed one at a time, for the cost.
_LIVE_EPOCHS = 120
#: First epochs of the filter's starts.
_STARTS = range(0, 50, 5)
#: Date of the station's day [year].
_STATION_YEAR = 2020.48
#: Directions of the lines over which the errors of what does not move are averaged [degrees].
_DIRECTIONS = range(0, 180, 15)


def recordings(data: Path) -> Iterator[tuple[str, Observations, Path, Floats, Trajectory]]:
    """Name, observations, navigation file, reference positions at the epochs, and line of each recording."""
    car = data / "kinematic"
    for name, folder, obs, nav, truth in (
        ("town, F9P", "urbannav_tst", "20210517.light-urban.tste.ublox.f9p.obs", "hksc137c.nav", "urbannav"),
        ("phone", "gsdc_pixel5_a", "Pixel5_a.21o", "hour1180.21n", "gsdc"),
        ("Japan", "japan_mosaic_2021265_with_GEONET3034", "SEPT265G.21O", "SEPT2650.21P", "japan"),
    ):
        at, ecef = getattr(recordings_truth, f"{truth}_truth")(car / folder)
        log = read_observations(car / folder / obs)
        yield name, log, car / folder / nav, interpolate_reference(log.time, at, ecef), trajectory_of(at, ecef)
    roof = data / "dual" / "mosaic_x2_99cm"
    log = read_observations(roof / "rover.obs")
    latitude, longitude, height = map(float, (roof / "rover_position.txt").read_text().split()[:3])
    place = ecef_from_geodetic(np.array(latitude), np.array(longitude), np.array(height))
    for azimuth in (0, 90):
        reference = np.broadcast_to(place, (len(log), 3))
        yield f"roof, az {azimuth}", log, roof / "base.nav", reference, straight_line(place, azimuth)
    station = data / "static" / "ESBC_2020177"
    log = read_observations(station / "ESBC00DNK_R_20201770000_01D_30S_MO.crx.gz")
    # the header is in ETRF2000, satellites are in the ITRF: 0.76 m apart
    to_itrf = Transformer.from_crs("EPSG:7930", "EPSG:7789")
    place = np.array(to_itrf.transform(*log.header.approximate_ecef_m, _STATION_YEAR)[:3])
    for azimuth in (0, 90):
        reference = np.broadcast_to(place, (len(log), 3))
        navigation = station / "ESBC00DNK_R_20201770000_01D_MN.rnx.gz"
        yield f"station, az {azimuth}", log, navigation, reference, straight_line(place, azimuth)


def row(log: Observations, navigation: Path, reference: Floats, line: Trajectory, frequencies: str) -> str:
    """Percentiles of the errors, rate, level, and processor time of a live epoch."""
    tracked = len(log) < 2000  # a day at 30 s is no ride
    config = parse_config(
        {"frequencies": frequencies, "filter": "track" if tracked else "off", "elevation": {"mask_deg": 15.0}}
    )
    processor = make_processor(config, read_navigation([navigation]), {"front": line})
    result, _ = processor.process({"front": log})
    antenna = result.antennas["front"]
    inside = np.isfinite(reference[:, 0])
    latitude, longitude, _ = geodetic_from_ecef(reference)
    away = antenna.point.ecef_m - reference
    across = np.linalg.norm(np.einsum("tij,tj->ti", enu_axes(latitude, longitude), away)[:, :2], axis=1)
    texts = [_percentiles(straight_distance(antenna.arc_m, reference, line)[inside]), _percentiles(across[inside])]
    texts.append(_filtered(processor, log, reference, line) if tracked else f"{'':17}")
    assert antenna.protection is not None
    level = antenna.protection.level.level_m
    texts.append(f"{np.isfinite(antenna.arc_m[inside]).mean() * 100:6.1f} {np.median(level[np.isfinite(level)]):6.1f}")
    live, taken = min(_LIVE_EPOCHS, len(log)), np.inf
    for _ in range(2):  # the first time fills caches
        state, begin = None, time.process_time()
        for k in range(live):
            _, state = processor.process({"front": log[k : k + 1]}, state)
        taken = min(taken, (time.process_time() - begin) / live)
    return " | ".join([*texts, f"{1e3 * taken:6.2f}"])


def over_directions(log: Observations, navigation: Path, reference: Floats, frequencies: str) -> tuple[Floats, Floats]:
    """Percentiles of the errors along lines of all directions, of single epochs: mean, and p95 of each."""
    config = parse_config({"frequencies": frequencies, "filter": "off", "elevation": {"mask_deg": 15.0}})
    records, errors = read_navigation([navigation]), []
    for azimuth in _DIRECTIONS:
        line = straight_line(reference[0], azimuth)
        result, _ = make_processor(config, records, {"front": line}).process({"front": log})
        errors.append(_of_errors(straight_distance(result.antennas["front"].arc_m, reference, line)))
    return np.mean(errors, axis=0), np.array(errors)[:, 1]


def _filtered(processor: EpochProcessor, log: Observations, reference: Floats, line: Trajectory) -> str:
    """Percentiles of the filter's errors, each the mean over starts: by which lap of a road it begins is chance."""
    errors = []
    for first in _STARTS:
        result, _ = processor.process({"front": log[first:]})
        found = on_line_m(result.fusion["front"].tracked, line)
        error = straight_distance(found, reference[first:], line)[np.isfinite(reference[first:, 0])]
        errors.append(_of_errors(error))
    return _text(np.mean(errors, axis=0))


def _of_errors(error: Floats) -> Floats:
    known = error[np.isfinite(error)]
    return np.array([*np.percentile(known, [50, 95]), known.max()])


def _text(numbers: Floats) -> str:
    return "{:5.2f} {:5.2f} {:5.1f}".format(*numbers)


def _percentiles(error: Floats) -> str:
    return _text(_of_errors(error))


def main() -> int:
    if not paths.DATA.is_dir():
        print(f"the real recordings are not at {paths.DATA}", file=sys.stderr)
        return 1
    columns = f"{'along p50 p95 max':17} | {'3-D, horizontal':17} | {'filter':17}"
    print(f"{'recording':16} {'':3}   {columns} | rate%  level | ms/epoch")
    for name, log, navigation, reference, line in recordings(paths.DATA):
        for frequencies in ("one", "two"):
            print(f"{name:16} {frequencies:3}   {row(log, navigation, reference, line, frequencies)}", flush=True)
        if name.endswith("az 90"):
            (one, of_one), (two, of_two) = (over_directions(log, navigation, reference, f) for f in ("one", "two"))
            wider = f"95 % larger with two on {int((of_two > of_one).sum())} of {len(of_one)}"
            print(
                f"{name[:-2] + 'all':16} one   {_text(one)}\n{name[:-2] + 'all':16} two   {_text(two)} | {wider}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
