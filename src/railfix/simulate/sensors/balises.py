"""Balises read on the way, some of them missed or with another identity, and the list of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from railfix.core.timescale import timedelta
from railfix.simulate.sensors.settings import Balise, BaliseSettings

if TYPE_CHECKING:
    from railfix.simulate.signals import Simulation

#: Streams of random numbers: error of a reading, missed, wrong identity.
_NOISE, _MISSED, _WRONG = 44, 45, 46
#: Spacing of the instants between which a passing is interpolated [s].
_STEP_S = 0.1


def balises_along(simulation: Simulation, settings: BaliseSettings) -> tuple[Balise, ...]:
    """Return the balises that are named, and those every `spacing_m`, in order of chainage."""
    length = float(simulation.line.sampled_chainage_m()[-1])
    spaced = np.arange(settings.spacing_m, length, settings.spacing_m) if settings.spacing_m else np.empty(0)
    drawn = [Balise(name=f"B{k + 1:03d}", chainage_m=at) for k, at in enumerate(spaced.tolist())]
    return tuple(sorted([*settings.balises, *drawn], key=lambda balise: balise.chainage_m))


def balise_list_table(simulation: Simulation, settings: BaliseSettings) -> pl.DataFrame:
    """The list of balises, see `railfix.simulate.sensors.tables.COLUMNS`."""
    balises, line = balises_along(simulation, settings), simulation.line
    at = np.array([balise.chainage_m for balise in balises], dtype=np.float64)
    mapped = np.interp(at, line.sampled_chainage_m(), line.track().chainage_m)
    return pl.DataFrame(
        {"balise": pl.Series([b.name for b in balises], dtype=pl.String), "chainage_m": mapped.round(3)}
    )


def balise_tables(simulation: Simulation, settings: BaliseSettings) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Readings and the ground truth of all passings; see `railfix.simulate.sensors.tables.COLUMNS`."""
    scenario, balises = simulation.scenario, balises_along(simulation, settings)
    time = np.arange(0.0, scenario.duration_s + 1e-9, _STEP_S)
    reader = simulation.body_truth((settings.along_m, 0.0, 0.0), time)[0].chainage_m
    names = [balise.name for balise in balises]
    noise = np.random.default_rng([scenario.seed, _NOISE]).standard_normal(len(balises)) * settings.noise_sigma_m
    missed = np.random.default_rng([scenario.seed, _MISSED]).uniform(size=len(balises)) < settings.missed_chance
    draws = np.random.default_rng([scenario.seed, _WRONG])
    chance, other = draws.uniform(size=len(balises)), draws.integers(0, max(len(balises) - 1, 1), len(balises))
    rows: list[tuple[float, float, str, str | None]] = []
    for k, balise in enumerate(balises):
        ahead = balise.chainage_m - reader
        for step in np.flatnonzero((ahead[:-1] > 0.0) != (ahead[1:] > 0.0)).tolist():
            speed = (reader[step + 1] - reader[step]) / _STEP_S
            at = float(time[step] + ahead[step] / speed)
            read: str | None = settings.wrong.get(balise.name, balise.name)
            if chance[k] < settings.wrong_chance and len(balises) > 1:
                read = names[other[k] + (other[k] >= k)]
            if missed[k] or balise.name in settings.missed:
                read = None
            rows.append((at, at + noise[k] / max(abs(speed), 1.0), balise.name, read))
    rows.sort()
    passed, heard = (scenario.start + timedelta(np.array([row[k] for row in rows], dtype=np.float64)) for k in (0, 1))
    truth = pl.DataFrame(
        {
            "time_gpst": pl.Series(passed, dtype=pl.Datetime("ns")),
            "balise": pl.Series([row[2] for row in rows], dtype=pl.String),
            "read": pl.Series([row[3] for row in rows], dtype=pl.String),
        }
    )
    readings = truth.with_columns(time_gpst=pl.Series(heard, dtype=pl.Datetime("ns"))).drop_nulls("read")
    return readings.select("time_gpst", balise="read").sort("time_gpst"), truth
