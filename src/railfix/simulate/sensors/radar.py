"""Speeds of a Doppler radar under the car (P2, chapter 3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.timescale import timedelta
from railfix.simulate.errors.processes import GaussMarkov
from railfix.simulate.sensors.settings import RadarSettings

if TYPE_CHECKING:
    from railfix.simulate.signals import Simulation


#: Streams of random numbers: noise, sway, dropouts.
_NOISE, _SWAY, _DROPOUTS = 26, 27, 28


def radar_table(simulation: Simulation, settings: RadarSettings) -> pl.DataFrame:
    """Samples of the radar, see `railfix.simulate.sensors.tables.COLUMNS`."""
    scenario = simulation.scenario
    time = np.arange(int(scenario.duration_s * settings.rate_hz + 1e-9) + 1) / settings.rate_hz
    true = simulation.motion.at(time)[1]
    ratio: Floats | float = settings.scale
    if settings.sway_ratio_sigma > 0.0:
        sway = GaussMarkov(
            [(scenario.seed, _SWAY)],
            sigma=settings.sway_ratio_sigma,
            time_s=settings.sway_time_s,
            duration_s=scenario.duration_s,
        )
        ratio = ratio + sway.at(time)[:, 0]
    noise = np.random.default_rng([scenario.seed, _NOISE]).standard_normal(len(time))
    speed = true * (1.0 + ratio) + settings.bias_mps + settings.noise_sigma_mps * noise
    blind = (np.abs(true) < settings.lowest_mps) | (np.abs(true) > settings.highest_mps)
    for start, end in dropouts(settings, scenario.seed, scenario.duration_s):
        blind |= (time >= start) & (time < end)
    tag = scenario.start + timedelta(time)
    return pl.DataFrame({"time_gpst": tag, "speed_mps": np.where(blind, np.nan, speed)})


def dropouts(settings: RadarSettings, seed: int, duration_s: float) -> list[tuple[float, float]]:
    """Start and end of each interval without a measurement [s], given ones first, then drawn ones."""
    found = [(d.start_s, d.end_s) for d in settings.dropouts]
    if settings.dropouts_per_hour > 0.0:
        rng = np.random.default_rng([seed, _DROPOUTS])
        start = 0.0
        while True:
            gap, lasting = rng.exponential(size=2) * (3600.0 / settings.dropouts_per_hour, settings.dropout_duration_s)
            start += float(gap)
            if start >= duration_s:
                break
            found.append((start, start + float(lasting)))
    return found
