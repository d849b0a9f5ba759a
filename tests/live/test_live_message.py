"""What a live message says of a place that sensors carry (requirement A8)."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from live_outputs import output_of
from pipeline_cases import clean_trajectories, demo_observations
from railfix.core.reasons import Reason, Status
from railfix.core.timescale import GPS_EPOCH
from railfix.io.rinex import read_navigation
from railfix.io.train_message import MessageStatus, SuspectedInterference
from railfix.live.console import Metrics
from railfix.live.engine import EngineState, LiveEngine
from railfix.live.forms import gga_sentence, nmea_bytes
from railfix.live.session import Hooks, _Session
from railfix.live.settings import LiveSettings
from railfix.live.stream import FOREVER, Sensed, SensorLines, single_epochs
from railfix.motion.samples import RadarSpeeds, SensorSamples
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.processor_state import State
from railfix.pipeline.results import Result
from railfix.ranges.corrected import CorrectedRanges
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
    given.clear()
    for epoch, tag in zip(epochs[:5], tags, strict=False):  # after a restart the table is used as at a start
        engine.push("front", epoch, now_ns=tag)
        engine.poll(now_ns=tag)
    assert given == [[0.0, 1.0, 2.0, 3.0, 4.0], *expected[3:5]]


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
