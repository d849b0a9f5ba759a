"""What a live message says of a place that sensors carry (requirement A8)."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline_cases import clean_trajectories, demo_observations
from railfix.core.reasons import Status
from railfix.core.timescale import GPS_EPOCH
from railfix.io.rinex import read_navigation
from railfix.io.train_message import MessageStatus
from railfix.live.engine import LiveEngine, LiveOutput
from railfix.live.forms import nmea_bytes, tpv_bytes
from railfix.live.message import create_message
from railfix.live.settings import LiveSettings
from railfix.live.stream import single_epochs
from railfix.motion.samples import SensorSamples, TachometerPulses
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import Result
from railfix.simulate.demonstration import demo_files
from railfix.tracking import TrackStatus


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
        message = create_message(changed, LiveSettings())
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
    one = with_track(filtered, "front")
    place = float(one.fusion["front"].chainage_m[-1])
    message = create_message(one, LiveSettings(facing=facing, front_offset_m=7.5))
    assert message.chainage_cm == pytest.approx(100.0 * (place + facing * 7.5), abs=0.51)
    assert message.facing == facing


@pytest.mark.requirement("A8")
def test_bound_of_the_speed_and_probability_of_the_track(filtered: Result) -> None:
    """0.1 m/s: 5.33 sigmas are 53.3 cm/s, rounded up; 0.9876 is 987 thousandths."""
    values = {"speed_sigma_mps": np.full(3, 0.1), "probability": np.full(3, 0.9876)}
    message = create_message(with_track(filtered, "front", tracked=values), LiveSettings())
    assert (message.speed_bound_cmps, message.track_permille) == (54, 987)


@pytest.mark.requirement("A8")
def test_the_bound_holds_for_the_single_epoch_and_for_the_filter(filtered: Result) -> None:
    """The filter's place moved 4 m away from the single epoch's: the bounds are 4 m wider than the level."""
    single = filtered.antennas["front"].chainage_m
    bounds = []
    for away_m in (0.0, 4.0, -4.0):
        moved = with_track(filtered, "front", chainage_m=single + away_m)
        message = create_message(moved, LiveSettings())
        assert message.over_cm is not None
        assert message.protection_level_cm is not None
        bounds.append(message.over_cm - message.protection_level_cm)
    assert bounds == [pytest.approx(1, abs=1), pytest.approx(401, abs=1), pytest.approx(401, abs=1)]


@pytest.mark.requirement("A8")
def test_forms_name_hemispheres_utc_and_the_antenna_of_the_message(filtered: Result) -> None:
    """GPS time is 18 s ahead of UTC from 2017 on."""
    for latitude, longitude, letters in ((35.5, 139.5, ("N", "E")), (-35.5, -139.5, ("S", "W"))):
        one = with_track(filtered, "front", latitude_deg=np.full(3, latitude), longitude_deg=np.full(3, longitude))
        message = create_message(one, LiveSettings())
        at = (np.datetime64("2024-03-05T00:00:10", "ns") - GPS_EPOCH) // np.timedelta64(1, "ns")
        output = LiveOutput(message=message.replaced(time_ns=int(at)), result=one)
        fields = nmea_bytes(output).decode().splitlines()[0].split(",")
        assert fields[1] == "235952.00"
        assert (fields[3], fields[5]) == letters
        assert (fields[2], fields[4]) == ("3530.0000000", "13930.0000000")
        tpv = json.loads(tpv_bytes(output))
        assert (tpv["time"], tpv["lat"], tpv["lon"]) == ("2024-03-04T23:59:52.000Z", latitude, longitude)
    for name in ("front", "rear"):
        level = {"level_m": np.full(3, 3.0)}
        fusion = {
            other: replace(
                track,
                latitude_deg=np.full(3, 10.0 if other == "front" else 20.0),
                tracked=replace(track.tracked, **(level if other == name else {"level_m": np.full(3, 99.0)})),
            )
            for other, track in filtered.fusion.items()
        }
        both = replace(filtered, fusion=fusion)
        output = LiveOutput(message=create_message(both, LiveSettings()), result=both)
        assert json.loads(tpv_bytes(output))["lat"] == {"front": 10.0, "rear": 20.0}[name]


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
