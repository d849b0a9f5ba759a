"""Simulated runs through several ways of positioning at once, in memory: what the parts of `p1_experiment` share."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from p1_rtklib import PROGRAM, single_points
from railfix.core.arrays import Codes, Datetimes, Floats, Integers, Masks, Strings
from railfix.core.reasons import CHECK_FAILED, Status
from railfix.core.settings_files import write_toml
from railfix.gnss.observations import Observations
from railfix.integrity.point_validation import PointStatus
from railfix.motion.samples import SensorSamples
from railfix.pipeline.config import parse_config
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.pipeline.results import AntennaResult
from railfix.ranges.cn0_curve_file import write_cn0_curve
from railfix.ranges.cn0_curve_fit import Cn0Samples, fit_cn0_curve
from railfix.run.processor_setup import make_processor
from railfix.run.sensors import read_sensors
from railfix.simulate import Scenario, Simulation
from railfix.simulate.run import vehicle_table
from railfix.simulate.sbas_stream import sbas_messages, write_sbas
from railfix.simulate.scenario import ANTENNAS, RunSettings
from railfix.simulate.scenario_file import load_recipe
from railfix.simulate.sensor_columns import sensor_tables
from railfix.simulate.signals import Piece
from railfix.track.vehicle import antenna_trajectory, read_vehicle

#: Errors along the line from here on are kept with the signals that made them.
LARGE_M: Final = 10.0
#: A code this far from the others (from their lower quartile: reflected codes are late) is one with multipath.
LATE_M: Final = 5.0


@dataclass(frozen=True)
class Way:
    """One way of getting positions.

    Attributes
    ----------
    name : str
    settings : mapping
        Of the run.
    positions : {"conventional", "validated", "rtklib", "constrained", "checked", "filtered"}
        Which of its positions: 3-D at the nearest point of the line; of these the valid ones (`conventional_status`);
        RTKLIB's, at the nearest point; on the line; of these the ones that no check failed (``failed_checks =
        "drop"``); those of the filter along the track.
    largest_sigma_m : float
        As `Config.largest_sigma_m` with failed checks dropped, put upon the results of a run with a wider limit.
    sensors : bool
        Whether the filter gets the tachometer and the inertial unit of the scenario.
    sbas : bool
        Whether positions are corrected by the scenario's SBAS messages.
    """

    name: str
    settings: Mapping[str, Any]
    positions: Literal["conventional", "validated", "rtklib", "constrained", "checked", "filtered"] = "constrained"
    largest_sigma_m: float = np.inf
    sensors: bool = False
    sbas: bool = False

    @property
    def key(self) -> str:
        """Ways alike in it are looked at in one run."""
        return repr((self.settings, self.sensors, self.sbas))


@cache
def cn0_curve(folder: Path, recipe: str = "commercial-run") -> Path:
    """P1 2.3(1): mean C/N0 over elevation, of a day of open sky standing, with the receivers of a scenario."""
    base = load_recipe(recipe).scenario()
    day = Scenario().replaced(
        seed=230,
        start=base.start,
        duration_s=86_400.0,
        rate_hz=0.1,
        run=RunSettings(first_stand_s=1e6),
        sky=base.sky,
        receiver=base.receiver,
        errors=base.errors,
    )
    samples = Cn0Samples()
    for piece in Simulation(day).pieces("front"):
        observed = piece.observations
        samples.add(observed.cn0_dbhz, piece.geometry.elevation_deg, observed.satellite, observed.signal)
    path = folder / f"cn0-curve-{recipe}.toml"
    write_cn0_curve(fit_cn0_curve(samples), path)
    return path


@dataclass(frozen=True, kw_only=True)
class Passage:
    """One antenna on one run: the truth of T epochs."""

    run: str
    antenna: str
    time: Datetimes
    chainage_m: Floats
    speed_mps: Floats
    environment: Strings
    observed: Masks
    ecef_m: Floats


@dataclass(frozen=True, kw_only=True)
class Found:
    """What one way gave on one passage."""

    error_m: Floats
    status: Codes
    n_used: Integers
    own_sigma_m: Floats
    horizontal_m: Floats


@dataclass(frozen=True, kw_only=True)
class Breaking:
    """One epoch whose error is large, with the signals that made it.

    Attributes
    ----------
    passage, epoch : int
    error_m : float
    dilution : float
        Along the line [m/m].
    late : int
        Used codes whose true error is `LATE_M` off the lower quartile of the used ones.
    signals : str
        Each satellite used: elevation, azimuth from the body's front, C/N0, true error of its code.
    """

    passage: int
    epoch: int
    error_m: float
    dilution: float
    late: int
    signals: str


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """All passages, and what every way of every choice of systems gave on each."""

    passages: list[Passage]
    found: dict[tuple[str, str], list[Found]]
    breaking: dict[tuple[str, str], list[Breaking]]


class Bench:
    """A run's pieces through several processors at once."""

    def __init__(
        self, scenario: Scenario, name: str, ways: Sequence[Way], systems: Sequence[str], curve: Path | None
    ) -> None:
        self.simulation = Simulation(scenario)
        self.name = name
        line = self.simulation.line
        track = line.track()
        self.sampled, self.mapped = line.point_chainage_m(), track.chainage_m
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "vehicle.toml"
            write_toml(path, vehicle_table(scenario.vehicle))
            vehicle = read_vehicle(path)
            self.trajectories = {a: antenna_trajectory(track, vehicle, a) for a in ANTENNAS}
            self.ways, self.systems = [way for way in ways if way.positions != "rtklib" or PROGRAM], systems
            self.sensors = samples_of(self.simulation) if any(way.sensors for way in ways) else SensorSamples()
            messages = Path(folder) / "messages.sbs"
            if scenario.sbas is not None:
                write_sbas(sbas_messages(self.simulation, scenario.sbas), messages)
                self.messages = messages.read_bytes()
            #: One processor for settings that are the same, whichever of their results is looked at.
            self.processors: dict[tuple[str, str], EpochProcessor] = {}
            for letters in systems:
                for way in self.ways:
                    if way.positions == "rtklib":
                        continue
                    common = {"systems": list(letters), "protection": "off", "cn0_curve": curve and str(curve)}
                    if way.sbas:
                        common["sbas"] = [str(messages)]
                    settings = {"filter": "off", **way.settings, **common}
                    key = (letters, way.key)
                    if key not in self.processors:
                        self.processors[key] = make_processor(
                            parse_config(settings), self.simulation.navigation, self.trajectories
                        )

    def sensing(self, words: str) -> bool:
        """Whether the ways of a key have sensors."""
        return any(way.key == words and way.sensors for way in self.ways)

    def pieces(self) -> Iterator[dict[str, Piece]]:
        """Pieces of both antennas together."""
        for parts in zip(*(self.simulation.pieces(a) for a in ANTENNAS), strict=True):
            yield dict(zip(ANTENNAS, parts, strict=True))

    def true_chainage_m(self, piece: Piece) -> Floats:
        """Where the antenna truly is, as the map counts."""
        return np.interp(piece.geometry.chainage_m, self.sampled, self.mapped)


