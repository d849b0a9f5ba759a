"""P1 3.2 on the simulated test line: standing still with two and with three satellites.

The part ``static`` of `p1_experiment`: a train stands every few metres of the simulated test line, and each pair and
each triple of the satellites above the mask is taken as all there is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Literal, get_args

import numpy as np

from railfix.core.arrays import Codes, Floats, Indices, Integers, Masks
from railfix.core.reasons import Status
from railfix.core.settings_files import write_toml
from railfix.gnss.observations import Observations
from railfix.pipeline.config import parse_config
from railfix.run.processor_setup import make_processor
from railfix.simulate import Scenario, Simulation
from railfix.simulate.environment.settings import EnvironmentSettings
from railfix.simulate.line_file import Element, LineSettings
from railfix.simulate.run import vehicle_table
from railfix.simulate.scenario import RunSettings, Station
from railfix.simulate.scenario_file import load_recipe, whole_run_s
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle

Place = Literal["houses", "open field", "open field, a line without curves"]

#: Starts of the standing experiments: the sky turns on between them.
STARTS: Final = tuple(np.datetime64("2010-08-19T00:14:30", "ns") + np.timedelta64(4 * h, "h") for h in range(6))
#: Where the vehicle's middle stands, chainage [m], and how long [s].
PLACES_M: Final = tuple(float(m) for m in range(24, 732, 12))
STANDING_S: Final = 3.0
#: P1's mask of 3.3.
MASK_DEG: Final = 20.0
#: Satellites along the line: from this dilution on railfix says "unobservable".
DILUTION: Final = 20.0
#: A position is on a wrong section when it is further off than this, and further than five of its own sigmas.
WRONG_M: Final = 10.0
WRONG_SIGMAS: Final = 5.0
#: Excess of q that noise explains (`SectionLimits.ambiguity_risk` 1e-3).
EXCESS: Final = 10.83
#: Classes by the radius of the curve [m]; between them the transitions.
CLASSES: Final = ("straight", "transition", "curve of 300 m", "curve of 160 m")


@dataclass(frozen=True, kw_only=True)
class Subsets:
    """Positions from subsets of the satellites, one row an epoch and subset.

    `turn_deg` is how far the line turns between the true place and the position.
    """

    place: Integers
    error_m: Floats
    turn_deg: Floats
    sigma_m: Floats
    dilution: Floats
    status: Codes
    excess: Floats

    @property
    def over(self) -> Masks:
        return np.abs(self.error_m) > WRONG_M

    @property
    def wrong(self) -> Masks:
        return self.over & (np.abs(self.error_m) > WRONG_SIGMAS * self.sigma_m)


def prior_basis_text(start: np.datetime64, seed: int, place: Place, places: Sequence[float] = PLACES_M) -> Scenario:
    """A train that stands at many places of the test line, between its houses or on an open field."""
    base = load_recipe("p1-test-line").scenario()
    run = RunSettings(
        cruise_mps=5.5,
        first_stand_s=STANDING_S,
        at_end="stand",
        stations=tuple(Station(at_m=float(m), dwell_s=STANDING_S) for m in places),
    )
    around = base.environment if place == "houses" else EnvironmentSettings()
    if place == "open field, a line without curves":
        straight = Element(kind="straight", length_m=756.0)
        base = base.replaced(line=LineSettings(kind="elements", elements=(straight,)))
    scenario = base.replaced(start=start, seed=seed, rate_hz=1.0, run=run, sensors=None, environment=around)
    return scenario.replaced(duration_s=whole_run_s(scenario))


def trajectory_of(simulation: Simulation) -> Trajectory:
    """Of the front antenna."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "vehicle.toml"
        write_toml(path, vehicle_table(simulation.scenario.vehicle))
        return antenna_trajectory(simulation.line.track(), read_vehicle(path), "front")


def classes_of(simulation: Simulation, chainage_m: Floats) -> Integers:
    """Index into `CLASSES` of places."""
    radius = 1.0 / np.maximum(np.abs(simulation.line.curvature_at(chainage_m)), 1e-9)
    return np.select([radius > 3000.0, radius > 305.0, radius > 295.0, radius < 165.0], [0, 1, 2, 3], 1)


def only(observations: Observations, channels: Sequence[int], epochs: Indices) -> Observations:
    """Some channels and epochs of a log."""
    index = list(channels)
    return Observations(
        time=observations.time[epochs],
        satellite=observations.satellite[index],
        signal=observations.signal[index],
        code_m=observations.code_m[np.ix_(epochs, index)],
        phase_cycles=observations.phase_cycles[np.ix_(epochs, index)],
        doppler_hz=observations.doppler_hz[np.ix_(epochs, index)],
        cn0_dbhz=observations.cn0_dbhz[np.ix_(epochs, index)],
        loss_of_lock=observations.loss_of_lock[np.ix_(epochs, index)],
        break_before=observations.break_before[epochs],
        header=observations.header,
    )


