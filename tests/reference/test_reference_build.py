"""Reference positions of made runs, where the truth is known: bridging by each sensor, refusals, passes, gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.errors import MismatchError, NoPositionError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.core.timescale import seconds, timedelta
from railfix.gnss import concatenate
from railfix.io.position_log import PositionLog
from railfix.pipeline.config import DEFAULT_SIGNALS
from railfix.positioning.doppler_speed import Dopplers, dopplers_of_log
from railfix.reference import (
    Acceleration,
    Built,
    FixRejection,
    Pulses,
    ReferenceData,
    ReferenceSettings,
    build_references,
)
from railfix.simulate import AntennaTruth, antenna_truth
from railfix.simulate.motion import Motion, shuttle
from railfix.simulate.scenario import LineSettings, ReceiverSettings, RunSettings, Scenario
from railfix.simulate.signals import Simulation
from railfix.track import Track
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("D1")


START = np.datetime64("2024-03-05T03:00:00", "ns")
ORIGIN = (35.0, 139.0, 50.0)
FIX_SIGMA_M = 0.02


def curved_track(length_m: float = 6000.0, *, grade: float = 0.0) -> Trajectory:
    """An arc of 2 km radius, points every 5 m, climbing evenly."""
    s = np.arange(0.0, length_m + 1.0, 5.0)
    enu = np.stack([2000.0 * np.sin(s / 2000.0), 2000.0 * (1.0 - np.cos(s / 2000.0)), grade * s], axis=1)
    return Trajectory.from_antenna_path(Track.from_ecef(ecef_from_geodetic(*ORIGIN) + enu @ enu_axes(*ORIGIN[:2])))


@dataclass(frozen=True)
class Run:
    """A made run on a trajectory, one instant a row."""

    trajectory: Trajectory
    time: Datetimes
    arc_m: Floats
    speed_mps: Floats
    motion: Motion

    @classmethod
    def shuttling(cls, duration_s: float, *, rate_hz: float = 5.0, length_m: float = 6000.0, grade: float = 0.0) -> Run:
        trajectory = curved_track(length_m, grade=grade)
        end = float(trajectory.arc_m[-1])
        motion = shuttle(100.0, min(end - 100.0, 4000.0), duration_s, RunSettings(cruise_mps=25.0, stand_s=20.0))
        t = np.arange(0.0, duration_s, 1.0 / rate_hz)
        arc, speed = motion.at(t)
        return cls(trajectory, START + timedelta(t), arc, speed, motion)

    def log(self, fixed: Masks | None = None, *, seed: int = 1, every: int = 5) -> PositionLog:
        """RTK positions, one of `every` instants; those that are not fixed are half a metre off."""
        rows = np.arange(0, len(self.time), every)
        good = np.ones(len(rows), dtype=bool) if fixed is None else fixed[rows]
        noise = np.random.default_rng(seed).normal(size=(len(rows), 3))
        return PositionLog(
            path="rtk.pos",
            time=self.time[rows],
            ecef_m=self.trajectory.at_arc(self.arc_m[rows]) + noise * np.where(good, FIX_SIGMA_M, 0.5)[:, None],
            quality=np.where(good, 1, 2),
            sigma_m=np.full((len(rows), 3), FIX_SIGMA_M),
            line=rows,
            ratio=np.where(good, 20.0, 1.5),
        )

    def errors(self, built: Built) -> tuple[Floats, Floats, Masks]:
        """Signed error along the line, standard deviation, and whether bridged."""
        t = seconds(built.reference.time - START)
        arc, _ = self.motion.at(t)
        error = built.reference.chainage_m - self.trajectory.chainage_at(arc)
        return error, built.reference.sigma_m, built.reference.source == "bridged"

    def pulses(self, pulse_m: float, *, slip_m: float = 0.0, step_s: float = 0.05, seed: int = 3) -> Pulses:
        """A counter that knows no direction, read every 50 ms."""
        t = np.arange(0.0, seconds(self.time[-1] - START) + 1.0, step_s)
        arc, _ = self.motion.at(t)
        way = np.abs(np.diff(arc, prepend=arc[0]))
        way = way + slip_m * np.sqrt(way) * np.random.default_rng(seed).normal(size=len(way))
        return Pulses(
            path="tacho.csv",
            time=START + timedelta(t),
            count=np.floor(np.cumsum(np.maximum(way, 0.0)) / pulse_m),
            kind="count",
            signed=False,
        )


def without_fixes(run: Run, *gaps: tuple[float, float]) -> Masks:
    t = seconds(run.time - START)
    return ~np.any([(t > begin) & (t < end) for begin, end in gaps], axis=0)


def ratio(error: Floats, sigma: Floats) -> float:
    return float(np.sqrt(np.mean((error / sigma) ** 2)))


# --- bridging ------------------------------------------------------------------


def test_fixes_are_the_reference_where_they_are() -> None:
    run = Run.shuttling(200.0)
    built = build_references(ReferenceData(logs={"front": run.log()}, trajectories={"front": run.trajectory}))["front"]
    error, sigma, bridged = run.errors(built)
    assert not bridged.any()
    assert len(built.reference) == 200
    assert 0.8 < ratio(error, sigma) < 1.2
    assert np.std(built.reference.speed_mps - run.speed_mps[::5]) < 0.15
    assert built.left_out == {"before_first_fix": 0, "after_last_fix": 0, "long_gap": 0, "uncertain": 0}


#: Gaps while the train accelerates, runs, brakes and stands, and one over which it turns around.
GAPS = ((20.0, 60.0), (90.0, 120.0), (150.0, 155.0), (170.0, 225.0), (300.0, 340.0), (355.0, 410.0))


def test_pulses_bridge_gaps_standing_and_turning_too() -> None:
    """The wheel is 1.2 % larger than thought, slips by 2 cm per square root of a metre, and cannot tell direction."""
    run = Run.shuttling(500.0)
    data = ReferenceData(
        logs={"front": run.log(without_fixes(run, *GAPS))},
        trajectories={"front": run.trajectory},
        pulses=run.pulses(0.0452, slip_m=0.02),
    )
    built = build_references(data, ReferenceSettings(pulse_m=0.0452 / 1.012))["front"]
    error, sigma, bridged = run.errors(built)
    assert bridged.sum() > 200
    assert np.abs(error[bridged]).max() < 1.5
    assert 0.5 < ratio(error[bridged], sigma[bridged]) < 1.4
    assert built.facts["pulses"]["scale_correction"] == pytest.approx(0.012, abs=0.003)
    assert built.facts["pulses"]["slip_m"] == pytest.approx(0.02, rel=0.4)
    assert set(built.bridged_by) == {"pulses"}


def test_the_distance_of_a_pulse_comes_from_the_fixes_where_nobody_gave_it() -> None:
    run = Run.shuttling(300.0)
    data = ReferenceData(
        logs={"front": run.log(without_fixes(run, (60.0, 100.0)))},
        trajectories={"front": run.trajectory},
        pulses=run.pulses(0.0452),
    )
    built = build_references(data)["front"]
    assert built.facts["pulses"]["pulse_m"] == pytest.approx(0.0452, rel=2e-3)
    assert built.facts["pulses"]["pulse_m_from"] == "estimated from the fixes"
    error, _, bridged = run.errors(built)
    assert np.abs(error[bridged]).max() < 0.12


def test_an_accelerometer_bridges_what_nothing_else_does() -> None:
    """On a climb of 8 per mille, gravity in the reading, offset 0.03 m/s2, facing falling chainage."""
    run = Run.shuttling(300.0, grade=0.008)
    t = np.arange(0.0, 300.0, 0.02)
    _, speed = run.motion.at(t)
    noise = 0.02 / np.sqrt(0.02) * np.random.default_rng(4).normal(size=len(t))
    force = -(np.gradient(speed, t) + 9.80665 * 0.008) + 0.03 + noise
    table = Acceleration(path="imu.csv", time=START + timedelta(t), acceleration_mps2=force, kind="specific_force")
    gaps = ((40.0, 60.0), (100.0, 130.0), (170.0, 200.0))
    data = ReferenceData(
        logs={"front": run.log(without_fixes(run, *gaps))},
        trajectories={"front": run.trajectory},
        acceleration=table,
        facing=-1,
    )
    built = build_references(data)["front"]
    error, sigma, bridged = run.errors(built)
    assert bridged.sum() > 60
    assert np.abs(error[bridged]).max() < 1.0
    assert 0.3 < ratio(error[bridged], sigma[bridged]) < 1.4
    alone = build_references(replace(data, acceleration=None), ReferenceSettings(max_sigma_m=100.0))["front"]
    worse, _, bare = run.errors(alone)
    assert np.abs(worse[bare]).max() > 4.0
    assert alone.bridged_by == {"nothing": int(bare.sum())}


def test_the_standard_deviation_is_largest_in_the_middle_and_grows_with_the_gap() -> None:
    run = Run.shuttling(250.0)
    data = ReferenceData(
        logs={"front": run.log(without_fixes(run, (60.0, 80.0), (100.0, 140.0)))},
        trajectories={"front": run.trajectory},
        pulses=run.pulses(0.02, slip_m=0.05),
    )
    reference = build_references(data)["front"].reference
    t = seconds(reference.time - START)
    peaks = []
    for begin, end in ((60.0, 80.0), (100.0, 140.0)):
        inside = np.flatnonzero((t > begin) & (t < end))
        peak = inside[np.argmax(reference.sigma_m[inside])]
        assert t[peak] == pytest.approx((begin + end) / 2.0, abs=3.0)
        peaks.append(reference.sigma_m[peak])
    # a Brownian bridge: the square root of the length
    assert peaks[1] / peaks[0] == pytest.approx(np.sqrt(2.0), rel=0.2)


class DopplerRun:
    """A simulated run of the front antenna with its Dopplers; the antenna's true path is the map."""

    def __init__(self, seed: int = 1) -> None:
        self.scenario = Scenario(
            seed=seed,
            duration_s=400.0,
            rate_hz=2.0,
            line=LineSettings(length_m=3024.0),
            run=RunSettings(cruise_mps=20.0),
            receiver=ReceiverSettings(doppler_sigma_hz=1.0),
        )
        self.simulation = Simulation(self.scenario)
        middle = np.arange(15.0, self.simulation.line.length_m - 15.0, 1.0)
        path = self._antenna(middle).ecef_m
        self.trajectory = Trajectory.from_antenna_path(Track.from_ecef(path))
        obs = concatenate(list(self.simulation.observations("front")))
        self.dopplers: Dopplers = dopplers_of_log(
            obs, self.simulation.navigation, systems=("G", "J", "E"), signals=DEFAULT_SIGNALS
        )
        tags = seconds(obs.time - self.scenario.start)
        true, _ = self.simulation.truth("front", tags - self.simulation.clocks.bias_s("front", tags))
        self.time, self.ecef_m = obs.time, true.ecef_m
        self.arc_m, _ = self.trajectory.nearest(true.ecef_m)

    def _antenna(self, middle: Floats) -> AntennaTruth:
        vehicle = self.scenario.vehicle
        return antenna_truth(self.simulation.line, vehicle, vehicle.front, middle)

    def log(self, fixed: Masks) -> PositionLog:
        rows = np.flatnonzero(fixed)[::2]
        noise = FIX_SIGMA_M * np.random.default_rng(8).normal(size=(len(rows), 3))
        return PositionLog(
            path="rtk.pos",
            time=self.time[rows],
            ecef_m=self.ecef_m[rows] + noise,
            quality=np.ones(len(rows), dtype=np.int64),
            sigma_m=np.full((len(rows), 3), FIX_SIGMA_M),
            line=rows,
        )


