"""Figures of docs/sbas.md: ``python tests/studies/sbas_figures.py FOLDER`` with the folder of the recordings."""

from __future__ import annotations

import sys
import time as clock
from collections import Counter
from pathlib import Path

import numpy as np

from railfix.core.geodesy import ecef_from_geodetic, elevation_azimuth
from railfix.gnss.orbits.states import satellite_states
from railfix.io.rinex.navigation import read_navigation
from railfix.ranges.sbas import IonosphereState, SatelliteState, SbasCorrections, SbasLimits, decode, read_sbas
from sbas_account import account

GPS = np.array([f"G{i:02d}" for i in range(1, 33)])
PLACES = {"Tokyo": (35.68, 139.77), "Sapporo": (43.06, 141.35), "Fukuoka": (33.59, 130.40), "Naha": (26.21, 127.68)}


def shares(states: np.ndarray, names: type[SatelliteState] | type[IonosphereState]) -> str:
    counts = Counter(states.ravel().tolist())
    return ", ".join(f"{names(state).name} {100.0 * n / states.size:.1f} %" for state, n in counts.most_common())


def quantiles(values: np.ndarray, unit: str = "m") -> str:
    good = values[np.isfinite(values)]
    return f"5/50/95 %: {' / '.join(f'{v:.2f}' for v in np.percentile(good, [5, 50, 95]))} {unit} ({good.size} values)"


def of_hour(folder: Path) -> None:
    """MSAS 2025: satellites, grid points, sigmas over Japan."""
    started = clock.perf_counter()
    log = read_sbas(folder / "msas_20250215" / "046r_sbas_prn137.txt")
    navigation = read_navigation(folder / "msas_20250215" / "046r_rnx.nav")
    print(f"read {len(log)} messages in {clock.perf_counter() - started:.2f} s")
    for what, number in account(log).items():
        print(f"  {what}: {number}")
    started = clock.perf_counter()
    engine = SbasCorrections.from_log(log)
    print(f"tables in {clock.perf_counter() - started:.2f} s")
    for note in engine.notes:
        print(f"  {note}")
    time = log.time[0] + np.arange(600, 3600) * np.timedelta64(1, "s")
    started = clock.perf_counter()
    found = engine.satellites(time, GPS, navigation)
    print(f"{found.state.size} satellite epochs in {clock.perf_counter() - started:.2f} s")
    print(f"states after ten minutes: {shares(found.state, SatelliteState)}")
    ok = (found.state == SatelliteState.OK).sum(axis=1)
    print(f"satellites corrected: {ok.min()} to {ok.max()}, median {np.median(ok):.0f}")
    codes = np.full((len(time), len(GPS)), 2.2e7)
    signal = np.full(len(GPS), "1C")
    states = satellite_states(time, GPS, signal, codes, navigation, record=found.record)
    masks = decode.decode(log, 18)
    last = {int(band): int(mask.sum()) for band, mask in zip(masks["band"], masks["mask"], strict=True)}
    print(f"grid points in the last masks by band: {last}")
    for name, (latitude, longitude) in PLACES.items():
        receiver = np.broadcast_to(ecef_from_geodetic(latitude, longitude, 50.0), (len(time), 3))
        elevation, azimuth = elevation_azimuth(states.position_ecef_m + found.position_m, receiver)
        up = elevation > 10.0
        place = np.full(len(time), latitude), np.full(len(time), longitude)
        grid = engine.ionosphere(time, *place, elevation, azimuth)
        sight = states.position_ecef_m - receiver[:, None, :]
        sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
        factor = engine.delta_udre(time, found, sight, *place)
        print(f"{name}: {np.where(up, 1, 0).sum(axis=1).mean():.1f} corrected satellites above 10 degrees")
        print(f"  sigma UIRE {quantiles(grid.sigma_uire_m[up])}; delay {quantiles(grid.delay_m[up])}")
        print(f"  delta UDRE {quantiles(factor[up], 'times')}; sigma flt {quantiles(found.sigma_flt_m(factor)[up])}")
        print(f"  {shares(grid.state[up], IonosphereState)}")


def of_crescent(folder: Path) -> None:
    """MSAS 2008: what the five minutes give, by how incomplete degradation data are taken."""
    stem = folder / "msas_20080526_crescent" / "cres_20080526.bin"
    log, navigation = read_sbas(f"{stem}.sbs"), read_navigation(f"{stem}.nav")
    print(*log.notes, sep="\n")
    time = np.datetime64("2008-05-26T06:01:34", "ns") + np.arange(312) * np.timedelta64(1, "s")
    satellite = np.array(sorted(set(navigation.kepler.satellite.tolist())))
    for incomplete in ("reject", "inflate"):
        for prn in log.prns:
            engine = SbasCorrections.from_log(log, prn=prn, limits=SbasLimits(incomplete=incomplete))
            found = engine.satellites(time, satellite, navigation)
            ok = (found.state == SatelliteState.OK).sum(axis=1)
            print(
                f"PRN {prn}, {incomplete}: epochs with 4 or more corrected satellites {(ok >= 4).sum()} of {len(time)}"
            )
            print(f"  {shares(found.state, SatelliteState)}")


if __name__ == "__main__":
    of_hour(Path(sys.argv[1]) / "sbas")
    of_crescent(Path(sys.argv[1]) / "sbas")
