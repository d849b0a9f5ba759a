"""Sensors on board in a live session: their lines, epochs that wait for them, the same answers as from a whole log."""

from __future__ import annotations

import asyncio
import json
import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.settings_files import write_toml
from railfix.core.timescale import GPS_EPOCH
from railfix.io.train_message import MessageStatus, Source
from railfix.live.console import SensorWatch
from railfix.live.engine import END_NS, LiveEngine, LiveOutput
from railfix.live.forms import ROW_FORMS
from railfix.live.settings import LiveSettings
from railfix.live.state import SavedSession, load_state, write_state
from railfix.live.stream import FOREVER, Sensed, SensorLines
from railfix.motion.samples import SENSORS, BaliseReadings, RadarSpeeds, SensorSamples, StationRanges
from railfix.pipeline.config import parse_config
from railfix.pipeline.filter_result import AlongTrack
from railfix.pipeline.processor_state import State
from railfix.run.processor_setup import make_processor
from railfix.simulate.run import vehicle_table
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from railfix.tracking import Kind
from sensed_ride import Ride, joined, ride

pytestmark = pytest.mark.requirement("A8", "E5")
RUNNER = CliRunner(env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"})
#: A tunnel between 61 and 68 s; the wheel slips in it.
RIDE = """{
    "duration_s": 80.0, "rate_hz": 2.0,
    "sensors": {
        "tachometer": {"jitter_s": 2e-6, "lowest_mps": 0.3, "slips": [{"start_s": 62.5, "end_s": 65.0, "ratio": 0.25}]},
        "inertial": UNIT,
        "ranging": {
            "noise_sigma_m": 0.19,
            "units": [{"name": "A", "chainage_m": 480.0}, {"name": "07", "chainage_m": 500.0, "lateral_m": -3.0}],
        },
        "balises": {"spacing_m": 90.0, "wrong": {"B004": "B007"}, "missed": ["B003"]},
    },
}"""
#: Place of the vehicle's ranging unit.
PLACE = {"range_ahead_m": 9.0, "range_above_m": -1.0}
HEADERS = {
    "tachometer": "pulse,time_gpst,direction",
    "inertial": "time_gpst,force_forward_mps2,force_right_mps2,force_down_mps2,roll_rate_radps,pitch_rate_radps,"
    "yaw_rate_radps",
    "radar": "time_gpst,speed_mps",
    "ranging": "time_gpst,unit,range_m,sigma_m",
    "balises": "time_gpst,balise,sigma_m",
}
#: Rows that say that nothing was measured until then.
BEATS = {"tachometer": ",{},\n", "ranging": "{},,,\n", "balises": "{},,\n"}


@pytest.fixture(scope="module")
def case() -> Ride:
    return ride(RIDE)


def lines_of(samples: SensorSamples) -> dict[str, list[tuple[np.datetime64, bytes]]]:
    """Rows of the sensors as lines, each with its time."""
    pulses, unit, radar, ranges = samples.tachometer, samples.inertial, samples.radar, samples.ranging
    six = np.concatenate([unit.force_mps2, unit.rate_radps], axis=1).tolist()
    return {
        "tachometer": [
            (t, f"{number},{t},{way}\n".encode())
            for t, number, way in zip(pulses.time, pulses.pulse, pulses.direction, strict=True)
        ],
        "inertial": [(t, f"{t},{','.join(map(repr, row))}\n".encode()) for t, row in zip(unit.time, six, strict=True)],
        "radar": [(t, f"{t},{v!r}\n".encode()) for t, v in zip(radar.time, radar.speed_mps.tolist(), strict=True)],
        "ranging": [
            (t, f"{t},{name},{metres!r},\n".encode())
            for t, name, metres in zip(ranges.time, ranges.station, ranges.range_m.tolist(), strict=True)
        ],
        "balises": [
            (t, f"{t},{name},\n".encode()) for t, name in zip(samples.balises.time, samples.balises.balise, strict=True)
        ],
    }


def engine_of(case: Ride, folder: Path, **settings: float) -> LiveEngine:
    path = folder / "vehicle.toml"
    if not path.exists():
        write_toml(path, vehicle_table(case.simulation.scenario.vehicle))
    track = case.simulation.line.track()
    paths = {"front": antenna_trajectory(track, read_vehicle(path), "front")}
    config = parse_config({"filter": "track", "protection": "off", "sensors": PLACE})
    processor = make_processor(
        config, case.simulation.navigation, paths, track=track, units=case.units, balises=case.balises
    )
    return LiveEngine(processor, LiveSettings(period_s=0.5, no_input="skip", **settings), SENSORS)


def live(case: Ride, engine: LiveEngine, *, latency_s: float, beat: bool = True) -> list[LiveOutput]:
    """Epochs 5 ms after their tags; rows of the sensors so long after theirs, 20 ms of them at a time, cut anywhere."""
    start = case.observations.time[0] - np.timedelta64(1, "s")

    def at_ns(time: np.datetime64) -> int:
        return int((time - GPS_EPOCH).astype(np.int64))

    events: list[tuple[int, int, object]] = []
    for k in range(len(case.observations)):
        epoch = case.observations[k : k + 1]
        events.append((at_ns(epoch.time[0]) + 5_000_000, 2, epoch))
    for sensor, rows in lines_of(case.samples).items():
        if sensor in BEATS and beat:  # so that its standing still, and that no unit is near, is heard
            beats = start + np.arange(0, 82_000, 20) * np.timedelta64(1, "ms")
            rows = sorted([*rows, *((t, BEATS[sensor].format(t).encode()) for t in beats)], key=lambda row: row[0])
        parts: dict[int, bytes] = {}
        for t, line in rows:
            sent = -(-at_ns(t) // 20_000_000) * 20_000_000
            parts[sent] = parts.get(sent, b"") + line
        lines = SensorLines(sensor=sensor, source="test")
        engine.add_samples(lines.take(f"{HEADERS[sensor]}\n".encode()))
        rest = b""
        for sent, data in parts.items():
            data, rest = (rest + data)[:-7], (rest + data)[-7:]
            events.append((sent + round(latency_s * 1e9), 1, (lines, data)))
        events.append((END_NS - 2, 1, (lines, rest)))
    outputs = []
    for now, kind, event in sorted(events, key=lambda item: item[:2]):
        if kind == 2:
            engine.push("front", event, now_ns=now)  # type: ignore[arg-type]
        else:
            lines, data = event  # type: ignore[misc]
            engine.add_samples(lines.take(data))
        outputs += engine.poll(now_ns=now)
    return [*outputs, *engine.poll(now_ns=END_NS)]


def places(outputs: list[LiveOutput]) -> AlongTrack:
    found: AlongTrack = joined(output.result.fusion["front"] for output in outputs if output.result is not None)
    return found


@pytest.mark.slow
def test_a_live_session_with_sensors_gives_what_the_log_gives(case: Ride, tmp_path: Path) -> None:
    engine = engine_of(case, tmp_path, sensor_wait_s=0.2)
    outputs = live(case, engine, latency_s=0.05)
    found, whole = places(outputs), case.run(sensors=PLACE)
    assert (whole.tracked.used[:, Kind.RANGE] > 0).sum() > 10
    np.testing.assert_allclose(found.chainage_m, whole.chainage_m, atol=1e-6)
    np.testing.assert_array_equal(found.sensed.state, whole.sensed.state)
    np.testing.assert_allclose(found.sensed.curvature_1pm, whole.sensed.curvature_1pm, atol=1e-9)
    np.testing.assert_array_equal(found.tracked.used, whole.tracked.used)
    passed = [json.loads(row) for output in outputs for row in ROW_FORMS["passings"](output).splitlines()]
    assert [row["balise"] for row in passed] == [passing.balise for passing in whole.passings]
    assert {(row["balise"], row["verdict"]) for row in passed if row["verdict"] != "read"} == {
        ("B003", "missing"), ("B004", "missing"), ("B007", "contradicts"),
    }  # fmt: skip
    assert not any("silent" in what for what in engine.counts)
    inside = ~np.isfinite(case.observations.code_m).any(axis=1) & (case.time_s > 50.0)
    assert inside.sum() > 10
    told = [output.message for output, tunnel in zip(outputs, inside, strict=True) if tunnel]
    assert {message.status for message in told} == {MessageStatus.COASTING}
    assert all(Source.INERTIAL in message.sources for message in told)
    assert not any(Source.CARRIER_PHASE in message.sources for message in told)
    assert all(message.over_cm is not None for message in told)
    ranged = found.tracked.used[:, Kind.RANGE] > 0
    sources = [output.message.sources for output in outputs]
    assert [Source.RANGING in some for some in sources] == ranged.tolist()
    assert not any(Source.FEATURES in some for some in sources)


@pytest.mark.slow
def test_a_sensor_that_is_late_is_left_out_and_no_way_is_made_up(case: Ride, tmp_path: Path) -> None:
    """Rows 0.3 s late, a wait of 0.1 s: no epoch has the way since the one before, and none a way that is too short."""
    engine = engine_of(case, tmp_path, sensor_wait_s=0.1)
    time = case.observations.time[:100]
    samples = case.samples.between(time[0] - np.timedelta64(2, "s"), time[-1])
    samples = replace(samples, ranging=StationRanges(), balises=BaliseReadings())  # these are places, not ways
    part = replace(case, observations=case.observations[:100], samples=samples)
    found = places(live(part, engine, latency_s=0.3, beat=False))
    assert {engine.counts[f"{sensor} silent"] for sensor in SENSORS} == {100}
    assert not (found.tracked.used[:, 3:] > 0).any()
    alone = part.run(filter_sources=("code", "phase", "doppler"))
    np.testing.assert_allclose(found.chainage_m, alone.chainage_m, atol=1e-6)


@pytest.mark.slow
def test_a_restart_in_a_slip_goes_on_from_the_state_file(case: Ride, tmp_path: Path) -> None:
    """The tables are read again from their beginning: what the state has heard already does not count twice."""

    def begun() -> LiveEngine:
        engine = engine_of(case, tmp_path)
        for name in SENSORS:
            samples = SensorSamples(**{name: case.samples.tables[name]})
            engine.add_samples(Sensed(sensor=name, samples=samples, until=FOREVER))
        return engine

    engine, outputs = begun(), []
    for k in range(len(case.observations)):
        if case.time_s[k] == 63.5:
            saved = engine.export_state()
            assert saved is not None
            write_state(tmp_path / "state", SavedSession(engine=saved, streams={}), {})
            loaded = load_state(tmp_path / "state", {})
            assert loaded.session is not None, loaded.outcome
            engine = begun()
            engine.resume(loaded.session.engine)
        epoch = case.observations[k : k + 1]
        now = int((epoch.time[0] - GPS_EPOCH).astype(np.int64))
        engine.push("front", epoch, now_ns=now)
        outputs += engine.poll(now_ns=now)
    found, whole = places(outputs), case.run(sensors=PLACE)
    np.testing.assert_allclose(found.chainage_m, whole.chainage_m, atol=1e-6)
    np.testing.assert_array_equal(found.tracked.used, whole.tracked.used)


def test_samples_wait_for_an_antenna_without_an_epoch(case: Ride, tmp_path: Path) -> None:
    """The rear antenna's epochs are missing for a second: its next one has the way of the wheel over all of it."""
    write_toml(tmp_path / "v.toml", vehicle_table(case.simulation.scenario.vehicle))
    track, vehicle = case.simulation.line.track(), read_vehicle(tmp_path / "v.toml")
    paths = {name: antenna_trajectory(track, vehicle, name) for name in ("front", "rear")}
    config = parse_config({"filter": "track", "protection": "off"})
    processor = make_processor(config, case.simulation.navigation, paths, track=track)
    rear = next(iter(case.simulation.pieces("rear", chunk_epochs=100_000))).observations
    gap = [40, 41]
    state, parts, since = State(), [], np.datetime64("NaT", "ns")
    for k in range(gap[-1] + 3):
        time = rear.time[k]
        chunk = {"front": case.observations[k : k + 1], "rear": rear[k : k + 1]}
        if k in gap:
            del chunk["rear"]
        result, state = processor.process(chunk, state, sensors=case.samples.between(since, time))
        since = time
        if "rear" in result.fusion:
            parts.append(result.fusion["rear"])
    found = joined(parts)
    after = int(np.flatnonzero(found.time > rear.time[gap[-1]])[0])
    assert (found.tracked.used[after, [Kind.WHEEL, Kind.RADAR, Kind.FORCE]] > 0).all()
    assert len(state.fusion["rear"].sensors.samples.inertial) < 500


@pytest.mark.slow
def test_a_radar_whose_mounting_moves_is_told_in_a_running_session(case: Ride, tmp_path: Path) -> None:
    """The ride's outputs over and over, each time later; from the eleventh on the radar reads 4 % more."""
    engine, said = engine_of(case, tmp_path, sensor_wait_s=0.2), list[str]()
    outputs, radar = live(case, engine, latency_s=0.05), case.samples.radar
    watch = SensorWatch(engine.processor, said.append)
    watch.judge()
    for turn in range(20):
        shift = np.timedelta64(90 * turn, "s")
        scale = 1.04 if turn > 10 else 1.0
        rows = RadarSpeeds(time=radar.time + shift, speed_mps=scale * radar.speed_mps)
        for part in np.array_split(np.arange(len(rows)), 40):
            some = RadarSpeeds(time=rows.time[part], speed_mps=rows.speed_mps[part])
            watch.take(Sensed(sensor="radar", samples=SensorSamples(radar=some), until=some.time[-1]))
            assert len(vars(watch)["_radar"].radar) < 130 * 10
        for output in outputs:
            front, track = output.result.antennas["front"], output.result.fusion["front"]
            later = replace(front, corrected=replace(front.corrected, time=front.time + shift))
            result = replace(output.result, antennas={"front": later}, fusion={"front": track})
            watch.take(replace(output, result=result))
    (note,) = said
    assert re.search(r"its speeds differ from satellite-derived speeds by \+[34].\d % \([+-]0.\d % before", note), note


@pytest.fixture
def served() -> Iterator[dict[bytes, int]]:
    """Servers of one answer each: a port by its content, made as they are asked for."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    servers: list[asyncio.Server] = []

    class Ports(dict[bytes, int]):
        def __missing__(self, content: bytes) -> int:
            async def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
                writer.write(content)
                await writer.drain()
                writer.close()

            async def serve() -> int:
                servers.append(await asyncio.start_server(answer, "127.0.0.1", 0))
                return int(servers[-1].sockets[0].getsockname()[1])

            self[content] = asyncio.run_coroutine_threadsafe(serve(), loop).result(10)
            return self[content]

    async def close() -> None:
        for server in servers:
            server.close()
            await server.wait_closed()

    yield Ports()
    asyncio.run_coroutine_threadsafe(close(), loop).result(10)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(5)
    loop.close()


@pytest.mark.slow
def test_the_command_with_tables_and_with_streams_is_the_run(served: dict[bytes, int], tmp_path: Path) -> None:
    """`railfix live` with the tables of `railfix run`, and with their rows over TCP: the same places."""
    out = tmp_path / "sim"
    unit = 'sensors.ranging={units=[{name="A", chainage_m=480.0}]}'
    sets = ["--set", "sensors.tachometer={}", "--set", "sensors.inertial={}", "--set", unit, "--set", "rate_hz=2"]
    made = RUNNER.invoke(app, ["simulate", "demo", "--seconds", "75", "--plain", *sets, "--out", str(out)])
    assert made.exit_code == 0, made.output
    given = [f"--{name}={out / file}" for name, file in {
        "front": "front.rnx", "nav": "nav.rnx", "track": "track.csv", "vehicle": "vehicle.toml",
    }.items()]  # fmt: skip
    given.append(f"--ranging-units={out / 'ranging_units.csv'}")
    tables = [f"--{name}={out / name}.csv" for name in ("tachometer", "inertial", "ranging")]
    run = RUNNER.invoke(app, ["run", *given, *tables, "--out", str(tmp_path / "run")])
    assert run.exit_code == 0, run.output
    fits = float(re.findall(r"sensors.range_ahead_m = ([0-9.]+) would fit", " ".join(run.output.split()))[0])
    assert fits == pytest.approx(9.0, abs=2.0)
    assert "--set sensors.range_ahead_m=9 " in (out / "README.md").read_text()
    expected = pl.read_parquet(tmp_path / "run" / "train.parquet")
    assert expected["sources"].str.contains("wheel").any()
    assert expected["sources"].str.contains("range").any()
    send = ["--live", "no_input=skip", "--live", "reconnect=off", "--send", f"json@{tmp_path / 'm'}", "--overwrite"]
    content = {name: (out / f"{name}.csv").read_bytes() for name in ("tachometer", "inertial", "ranging")}
    first = content["ranging"].splitlines(keepends=True)[1]
    content["ranging"] = content["ranging"].replace(first, first + first.replace(b",A,", b",B,"))
    ports = {name: served[rows] for name, rows in content.items()}
    streams = [f"--{name}=tcp://127.0.0.1:{port}" for name, port in ports.items()]
    for folder, words in (
        ("tables", tables),
        ("streams", [*streams, "--speed", "1.5", "--live", "sensor_wait_s=5", "--live", "period_s=0.03"]),
    ):
        said = RUNNER.invoke(app, ["live", *given, *words, *send, "--out", str(tmp_path / folder)])
        assert said.exit_code == 0, said.output
        assert "silent" not in said.output
        assert f"sensors.range_ahead_m = {fits:.1f} would fit" in " ".join(said.output.split())
        assert ("skipped: 1 ranges to ground units that are not surveyed" in said.output) == (folder == "streams")
        found = pl.read_parquet(tmp_path / folder / "train.parquet")
        np.testing.assert_allclose(found["chainage_m"], expected["chainage_m"], atol=1e-6)
        assert found["sources"].equals(expected["sources"])


def test_a_table_of_a_sensor_is_no_output_and_needs_the_filter(case: Ride, tmp_path: Path) -> None:
    table = tmp_path / "radar.csv"
    table.write_text("time_gpst,speed_mps\n2024-03-05T03:10:01,4\n")
    words = ["--front", "x.ubx", "--track", "t.csv", "--radar", str(table), "--send", f"json@{table}", "--overwrite"]
    said = RUNNER.invoke(app, ["live", *words])
    assert said.exit_code == 8, said.output
    words = ["--front", "x.ubx", "--track", "t.csv", "--radar", str(table), "--filter", "off"]
    for command in (["live", *words], ["run", *words, "--nav", str(table), "--out", str(tmp_path / "out")]):
        (tmp_path / "x.ubx").touch()
        (tmp_path / "t.csv").touch()
        command = [str(tmp_path / word) if word in ("x.ubx", "t.csv") else word for word in command]
        said = RUNNER.invoke(app, command)
        assert said.exit_code == 4, said.output
        assert "--radar needs the filter along the track; leave out --filter off" in said.output
    assert replace(case.samples, silent=frozenset({"radar"})).between(
        np.datetime64("NaT", "ns"), case.observations.time[-1]
    ).silent == {"radar"}