def samples_of(simulation: Simulation) -> SensorSamples:
    """Samples of the tachometer and the inertial unit of a run."""
    with tempfile.TemporaryDirectory() as folder:
        tables = sensor_tables(simulation)
        paths = {name: Path(folder) / f"{name}.parquet" for name in ("tachometer", "inertial")}
        for name, path in paths.items():
            tables[name].write_parquet(path)
        return read_sensors(**paths)


def ridden(bench: Bench) -> Campaign:
    """One run: every way of every choice of systems, both antennas."""
    states: dict[tuple[str, str], State | None] = dict.fromkeys(bench.processors)
    truths: dict[str, list[Passage]] = {a: [] for a in ANTENNAS}
    parts: dict[tuple[str, str, str], list[Found]] = {}
    observed: dict[str, list[Observations]] = {a: [] for a in ANTENNAS}
    breaking: dict[tuple[str, str], list[Breaking]] = {}
    before = 0
    received = np.datetime64("NaT", "ns")
    for piece in bench.pieces():
        end = max(p.observations.time[-1] for p in piece.values())
        since, received = bench.sensors.between(received, end), end
        for antenna, one in piece.items():
            geometry = one.geometry
            observed[antenna].append(one.observations)
            truths[antenna].append(
                Passage(
                    run=bench.name,
                    antenna=antenna,
                    time=one.observations.time,
                    chainage_m=bench.true_chainage_m(one),
                    speed_mps=np.abs(geometry.speed_mps),
                    environment=bench.simulation.environment.label_at(geometry.chainage_m),
                    observed=np.isfinite(one.observations.code_m).any(axis=1),
                    ecef_m=geometry.antenna_ecef_m,
                )
            )
        for (letters, words), processor in bench.processors.items():
            observations = {a: p.observations for a, p in piece.items()}
            sensors = since if bench.sensing(words) else None
            result, states[letters, words] = processor.process(observations, states[letters, words], sensors=sensors)
            for way in bench.ways:
                if way.key != words or way.positions == "rtklib":
                    continue
                for index, antenna in enumerate(ANTENNAS):
                    got, truth = result.antennas[antenna], truths[antenna][-1]
                    found = of_result(way, got, truth, result.fusion.get(antenna))
                    parts.setdefault((letters, way.name, antenna), []).append(found)
                    large = np.flatnonzero(np.abs(found.error_m) >= LARGE_M)
                    breaking.setdefault((letters, way.name), []).extend(
                        broken(piece[antenna], got, found, int(t), passage=index, before=before) for t in large
                    )
        before += len(piece[ANTENNAS[0]].observations)
    passages = [joined(truths[a]) for a in ANTENNAS]
    for letters, way in product(bench.systems, bench.ways):
        if way.positions == "rtklib":
            for antenna, passage in zip(ANTENNAS, passages, strict=True):
                found = of_rtklib(bench, way, letters, passage, observed[antenna])
                parts[letters, way.name, antenna] = [found]
    return Campaign(
        passages=passages,
        found={
            (letters, way.name): [joined(parts[letters, way.name, a]) for a in ANTENNAS]
            for letters in bench.systems
            for way in bench.ways
        },
        breaking=breaking,
    )


