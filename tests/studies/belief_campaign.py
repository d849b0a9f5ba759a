"""Cold starts and faults: what the filter states against what is true.

``python tests/studies/belief_campaign.py`` runs the recordings beside the checkout; ``python
tests/studies/belief_campaign.py FOLDER ...`` runs cases of ``railfix benchmark``; shipped scenarios of the simulator by
their names (``city``, ``commercial-run``) at 1 Hz, with the sensors on board that they have. Every trial is the
pipeline with its defaults from a cold start; ``--mask`` changes the elevation mask, ``--set`` a setting of the filter,
``--thin N`` takes every N-th epoch of a log, as a receiver with a longer interval would have written it.

Whole recordings first (``--whole``), then a cold start every ``--every`` seconds, ``--length`` seconds each; with
``--faults`` instead faults of one satellite, one constellation, all Dopplers, all phases, a step of all codes, the map,
pairs, few satellites, and sensors on board where there are any, in windows ``--fault-every`` seconds apart; with
``--frequencies two`` of one satellite's second code too; with ``--pairs N`` of N pairs of satellites a window instead.
``--verbose`` lists the trials that fail.

On a wrong map the straight distance counts, against the level on the ground alone. Otherwise an epoch is *exceeded*
where its level is finite and the error is larger: by straight distance on the ground, and by chainage, where another
lap of the same road counts as wrong. *Sure and wrong* are epochs with the status `tracking` and an error of more than
four standard deviations.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from scipy.interpolate import make_interp_spline
from scipy.stats import binomtest

import paths
import recordings_score
import recordings_truth
import sensed_ride
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.core.reasons import Reason, Status
from railfix.core.settings_files import write_toml
from railfix.core.timescale import seconds
from railfix.evaluate import interpolate_reference, straight_distance
from railfix.evaluate.cases import read_case
from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.integrity.interference import InterferenceLimits, Suspicion
from railfix.io import read_navigation, read_observations
from railfix.io.reference_log import read_reference
from railfix.motion.samples import SensorSamples
from railfix.pipeline.along_track import on_line_m
from railfix.pipeline.config import parse_config
from railfix.pipeline.results import Result
from railfix.run.processor_setup import make_processor
from railfix.simulate.run import truth_table, vehicle_table
from railfix.simulate.scenario_file import list_scenarios, load_recipe
from railfix.track import Track, antenna_trajectory, read_track, read_vehicle
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line, Tracked, TrackStatus

#: Faults that no measurement of this receiver contradicts: codes, phases and Dopplers agree on another motion.
UNDETECTED: Final = ("pull 0.5 m/s, all", "pull 0.5 m/s, all, from the start")
#: Beginnings of the names of faults that never begin with the first epoch.
LATE_FAULTS: Final = ("Dopp", "phases", "step", "codes ", "late", "clock of", "clock +1")

#: Beyond this the vehicle's place is not where its speed allows: it is sought further on [m].
_OFF_M: Final = 10.0


@dataclass(frozen=True)
class Case:
    """A log, its navigation records, the line and the reference at every epoch of the log."""

    name: str
    observations: Observations
    navigation: Navigation
    trajectory: Trajectory
    reference_ecef_m: np.ndarray
    reference_arc_m: np.ndarray
    sensors: SensorSamples | None = None

    def part(self, first: int, end: int, step: int = 1) -> Case:
        """Some epochs of it, every `step`-th; what was lost between them is kept."""
        observations = self.observations[first:end]
        since = np.maximum(np.arange(0, len(observations.time), step) - step + 1, 0)
        lost = np.bitwise_or.reduceat(observations.loss_of_lock, since, axis=0)
        broken = np.logical_or.reduceat(observations.break_before, since)
        return replace(
            self,
            observations=replace(observations[::step], loss_of_lock=lost, break_before=broken),
            reference_ecef_m=self.reference_ecef_m[first:end:step],
            reference_arc_m=self.reference_arc_m[first:end:step],
        )


@dataclass(frozen=True)
class Judged:
    """What one trial stated and what was true, at the epochs with a reference."""

    time_s: np.ndarray
    status: np.ndarray
    probability: np.ndarray
    sigma_m: np.ndarray
    level_m: np.ndarray
    ground_level_m: np.ndarray
    straight_m: np.ndarray
    chainage_m: np.ndarray

    @property
    def bounded(self) -> np.ndarray:
        return np.isfinite(self.level_m)

    @property
    def over(self) -> np.ndarray:
        """Exceeded by straight distance: the level along the line, or that of the straight distance."""
        either = np.where(self.bounded, self.level_m, self.ground_level_m)
        return np.isfinite(either) & (self.straight_m > either)

    @property
    def over_ground(self) -> np.ndarray:
        return np.isfinite(self.ground_level_m) & (self.straight_m > self.ground_level_m)

    @property
    def over_chainage(self) -> np.ndarray:
        return self.bounded & (self.chainage_m > self.level_m)

    @property
    def tracking(self) -> np.ndarray:
        return self.status == TrackStatus.TRACKING

    @property
    def sure_and_wrong(self) -> np.ndarray:
        return self.tracking & (self.straight_m > 4.0 * self.sigma_m)


def joined(parts: list[Judged]) -> Judged:
    return Judged(*(np.concatenate([getattr(p, n) for p in parts]) for n in Judged.__dataclass_fields__))


def arc_of(reference: np.ndarray, time_s: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    """Arc length of the vehicle, lap by lap: the nearest place not far from that of the epoch before."""
    points, arc = np.asarray(trajectory.ecef_m), np.asarray(trajectory.arc_m)
    found = np.full(len(reference), np.nan)
    near, last = 0.0, time_s[0]
    for k, place in enumerate(reference):
        if not np.isfinite(place[0]):
            continue
        window = (arc >= near - 15.0) & (arc <= near + 15.0 + 25.0 * max(time_s[k] - last, 1.0))
        distance = np.linalg.norm(points - place, axis=1)
        if distance[window].min() > _OFF_M:
            window = arc >= near - 15.0
        index = np.flatnonzero(window)
        best = index[np.argmin(distance[index])]
        segment = min(best, len(arc) - 2)
        along = float((place - points[segment]) @ np.asarray(trajectory.tangent)[segment])
        near = found[k] = float(np.clip(arc[segment] + along, arc[0], arc[-1]))
        last = time_s[k]
    return found


def made(name: str, log: Path, nav: list[Path], truth: recordings_truth.Truth, trajectory: Trajectory | None) -> Case:
    """A case; without a line it is made from the reference."""
    time, ecef = truth
    trajectory = recordings_score.trajectory_of(time, ecef) if trajectory is None else trajectory
    observations = read_observations(log)
    reference = interpolate_reference(observations.time, time, ecef)
    # The vehicle's own lap and strand: followed through the whole reference, which may begin before the log.
    whole = arc_of(ecef, seconds(time - time[0]), trajectory)
    since = seconds(observations.time - time[0])
    arc = np.where(np.isfinite(reference[:, 0]), np.interp(since, seconds(time - time[0]), whole), np.nan)
    return Case(name, observations, read_navigation(nav), trajectory, reference, arc)


def simulated(name: str, seconds_at_most: float = 1800.0) -> Case:
    """A shipped scenario at 1 Hz: its front antenna and its sensors on board."""
    scenario = load_recipe(name).scenario().replaced(rate_hz=1.0)
    if scenario.epochs > seconds_at_most:
        scenario = scenario.replaced(duration_s=seconds_at_most)
    ride = sensed_ride.made(scenario)
    track = ride.simulation.line.track()
    with tempfile.TemporaryDirectory() as folder:
        write_toml(Path(folder) / "vehicle.toml", vehicle_table(scenario.vehicle))
        trajectory = antenna_trajectory(track, read_vehicle(Path(folder) / "vehicle.toml"), "front")
    truth = truth_table(ride.simulation).filter(pl.col("antenna") == "front")
    ecef = truth.select("x_m", "y_m", "z_m").to_numpy()
    arc = arc_of(ecef, seconds(ride.observations.time - ride.observations.time[0]), trajectory)
    sensors = ride.samples if any(len(rows) for rows in ride.samples.tables.values()) else None
    return Case(name, ride.observations, ride.simulation.navigation, trajectory, ecef, arc, sensors)


@dataclass(frozen=True)
class Recording:
    """Files of a recording beside the checkout, and what reads its reference."""

    log: Path
    nav: list[Path]
    truth: Callable[[], recordings_truth.Truth]


def recordings(data: Path) -> dict[str, Recording]:
    """Recordings beside the checkout by name."""
    road = data / "kinematic"
    tst, pixel, japan = road / "urbannav_tst", road / "gsdc_pixel5_a", next(iter(road.glob("japan_mosaic*")))
    berlin = road / "smartloc_berlin_rinex"
    nav, truth = [tst / "hksc137c.nav"], partial(recordings_truth.urbannav_truth, tst)
    return {
        "m8t": Recording(tst / "20210517.light-urban.tste.ublox.m8t.GC.obs", nav, truth),
        "f9p": Recording(tst / "20210517.light-urban.tste.ublox.f9p.obs", nav, truth),
        "pixel": Recording(
            pixel / "Pixel5_a.21o", [pixel / "hour1180.21n"], partial(recordings_truth.gsdc_truth, pixel)
        ),
        "japan": Recording(
            japan / "SEPT265G.21O", [japan / "SEPT2650.21P"], partial(recordings_truth.japan_truth, japan)
        ),
        "berlin": Recording(
            berlin / "Berlin_Potsdamer_Platz.obs.gz",
            [berlin / "brdc1580.16n.gz", berlin / "brdc1580.16g.gz"],
            partial(recordings_truth.smartloc_rinex_truth, berlin),
        ),
    }


def cases(data: Path) -> dict[str, Callable[[], Case]]:
    """Recordings beside the checkout by name, read when called."""
    return {name: partial(_read, name, files) for name, files in recordings(data).items()}


def _read(name: str, files: Recording) -> Case:
    return made(name, files.log, files.nav, files.truth(), None)


def case_of_folder(folder: Path) -> Case:
    """The case of the benchmark in a folder."""
    case = read_case(folder)
    reference = read_reference(case.truth, ["front"])["front"]
    trajectory = Trajectory.from_antenna_path(read_track(case.inputs.track))
    truth = (reference.time, reference.ecef_m)
    return made(folder.name, case.inputs.front[0], list(case.inputs.nav), truth, trajectory)


def run(case: Case, settings: dict[str, Any], *, first: int = 0) -> Judged:
    """Judge the pipeline on a case from a cold start, epochs from `first` on."""
    config = parse_config({"filter": "track", **settings})
    processor = make_processor(config, case.navigation, {"front": case.trajectory})
    sensors = case.sensors
    if sensors is not None:
        time = case.observations.time
        sensors = sensors.between(time[0] - np.timedelta64(1, "s"), time[-1])
    result, _ = processor.process({"front": case.observations}, sensors=sensors)
    return judged(case, result.fusion["front"].tracked, first)


def judged(case: Case, found: Tracked, first: int = 0) -> Judged:
    """Compare what was found with the reference."""
    place = on_line_m(found, case.trajectory)
    straight = straight_distance(place, case.reference_ecef_m, case.trajectory)
    arc = Line(case.trajectory).nearest_m(found.arc_m, case.reference_arc_m)
    chainage = np.abs(arc - case.reference_arc_m)
    known = np.isfinite(case.reference_ecef_m[:, 0])
    known[:first] = False
    # A place off the map has no straight distance: it is as wrong as its arc length.
    straight = np.where(np.isfinite(straight), straight, chainage)
    time = seconds(case.observations.time - case.observations.time[0])
    stated = (found.status, found.probability, found.sigma_m, found.level_m, found.ground_level_m)
    return Judged(*(np.asarray(column)[known] for column in (time, *stated, straight, chainage)))


def starts(case: Case, every_s: float, length_s: float) -> Iterator[tuple[float, Case]]:
    """Cold starts: seconds after the first epoch with a reference, and the part of the case."""
    t = seconds(case.observations.time - case.observations.time[0])
    known = np.flatnonzero(np.isfinite(case.reference_ecef_m[:, 0]))
    for begin in np.arange(t[known[0]], t[known[-1]] - 60.0, every_s):
        first, end = (int(k) for k in np.searchsorted(t, [begin, begin + length_s]))
        if end - first >= 30:
            yield float(begin), case.part(first, end)


@dataclass(frozen=True)
class Fault:
    """A fault as it is added to a case: what it changes a range by [m] and the rate of change [m/s], T epochs by M."""

    name: str
    code_m: np.ndarray
    phase_m: np.ndarray
    rate_mps: np.ndarray


def with_fault(case: Case, fault: Fault) -> Case:
    """A case with ranges, phases and range rates changed."""
    obs = case.observations
    channel = {**glonass_channels(case.navigation), **obs.header.glonass_channel}
    wavelength = SPEED_OF_LIGHT / carrier_frequency_hz(obs.satellite, obs.signal, channel)
    changed = replace(
        obs,
        code_m=obs.code_m + fault.code_m,
        phase_cycles=obs.phase_cycles + fault.phase_m / wavelength,
        doppler_hz=obs.doppler_hz - fault.rate_mps / wavelength,
    )
    return replace(case, observations=changed)


def moved(case: Case, metres: float) -> Case:
    """A case whose map lies so far to the right of the true line."""
    at = case.trajectory
    points = np.asarray(at.ecef_m)
    tangent = np.gradient(points, axis=0)
    up = points / np.linalg.norm(points, axis=1, keepdims=True)
    right = np.cross(tangent, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return on_line(case, points + metres * right)


def ended(case: Case, share: float = 0.6) -> Case:
    """A case whose line ends where the drive is after a share of its epochs; chainages go on beyond the end.

    Nothing is known where the drive comes back to it on another lap.
    """
    points, arc = np.asarray(case.trajectory.ecef_m), np.asarray(case.trajectory.arc_m)
    known = case.reference_arc_m[np.isfinite(case.reference_arc_m)]
    way = np.sign(known[-1] - known[0])
    ends = np.sort([known[0] - 100.0 * way, known[int(share * len(known))]])
    kept = (arc >= ends[0]) & (arc <= ends[1])
    if kept.sum() < 2:
        return case
    other = Trajectory.from_antenna_path(Track.from_ecef(points[kept]))
    at, aside = other.nearest(case.reference_ecef_m)
    arc_m = case.reference_arc_m - arc[kept][0]
    lap = (aside < 30.0) & (np.abs(at - arc_m) > 30.0)
    return replace(
        case,
        trajectory=other,
        reference_arc_m=arc_m,
        reference_ecef_m=np.where(lap[:, None], np.nan, case.reference_ecef_m),
    )


def beside(case: Case, apart_m: float, *, loop_m: float = 15.0) -> Case:
    """The longest part without a second pass within 40 m, on a line that turns in a loop and returns on a lane beside.

    The lane is so far to the left; the reference is on the way there. A distance of 0: the part alone.
    """
    t, arc = seconds(case.observations.time - case.observations.time[0]), case.reference_arc_m
    known = np.flatnonzero(np.isfinite(arc))
    place, first, ends = case.reference_ecef_m, 0, (0, 0)
    for k, row in enumerate(known):
        before = known[first:k]
        again = (np.abs(arc[before] - arc[row]) > 100.0) & (np.linalg.norm(place[before] - place[row], axis=1) < 40.0)
        first += int(np.flatnonzero(again)[-1]) + 1 if again.any() else 0
        ends = max(ends, (first, k), key=lambda pair: t[known[pair[1]]] - t[known[pair[0]]])
    part = case.part(int(known[ends[0]]), int(known[ends[1]]) + 1)
    kept = (
        np.abs(np.asarray(case.trajectory.arc_m) - arc[known[[*ends]]].mean()) < np.ptp(arc[known[[*ends]]]) / 2 + 20.0
    )
    there = np.asarray(case.trajectory.ecef_m)[kept]
    ahead = np.gradient(there, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    left = np.cross(there, ahead)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    back = there + apart_m * left
    # on the inside of bends the points of the lane would turn back
    back = back[np.insert((np.diff(back, axis=0) * ahead[1:]).sum(axis=1) > 1.0, 0, values=True)][::-1]
    bulge = np.arccos((apart_m / 2.0 + loop_m) / (2.0 * loop_m))
    turn = np.linspace(-np.pi / 2.0 - bulge, np.pi / 2.0 + bulge, 30)[:, None]
    centre = there[-1] + 2.0 * loop_m * np.sin(bulge) * ahead[-1] + apart_m / 2.0 * left[-1]
    loop = centre + loop_m * (np.cos(turn) * ahead[-1] + np.sin(turn) * left[-1])
    line = Trajectory.from_antenna_path(Track.from_ecef(np.concatenate([there, loop, back] if apart_m else [there])))
    since = seconds(part.observations.time - part.observations.time[0])
    return replace(part, trajectory=line, reference_arc_m=arc_of(part.reference_ecef_m, since, line))


def roughened(case: Case, metres: float, length_m: float = 80.0, *, seed: int = 0) -> Case:
    """A case whose map wanders across and up by so much over such a length, and says so."""
    at, random = case.trajectory, np.random.default_rng(seed)
    points, arc = np.asarray(at.ecef_m), np.asarray(at.arc_m)
    knots = np.arange(0.0, arc[-1] + 2.0 * length_m, length_m)
    right, up = (make_interp_spline(knots, random.normal(0.0, metres, len(knots)))(arc) for _ in range(2))
    above = points / np.linalg.norm(points, axis=1, keepdims=True)
    across = np.cross(np.gradient(points, axis=0), above)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return on_line(case, points + right[:, None] * across + up[:, None] * above, sigma_m=metres)


def stretched(case: Case, share: float) -> Case:
    """A case whose map is too long by a share, right where the run begins."""
    points = np.asarray(case.trajectory.ecef_m)
    known = np.flatnonzero(np.isfinite(case.reference_ecef_m[:, 0]))
    centre = case.reference_ecef_m[known[0]]
    return on_line(case, centre + (1.0 + share) * (points - centre))


def on_line(case: Case, ecef_m: np.ndarray, *, sigma_m: float | None = None) -> Case:
    """The case on another line with the same vertices; with an accuracy of its own, or that of a survey."""
    stated = {} if sigma_m is None else {"sigma_plan_m": sigma_m, "sigma_height_m": sigma_m}
    other = Trajectory.from_antenna_path(Track.from_ecef(ecef_m, **stated))
    arc = np.interp(case.reference_arc_m, np.asarray(case.trajectory.arc_m), np.asarray(other.arc_m))
    return replace(case, trajectory=other, reference_arc_m=np.where(np.isfinite(case.reference_arc_m), arc, np.nan))


def sights(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Change of each range by a metre along the line at the reference, shape (T, M), and by a tilted ionosphere.

    The tilt is ``cot(elevation)`` times cosine and sine of the azimuth over ``cot(20 deg)``, no more than 1, shape
    (T, M, 2): a metre on a satellite at 20 deg in the north, or in the east. 0 where unknown. Tilts turn with the sky,
    those along the line with the train.
    """
    processor = make_processor(parse_config({"filter": "off"}), case.navigation, {"front": case.trajectory})
    found = processor.process({"front": case.observations})[0].antennas["front"]
    known = np.isfinite(case.reference_arc_m)
    arc = np.where(known, case.reference_arc_m, 0.0)
    tangent = Line(case.trajectory).at(arc)[1][:, 0]
    sat = found.corrected.satellites.position_ecef_m
    sight = sat - np.where(known[:, None], case.reference_ecef_m, 0.0)[:, None, :]
    sight /= np.linalg.norm(sight, axis=2, keepdims=True)
    along = np.zeros(case.observations.code_m.shape)
    tilt = np.zeros((*along.shape, 2))
    elevation, azimuth = np.radians(found.elevation_deg), np.radians(found.azimuth_deg)
    slope = np.fmin(np.tan(np.radians(20.0)) / np.tan(np.fmax(elevation, 0.01)), 1.0)
    of_channel = np.nan_to_num(slope[..., None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=2))
    # Every signal of a satellite has the sight of its channel that the pipeline used.
    names = case.observations.satellite
    for k, column in enumerate(found.columns):
        change = np.where(known & np.isfinite(sat[:, k, 0]), -(sight[:, k] * tangent).sum(axis=1), 0.0)
        along[:, names == names[column]] = change[:, None]
        tilt[:, names == names[column]] = of_channel[:, column, None]
    return along, tilt


