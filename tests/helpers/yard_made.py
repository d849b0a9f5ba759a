"""Simulated yards: trains at rest on parallel tracks, with the code errors of `StandstillErrors`."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter

from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.positioning.standstill_phase import MeanPhases
from railfix.positioning.track_choice import StandstillErrors, YardTrack, standstill_fix, track_posterior

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


def made_phases(
    rng: np.random.Generator,
    bearing: np.ndarray,
    elevation: np.ndarray,
    system: np.ndarray,
    place_m: np.ndarray,
    errors: StandstillErrors,
    *,
    half_cycle: bool = False,
) -> MeanPhases:
    """Double differences of an antenna at a place (east, north, up), with the phase errors of `StandstillErrors`."""
    azimuth, up = np.radians(bearing), np.radians(elevation)
    toward = np.stack([np.cos(up) * np.sin(azimuth), np.cos(up) * np.cos(azimuth), np.sin(up)], axis=-1)
    sigma = errors.phase_sigma_m(elevation, distance_m=0.0)
    single = -toward @ place_m + rng.normal(0.0, sigma) + 0.190293673 * rng.integers(-30, 30, len(elevation))
    if half_cycle:
        single[int(np.argmin(elevation))] += 0.190293673 / 2.0
    values, away, blocks = [], [], []
    for letter in np.unique(system):
        columns = np.flatnonzero(system == letter)
        reference = columns[np.argmax(elevation[columns])]
        own = columns[columns != reference]
        values.append(single[own] - single[reference])
        away.append(-(toward[own] - toward[reference]))
        blocks.append(np.diag(sigma[own] ** 2) + sigma[reference] ** 2)
    return MeanPhases(
        difference_m=np.concatenate(values),
        away=np.concatenate(away),
        wavelength_m=np.full(sum(map(len, values)), 0.190293673),
        covariance_m2=block_diag(*blocks),
    )


def decided(
    seed: int,
    *,
    errors: StandstillErrors,
    common_sigma_m: float,
    method: str = "model",
    unmapped: bool | None = None,
    looks: tuple[float, ...] = LOOKS_S,
    half_cycle: bool = False,
) -> tuple[dict[float, tuple[str, float]], str]:
    """First decision at each risk, with its time, and the true track of one simulated yard.

    A track is missing in the map with the prior's probability, or as `unmapped` states.

    `method` "phase" has carrier phases, too, with `half_cycle` a satellite of each antenna half a cycle off.
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
    seconds = int(looks[-1])
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
    mounting = (
        rng.normal(0.0, errors.antenna_sigma_m, (len(arms), 2)) if method == "phase" else np.zeros((len(arms), 2))
    )
    moved = [facing * arm * heading + error for arm, error in zip(arms, mounting, strict=True)]
    phases = [
        made_phases(rng, bearing, elevation, system, np.append(place, 0.0), errors, half_cycle=half_cycle)
        for place in (moved if method == "phase" else [])
    ]
    for look in looks:
        fixes = []
        for code, shift in zip(codes, moved, strict=True):
            fix = standstill_fix(
                bearing, elevation, system, code[int(look) - 1], seconds=look,
                common_m=np.full(satellites, common_sigma_m), errors=errors,
            )  # fmt: skip
            assert fix is not None
            assert fix.place is not None
            moved_place = replace(fix.place, place_m=fix.place.place_m + np.append(shift, 0.0))
            fixes.append(replace(fix, east_north_m=fix.east_north_m + shift, place=moved_place))
        posterior = track_posterior(tracks, fixes, arms_m=arms, errors=errors, phases=phases)
        for risk in RISKS:
            name = posterior.decision(risk=risk)
            if name and risk not in answers:
                answers[risk] = (name, look)
    return answers, "none" if missing else yard[own].name
