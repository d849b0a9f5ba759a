"""One reference point in every message: the train's true ends lie inside its bounds, whichever antenna it is from."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import polars as pl
import pytest

import railfix
from railfix.core.errors import SettingsError
from railfix.core.timescale import GPS_EPOCH
from railfix.gnss.observations import Observations
from railfix.io.train_message import TrainMessage, Unknown, decode, from_json
from railfix.live.engine import LiveEngine, LiveOutput
from railfix.live.forms import cbor_bytes, forms, json_bytes
from railfix.live.settings import LiveSettings
from railfix.live.stream import single_epochs
from railfix.live.train_ends import TrainFrame
from railfix.simulate.demonstration import demo_files
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import AntennaOffset, Vehicle

#: Ends of the demonstration's vehicle from its middle, and its antennas [m].
HALF_M, ANTENNA_M = 11.6, 9.1
#: A length over the ends that is not twice the distance of the front: 14 m ahead of the middle, 26 m behind.
LONG = LiveSettings(period_s=1.0, front_offset_m=14.0 - ANTENNA_M, length_m=40.0, no_input="skip")


@dataclass(frozen=True)
class Ride:
    """The demonstration's train on its line: out, a stop, and back."""

    paths: dict[str, Trajectory]
    logs: dict[str, Observations]
    middle_m: dict[int, float]  #: True chainage of the middle between the bogies by time tag.


def ride(facing: Literal["rising", "falling"], epochs: slice) -> Ride:
    """The ride with the vehicle as it is, or turned: then its front antenna is the rear one of the log."""
    files = demo_files()
    vehicle = railfix.read_vehicle(files["vehicle"])
    source = {"front": "front", "rear": "rear"}
    if facing == "falling":
        turned = {
            name: AntennaOffset(along_m=offset.along_m, across_m=-offset.across_m, up_m=offset.up_m)
            for name, offset in vehicle.antennas.items()
        }
        vehicle = vehicle.replaced(facing="falling", antennas=turned)
        source = {"front": "rear", "rear": "front"}
    track = railfix.read_track([files["track"]])
    truth = pl.read_csv(files["truth"]).with_columns(pl.col("time_gpst").str.to_datetime(time_unit="ns", strict=False))
    mean = truth.group_by("time_gpst").agg(pl.col("chainage_m").mean()).sort("time_gpst")
    tags = (mean["time_gpst"].to_numpy() - GPS_EPOCH).astype("timedelta64[ns]").astype(np.int64)
    return Ride(
        paths={name: railfix.antenna_trajectory(track, vehicle, name) for name in source},  # type: ignore[arg-type]
        logs={name: railfix.read_observations(files[source[name]])[epochs] for name in source},
        middle_m=dict(zip(tags.tolist(), mean["chainage_m"].to_list(), strict=True)),
    )


def outputs_of(ride: Ride, settings: LiveSettings, *, without: dict[str, slice]) -> Iterator[LiveOutput]:
    """The messages of a ride, in which each antenna has gaps of its own."""
    processor = railfix.EpochProcessor(
        railfix.Config(filter="track"), ride.paths, navigation=railfix.read_navigation(demo_files()["nav"])
    )
    engine = LiveEngine(processor, settings)
    logs = {name: single_epochs(log) for name, log in ride.logs.items()}
    for k in range(len(logs["front"])):
        for name, epochs in logs.items():
            if k not in range(*without[name].indices(len(epochs))):
                tag = int((epochs[k].time[0] - GPS_EPOCH).astype(np.int64))
                engine.push(name, epochs[k], now_ns=tag)
        yield from engine.poll(now_ns=tag + 40_000_000)


def beyond_m(message: TrainMessage, middle_m: float, ahead_m: dict[int, float]) -> tuple[float, float]:
    """How far the true front end is beyond its bounds, and the true ends beyond the safe ones; `ahead_m`: of the ends
    on the side of rising and falling chainage from the middle.
    """
    side = message.facing
    front = middle_m + side * ahead_m[side]
    place = message.chainage_cm / 100.0
    off = max(side * (front - place) - message.under_cm / 100.0, side * (place - front) - message.over_cm / 100.0)
    rear = middle_m - side * ahead_m[-side]
    safe = max(side * (front - message.safe_front_cm / 100.0), side * (message.safe_rear_cm / 100.0 - rear))
    return off, safe