def faults(case: Case, along: np.ndarray, random: np.random.Generator) -> Iterator[tuple[str, Case]]:
    """Every kind of fault once, of random satellites and sizes; from the first epoch or from 45 s on."""
    obs = case.observations
    t = seconds(obs.time - obs.time[0])
    nothing = np.zeros(obs.code_m.shape)
    names = np.unique(obs.satellite[np.isfinite(obs.code_m).sum(axis=0) > 0.5 * len(t)])
    if not len(names):
        return

    def of(*satellites: str) -> np.ndarray:
        return np.isin(obs.satellite, satellites)[None, :]

    def since(start: float) -> np.ndarray:
        return np.maximum(t - start, 0.0)[:, None], (t >= start)[:, None]

    one, other = (str(x) for x in random.choice(names, 2, replace=len(names) < 2))
    seen = np.abs(along).max(axis=0) > 0.0
    letters = sorted({str(name)[0] for name in obs.satellite[seen]})
    letter = str(random.choice(letters))
    start = 45.0 if random.random() < 0.6 else 0.0
    after, on = since(start)
    listed: list[tuple[str, np.ndarray, np.ndarray, np.ndarray]] = []
    for size in (20.0, -50.0, 100.0):
        listed.append((f"code {size:+.0f} m", size * (of(one) & on), nothing, nothing))
    for rate in (0.1, 1.0):
        listed.append((f"code {rate:g} m/s", rate * after * of(one), nothing, nothing))
    whole = -100.0 * (of(one) & on)
    listed.append(("clock -100 m", whole, whole, nothing))
    for rate in (-1.0, 0.5):
        drift = rate * after * of(one)
        listed.append((f"clock {rate:g} m/s", drift, drift, rate * (of(one) & on)))
    if len(letters) > 1:
        own = np.char.startswith(obs.satellite.astype(str), letter)[None, :]
        tilt = np.where(own & on, 30.0 * along, 0.0)
        listed.append(("constellation 30 m along", tilt, nothing, nothing))
        pull = np.where(own, along, 0.0)
        listed.append(("constellation 0.5 m/s along, all", *(x * pull for x in (0.5 * after, 0.5 * after, 0.5 * on))))
    _, short = since(45.0)
    short = short & (t < 65.0)[:, None]
    listed.append(("Dopplers +5 m/s", nothing, nothing, 5.0 * along * short))
    listed.append(("Dopplers common +5 m/s", nothing, nothing, 5.0 * short))
    slide = np.clip(t - 45.0, 0.0, 20.0)[:, None]
    listed.append(("phases +2 m/s", nothing, 2.0 * along * slide, nothing))
    listed.append(("step of all codes 30 m", 30.0 * along * (t >= 45.0)[:, None], nothing, nothing))
    listed.append(("pull 0.5 m/s, all", *(x * along for x in (0.5 * after, 0.5 * after, 0.5 * on))))
    listed.extend(shared_faults(along, t, seed=len(t) + int(start)))
    pair = of(one, other)
    listed.append(("pair +30 m", 30.0 * (pair & on), nothing, nothing))
    listed.append(("pair +20, -20 m", 20.0 * ((of(one) & on).astype(float) - (of(other) & on)), nothing, nothing))
    for name, code, phase, rate in listed:
        label = name if start or name.startswith(LATE_FAULTS) else f"{name}, from the start"
        yield label, with_fault(case, Fault(name, code, phase, rate))
    few = [str(x) for x in random.choice(names, min(3, len(names)), replace=False)]
    for count in (3, 2):
        left = {
            f: np.where(of(*few[:count]), getattr(obs, f), np.nan) for f in ("code_m", "phase_cycles", "doppler_hz")
        }
        full = t[:, None] < 45.0
        some = {name: np.where(full, getattr(obs, name), values) for name, values in left.items()}
        yield f"{count} satellites", replace(case, observations=replace(obs, **left))
        yield f"{count} satellites after 45 s", replace(case, observations=replace(obs, **some))
    gps = np.char.startswith(obs.satellite.astype(str), "G")[None, :]
    alone = {f: np.where(gps, getattr(obs, f), np.nan) for f in ("code_m", "phase_cycles", "doppler_hz")}
    own = np.random.default_rng(len(t) + int(start)).permutation(names[np.char.startswith(names.astype(str), "G")])
    for name in own[:2].tolist():
        drift = after * of(name)
        faulty = with_fault(replace(case, observations=replace(obs, **alone)), Fault("", drift, drift, of(name) & on))
        yield "clock 1 m/s, GPS alone", faulty
    if case.sensors is not None:
        yield from sensor_faults(case, case.sensors)
    up = np.asarray(case.trajectory.ecef_m) / np.linalg.norm(case.trajectory.ecef_m, axis=1, keepdims=True)
    for metres in (40.0, -40.0):
        yield f"map {metres:+g} m in height", on_line(case, np.asarray(case.trajectory.ecef_m) + metres * up)
    yield "map 20 m to the right", moved(case, 20.0)
    yield "map 20 m to the left", moved(case, -20.0)
    yield "map 5 m to the right", moved(case, 5.0)
    north = enu_axes(*geodetic_from_ecef(case.trajectory.ecef_m[0])[:2])[1]
    yield "map 10 m to the north", on_line(case, np.asarray(case.trajectory.ecef_m) + 10.0 * north)
    yield "line that ends under way", ended(case)
    yield "map 2 % long", stretched(case, 0.02)
    yield "map wandering by 2 m, stated", roughened(case, 2.0)


