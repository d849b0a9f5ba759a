"""What a live message says of a place that sensors carry (requirement A8)."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from live_outputs import output_of
from pipeline_cases import clean_trajectories, demo_observations
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.reasons import Reason, Status
from railfix.core.timescale import GPS_EPOCH
from railfix.io.rinex import read_navigation
from railfix.io.train_message import MessageStatus, Source, SuspectedInterference, Unknown
from railfix.live.console import Metrics
from railfix.live.engine import EngineState, LiveEngine
from railfix.live.forms import gga_sentence, nmea_bytes, tpv_bytes
from railfix.live.session import Hooks, _Session
from railfix.live.settings import LiveSettings
from railfix.live.stream import FOREVER, Sensed, SensorLines, single_epochs
from railfix.motion.samples import RadarSpeeds, SensorSamples, TachometerPulses
from railfix.motion.slip import MotionState
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.pipeline.results import Result
from railfix.ranges.corrected import CorrectedRanges
from railfix.simulate.demonstration import demo_files
from railfix.tracking import Kind, TrackStatus


@pytest.mark.requirement("A8")
def test_no_bound_of_a_position_that_failed_a_check_goes_out_as_coasting() -> None:
    """Codes that contradict the place after a tunnel are left out, though the single epoch has a level."""
    processor = EpochProcessor(
        parse_config({"filter": "track", "tracking": {"level": "off"}}),
        {"front": clean_trajectories()["front"]},
        navigation=read_navigation(demo_files()["nav"]),
    )
    result, _ = processor.process({"front": demo_observations()["front"][:30:10]})
    antenna, track = result.antennas["front"], result.fusion["front"]
    assert antenna.status[-1] == Status.OK
    tracked = replace(track.tracked, status=np.full(3, TrackStatus.COASTING, dtype=np.int8))
    for single, expected in ((Status.OK, MessageStatus.COASTING), (Status.INCONSISTENT, MessageStatus.DOUBTFUL)):
        changed = replace(
            result,
            antennas={"front": replace(antenna, status=np.full(3, single, dtype=np.int8))},
            fusion={"front": replace(track, tracked=tracked)},
        )
        message = output_of(changed, LiveSettings()).message
        assert message.status is expected
        assert (message.over_cm is None) == (expected is MessageStatus.DOUBTFUL)


@pytest.fixture(scope="module")
def filtered() -> Result:
    """Three epochs of both antennas with the filter along the track, without a level of its own."""
    processor = EpochProcessor(
        parse_config({"filter": "track", "tracking": {"level": "off"}}),
        clean_trajectories(),
        navigation=read_navigation(demo_files()["nav"]),
    )
    return processor.process({name: demo_observations()[name][:30:10] for name in ("front", "rear")})[0]


def with_track(result: Result, name: str, *, tracked: dict[str, Any] | None = None, **values: Any) -> Result:
    """The result of one antenna alone, with other values in its filter."""
    track = result.fusion[name]
    changed = replace(track, tracked=replace(track.tracked, **(tracked or {})), **values)
    return replace(result, antennas={name: result.antennas[name]}, fusion={name: changed})


@pytest.mark.requirement("A8")
@pytest.mark.parametrize("facing", [-1, 0, 1])
def test_the_front_end_is_ahead_of_the_place_in_the_direction_it_looks(filtered: Result, facing: int) -> None:
    """A train of 40 m whose front end is 7.5 m ahead of the front antenna, 9.1 m ahead of the vehicle's middle."""
    one = with_track(filtered, "front")
    apart_m = float(abs(one.fusion["front"].chainage_m[-1] - one.antennas["front"].chainage_m[-1]))
    middle = float(one.fusion["front"].chainage_m[-1]) - 9.1
    message = output_of(one, LiveSettings(facing=facing, front_offset_m=7.5, length_m=40.0)).message
    ahead = {1: 9.1 + 7.5, 0: 0.0, -1: 40.0 - 9.1 - 7.5}[facing]
    assert message.chainage_cm == pytest.approx(100.0 * (middle + facing * ahead), abs=0.6)
    assert (message.facing, message.length_cm) == (facing, 4000)
    assert message.unknown == (Unknown(0) if facing else Unknown.FACING)
    assert message.over_cm is not None
    assert message.protection_level_cm is not None
    either = 0.0 if facing else 40.0 - 9.1 - 7.5  # the rear end, the further one, may be ahead on either side
    assert message.over_cm - message.protection_level_cm == pytest.approx(100.0 * (either + apart_m) + 1.0, abs=2.0)
    if not facing:
        assert (message.safe_front_cm, message.safe_rear_cm) == (None, None)
        return
    assert message.chainage_cm is not None
    assert message.safe_front_cm == pytest.approx(message.chainage_cm + facing * message.over_cm, abs=1)
    assert message.safe_rear_cm == pytest.approx(message.chainage_cm - facing * (message.over_cm + 4000), abs=1)