#: Gaps of 10 to 55 s.
DOPPLER_GAPS = ((20, 30), (45, 65), (80, 110), (125, 135), (150, 205), (220, 240), (260, 300), (315, 325), (340, 380))


def bridged_by_dopplers(run: DopplerRun) -> tuple[Built, Floats, Masks]:
    """The reference, its errors, and whether bridged."""
    t = seconds(run.time - run.time[0])
    fixed = ~np.any([(t > begin) & (t < end) for begin, end in DOPPLER_GAPS], axis=0)
    data = ReferenceData(
        logs={"front": run.log(fixed)}, trajectories={"front": run.trajectory}, dopplers={"front": run.dopplers}
    )
    built = build_references(data)["front"]
    at = np.searchsorted(run.time, built.reference.time)
    error = built.reference.chainage_m - run.trajectory.chainage_at(run.arc_m[at])
    return built, error, built.reference.source == "bridged"


def test_dopplers_bridge_gaps() -> None:
    """Noise of 1 Hz, five times a good receiver's, so that the way between fixes counts."""
    run = DopplerRun()
    built, error, bridged = bridged_by_dopplers(run)
    assert bridged.sum() > 400
    assert [round(gap.length_s) for gap in built.gaps] == [10, 20, 30, 10, 56, 20, 40, 10, 40]
    assert np.percentile(np.abs(error[bridged]), 95) < 0.4
    assert set(built.bridged_by) == {"doppler"}
    at = np.searchsorted(run.time, built.reference.time)
    fixed = ~bridged
    even = np.interp(at, at[fixed], run.arc_m[at][fixed])
    assert np.percentile(np.abs(even - run.arc_m[at])[bridged], 95) > 20.0