def shared_faults(along: np.ndarray, t: np.ndarray, *, seed: int) -> Iterator[tuple[str, *tuple[np.ndarray, ...]]]:
    """Faults that several satellites share, from 45 s on or for the minute after: name, code, phase, range rate."""
    random, nothing = np.random.default_rng(seed), np.zeros(along.shape)
    minute = ((t >= 45.0) & (t < 105.0))[:, None]
    for side, there in (("ahead", along < -0.2), ("behind", along > 0.2)):
        for size in (15.0, 25.0):
            yield f"codes {side} {size:+.0f} m", size * (there & minute), nothing, nothing
    late = np.where(random.random(along.shape[1]) < 0.4, random.exponential(15.0, along.shape[1]), 0.0)
    yield "late codes of 40 %", late * minute, nothing, nothing
    slips = np.cumsum(random.choice([-1.0, 0.0, 0.0, 0.0, 1.0], along.shape), axis=0)
    yield "slips unflagged on a third", nothing, slips * (random.random(along.shape[1]) < 0.33), nothing
    step = 1e-3 * SPEED_OF_LIGHT * (t >= 45.0)[:, None] * np.ones(along.shape)
    yield "clock of the codes +1 ms", step, nothing, nothing
    yield "clock +1 ms", step, step, nothing