@pytest.mark.requirement("A8")
def test_bound_of_the_speed_and_probability_of_the_track(filtered: Result) -> None:
    """0.1 m/s: 5.33 sigmas are 53.3 cm/s, rounded up; 0.9876 is 987 thousandths."""
    values = {"speed_sigma_mps": np.full(3, 0.1), "probability": np.full(3, 0.9876)}
    message = output_of(with_track(filtered, "front", tracked=values), LiveSettings()).message
    assert (message.speed_bound_cmps, message.track_permille) == (54, 987)


@pytest.mark.requirement("A8")
def test_the_bound_holds_for_the_single_epoch_and_for_the_filter(filtered: Result) -> None:
    """The filter's place moved 4 m away from the single epoch's: the bounds are 4 m wider than the level."""
    single = filtered.antennas["front"].chainage_m
    bounds = []
    for away_m in (0.0, 4.0, -4.0):
        arc_m = filtered.fusion["front"].trajectory.arc_at_chainage(single + away_m)
        moved = with_track(filtered, "front", arc_m=arc_m)
        message = output_of(moved, LiveSettings()).message
        assert message.over_cm is not None
        assert message.protection_level_cm is not None
        bounds.append(message.over_cm - message.protection_level_cm)
    assert bounds == [pytest.approx(1, abs=1), pytest.approx(401, abs=1), pytest.approx(401, abs=1)]


@pytest.mark.requirement("A8")
def test_forms_name_hemispheres_utc_and_the_place_of_the_first_antenna(filtered: Result) -> None:
    """GPS time is 18 s ahead of UTC from 2017 on."""
    for latitude, longitude, letters in ((35.5, 139.5, ("N", "E")), (-35.5, -139.5, ("S", "W"))):
        one = with_track(filtered, "front")
        # computed from the position on the line at the first access; no line is on the southern half as well
        vars(one.fusion["front"])["geodetic"] = np.full(3, latitude), np.full(3, longitude), np.zeros(3)
        message = output_of(one, LiveSettings()).message
        at = (np.datetime64("2024-03-05T00:00:10", "ns") - GPS_EPOCH) // np.timedelta64(1, "ns")
        output = replace(output_of(one), message=message.replaced(time_ns=int(at)))
        fields = nmea_bytes(output).decode().splitlines()[0].split(",")
        assert fields[1] == "235952.00"
        assert (fields[3], fields[5]) == letters
        assert (fields[2], fields[4]) == ("3530.0000000", "13930.0000000")
        tpv = json.loads(tpv_bytes(output))
        assert (tpv["time"], tpv["lat"], tpv["lon"]) == ("2024-03-04T23:59:52.000Z", latitude, longitude)
    places = []
    for name in ("rear", "front"):  # whichever has the smaller level, the point is the same
        fusion = {
            other: replace(track, tracked=replace(track.tracked, level_m=level, amount_m=level))
            for other, track in filtered.fusion.items()
            for level in [np.full(3, 3.0 if other == name else 99.0)]
        }
        output = output_of(replace(filtered, fusion=fusion))
        assert output.place is not None
        assert output.place.antenna == name
        tpv = json.loads(tpv_bytes(output))
        places.append(ecef_from_geodetic(tpv["lat"], tpv["lon"], tpv["altHAE"]))
    assert np.linalg.norm(places[0] - places[1]) < 3.0  # the antennas are 18.2 m apart