def of_rtklib(bench: Bench, way: Way, letters: str, truth: Passage, parts: Sequence[Observations]) -> Found:
    """Errors of RTKLIB's positions, each at the nearest point of the trajectory."""
    with tempfile.TemporaryDirectory() as folder:
        messages = Path(folder) / "messages.sbs"
        if way.sbas:
            messages.write_bytes(bench.messages)
        limits = {
            "mask_deg": way.settings.get("elevation", {}).get("mask_deg", 20.0),
            "floor_dbhz": 30.0 if "cn0" in way.settings["screens"] else 0.0,
        }
        place = single_points(bench.simulation, parts, letters, messages if way.sbas else None, **limits)
    trajectory = bench.trajectories[truth.antenna]
    error = trajectory.chainage_at(trajectory.nearest(place)[0]) - truth.chainage_m
    return Found(
        error_m=error,
        status=np.where(np.isfinite(error), Status.OK, Status.NO_CONVERGENCE).astype(np.int8),
        n_used=np.zeros(len(place), dtype=np.int64),
        own_sigma_m=np.full(len(place), np.nan),
        horizontal_m=horizontal_m(place - truth.ecef_m, truth.ecef_m),
    )


def of_result(way: Way, got: AntennaResult, truth: Passage, track: AlongTrack | None) -> Found:
    """Errors of one way out of a result."""
    conventional = way.positions in ("conventional", "validated")
    chainage = got.conventional_chainage_m if conventional else got.chainage_m
    place = got.point.ecef_m if conventional else got.ecef_m
    if way.positions == "filtered":
        assert track is not None
        chainage, place = track.chainage_m, track.ecef_m
    kept = np.ones(len(chainage), dtype=np.bool_)
    if way.positions == "validated":
        kept = got.conventional_status == PointStatus.VALID
    if way.positions == "checked":
        kept = ~np.isin(got.status, CHECK_FAILED)
    if way.positions not in ("conventional", "validated", "filtered"):
        kept &= (got.epoch_sigma_m <= way.largest_sigma_m) | (got.status == Status.OFF_MAP)
    error = chainage - truth.chainage_m
    return Found(
        error_m=np.where(kept, error, np.nan),
        status=got.status,
        n_used=got.n_used,
        own_sigma_m=got.epoch_sigma_m,
        horizontal_m=horizontal_m(place - truth.ecef_m, truth.ecef_m),
    )