def second_faults(case: Case, random: np.random.Generator) -> Iterator[tuple[str, Case]]:
    """Faults of one satellite's codes below L1 alone: with one frequency nothing of them is used."""
    obs = case.observations
    t, nothing = seconds(obs.time - obs.time[0])[:, None], np.zeros(obs.code_m.shape)
    below = ~np.char.startswith(obs.signal, "1") & ~np.isin(np.char.add(obs.system, obs.signal), ["C2I", "C2X"])
    seen = below & (np.isfinite(obs.code_m).mean(axis=0) > 0.5)
    if not seen.any():
        return
    mine = (below & (obs.satellite == random.choice(np.unique(obs.satellite[seen]))))[None, :]
    minute = (t >= 45.0) & (t < 105.0)
    for size in (20.0, -50.0, 100.0):
        yield f"second code {size:+.0f} m, 60 s", with_fault(case, Fault("", size * (mine & minute), nothing, nothing))
    for size in (6.0, 20.0, -20.0):
        label = f"second code {size:+.0f} m, from the start"
        yield label, with_fault(case, Fault(label, size * mine.repeat(len(t), 0), nothing, nothing))
    drift = 0.1 * np.maximum(t - 30.0, 0.0) * mine
    yield "second code 0.1 m/s", with_fault(case, Fault("", drift, nothing, nothing))


