"""Made codes and phases on made lines, and made logs; nothing here uses the code under test but its frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import synthetic
from railfix.core.geodesy import range_with_rotation
from railfix.gnss.observations import Observations
from railfix.positioning.carrier import Phases
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.channels import clock_groups
from railfix.track import Track
from railfix.track.trajectory import Trajectory

START = np.datetime64("2024-03-05T03:10:03", "ns")
WAVELENGTH_M = 299_792_458.0 / 1_575.42e6


def times(epochs: int, interval_s: float = 1.0) -> np.ndarray:
    return START + (np.arange(epochs) * round(interval_s * 1e9)).astype("timedelta64[ns]")


def straight(length_m: float = 1000.0) -> Trajectory:
    s = np.arange(0.0, length_m + 1.0, 50.0)
    return Trajectory.from_antenna_path(
        Track.from_ecef(synthetic.enu_to_ecef(np.stack([0.6 * s, 0.8 * s, 0.005 * s], axis=1)), name="straight")
    )


def sky(epochs: int, systems: str, seed: int) -> np.ndarray:
    """Satellites that move slowly (about 3 km/s), shape (T, M, 3)."""
    rng = np.random.default_rng(seed)
    one = synthetic.satellites(rng, 1, systems)
    velocity = rng.normal(size=one.shape)
    velocity *= 3000.0 / np.linalg.norm(velocity, axis=-1, keepdims=True)
    return one + velocity * np.arange(epochs)[:, None, None]


def observed(
    line: Trajectory,
    arc_m: np.ndarray,
    *,
    systems: str = "GGGGJEEE",
    code_sigma_m: float = 1.0,
    phase_sigma_m: float = 0.01,
    noise: float = 1.0,
    seed: int = 5,
    cycles: np.ndarray | None = None,
    arc_id: np.ndarray | None = None,
    own_clock_m: float = 0.0,
) -> tuple[Ranges, Phases]:
    """Codes and phases of an antenna at `arc_m`; `noise` 0 makes them exact with the same weights."""
    epochs, channels = len(arc_m), len(systems)
    rng = np.random.default_rng(seed)
    sats = sky(epochs, systems, seed)
    groups = clock_groups(list(systems))
    clock = np.repeat(300.0 + rng.normal(0.0, 20.0, (epochs, 1)), channels, axis=1)
    for g, group in enumerate(groups):
        clock[:, group] += 5.5 * g
    exact, _ = range_with_rotation(sats, line.at_arc(arc_m)[:, None, :])
    if arc_id is None:
        arc_id = np.broadcast_to(np.arange(channels, dtype=np.int64) << 23, exact.shape)
    whole = rng.integers(-2_000_000, 2_000_000, 4096).astype(float) if cycles is None else cycles
    names, which = np.unique(arc_id, return_inverse=True)
    constant = WAVELENGTH_M * whole[: len(names)][which.reshape(arc_id.shape)]
    phase_clock = clock if own_clock_m == 0.0 else rng.normal(0.0, own_clock_m, (epochs, 1))
    ranges = Ranges(
        sat_ecef_m=sats,
        code_m=exact + clock + noise * rng.normal(0.0, code_sigma_m, exact.shape),
        weight=np.full(exact.shape, code_sigma_m**-2.0),
        groups=groups,
    )
    phases = Phases(
        phase_m=exact + phase_clock + constant + noise * rng.normal(0.0, phase_sigma_m, exact.shape),
        weight=np.where(arc_id >= 0, phase_sigma_m**-2.0, 0.0),
        arc_id=arc_id,
    )
    for array in (ranges.sat_ecef_m, ranges.code_m, ranges.weight, phases.phase_m, phases.weight, arc_m):
        array.flags.writeable = False
    return ranges, phases


def log(
    epochs: int = 60,
    channels: int = 8,
    *,
    interval_s: float = 1.0,
    doppler: bool = True,
    code_sigma_m: float = 0.5,
    seed: int = 3,
) -> Observations:
    """A log of satellites with curved ranges, phases good to 3 mm, Dopplers to 0.02 m/s."""
    rng = np.random.default_rng(seed)
    t = np.arange(epochs)[:, None] * interval_s
    rate, bend = rng.uniform(-700, 700, channels), rng.uniform(-0.1, 0.1, channels)
    distance = rng.uniform(2.0e7, 2.5e7, channels) + rate * t + 0.5 * bend * t**2
    speed = rate + bend * t
    clock, drift = 60.0 * t, 60.0
    shape = distance.shape
    return Observations(
        time=times(epochs, interval_s),
        satellite=np.array([f"G{i + 1:02d}" for i in range(channels)]),
        signal=np.full(channels, "1C"),
        code_m=distance + clock + rng.normal(0.0, code_sigma_m, shape),
        phase_cycles=(distance + clock + rng.normal(0.0, 0.003, shape)) / WAVELENGTH_M
        + rng.integers(-1e6, 1e6, channels),
        doppler_hz=(-(speed + drift) + rng.normal(0.0, 0.02, shape)) / WAVELENGTH_M
        if doppler
        else np.full(shape, np.nan),
        cn0_dbhz=np.full(shape, 45.0),
        loss_of_lock=np.zeros(shape, dtype=np.uint8),
        break_before=np.zeros(epochs, dtype=bool),
    )


def changed(obs: Observations, **arrays: np.ndarray) -> Observations:
    return replace(obs, **arrays)