@pytest.mark.requirement("A8")
def test_nothing_from_before_a_restart_of_the_receiver_is_used() -> None:
    """Epochs that wait for the other antenna, and samples of sensors, are of the time before."""
    processor = EpochProcessor(
        parse_config({"filter": "track"}), clean_trajectories(), navigation=read_navigation(demo_files()["nav"])
    )
    engine = LiveEngine(processor, LiveSettings(restart_epochs=3))
    epochs = single_epochs(demo_observations()["front"][:60])
    for epoch in epochs[40:43]:
        engine.push("front", epoch, now_ns=0)
    pulses = TachometerPulses(time=epochs[0].time, pulse=np.array([1]), direction=np.array([1]))
    engine._samples = SensorSamples(tachometer=pulses)
    for epoch in epochs[:3]:
        engine.push("front", epoch, now_ns=0)
    assert engine.counts["restart"] == 1
    assert not engine._samples
    tags = [o.result.antennas["front"].time[-1] for o in engine.poll(now_ns=10**12) if o.result is not None]
    assert tags == [epochs[2].time[0]]


@pytest.mark.requirement("A8", "E5")
def test_a_sample_goes_to_the_first_epoch_after_it_and_to_none_that_a_restart_has_behind_it() -> None:
    """A whole table is there from the beginning: each epoch has the samples since the one before."""
    processor = EpochProcessor(
        parse_config({"filter": "off"}),
        {"front": clean_trajectories()["front"]},
        navigation=read_navigation(demo_files()["nav"]),
    )
    screen, given = processor.screen, []

    def spied(*arguments: Any, sensors: SensorSamples, **options: Any) -> Any:
        given.append(sensors.radar.speed_mps.tolist())
        return screen(*arguments, sensors=sensors, **options)

    processor.screen = spied  # type: ignore[method-assign]
    epochs = single_epochs(demo_observations()["front"][:8])
    tags = [int((epoch.time[0] - GPS_EPOCH).astype(np.int64)) for epoch in epochs]
    time = epochs[0].time[0] + np.arange(20) * np.timedelta64(50, "ms")
    radar = SensorSamples(radar=RadarSpeeds(time=time, speed_mps=np.arange(20.0)))
    expected = [[0.0], *([2.0 * k - 1.0, 2.0 * k] for k in range(1, 8))]
    for first in (0, 4):
        engine = LiveEngine(processor, LiveSettings(), ("radar",))
        engine.add_samples(Sensed(sensor="radar", samples=radar, until=FOREVER))
        if first:
            engine.resume(EngineState(state=State(), done_ns=tags[first - 1], last_tag={}, sequence=1))
        given.clear()
        for epoch, tag in zip(epochs[first:], tags[first:], strict=True):
            engine.push("front", epoch, now_ns=tag)
            engine.poll(now_ns=tag)
        assert given == expected[first:]


def using(corrected: CorrectedRanges, count: int) -> CorrectedRanges:
    """The ranges of the first channels alone, as used."""
    reason = np.full_like(corrected.reason, Reason.ELEVATION_MASK)
    reason[:, :count] = 0
    return replace(corrected, reason=reason)