def pair_faults(case: Case, along: np.ndarray, random: np.random.Generator, pairs: int) -> Iterator[tuple[str, Case]]:
    """Two random satellites faulty at a time, from the first epoch or from 45 s on."""
    obs = case.observations
    t = seconds(obs.time - obs.time[0])
    names = np.unique(obs.satellite[np.isfinite(obs.code_m).sum(axis=0) > 0.5 * len(t)])
    nothing = np.zeros(obs.code_m.shape)
    for _ in range(pairs if len(names) > 1 else 0):
        one, other = ((obs.satellite == name)[None, :] for name in random.choice(names, 2, replace=False))
        start = 45.0 if random.random() < 0.5 else 0.0
        after, on = np.maximum(t - start, 0.0)[:, None], (t >= start)[:, None]
        both, apart = on & (one | other), on * (one.astype(float) - other)
        tilt = np.where(both, np.sign(along), 0.0)
        for size in (20.0, 40.0):
            yield f"pair late by {size:.0f} m", with_fault(case, Fault("", size * both, nothing, nothing))
            yield f"pair +{size:.0f}, -{size:.0f} m", with_fault(case, Fault("", size * apart, nothing, nothing))
        yield "pair's clocks 30 m along", with_fault(case, Fault("", 30.0 * tilt, 30.0 * tilt, nothing))
        for name, rate in (("0.5 m/s", 0.5 * both), ("+0.5, -0.5 m/s", 0.5 * apart)):
            yield f"pair's clocks {name}", with_fault(case, Fault("", after * rate, after * rate, rate))


def sensor_faults(case: Case, sensors: SensorSamples) -> Iterator[tuple[str, Case]]:
    """Every sensor that there is, wrong from 45 s on."""
    start = case.observations.time[0] + np.timedelta64(45, "s")
    pulses, unit, radar = sensors.tachometer, sensors.inertial, sensors.radar
    if len(pulses):
        slip = (pulses.time > start) & (pulses.time <= start + np.timedelta64(20, "s"))
        for share in (0.05, 0.3):
            # a slipping wheel turns too fast: pulses more than there are, numbered on
            number = pulses.pulse + np.round(share * np.cumsum(slip)).astype(np.int64)
            wrong = replace(sensors, tachometer=replace(pulses, pulse=number))
            yield f"wheel slips by {100 * share:.0f} % for 20 s", replace(case, sensors=wrong)
        kept = ~slip
        locked = {f.name: getattr(pulses, f.name)[kept] for f in fields(pulses)}
        locked["pulse"] = locked["pulse"] - np.where(locked["time"] > start, slip.sum(), 0)
        yield "wheel locked for 20 s", replace(case, sensors=replace(sensors, tachometer=replace(pulses, **locked)))
    if len(unit):
        force = unit.force_mps2 + np.where(unit.time > start, 0.3, 0.0)[:, None] * np.array([1.0, 0.0, 0.0])
        yield "force +0.3 m/s2", replace(case, sensors=replace(sensors, inertial=replace(unit, force_mps2=force)))
    if len(radar):
        speed = radar.speed_mps + np.where(radar.time > start, 1.0, 0.0)
        yield "radar +1 m/s", replace(case, sensors=replace(sensors, radar=replace(radar, speed_mps=speed)))


def whole_faults(
    case: Case, along: np.ndarray, tilt: np.ndarray, random: np.random.Generator
) -> Iterator[tuple[str, str, Case]]:
    """Faults that cover a whole trial: name, the cause that has to be named ("" where none need be), and the case."""
    obs = case.observations
    t, nothing = seconds(obs.time - obs.time[0]), np.zeros(obs.code_m.shape)
    yield "nothing", "nothing", case
    for late in (1.0, -1.0, 18.0, -18.0):
        yield f"tags {late:+g} s", "time tags", on_tags(case, np.full(len(t), late))
    yield "tags +10 ms/s", "time tags", on_tags(case, 0.01 * t)
    letter = obs.satellite.astype("<U1")
    # of constellations with records alone: the others are not used
    letters = sorted(set(letter[np.abs(along).max(axis=0) > 0.0].tolist()))
    wavelength = SPEED_OF_LIGHT / carrier_frequency_hz(
        obs.satellite, obs.signal, {**glonass_channels(case.navigation), **obs.header.glonass_channel}
    )
    own = letter == str(random.choice(letters))
    for name, field_, factor in (
        ("Dopplers flipped", "doppler_hz", np.full(len(letter), -1.0)),
        ("Dopplers of one constellation flipped", "doppler_hz", np.where(own, -1.0, 1.0)),
        ("Dopplers in m/s", "doppler_hz", wavelength),
        ("phases flipped", "phase_cycles", np.full(len(letter), -1.0)),
        ("phases in metres", "phase_cycles", wavelength),
    ):
        values = getattr(obs, field_) * factor
        if np.isfinite(values[:, np.abs(along).max(axis=0) > 0.0]).any():
            yield name, "observable", replace(case, observations=replace(obs, **{field_: values}))
    seen = (np.isfinite(obs.code_m) & (np.abs(along) > 0.0)).mean(axis=0) > 0.8
    names = np.unique(obs.satellite[seen])
    for count in (1, 2, 3):
        if len(names) >= 4 + count:
            wrong = np.isin(obs.satellite, random.choice(names, count, replace=False))[None, :]
            for size in (200.0, 1000.0, 300000.0):
                fault = Fault("", size * wrong.repeat(len(t), 0), nothing, nothing)
                yield f"{count} codes +{size / 1e3:g} km", "satellite", with_fault(case, fault)
    step = SPEED_OF_LIGHT * 1e-3 * (t >= 45.0)[:, None] * np.ones(obs.code_m.shape)
    yield "clock +1 ms", "nothing", with_fault(case, Fault("", step, step, nothing))
    yield "no C/N0", "nothing", replace(case, observations=replace(obs, cn0_dbhz=np.full(obs.cn0_dbhz.shape, np.nan)))
    yield "one epoch in 5 s", "nothing", case.part(0, len(t), 5)
    if len(letters) > 1:
        lost = ((letter != letters[-1])[None, :]) & (t >= 45.0)[:, None]
        gone = {f: np.where(lost, np.nan, getattr(obs, f)) for f in ("code_m", "phase_cycles", "doppler_hz")}
        yield "all but one constellation lost", "nothing", replace(case, observations=replace(obs, **gone))
    steep = np.where(np.abs(along) > 0.0, along, 0.0)
    for size in (8.0, 11.0):
        fault = Fault("", size * steep, -size * steep, nothing)
        yield f"ionosphere tilted by {size:g} m along the line", "", with_fault(case, fault)
    for axis, side in enumerate(("north", "east")):
        delay = 11.0 * tilt[..., axis]
        yield f"ionosphere tilted by 11 m to the {side}", "", with_fault(case, Fault("", delay, -delay, nothing))
    late = 15.0 * (random.random(len(letter)) < 0.5)[None, :].repeat(len(t), 0)
    yield "half of the sky 15 m late", "", with_fault(case, Fault("", late, nothing, nothing))
    step = 500.0 * (t >= 45.0)[:, None] * np.ones(obs.code_m.shape)
    yield "codes +500 m, all", "spoofing", with_fault(case, Fault("", step, nothing, nothing))
    short = ended(case)
    away = short.trajectory.nearest(case.reference_ecef_m)[1] > InterferenceLimits().off_map_m
    left = len(np.unique(np.floor(t[away]))) > 10
    yield "off the map" if left else "a map that ends", "off the map" if left else "", short
    up = np.asarray(case.trajectory.ecef_m) / np.linalg.norm(case.trajectory.ecef_m, axis=1, keepdims=True)
    yield "map 100 m too high", "", on_line(case, np.asarray(case.trajectory.ecef_m) + 100.0 * up)
    fall = np.where(t >= 45.0, 8.0, 0.0)[:, None]
    yield "C/N0 8 dB lower", "", replace(case, observations=replace(obs, cn0_dbhz=obs.cn0_dbhz - fall))


