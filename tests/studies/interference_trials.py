"""Attacks on simulated trains: what is suspected, when, and whether a level is exceeded before; recordings without one.

``python tests/studies/interference_trials.py`` prints the tables of tests/references/results/interference.txt: 350
attacks at 1 Hz, by the codes and Dopplers of single epochs without a wheel, on the demonstration's line, of bends, and
on a straight one; and, with the recordings beside the checkout, the largest statistics of each.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
import polars as pl

import paths
import signal_attacks
from frequencies_score import recordings as of_two_frequencies
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.interference import Suspicion, cause_text
from railfix.integrity.protection import LevelStatus
from railfix.io import read_navigation, read_observations
from railfix.io.receiver.log import read_receiver_navigation, read_receiver_positions
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import AntennaResult
from railfix.simulate import Element, LineSettings, Scenario, write_run
from railfix.track import read_track
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from recordings_score import straight_line, trajectory_of
from recordings_truth import smartloc_rinex_truth
from signal_attacks import Scene

#: Suspicions that count as seen, by that of an attack; positions that leave or contradict the map are no alarm.
_ALARMS: Final = {
    Suspicion.JAMMING_SUSPECTED: (Suspicion.JAMMING_SUSPECTED, Suspicion.SPOOFING_SUSPECTED),
    Suspicion.SPOOFING_SUSPECTED: (Suspicion.SPOOFING_SUSPECTED,),
}
SINGLE: Final = parse_config({"filter": "off"})
#: Trials of each attack.
TRIALS: Final = 50
#: Scenarios that trials share, and how long they are.
_SEEDS: Final = (1, 2, 3, 4)
_RIDE_S: Final = 400.0
_FIRST, _LAST = 60, 120
_SILENT: Final = 10
_STRAIGHT: Final = LineSettings(kind="elements", elements=(Element(kind="straight", length_m=5000.0),))

Attack = Callable[[Scene, int, np.random.Generator], Observations]


def _jammer(scene: Scene, at: int, rng: np.random.Generator) -> Observations:
    return signal_attacks.jammed(scene, at, rng.uniform(-20.0, -8.0), rng)


def _meacon(scene: Scene, at: int, rng: np.random.Generator) -> Observations:
    east, north = rng.uniform(-1.0, 1.0, 2) * 500.0
    return signal_attacks.repeated(scene, at, (east, north), rng.uniform(30.0, 500.0))


def _pull(scene: Scene, at: int, rng: np.random.Generator) -> Observations:
    return signal_attacks.pulled(scene, at, rng.choice([-0.5, 0.5]), power="equal", rng=rng)


def _pull_with_own_power(scene: Scene, at: int, rng: np.random.Generator) -> Observations:
    return signal_attacks.pulled(scene, at, rng.choice([-0.5, 0.5]), rng=rng)


def _straight_pull(scene: Scene, at: int, rng: np.random.Generator) -> Observations:
    return signal_attacks.pulled(scene, at, rng.choice([-0.5, 0.5]), straight=True, rng=rng)


def _one_constellation(scene: Scene, at: int, rng: np.random.Generator) -> Observations:
    return signal_attacks.pulled(scene, at, rng.choice([-0.5, 0.5]), systems=str(rng.choice(["G", "E"])), rng=rng)


#: Attack, and the line.
ATTACKS: Final[dict[str, tuple[Attack, LineSettings]]] = {
    "jammer passed at 50 m, -20 to -8 dBm": (_jammer, LineSettings()),
    "meaconing, 30 to 500 m later": (_meacon, LineSettings()),
    "pull of 0.5 m/s, one transmitter's C/N0": (_pull, LineSettings()),
    "pull of 0.5 m/s, one constellation": (_one_constellation, LineSettings()),
    "pull of 0.5 m/s, C/N0 as before": (_pull_with_own_power, LineSettings()),
    "the same, straight on where the line bends": (_straight_pull, LineSettings()),
    "the same on a straight line": (_pull_with_own_power, _STRAIGHT),
}


@dataclass(frozen=True)
class Train:
    """A simulated train without an attack."""

    scene: Scene
    trajectory: Trajectory
    chainage_m: np.ndarray

    @classmethod
    def of(cls, scenario: Scenario, folder: Path) -> Train:
        files = write_run(scenario, folder)
        observations, navigation = read_observations(files["front"]), read_navigation([files["nav"]])
        truth = pl.read_csv(files["truth"]).filter(pl.col("antenna") == "front")
        trajectory = antenna_trajectory(read_track(files["track"]), read_vehicle(files["vehicle"]), "front")
        scene = Scene.of(observations, navigation, truth.select("x_m", "y_m", "z_m").to_numpy())
        return cls(scene, trajectory, truth["chainage_m"].to_numpy())

    def result(self, observations: Observations) -> AntennaResult:
        processor = EpochProcessor(SINGLE, {"front": self.trajectory}, navigation=self.scene.navigation)
        return processor.process({"front": observations})[0].antennas["front"]


@dataclass(frozen=True)
class Trial:
    """What one attack led to: delays of the first suspicion and of the first 10 epochs without a level [s], NaN where
    there are none; alarms before the attack; largest error [m]; epochs whose error exceeds a level without an alarm;
    causes."""

    delay_s: float
    silent_s: float
    early: int
    error_m: float
    exceeded: int
    causes: frozenset[str]


def trial(train: Train, attack: Attack, at: int, rng: np.random.Generator, *, kind: Suspicion) -> Trial:
    attacked = attack(train.scene, at, rng)
    result = train.result(attacked)
    found = result.interference.suspicion
    start = at
    if kind is Suspicion.JAMMING_SUSPECTED:  # from 5 dB on
        start = int(np.argmax(np.nan_to_num(train.scene.observations.cn0_dbhz - attacked.cn0_dbhz).max(axis=1) >= 5.0))
    after = np.flatnonzero(np.isin(found, _ALARMS[kind]) & (np.arange(len(found)) >= start))
    delay = float(train.scene.seconds[after[0]] - train.scene.seconds[start]) if len(after) else np.nan
    error = np.abs(result.chainage_m - train.chainage_m)
    promised = result.protection.status != int(LevelStatus.ALARM)
    exceeded = promised & (error > result.protection.level.level_m)
    silent = np.convolve(~promised[start:], np.ones(_SILENT), mode="valid") == _SILENT
    silence = float(np.argmax(silent)) if silent.any() else np.nan
    texts = {word for text in cause_text(result.interference.causes).tolist() for word in text.split("+") if word}
    early = int(np.isin(found[:start], _ALARMS[Suspicion.JAMMING_SUSPECTED]).sum())
    return Trial(
        delay,
        silence,
        early,
        float(np.nanmax(error)),
        int(exceeded.sum()),
        frozenset(texts),
    )


def trains_on(line: LineSettings) -> list[Train]:
    scenarios = [Scenario(seed=seed, rate_hz=1.0, duration_s=_RIDE_S, line=line) for seed in _SEEDS]
    with TemporaryDirectory() as folder:
        return [Train.of(scenario, Path(folder) / str(scenario.seed)) for scenario in scenarios]


def trials(number: int = TRIALS) -> Iterator[tuple[str, list[Trial]]]:
    on = {line.kind: trains_on(line) for line in (LineSettings(), _STRAIGHT)}
    for name, (attack, line) in ATTACKS.items():
        trains = on[line.kind]
        rng = np.random.default_rng(7)
        kind = Suspicion.JAMMING_SUSPECTED if attack is _jammer else Suspicion.SPOOFING_SUSPECTED
        starts = rng.integers(_FIRST, _LAST, number).tolist()
        yield name, [trial(trains[k % len(trains)], attack, at, rng, kind=kind) for k, at in enumerate(starts)]


def row(name: str, found: list[Trial]) -> str:
    suspected, silent = ([getattr(one, f"{what}_s") for one in found] for what in ("delay", "silent"))
    causes = sorted(frozenset().union(*(one.causes for one in found)))
    return (
        f"{name:42} {len(found):6} {_times(suspected)} {_times(silent)} {sum(one.early for one in found):6} "
        f"{sum(one.exceeded > 0 for one in found):8} {np.median([one.error_m for one in found]):8.1f}  "
        + " ".join(causes)
    )


def _times(delays: list[float]) -> str:
    """Number of delays, their median, 95 % and largest."""
    known = np.array(delays)[np.isfinite(delays)]
    if not len(known):
        return f"{0:8} {'-':>5} {'-':>5} {'-':>5}"
    return f"{len(known):8} {np.median(known):5.0f} {np.percentile(known, 95):5.0f} {known.max():5.0f}"


def clean(data: Path) -> Iterator[tuple[str, Observations, Navigation, Trajectory]]:
    """Every recording with navigation and no interference."""
    for name, log, navigation, _, line in of_two_frequencies(data):
        yield name, log, read_navigation([navigation]), line
    car = data / "kinematic"
    town = car / "urbannav_tst"
    _, _, _, _, line = next(iter(of_two_frequencies(data)))
    log = read_observations(town / "20210517.light-urban.tste.ublox.m8t.GC.obs")
    yield "town, M8T", log, read_navigation([town / "hksc137c.nav"]), line
    folder = car / "smartloc_berlin_rinex"
    log = read_observations(folder / "Berlin_Potsdamer_Platz.obs.gz")
    navigation = read_navigation([folder / "brdc1580.16n.gz", folder / "brdc1580.16g.gz"])
    yield "deep city", log, navigation, trajectory_of(*smartloc_rinex_truth(folder))
    geonet = data / "static" / "rtklib_geonet2005"
    stations = [(geonet / f"{name}0920.05o", geonet / f"{name}0920.05n") for name in ("0759", "3040")]
    crescent = data / "sbas" / "msas_20080526_crescent"
    japan = car / "japan_mosaic_2021265_with_GEONET3034"
    stations += [(japan / "3034265G.21O", japan / "SEPT2650.21P")]
    stations += [(crescent / "cres_20080526.bin.obs", crescent / "cres_20080526.bin.nav")]
    roof = data / "dual" / "mosaic_x2_99cm"
    stations += [(roof / "base.obs", roof / "base.nav")]
    for path, nav in stations:
        log = read_observations(path)
        yield path.name[:12], log, read_navigation([nav]), straight_line(log.header.approximate_ecef_m, 30.0)
    stream = data / "live" / "16dBatt_no_interference_coldstart.ubx.gz"
    place = np.nanmedian(read_receiver_positions(stream).ecef_m, axis=0)
    yield "cold start", read_observations(stream), read_receiver_navigation([stream]), straight_line(place, 30.0)


def clean_row(name: str, log: Observations, navigation: Navigation, line: Trajectory) -> str:
    result, _ = EpochProcessor(SINGLE, {"front": line}, navigation=navigation).process({"front": log})
    found = result.antennas["front"].interference
    motion, power = found.motion, found.power
    compared = power.spread_db <= 1.5
    largest = [
        np.where(compared, power.fall_db, np.nan), -power.difference_db, np.abs(motion.clock_jump_m),
        motion.drift_jump_sigmas, motion.speed_jump_sigmas, motion.position_jump_sigmas, motion.part_sigmas,
        motion.off_line_sigmas,
    ]  # fmt: skip
    alarms = int(np.isin(found.suspicion, _ALARMS[Suspicion.JAMMING_SUSPECTED]).sum())
    cells = " ".join(f"{abs(np.nanmax(one)):7.1f}" if np.isfinite(one).any() else "      -" for one in largest)
    return f"{name:18} {len(log):6} {alarms:6} {cells}"


def main() -> int:
    times = f"{'p50':>5} {'p95':>5} {'max':>5}"
    print(
        f"{'attack':42} {'trials':>6} {'detected':>8} {'after [s]':>17} {'no level':>8} {'after [s]':>17} {'early':>6} "
        f"{'exceeded':>8} {'error':>8}  by"
    )
    print(f"{'':58} {times} {'':8} {times} {'epochs':>6} {'trials':>8} {'p50 [m]':>8}")
    imitated, others = [], []
    for name, found in trials():
        print(row(name, found), flush=True)
        alike = ATTACKS[name][0] in (_pull_with_own_power, _straight_pull)
        (imitated if alike else others).append((name, sum(one.exceeded > 0 for one in found), len(found)))
    exceeded, attacks = (sum(counts) for counts in zip(*[counts for _, *counts in others], strict=True))
    print(
        f"\nlevel exceeded without an alarm: {exceeded} of {attacks} attacks; and of pulls of all signals, their C/N0"
    )
    print("imitated, without a wheel: " + "; ".join(f"{n} of {of} ({name})" for name, n, of in imitated))
    if paths.DATA.is_dir():
        names = ("fall", "equal", "clock", "drift", "speed", "jump", "parts", "map")
        print(f"\n{'recording':18} {'epochs':>6} {'alarms':>6} {' '.join(f'{name:>7}' for name in names)}")
        for given in clean(paths.DATA):
            print(clean_row(*given), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