@pytest.mark.slow
def test_errors_of_bridged_places_are_as_large_as_their_standard_deviations() -> None:
    """Ten runs, ninety gaps; what all fixes have in common is not in these errors, but in the standard deviations."""
    runs = [bridged_by_dopplers(DopplerRun(seed)) for seed in range(1, 11)]
    ratios = np.concatenate([(error / built.reference.sigma_m)[bridged] for built, error, bridged in runs])
    assert 0.7 < np.sqrt(np.mean(ratios**2)) < 1.1
    assert abs(np.mean(ratios)) < 0.2


# --- refusals ------------------------------------------------------------------


def test_each_refusal_has_its_reason_and_they_add_up() -> None:
    run = Run.shuttling(200.0)
    log = run.log()
    up = enu_axes(*ORIGIN[:2])[2]
    ecef, quality, ratios = log.ecef_m.copy(), log.quality.copy(), log.ratio.copy() if log.ratio is not None else None
    assert ratios is not None
    section, _ = run.trajectory.segment_at(run.arc_m[::5])
    tangent, across = run.trajectory.tangent[section], run.trajectory.across[section]
    quality[10:20] = 2
    ratios[30:33] = 2.9
    ecef[40:42] += 1.5 * across[40:42]
    ecef[50:55] += 3.0 * up
    ecef[60] = np.nan
    ecef[80:84] += 0.6 * tangent[80:84]
    log = replace(log, ecef_m=ecef, quality=quality, ratio=ratios)
    data = ReferenceData(logs={"front": log}, trajectories={"front": run.trajectory}, pulses=run.pulses(0.02))
    fixes = build_references(data, ReferenceSettings(pulse_m=0.02))["front"].fixes
    assert fixes.counts() == {
        "good": 175,
        "no_position": 1,
        "not_fixed": 10,
        "low_ratio": 3,
        "repeated": 0,
        "unpaired": 0,
        "spacing": 0,
        "off_track": 2,
        "off_height": 5,
        "travel": 4,
    }
    assert sum(fixes.counts().values()) == len(fixes) == 200
    np.testing.assert_array_equal(np.flatnonzero(fixes.rejection & FixRejection.TRAVEL), [80, 81, 82, 83])
    np.testing.assert_allclose(fixes.lateral_m[40:42], 1.5, atol=0.1)
    np.testing.assert_allclose(fixes.height_m[50:55], 3.0, atol=0.1)
    assert FixRejection(int(fixes.rejection[40])).text == "off_track"