def on_tags(case: Case, late_s: np.ndarray) -> Case:
    """A case whose time tags are so late."""
    time = case.observations.time + np.round(late_s * 1e9).astype("timedelta64[ns]")
    return replace(case, observations=replace(case.observations, time=time))


def named_cause(result: Result) -> str:
    """The cause that a run names, in the order in which it decides."""
    found, filtered = result.antennas["front"], result.fusion["front"].tracked.status
    if any("they are not used" in note for note in result.notes):
        return "observable"
    kinds = [] if found.interference is None else found.interference.suspicion.tolist()
    for kind, cause in ((Suspicion.TIME_TAGS, "time tags"), (Suspicion.SPOOFING_SUSPECTED, "spoofing")):
        if kinds.count(kind) > 3:
            return cause
    if kinds.count(Suspicion.JAMMING_SUSPECTED) > 3:
        return "jamming"
    away = (found.status == Status.OFF_MAP) | np.isin(filtered, (TrackStatus.OFF_MAP, TrackStatus.LOST))
    if kinds.count(Suspicion.LEFT_MAP) > 3 or away.sum() > 10:
        return "off the map"
    wrong = (found.reason & int(Reason.GROSS_ERROR | Reason.LASTING_ERROR | Reason.NO_EPHEMERIS)) != 0
    if (wrong & np.isfinite(found.elevation_deg)).mean(axis=0).max() > 0.3:
        return "satellite"
    return "map" if (filtered == TrackStatus.MAP_OFFSET).sum() > 10 else "nothing"


#: Causes put in, or named, in the order in which they are decided.
CAUSES: Final = ("nothing", "time tags", "observable", "satellite", "spoofing", "jamming", "off the map", "map")


def show_matrix(counts: Counter[tuple[str, str]]) -> None:
    """Print how often each cause that was put in was named as each."""
    print(f"\n| put in | {' | '.join(CAUSES)} |\n|---|{'---:|' * len(CAUSES)}")
    for cause in CAUSES:
        if any(counts[cause, named] for named in CAUSES):
            print(f"| {cause} | {' | '.join(str(counts[cause, named] or '') for named in CAUSES)} |")
    right, total = sum(counts[cause, cause] for cause in CAUSES), counts.total()
    print(f"\n{right} of {total} causes named right, {100 * right / max(total, 1):.1f} %")


def show_causes(case: Case, args: argparse.Namespace) -> Counter[tuple[str, str]]:
    """Print the causes named and what went over its level by kind of fault; return how often each was named as each."""
    random = np.random.default_rng(args.seed)
    config = parse_config({"filter": "track", "elevation": {"mask_deg": args.mask[0]}, **args.settings})
    along, tilt = sights(case)
    rows: dict[tuple[str, str], list[tuple[str, Judged]]] = {}
    t = seconds(case.observations.time - case.observations.time[0])
    known = np.flatnonzero(np.isfinite(case.reference_ecef_m[:, 0]))
    for begin in np.arange(t[known[0]], t[known[-1]] - 90.0, args.fault_every):
        first, end = (int(k) for k in np.searchsorted(t, [begin, begin + args.length]))
        for label, cause, faulty in whole_faults(case.part(first, end), along[first:end], tilt[first:end], random):
            if args.only not in label:
                continue
            processor = make_processor(config, faulty.navigation, {"front": faulty.trajectory})
            result, _ = processor.process({"front": faulty.observations})
            trial = judged(faulty, result.fusion["front"].tracked)
            cause_named, bad = named_cause(result), over(label, trial) & trial.tracking
            if args.verbose and (bad.any() or (cause and cause != cause_named)):
                text = first_of(trial, bad) if bad.any() else "none over its level"
                print(f"    start {begin:.0f} s, {label}: named {cause_named}, {text}", flush=True)
            rows.setdefault((label, cause), []).append((cause_named, trial))
    print(
        f"| {case.name}: put in | has to be named | trials | named | tracking % | over, on the ground, sure and wrong |"
        " median level on the ground |"
    )
    print("|---|---|---:|---|---:|---|---:|")
    counts: Counter[tuple[str, str]] = Counter()
    for (label, cause), found in rows.items():
        named = Counter(name for name, _ in found)
        trial = joined([each for _, each in found])
        counts.update({(cause, name): count for name, count in named.items() if cause})
        print(
            f"| {label} | {cause or '-'} | {len(found)} | {', '.join(f'{n} {c}' for n, c in named.most_common())} | "
            f"{100 * trial.tracking.mean():.0f} | {int((trial.over | trial.over_chainage).sum())}, "
            f"{int(trial.over_ground.sum())}, {int(trial.sure_and_wrong.sum())} | "
            f"{np.nanmedian(trial.ground_level_m):.1f} |"
        )
    right = sum(count for (cause, name), count in counts.items() if cause == name)
    print(f"{case.name}: {right} of {counts.total()} causes named right", flush=True)
    return counts


#: Sizes of the errors of codes [m]; 0: without these codes. From the index on all are gross errors.
OUTLIERS_M: Final = (0.0, 30.0, 100.0, 300.0, 1e3, 3e3, 3e4, 3e5)
GROSS: Final = 3