def subsets(start: np.datetime64, seed: int, size: int, place: Place, places: Sequence[float] = PLACES_M) -> Subsets:
    """Every subset of so many satellites of one standing experiment."""
    simulation = Simulation(prior_basis_text(start, seed, place, places))
    config = parse_config(
        {
            "systems": ["G"],
            "screens": ["elevation"],
            "elevation": {"mask_deg": MASK_DEG},
            "min_satellites": 2,
            "dilution_limit": 1e9,
            "largest_sigma_m": 1e9,
            "protection": "off",
            "section": {"redundancy": 0},
        }
    )
    processor = make_processor(config, simulation.navigation, {"front": trajectory_of(simulation)})
    (piece,) = simulation.pieces("front", chunk_epochs=simulation.scenario.epochs)
    observations, geometry = piece.observations, piece.geometry
    still = np.flatnonzero(np.abs(geometry.speed_mps) < 1e-6)
    line = simulation.line
    true = np.interp(geometry.chainage_m, line.point_chainage_m(), line.track().chainage_m)
    kind = classes_of(simulation, geometry.chainage_m)
    high = np.isfinite(observations.code_m) & (geometry.elevation_deg > MASK_DEG + 0.1)
    wanted = [k for k, name in enumerate(observations.satellite) if name[0] == "G" and name != "G02"]
    every = np.arange(0.0, line.length_m, 0.5)
    bearing = np.degrees(np.cumsum(0.5 * line.curvature_at(every)))
    parts: list[Subsets] = []
    for chosen in combinations(wanted, size):
        epochs = still[high[np.ix_(still, list(chosen))].all(axis=1)]
        if not len(epochs):
            continue
        result, _ = processor.process({"front": only(observations, chosen, epochs)})
        got = result.antennas["front"]
        fitted = got.fix.constrained
        has = np.isfinite(fitted.arc_m)
        chainage = processor.trajectories["front"].chainage_at(fitted.arc_m)
        parts.append(
            Subsets(
                place=kind[epochs][has],
                error_m=(chainage - true[epochs])[has],
                turn_deg=np.abs(np.interp(chainage, every, bearing) - np.interp(true[epochs], every, bearing))[has],
                sigma_m=fitted.sigma_m[has],
                dilution=fitted.dilution[has],
                status=got.status[has],
                excess=got.fix.section.excess[has],
            )
        )
    return joined(parts)


def joined(parts: Sequence[Subsets]) -> Subsets:
    return Subsets(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Subsets)})


HEAD: Final = (
    "                             positions over 10 m  wrong section  line turns  told ambiguous  of the rest largest\n"
    "satellites place                          %          %       between, deg   of wrong, %     wrong, %  of rest, m"
)


def rows(name: str, found: Subsets) -> Iterator[str]:
    """One line a class of places, for positions that geometry allows (`DILUTION`)."""
    usable = found.dilution <= DILUTION
    doubtful = (found.excess <= EXCESS) | (found.status != Status.OK)
    for number, word in [*enumerate(CLASSES), (-1, "everywhere")]:
        part = usable & (found.place == number if number >= 0 else True)
        if not part.any():
            continue
        wrong, rest = found.wrong[part], ~doubtful[part]
        size = np.abs(found.error_m[part])
        turn = np.median(found.turn_deg[part][wrong]) if wrong.any() else np.nan
        largest = size[rest].max() if rest.any() else np.nan
        told = 100.0 * np.mean(doubtful[part][wrong]) if wrong.any() else np.nan
        missed = 100.0 * np.mean(wrong[rest]) if rest.any() else np.nan
        yield (
            f"{name:10s} {word:17s} {np.count_nonzero(part):8d} {100 * found.over[part].mean():9.2f} "
            f"{100 * wrong.mean():11.3f} {turn:12.0f} {told:13.1f} {missed:14.3f} {largest:8.1f}"
        )


def static_report(starts: Sequence[np.datetime64] = STARTS) -> Iterator[str]:
    """Two and three satellites by the curvature of the place."""
    for place in get_args(Place):
        yield f"the test line, {place}"
        yield from HEAD.splitlines()
        for size, word in ((2, "two"), (3, "three")):
            found = joined([subsets(start, 100 + k, size, place) for k, start in enumerate(starts)])
            yield from rows(word, found)
            narrow = 100.0 * np.mean(found.dilution > DILUTION)
            yield f"{word}: {narrow:.1f} % of all have their satellites across the track: unobservable, left out above"
        yield ""
