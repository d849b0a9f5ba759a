"""Simulated yards: trains at rest on parallel tracks, with the code errors of `StandstillErrors`.

``python tests/yard_made.py 2000`` prints the calibration of the decisions and of a naive method.
"""

from __future__ import annotations

import json
import sys

import numpy as np
from scipy.signal import lfilter

from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.positioning.which_track import (
    StandstillErrors,
    StandstillFix,
    YardTrack,
    standstill_fix,
    track_posterior,
)

SPACING_M = 3.6
#: Times at which the posterior is computed [s].
LOOKS_S = (60.0, 120.0, 180.0, 300.0, 600.0)
RISKS = (1e-1, 1e-2, 1e-3)


def made_tracks(count: int, azimuth_deg: float, through: np.ndarray, own: int) -> list[YardTrack]:
    """Parallel tracks of 400 m, the one of a number through a point."""
    heading = np.array([np.sin(np.radians(azimuth_deg)), np.cos(np.radians(azimuth_deg))])
    right = np.array([heading[1], -heading[0]])
    ends = np.array([-200.0, 200.0])[:, None] * heading
    return [YardTrack(name=f"T{k + 1}", points_m=through + (k - own) * SPACING_M * right + ends) for k in range(count)]


def to_geojson(tracks: list[YardTrack], latitude: float, longitude: float) -> str:
    """Tracks about a place as a 2-D GeoJSON map."""
    metre = enu_axes(latitude, longitude) @ (
        ecef_from_geodetic(latitude + 1e-5, longitude + 1e-5, 0.0) - ecef_from_geodetic(latitude, longitude, 0.0)
    )
    features = [
        {
            "type": "Feature",
            "properties": {"name": track.name},
            "geometry": {
                "type": "LineString",
                "coordinates": [
                    [longitude + e / metre[0] * 1e-5, latitude + n / metre[1] * 1e-5] for e, n in track.points_m
                ],
            },
        }
        for track in tracks
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})


def decided(
    seed: int, *, errors: StandstillErrors, common_sigma_m: float, method: str = "model", unmapped: bool | None = None
) -> tuple[dict[float, tuple[str, float]], str]:
    """First decision at each risk, with its time, and the true track of one simulated yard.

    A track is missing in the map with the prior's probability, or as `unmapped` states.

    `method` "naive" counts the 1 Hz samples as independent.
    """
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 13))
    own = int(rng.integers(0, count))
    azimuth = float(rng.uniform(0.0, 180.0))
    satellites = int(rng.integers(10, 25))
    elevation = np.degrees(np.arcsin(rng.uniform(np.sin(np.radians(10.0)), 1.0, satellites)))
    bearing = rng.uniform(0.0, 360.0, satellites)
    system = rng.choice(np.array(["G", "E"]), satellites)
    across = np.array([np.cos(np.radians(azimuth)), -np.sin(np.radians(azimuth))])
    shift = rng.normal(0.0, errors.map_sigma_m)
    yard = made_tracks(count, azimuth, shift * across, own)
    missing = bool(rng.random() < errors.unmapped_prior) if unmapped is None else unmapped
    tracks = [track for k, track in enumerate(yard) if not (missing and k == own)]
    common = rng.normal(0.0, common_sigma_m, satellites)
    seconds = int(LOOKS_S[-1])
    keep = np.exp(-1.0 / errors.correlation_s)
    arms = (10.0, -10.0)
    heading = np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
    facing = float(rng.choice([1.0, -1.0]))
    sines = np.sin(np.radians(elevation))
    codes = []
    for _ in arms:
        noise = rng.normal(0.0, 1.0, (seconds, satellites))
        noise[1:] *= np.sqrt(1.0 - keep**2)
        noise = lfilter([1.0], [1.0, -keep], noise, axis=0)
        bias = rng.normal(0.0, errors.code_bias_m, satellites) / sines
        codes.append(
            common + bias + np.cumsum(noise, axis=0) / np.arange(1, seconds + 1)[:, None] * errors.code_noise_m / sines
        )
    answers: dict[float, tuple[str, float]] = {}
    for look in LOOKS_S:
        fixes = []
        for code, arm in zip(codes, arms, strict=True):
            fix = standstill_fix(
                bearing, elevation, system, code[int(look) - 1], seconds=look,
                common_m=np.full(satellites, common_sigma_m), errors=errors,
            )  # fmt: skip
            assert fix is not None
            place = fix.east_north_m + facing * arm * heading
            shrink = 1.0 if method == "model" else 1.0 / look
            fixes.append(
                StandstillFix(
                    east_north_m=place,
                    own_m2=fix.own_m2 * shrink,
                    common_m2=fix.common_m2 * shrink,
                    misfit=fix.misfit,
                    freedom=fix.freedom,
                )
            )
        used = errors if method == "model" else errors.replaced(map_sigma_m=0.0)
        posterior = track_posterior(tracks, fixes, arms_m=arms, errors=used)
        for risk in RISKS:
            name = posterior.decision(risk=risk)
            if name and risk not in answers:
                answers[risk] = (name, look)
    return answers, "none" if missing else yard[own].name


def main() -> None:
    yards = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    errors = StandstillErrors()
    for title, common, method in (
        ("base station", 0.05, "model"),
        ("no base station", 1.0, "model"),
        ("1 Hz samples as independent, no base station", 1.0, "naive"),
    ):
        rows = [decided(k, errors=errors, common_sigma_m=common, method=method) for k in range(yards)]
        for risk in RISKS:
            given = [(a[risk], own) for a, own in rows if risk in a]
            wrong = sum(name != own for (name, _), own in given)
            times = [t for (_, t), _ in given]
            print(
                f"{title}, risk {risk:g}: {len(given)} of {yards} decided, {wrong} wrong "
                f"({wrong / max(len(given), 1):.4f}), median time {np.median(times) if times else np.nan:.0f} s"
            )


if __name__ == "__main__":
    main()