def show_outliers(case: Case, args: argparse.Namespace) -> None:
    """Print availability and errors by the size of the errors of one, two and three codes, as means over windows.

    Also the numbers of windows in which a larger gross error lowers a share by more than 5 %, or raises an error by
    more than 3 m and 20 %.
    """
    random, along = np.random.default_rng(args.seed), sights(case)[0]
    config = parse_config({"filter": "track", "elevation": {"mask_deg": args.mask[0]}, **args.settings})
    found: dict[tuple[int, float], list[tuple[float, ...]]] = {}
    for _, part in starts(case, args.fault_every, args.length):
        obs, nothing = part.observations, np.zeros(part.observations.code_m.shape)
        seen = (np.isfinite(obs.code_m) & (np.abs(along).max(axis=0) > 0.0)).mean(axis=0) > 0.8
        names = np.unique(obs.satellite[seen])
        for count in (k for k in (1, 2, 3) if len(names) >= 4 + k):
            wrong = np.isin(obs.satellite, random.choice(names, count, replace=False))
            for size in OUTLIERS_M:
                fault = Fault("", np.where(wrong, size or np.nan, 0.0) + nothing, nothing, nothing)
                faulty = with_fault(part, fault)
                processor = make_processor(config, faulty.navigation, {"front": faulty.trajectory})
                result, _ = processor.process({"front": faulty.observations})
                trial, single = judged(faulty, result.fusion["front"].tracked), result.antennas["front"]
                error = straight_distance(single.arc_m, faulty.reference_ecef_m, faulty.trajectory)
                shares = np.isfinite(trial.ground_level_m), trial.tracking, single.status <= Status.AMBIGUOUS
                errors = np.nanpercentile(trial.straight_m, 95), np.nanpercentile(error, 95)
                bad = int((over("", trial) | trial.over_ground).sum())
                found.setdefault((count, size), []).append((*(100 * s.mean() for s in shares), *errors, bad))
    print(f"| {case.name}: codes, off by | ground level, tracking, ok or ambiguous % | p95 filter, single m | over |")
    print("|---|---|---|---:|")
    for (count, size), rows in found.items():
        ground, tracking, ok, filtered, alone, _ = np.mean(rows, axis=0)
        text = f"{size:g} m" if size else "left out"
        exceeded = int(sum(row[-1] for row in rows))
        print(
            f"| {count}, {text} | {ground:.0f}, {tracking:.0f}, {ok:.0f} | {filtered:.1f}, {alone:.1f} | {exceeded} |",
            flush=True,
        )
    for count in sorted({count for count, _ in found}):
        values = np.array([found[count, size] for size in OUTLIERS_M[GROSS:]])
        best, least = np.maximum.accumulate(values), np.fmin.accumulate(values)
        lower, larger = best - values > 5.0, values - least > np.fmax(3.0, 0.2 * least)
        worse = np.concatenate([lower[..., :3], larger[..., 3:5]], axis=2).any(axis=0).sum(axis=0)
        print(f"{case.name}: {count}, {values.shape[1]} windows, a larger gross error is worse: {worse.tolist()}")


def over(label: str, found: Judged) -> np.ndarray:
    """Epochs over their level; on a wrong map, whose chainage is not defined, that on the ground."""
    return found.over_ground if label.startswith("map") else found.over | found.over_chainage


def first_of(found: Judged, bad: np.ndarray) -> str:
    """The first epoch of some, in words."""
    k = int(np.flatnonzero(bad)[0])
    return (
        f"{int(bad.sum())} epochs, first at {found.time_s[k]:.0f} s: error {found.straight_m[k]:.1f} m "
        f"({found.chainage_m[k]:.0f} m by chainage), sigma {found.sigma_m[k]:.1f} m, level {found.level_m[k]:.1f} m, "
        f"on the ground {found.ground_level_m[k]:.1f} m, probability {found.probability[k]:.4f}; largest error "
        f"{np.nanmax(found.straight_m):.0f} m"
    )


def show_faults(case: Case, args: argparse.Namespace) -> None:
    """Print faults by kind: trials, epochs over the level and trials with any, availability, errors."""
    random = np.random.default_rng(args.seed)
    settings = {"elevation": {"mask_deg": args.mask[0]}, **args.settings}
    along, _ = sights(case)
    found: dict[str, list[Judged]] = {}
    t = seconds(case.observations.time - case.observations.time[0])
    known = np.flatnonzero(np.isfinite(case.reference_ecef_m[:, 0]))
    for begin in np.arange(t[known[0]], t[known[-1]] - 90.0, args.fault_every):
        first, end = (int(k) for k in np.searchsorted(t, [begin, begin + args.length]))
        part = case.part(first, end)
        listed = faults(part, along[first:end], random)
        if args.settings.get("frequencies") == "two":
            listed = chain(listed, second_faults(part, random))
        listed = pair_faults(part, along[first:end], random, args.pairs) if args.pairs else listed
        for label, faulty in listed:
            if args.only not in label:
                continue
            trial = run(faulty, settings)
            bad = over(label, trial)
            if args.verbose and bad.any():
                print(f"    start {begin:.0f} s, {label}: {first_of(trial, bad)}", flush=True)
            found.setdefault(label, []).append(trial)
    print(f"| {case.name}: fault | trials | epochs over the level | level, on the ground, % | p95, largest error |")
    print("|---|---:|---:|---|---|")
    total = 0
    for label, parts in found.items():
        whole, failed = joined(parts), sum(bool(over(label, part).any()) for part in parts)
        count = int(over(label, whole).sum())
        total += count if label not in UNDETECTED else 0
        error = whole.straight_m[np.isfinite(whole.straight_m)]
        size = f"{np.percentile(error, 95):.1f}, {error.max():.0f}" if len(error) else "no place"
        print(
            f"| {label} | {len(parts)} | {count} in {failed} | {100 * whole.bounded.mean():.0f}, "
            f"{100 * np.isfinite(whole.ground_level_m).mean():.0f} | {size} |"
        )
    print(f"{case.name}: {sum(map(len, found.values()))} faults, {total} epochs over their level", flush=True)


def counts(label: str, found: Judged, *, trials: int, failed: int) -> str:
    """Return a row of the table of cold starts."""
    tracking, on_ground = found.tracking, np.isfinite(found.ground_level_m)
    error = found.straight_m[np.isfinite(found.straight_m)]
    ratio = (found.straight_m / found.sigma_m)[np.isfinite(found.straight_m)]
    medians = [
        f"{100 * (level <= 20.0).mean():.0f}, {100 * (level <= 50.0).mean():.0f} % {np.median(level[mask]):.1f} m"
        if mask.any()
        else "none"
        for mask, level in ((found.bounded, found.level_m), (on_ground, found.ground_level_m))
    ]
    return (
        f"| {label} | {trials} | {len(found.status)} | {100 * tracking.mean():.0f} | {medians[0]} | {medians[1]} | "
        f"{int(found.over.sum())} | {int(found.over_chainage.sum())} | {failed} | "
        f"{100 * found.sure_and_wrong.sum() / max(int(tracking.sum()), 1):.2f} | "
        f"{np.median(error):.2f} / {np.percentile(error, 95):.2f} / {error.max():.1f} | "
        f"{np.percentile(ratio, 95):.2f} |"
    )