def horizontal_m(away_m: Floats, place_m: Floats) -> Floats:
    """Horizontal part of differences at places, shape (T,) [m]; the vertical is toward the Earth's centre."""
    up = place_m / np.linalg.norm(place_m, axis=1, keepdims=True)
    return np.linalg.norm(away_m - np.einsum("ti,ti->t", away_m, up)[:, None] * up, axis=1)


def broken(piece: Piece, got: AntennaResult, found: Found, t: int, *, passage: int, before: int) -> Breaking:
    """What an epoch's large error is made of."""
    used = np.flatnonzero(got.reason[t] == 0)
    observed, geometry = piece.observations, piece.geometry
    wrong = observed.code_m[t] - piece.clean_code_m[t] + piece.error_m[t]
    around = (geometry.azimuth_deg[t] - geometry.heading_deg[t] + 180.0) % 360.0 - 180.0
    return Breaking(
        passage=passage,
        epoch=before + t,
        error_m=float(found.error_m[t]),
        dilution=float(got.fix.constrained.dilution[t]),
        late=int(np.count_nonzero(np.abs(wrong[used] - np.quantile(wrong[used], 0.25)) > LATE_M)) if len(used) else 0,
        signals=" ".join(
            f"{observed.satellite[k]}({geometry.elevation_deg[t, k]:.0f},{around[k]:+.0f},"
            f"{observed.cn0_dbhz[t, k]:.0f}){wrong[k]:+.1f}"
            for k in used
        ),
    )


def joined(parts: Sequence[Any]) -> Any:
    """Pieces of one frozen table of arrays as a whole."""
    first = parts[0]
    values = {
        name: np.concatenate([getattr(p, name) for p in parts]) if isinstance(value, np.ndarray) else value
        for name, value in vars(first).items()
    }
    return type(first)(**values)


def together(campaigns: Sequence[Campaign]) -> Campaign:
    """Several runs as one."""
    breaking: dict[tuple[str, str], list[Breaking]] = {}
    found: dict[tuple[str, str], list[Found]] = {}
    passages: list[Passage] = []
    for one in campaigns:
        for key, items in one.breaking.items():
            breaking.setdefault(key, []).extend(replace(i, passage=i.passage + len(passages)) for i in items)
        for key, founds in one.found.items():
            found.setdefault(key, []).extend(founds)
        passages += one.passages
    return Campaign(passages=passages, found=found, breaking=breaking)


def in_ways(chainage_m: Floats, ways: Sequence[tuple[float, float]]) -> Masks:
    """Whether places lie in stretches of the line."""
    return np.any([(chainage_m >= low) & (chainage_m < high) for low, high in ways], axis=0)


def intervals_m(passage: Passage, found: Found, where: Masks) -> Floats:
    """Metres run from one position to the next, standing left out (figure 12), both positions in part of the epochs."""
    step = np.abs(np.diff(passage.chainage_m, prepend=passage.chainage_m[0]))
    moved = np.cumsum(np.where(passage.speed_mps > 0.3, step, 0.0))
    # what lies outside counts as a stretch of its own: no interval reaches over it
    stretch = np.cumsum(np.diff(where, prepend=where[0]))
    has = np.isfinite(found.error_m) & where
    apart = np.diff(moved[has])
    return np.asarray(apart[(apart > 0) & (np.diff(stretch[has]) == 0)])