@pytest.mark.every(3)
@pytest.mark.requirement("A8")
@pytest.mark.parametrize("facing", ["rising", "falling"])
def test_the_true_ends_are_inside_the_bounds_in_every_message_of_every_form(
    facing: Literal["rising", "falling"],
) -> None:
    """Both antennas with gaps, so that either one alone or the better of the two gives the place; the train turns back.

    True ends by the simulation, with a train of 40 m, not symmetric about the middle of its vehicle.
    """
    journey = ride(facing, slice(300, 1500, 10))
    settings = LONG.replaced(reference_m=100.0, reference=7)
    etcs = forms(settings)["etcs"]
    side = 1 if facing == "rising" else -1
    ahead = {side: 14.0, -side: 26.0}
    gaps = {"front": slice(20, 45), "rear": slice(60, 75)}
    bounded, antennas, seen, places = 0, set(), [], []
    for output in outputs_of(journey, settings, without=gaps):
        message = output.message
        assert from_json(json_bytes(output).decode()) == message
        assert decode(cbor_bytes(output)[2:]) == message
        assert (message.length_cm, message.unknown) == (4000, Unknown(0))
        if message.over_cm is None or message.chainage_cm is None:
            continue
        middle = journey.middle_m[message.time_ns]
        front_off, ends_off = beyond_m(message, middle, ahead)
        assert front_off <= 0.0, (front_off, message)
        assert ends_off <= 0.0, (ends_off, message)
        packet = json.loads(etcs(output))
        sign = {1: 1, 0: -1}[packet["Q_DLRBG"]]
        place, front = 100.0 + sign * packet["D_LRBG"], middle + message.facing * ahead[message.facing]
        assert place - packet["L_DOUBTUNDER"] <= front <= place + packet["L_DOUBTUNDER"]
        assert packet["Q_DIRLRBG"] == (1 if message.facing > 0 else 0)
        assert output.place.geodetic is not None
        antenna = railfix.core.geodesy.ecef_from_geodetic(*output.place.geodetic)
        first = journey.paths["front"]
        true = first.at_arc(first.arc_of_body(middle))
        assert np.linalg.norm(antenna - true) <= message.over_cm / 100.0 + 0.1  # nmea and tpv: the front antenna
        bounded += 1
        antennas.add(output.place.antenna)
        seen.append(message.facing)
        places.append(message.chainage_cm / 100.0 - message.facing * ahead[message.facing] - middle)
    assert bounded > 80
    assert antennas == {"front", "rear"}
    assert seen[0] == side  # as the vehicle file has it; on the way back, after 50 m, the other end is the front
    assert set(seen) == {1, -1}
    assert np.abs(np.diff(places)).max() < 6.0  # no jump by the 18.2 m between the antennas


def without_vehicle(path: Trajectory) -> Trajectory:
    """The path of an antenna of which nothing else is known."""
    return replace(path, body_chainage_m=None, front_end_m=None, rear_end_m=None, antenna_ahead_m=0.0)


@pytest.mark.requirement("A8")
def test_without_a_vehicle_file_the_place_is_that_of_the_first_antenna_alone() -> None:
    """How far the antennas are apart is not known: the second one says nothing of the first one's place."""
    journey = ride("rising", slice(300, 360, 10))
    track = without_vehicle(journey.paths["front"])
    alone = replace(journey, paths={"front": track, "rear": track})
    outputs = list(outputs_of(alone, LONG, without={"front": slice(4, 6), "rear": slice(0)}))
    placed = [o.place.antenna for o in outputs if o.place is not None and o.message.chainage_cm is not None]
    assert placed == ["front"] * 4
    assert [o.message.status.name for o in outputs[4:]] == ["NO_POSITION"] * 2


def test_a_train_shorter_than_its_front_is_ahead_is_refused() -> None:
    paths = ride("rising", slice(0, 1)).paths
    with pytest.raises(SettingsError, match="further than the train is long"):
        TrainFrame.of(paths, LiveSettings(front_offset_m=5.0, length_m=10.0))
    frame = TrainFrame.of(paths, LiveSettings())
    assert (frame.front_m, frame.rear_m, frame.running) == (HALF_M, HALF_M, 1)
    frame = TrainFrame.of(paths, LiveSettings(length_m=100.0))  # a train behind the vehicle
    assert (frame.front_m, frame.rear_m) == (HALF_M, 100.0 - HALF_M)


def test_the_vehicle_file_has_the_ends(tmp_path: Path) -> None:
    text = "bogie_distance_m = 13.8\nlength_m = 20.0\n{}[antennas.front]\nalong_m = 9.1\nup_m = 4.0\n"
    path = tmp_path / "vehicle.toml"
    for extra, ends in (("", (10.0, 10.0)), ("front_end_m = 12.0\n", (12.0, 8.0))):
        path.write_text(text.format(extra))
        assert railfix.read_vehicle(path).ends_m == ends
    path.write_text(text.format("front_end_m = 21.0\n"))
    with pytest.raises(SettingsError, match="front_end_m must be at most length_m"):
        railfix.read_vehicle(path)
    antennas = {"front": AntennaOffset(along_m=1.0, up_m=4.0)}
    assert Vehicle(bogie_distance_m=10.0, antennas=antennas).ends_m == (None, None)  # type: ignore[arg-type]