HEAD: Final = (
    "| recording, mask | trials | epochs | tracking % | level within 20, 50 m | on the ground | over | chainage | "
    "trials with any | sure and wrong % | p50 / p95 / largest | error over sigma p95 |\n"
    "|---|---:|---:|---:|---|---|---:|---:|---:|---:|---|---:|"
)


FIRST_HEAD: Final = (
    "| recording, mask | starts | first level on the ground: within 60, 150 s, median | the same along the line |"
)


def calibration(found: Judged) -> list[str]:
    """Return the stated probability of the branch against the share that is right by chainage."""
    right = found.chainage_m < np.fmax(10.0, 4.0 * found.sigma_m)
    lines = []
    for low, high in ((0.0, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 0.999), (0.999, 1.1)):
        mine = (found.probability >= low) & (found.probability < high) & np.isfinite(found.chainage_m)
        if mine.any():
            count, hits = int(mine.sum()), int(right[mine].sum())
            least, most = binomtest(hits, count).proportion_ci(method="exact")
            lines.append(
                f"    stated {low:.3f} to {min(high, 1.0):.3f}: right {hits} of {count}, {hits / count:.4f} "
                f"({least:.4f} to {most:.4f})"
            )
    return lines


def first_levels(label: str, parts: list[Judged]) -> str:
    """Return a row on when cold starts get their first level, on the ground and along the line."""
    row = f"| {label} | {len(parts)} |"
    for name in ("ground_level_m", "level_m"):
        after = [part.time_s[np.isfinite(getattr(part, name))][:1] - part.time_s[0] for part in parts]
        first = np.concatenate(after) if after else np.empty(0)
        median = f"{np.median(first):.0f} s" if len(first) else "never"
        shares = [100.0 * (first <= limit_s).sum() / max(len(parts), 1) for limit_s in (60.0, 150.0)]
        row += f" {shares[0]:.0f}, {shares[1]:.0f} %, {median} |"
    return row


def medians_aside(case: Case, args: argparse.Namespace) -> str:
    """Return how far medians of 3-D single-epoch positions lie across the line, and how many beyond half of the lane.

    Over the window of each cold start. Also p50, p95 and largest error of single-epoch positions on the line.
    """
    config = parse_config({"filter": "off", "elevation": {"mask_deg": args.mask[0]}})
    processor = make_processor(config, case.navigation, {"front": case.trajectory})
    found = processor.process({"front": case.observations})[0].antennas["front"]
    along = Line(case.trajectory).at(np.nan_to_num(case.reference_arc_m))[1][:, 0]
    right = np.cross(along, case.reference_ecef_m)
    away = ((found.point.ecef_m - case.reference_ecef_m) * right).sum(axis=1) / np.linalg.norm(right, axis=1)
    ends = [(since, len(part.observations.time)) for since, part in starts(case, args.every, args.length)]
    first = np.searchsorted(seconds(case.observations.time - case.observations.time[0]), [since for since, _ in ends])
    median = np.abs([np.nanmedian(away[k : k + count]) for k, (_, count) in zip(first, ends, strict=True)])
    size = np.nanpercentile(straight_distance(found.arc_m, case.reference_ecef_m, case.trajectory), (50.0, 95.0, 100.0))
    half, largest = args.lane / 2.0, median.max()
    return f"{(median > half).sum()} of {len(median)} beyond {half:g}, largest {largest:.1f}; errors {size.round(1)} m"


def show_starts(case: Case, args: argparse.Namespace) -> None:
    """Print a row for each mask, and the calibration of the branches."""
    for mask in args.mask:
        settings = {"elevation": {"mask_deg": mask}, **args.settings}
        parts, failed = [], 0
        for begin, part in starts(case, args.every, args.length):
            found = run(part, settings)
            parts.append(found)
            bad = found.over | found.over_chainage
            failed += bool(bad.any())
            if args.verbose and (bad | found.sure_and_wrong).any():
                print(f"    start {begin:.0f} s: {first_of(found, bad | found.sure_and_wrong)}", flush=True)
        print(counts(f"{case.name} {mask:g}", joined(parts), trials=len(parts), failed=failed), flush=True)
        print(f"    {FIRST_HEAD}\n    {first_levels(f'{case.name} {mask:g}', parts)}", flush=True)
        if args.calibration:
            print("\n".join(calibration(joined(parts))), flush=True)
    if args.lane is not None:
        print(f"    {case.name}: positions across the line: {medians_aside(case, args)}", flush=True)


def show_whole(case: Case, args: argparse.Namespace) -> None:
    """Print a row for the recording as a whole, from its first epoch."""
    for mask in args.mask:
        found = run(case, {"elevation": {"mask_deg": mask}, **args.settings})
        bad = bool((found.over | found.over_chainage).any())
        print(counts(f"{case.name} {mask:g}, whole", found, trials=1, failed=int(bad)), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", help="folders with a case.toml, or names of recordings")
    parser.add_argument("--every", type=float, default=10.0)
    parser.add_argument("--length", type=float, default=150.0)
    parser.add_argument("--mask", type=float, nargs="*", default=[20.0])
    parser.add_argument("--thin", type=int, default=1)
    parser.add_argument("--lane", type=float, help="on a line there and back, on a lane so far to the left [m]")
    parser.add_argument("--set", dest="sets", nargs="*", default=[], help="settings of the filter, name=value")
    parser.add_argument("--frequencies", choices=("one", "two"), default="one")
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--causes", action="store_true", help="faults of whole trials: cause put in against named")
    parser.add_argument("--outliers", action="store_true", help="errors of one to three codes, by their size")
    parser.add_argument("--only", default="", help="with --causes or --faults: kinds with this in their name alone")
    parser.add_argument("--pairs", type=int, default=0, help="with --faults: so many pairs in their place")
    parser.add_argument("--fault-every", type=float, default=90.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--no-starts", action="store_true")
    parser.add_argument("--calibration", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    given = "\n".join(args.sets)
    args.settings = {"frequencies": args.frequencies} | ({"tracking": tomllib.loads(given)} if given else {})
    known = cases(paths.DATA) if paths.DATA.is_dir() else {}
    if not (args.faults or args.causes or args.outliers):
        print(HEAD)
    named: Counter[tuple[str, str]] = Counter()
    for name in args.folders or list(known):
        if name in known:
            case = known[name]()
        else:
            case = simulated(name) if name in list_scenarios() else case_of_folder(Path(name))
        case = case.part(0, len(case.observations.time), args.thin) if args.thin > 1 else case
        case = case if args.lane is None else beside(case, args.lane)
        if args.whole:
            show_whole(case, args)
        if args.outliers:
            show_outliers(case, args)
        elif args.causes:
            named += show_causes(case, args)
        elif args.faults:
            show_faults(case, args)
        elif not args.no_starts:
            show_starts(case, args)
    if args.causes:
        show_matrix(named)
    return 0


if __name__ == "__main__":
    sys.exit(main())