def test_two_antennas_must_be_as_far_apart_as_on_the_vehicle() -> None:
    """P2 3.3: 5 cm. One of them is wrong by 7 cm once, and is missing once."""
    run = Run.shuttling(100.0)
    front = run.log()
    rear = replace(front, ecef_m=run.trajectory.at_arc(run.arc_m[::5] - 18.2))
    front = replace(front, ecef_m=run.trajectory.at_arc(run.arc_m[::5]))
    chord = np.linalg.norm(front.ecef_m - rear.ecef_m, axis=1)
    wrong = rear.ecef_m.copy()
    section, _ = run.trajectory.segment_at(run.arc_m[::5])
    wrong[20] -= 0.07 * run.trajectory.tangent[section[20]]
    wrong[30] -= 0.03 * run.trajectory.tangent[section[30]]
    quality = rear.quality.copy()
    quality[40] = 2
    data = ReferenceData(
        logs={"front": front, "rear": replace(rear, ecef_m=wrong, quality=quality)},
        trajectories={"front": run.trajectory, "rear": run.trajectory},
        distance_m=float(np.median(chord)),
    )
    built = build_references(data)
    for name in ("front", "rear"):
        fixes = built[name].fixes
        assert np.flatnonzero(fixes.rejection & FixRejection.SPACING).tolist() == [20]
        assert fixes.spacing_m[20] == pytest.approx(0.07, abs=0.003)
        assert fixes.spacing_m[30] == pytest.approx(0.03, abs=0.003)
    assert np.flatnonzero(built["front"].fixes.rejection & FixRejection.UNPAIRED).tolist() == [40]
    assert np.flatnonzero(built["rear"].fixes.rejection & FixRejection.NOT_FIXED).tolist() == [40]
    kept = build_references(data, ReferenceSettings(unpaired="keep"))["front"].fixes
    assert kept.rejection[40] == 0
    with pytest.raises(MismatchError, match="name a vehicle"):
        build_references(replace(data, distance_m=float("nan")))


def test_tags_a_little_apart_are_no_distance() -> None:
    """The rear receiver tags 3 ms later: 7.5 cm at 25 m/s."""
    run = Run.shuttling(100.0)
    front = run.log()
    front = replace(front, ecef_m=run.trajectory.at_arc(run.arc_m[::5]))
    later, _ = run.motion.at(seconds(front.time - START) + 0.003)
    rear = replace(
        front, time=front.time + np.timedelta64(3, "ms"), ecef_m=run.trajectory.at_arc(np.asarray(later) - 18.2)
    )
    data = ReferenceData(
        logs={"front": front, "rear": rear},
        trajectories={"front": run.trajectory, "rear": run.trajectory},
        distance_m=18.2,
    )
    fixes = build_references(data)["front"].fixes
    assert fixes.counts()["good"] == 100
    assert np.abs(fixes.spacing_m).max() < 0.01