@pytest.mark.requirement("A8")
def test_interference_is_the_worst_of_both_antennas_and_satellites_are_the_most(filtered: Result) -> None:
    for front, rear in ((0, 2), (2, 0), (1, 2)):
        antennas = {
            name: replace(
                filtered.antennas[name],
                interference=SimpleNamespace(suspicion=np.array([0, 0, found])),
                corrected=using(filtered.antennas[name].corrected, 5 + found),
            )
            for name, found in (("front", front), ("rear", rear))
        }
        both = replace(filtered, antennas=antennas)
        message = output_of(both, LiveSettings()).message
        assert message.interference == SuspectedInterference(2)
        gga = nmea_bytes(output_of(both)).decode().split(",")
        assert gga[7] == "07"
    assert output_of(filtered, LiveSettings()).message.interference == SuspectedInterference(0)


@pytest.mark.requirement("A8", "E5")
def test_a_way_that_inertia_carries_is_of_the_inertial_unit(filtered: Result) -> None:
    used = np.zeros_like(filtered.fusion["front"].tracked.used)
    used[-1, Kind.WHEEL] = 1
    for state, expected in ((MotionState.NORMAL, Source.TACHOMETER), (MotionState.INERTIAL_SLIDE, Source.INERTIAL)):
        sensed = replace(filtered.fusion["front"].sensed, state=np.full(3, state, dtype=np.int8))
        message = output_of(
            with_track(filtered, "front", tracked={"used": used}, sensed=sensed), LiveSettings()
        ).message
        assert message.sources == Source.FRONT_RECEIVER | expected


@pytest.mark.requirement("A8")
def test_speeds_of_forms_are_without_a_sign_and_carried_places_are_estimates(filtered: Result) -> None:
    """10 m/s toward falling chainage are 19.44 knots; quality 6 of NMEA is an estimated position."""
    one = with_track(filtered, "front", tracked={"speed_mps": np.full(3, -10.0)})
    message = output_of(one, LiveSettings()).message
    assert message.speed_cmps == -1000
    for status, quality, valid in (
        (MessageStatus.POSITION, "1", "A"), (MessageStatus.COASTING, "6", "A"), (MessageStatus.DOUBTFUL, "0", "V"),
    ):  # fmt: skip
        output = replace(output_of(one), message=message.replaced(status=status))
        gga, rmc, _ = (line.split(",") for line in nmea_bytes(output).decode().splitlines())
        assert (gga[6], rmc[2], rmc[7]) == (quality, valid, "19.44")
        assert json.loads(tpv_bytes(output))["speed"] == 10.0


@pytest.mark.requirement("A12")
def test_a_caster_keeps_the_last_valid_place_while_there_is_none(filtered: Result) -> None:
    one = with_track(filtered, "front")
    good = output_of(one)
    good = replace(good, message=good.message.replaced(status=MessageStatus.POSITION))
    bad = replace(good, message=good.message.replaced(status=MessageStatus.DOUBTFUL))
    polled = [[good], [bad], []]
    engine: Any = SimpleNamespace(poll=lambda **_: polled.pop(0), settings=LiveSettings(gga_s=10.0), reports=[])
    session = _Session(engine=engine, sinks=[], metrics=Metrics(), hooks=Hooks())
    while polled:
        session.emit(0, None)
        assert session.place == gga_sentence(good)
    assert session.place.startswith(b"$GPGGA")


@pytest.mark.requirement("A8", "E5")
def test_a_row_of_a_time_alone_is_heard_and_a_line_cut_by_a_break_is_none() -> None:
    lines = SensorLines(sensor="tachometer", source="test")
    sensed = lines.take(b"time_gpst,pulse,direction\n2024-03-05T03:10:01,4,1\n2024-03-05T03:10:04,,\n")
    assert sensed.until == np.datetime64("2024-03-05T03:10:04")
    assert sensed.samples.tachometer.pulse.tolist() == [4]
    assert lines.take(b"2024-03-05T03:10:03,5,1\n").skipped == 1  # nothing was measured until 04
    lines.take(b"2024-03-05T03:10:05,6,1\n2024-03-05T03:1")
    lines.after_break()
    sensed = lines.take(b"2024-03-05T03:10:07,9,1\n")
    assert (sensed.skipped, sensed.samples.tachometer.pulse.tolist()) == (0, [9])