def test_a_sensor_that_jumps_does_not_cost_the_fixes() -> None:
    """The wheel loses 3 m at once: long stretches on both sides stay."""
    run = Run.shuttling(200.0)
    pulses = run.pulses(0.02)
    count = pulses.count.copy()
    count[seconds(pulses.time - START) > 80.0] += 150.0
    data = ReferenceData(
        logs={"front": run.log()}, trajectories={"front": run.trajectory}, pulses=replace(pulses, count=count)
    )
    fixes = build_references(data, ReferenceSettings(pulse_m=0.02))["front"].fixes
    assert fixes.counts()["good"] == 200


# --- passes and gaps -----------------------------------------------------------


def test_a_loop_is_followed_pass_by_pass() -> None:
    """Two laps of a circle on a map that has both: the places of the second lap are those of the first."""
    radius, laps = 150.0, 2
    s = np.arange(0.0, laps * 2.0 * np.pi * radius, 2.0)
    angle = s / radius
    enu = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(s)], axis=1)
    path = ecef_from_geodetic(*ORIGIN) + enu @ enu_axes(*ORIGIN[:2])
    trajectory = Trajectory.from_antenna_path(Track.from_ecef(path))
    t = np.arange(0.0, 180.0, 1.0)
    arc = 5.0 + 10.0 * t
    keep = (t < 60.0) | (t > 100.0)
    log = PositionLog(
        path="rtk.pos",
        time=START + timedelta(t[keep]),
        ecef_m=trajectory.at_arc(arc[keep]),
        quality=np.ones(int(keep.sum()), dtype=np.int64),
        sigma_m=np.full((int(keep.sum()), 3), FIX_SIGMA_M),
        line=np.arange(int(keep.sum())),
    )
    built = build_references(
        ReferenceData(logs={"front": log}, trajectories={"front": trajectory}), ReferenceSettings(max_sigma_m=100.0)
    )["front"]
    np.testing.assert_allclose(
        built.reference.chainage_m,
        trajectory.chainage_at(5.0 + 10.0 * seconds(built.reference.time - START)),
        atol=0.05,
    )
    assert len(built.reference) == 180


def test_gaps_that_are_too_long_are_left_out_and_named() -> None:
    run = Run.shuttling(300.0)
    data = ReferenceData(
        logs={"front": run.log(without_fixes(run, (50.0, 70.0), (100.0, 180.0)))},
        trajectories={"front": run.trajectory},
        pulses=run.pulses(0.02),
    )
    built = build_references(data)["front"]
    assert [(round(gap.length_s), gap.bridged) for gap in built.gaps] == [(20, True), (80, False)]
    assert built.left_out["long_gap"] == 79
    t = seconds(built.reference.time - START)
    assert not ((t > 100.0) & (t < 180.0)).any()
    assert ((t > 50.0) & (t < 70.0)).sum() == 19
    certain = build_references(data, ReferenceSettings(max_sigma_m=0.025))["front"]
    assert certain.left_out["uncertain"] > 5
    assert certain.reference.sigma_m.max() <= 0.025


def test_without_two_good_fixes_there_is_no_reference() -> None:
    run = Run.shuttling(60.0)
    data = ReferenceData(
        logs={"front": run.log(np.zeros(len(run.time), dtype=bool))}, trajectories={"front": run.trajectory}
    )
    with pytest.raises(NoPositionError, match=r"front: fewer than two good fixes \(60 not_fixed\)"):
        build_references(data)


def test_pulses_of_another_day_or_wheel_do_not_belong() -> None:
    run = Run.shuttling(120.0)
    pulses = run.pulses(0.02)
    data = ReferenceData(logs={"front": run.log()}, trajectories={"front": run.trajectory}, pulses=pulses)
    other = replace(pulses, time=pulses.time + np.timedelta64(1, "D"))
    with pytest.raises(MismatchError, match=r"tacho\.csv: .* no time in common"):
        build_references(replace(data, pulses=other))
    with pytest.raises(MismatchError, match="does the counter wrap"):
        build_references(data, ReferenceSettings(pulse_m=0.5))
    with pytest.raises(SettingsError, match="max_gap_s"):
        ReferenceSettings(max_gap_s=-1.0)
