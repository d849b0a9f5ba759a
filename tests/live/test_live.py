"""Live positioning: the same answers as from logs, whatever way the bytes come; pairs, gaps, restarts; two channels."""

from __future__ import annotations

import asyncio
import gzip
from collections.abc import AsyncIterator, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import railfix
from railfix.cli import app
from railfix.core.errors import ChannelsDisagreeError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.timescale import GPS_EPOCH
from railfix.gnss.observations import Observations
from railfix.io import read_positions
from railfix.io.train_message import MessageStatus
from railfix.live import session
from railfix.live.channels import TwoChannels, compare, digests
from railfix.live.engine import LiveEngine, LiveOutput
from railfix.live.session import Hooks, run_session
from railfix.live.settings import LiveSettings
from railfix.live.stream import Lag, ReceivedData, ReceiverState, receive_bytes, single_epochs
from railfix.simulate.demonstration import demo_files

pytestmark = pytest.mark.requirement("A8")
RUNNER = CliRunner(env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"})
MS = 1_000_000
EPOCHS = 80


@pytest.fixture(scope="module")
def logs() -> dict[str, tuple[Observations, ...]]:
    """The first epochs of the demonstration, 10 Hz, antenna by antenna."""
    files = demo_files()
    return {name: single_epochs(railfix.read_observations(files[name])[:EPOCHS]) for name in ("front", "rear")}


def processor(*antennas: str, **settings: object) -> railfix.EpochProcessor:
    files = demo_files()
    track, vehicle = railfix.read_track([files["track"]]), railfix.read_vehicle(files["vehicle"])
    return railfix.EpochProcessor(
        railfix.Config(**{"filter": "off", **settings}),
        {name: railfix.antenna_trajectory(track, vehicle, name) for name in antennas or ("front", "rear")},
        navigation=railfix.read_navigation(files["nav"]),
    )


@pytest.fixture(scope="module")
def batch() -> railfix.Result:
    files = demo_files()
    whole = {name: railfix.read_observations(files[name])[:EPOCHS] for name in ("front", "rear")}
    return processor().process(whole)[0]


def tag_ns(epoch: Observations) -> int:
    return int((epoch.time[0] - GPS_EPOCH).astype(np.int64))


def played(
    engine: LiveEngine, arrivals: Iterable[tuple[int, str, Observations]], *, until: int | None = None
) -> list[LiveOutput]:
    """Outputs of epochs that arrive at given instants [ns]; the clock steps by 5 ms between."""
    arrivals = sorted(arrivals, key=lambda arrival: arrival[0])
    outputs: list[LiveOutput] = []
    now = arrivals[0][0]
    for at, name, epoch in arrivals:
        while now + 5 * MS < at:
            now += 5 * MS
            outputs += engine.poll(now_ns=now)
        now = at
        engine.push(name, epoch, now_ns=now)
        outputs += engine.poll(now_ns=now)
    while now < (until or now + 100 * MS):
        now += 5 * MS
        until = until or now + 100 * MS
        outputs += engine.poll(now_ns=now)
    return outputs


def chainages(outputs: list[LiveOutput], name: str) -> dict[int, float]:
    found = {}
    for output in outputs:
        if output.result is not None and name in output.result.antennas:
            antenna = output.result.antennas[name]
            found[int((antenna.time[-1] - GPS_EPOCH).astype(np.int64))] = float(antenna.chainage_m[-1])
    return found


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_live_is_batch(logs: dict[str, tuple[Observations, ...]], batch: railfix.Result, seed: int) -> None:
    """Two antennas, each epoch delayed at random by up to 25 ms: the rows of the log, within 1e-9 m."""
    rng = np.random.default_rng(seed)
    engine = LiveEngine(processor(), LiveSettings())
    arrivals = [
        (tag_ns(epoch) + int(rng.uniform(0, 25) * MS), name, epoch) for name, epochs in logs.items() for epoch in epochs
    ]
    outputs = played(engine, arrivals)
    for name in logs:
        live = chainages(outputs, name)
        expected = batch.antennas[name]
        assert len(live) == EPOCHS
        got = np.array([live[int((t - GPS_EPOCH).astype(np.int64))] for t in expected.time])
        assert np.array_equal(np.isnan(got), np.isnan(expected.chainage_m))
        assert np.nanmax(np.abs(got - expected.chainage_m)) < 1e-9
    assert engine.counts["paired"] == EPOCHS
    assert [output.message.sequence for output in outputs] == list(range(1, len(outputs) + 1))


def test_one_message_a_period_however_epochs_come(logs: dict[str, tuple[Observations, ...]]) -> None:
    """Live, epochs in bursts of five and late by up to 90 ms: a message each period, of the newest epoch; all rows."""
    engine, period = LiveEngine(processor("front"), LiveSettings()), 100 * MS
    epochs = logs["front"][:60]
    start = tag_ns(epochs[0])
    rng = np.random.default_rng(4)
    arrivals = [
        (tag_ns(epoch) + (4 - k % 5) * period if 20 <= k < 40 else tag_ns(epoch) + int(rng.uniform(0, 90) * MS), k)
        for k, epoch in enumerate(epochs)
    ]
    arrivals.sort(key=lambda arrival: (arrival[0], arrival[1]))
    engine.start(now_ns=start - period)
    sent: list[tuple[int, LiveOutput]] = []
    rows: list[LiveOutput] = []
    end = start + 61 * period
    for now in range(start - period, end, 2 * MS):
        while arrivals and arrivals[0][0] <= now:
            engine.push("front", epochs[arrivals.pop(0)[1]], now_ns=now)
        for output in engine.poll(now_ns=now, sent_ns=now):
            if output.part != "rows":
                sent.append((now, output))
            if output.part != "message" and output.result is not None:
                rows.append(output)
    assert len(rows) == 60
    assert [output.message.sequence for _, output in sent] == list(range(1, len(sent) + 1))
    assert abs(len(sent) - (end - start) // period) <= 3  # by the jitter; without it there were some twenty more
    between = np.diff([now for now, _ in sent]) / MS
    assert between.min() >= 50.0
    assert between.max() <= 200.0
    tags = [output.message.time_ns for _, output in sent if output.message.status is not MessageStatus.NO_INPUT]
    assert tags == sorted(set(tags))
    assert engine.counts["superseded"] == 60 - len(tags) > 0


def test_a_session_that_falls_behind_says_so_and_skips_to_the_present(
    logs: dict[str, tuple[Observations, ...]],
) -> None:
    """The computer stands still for 3 s, then takes what waits at once; and tags that step by 3 s are no delay."""
    epochs, settings = logs["front"][:60], LiveSettings(behind_s=1.0)
    engine, start = LiveEngine(processor("front"), settings), tag_ns(logs["front"][0])
    held = [
        max(tag_ns(epoch), start + 3000 * MS) if tag_ns(epoch) > start + 500 * MS else tag_ns(epoch) for epoch in epochs
    ]
    outputs = played(engine, [(at, "front", epoch) for at, epoch in zip(held, epochs, strict=True)])
    late = [k for k, epoch in enumerate(epochs) if held[k] - tag_ns(epoch) > 250 * MS]
    skipped = engine.counts["skipped, behind the receivers"]
    assert skipped == len(late) == 22
    assert sum(output.result is not None for output in outputs) == 60 - skipped
    told = [text for text in engine.reports if "behind" in text or "skipped" in text]
    assert told == [
        "processing is 2.4 s behind the receivers: epochs are skipped until it is up to date",
        "processing is up to date again; 22 epochs were skipped",
    ]
    stepped = LiveEngine(processor("front"), settings)
    times = [tag_ns(epoch) + (3000 * MS if k >= 10 else 0) for k, epoch in enumerate(epochs)]
    played(stepped, [(at, "front", epoch) for at, epoch in zip(times, epochs, strict=True)])
    assert stepped.counts["skipped, behind the receivers"] == 21
    assert any("the receivers' time tags are 3.0 s older than before" in text for text in stepped.reports)


def test_a_session_that_is_behind_says_so_while_data_wait(
    logs: dict[str, tuple[Observations, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many epochs come together, 0.7 s after the one before: said before the last, and few polls for those skipped."""
    engine = LiveEngine(processor("front"), LiveSettings(behind_s=0.5))
    poll, polls, said, many = engine.poll, list[int](), dict[str, int](), 3000

    def skipped() -> int:
        return engine.counts["skipped, behind the receivers"]

    def counted(**keywords: Any) -> list[LiveOutput]:
        polls.append(skipped())
        return poll(**keywords)

    async def arrivals(_source: str, state: ReceiverState, *_: object) -> AsyncIterator[ReceivedData]:
        first = logs["front"][0]
        yield ReceivedData(epochs=(first,), after=state)
        await asyncio.sleep(0.7)
        for k in range(1, many + 1):
            epoch = replace(logs["front"][1 + k % 60], time=first.time + np.timedelta64(20 * k, "us"))
            yield ReceivedData(epochs=(epoch,), after=state)

    monkeypatch.setattr(engine, "poll", counted)
    monkeypatch.setattr(session, "arrivals", arrivals)
    monkeypatch.setattr(session._LOG, "warning", lambda form, text: said.setdefault(form % text, skipped()))
    asyncio.run(run_session(engine, {"front": "tcp://127.0.0.1:1"}, [], speed=None))
    (at,) = (count for text, count in said.items() if "behind the receivers: epochs are skipped" in text)
    assert at < skipped() == many
    assert len([count for count in polls if 0 < count < many]) < many // 2  # by time, not one an epoch


def test_a_clock_of_100_ppm_beside_the_receivers_is_no_lag() -> None:
    """An hour at 1 Hz, the computer's clock 100 ppm fast: the delay grows by 0.36 s, of which none is a lag."""
    lag = Lag(behind_s=0.3)
    assert not any(lag.skips(k * 1000 * MS, round(k * 1000 * MS * (1.0 + 1e-4))) for k in range(3600))


def test_numbers_are_reserved_for_ten_times_between_two_states(
    logs: dict[str, tuple[Observations, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crash after a state is written may follow messages that have been sent: the next session begins beyond them."""

    async def arrivals(*_: Any, **__: Any) -> AsyncIterator[ReceivedData]:
        for epoch in logs["front"][:3]:
            yield ReceivedData(epochs=(epoch,), after=ReceiverState())

    saved: list[Any] = []
    monkeypatch.setattr(session, "arrivals", arrivals)
    engine = LiveEngine(processor("front"), LiveSettings(period_s=0.1, state_every_s=2.0))
    asyncio.run(run_session(engine, {"front": "tcp://127.0.0.1:1"}, [], speed=None, hooks=Hooks(save=saved.append)))
    assert saved[0].engine.sequence == 10 * 20
    assert saved[-1].engine.sequence < 4  # of an orderly end, that of the last message


def ubx_line(log: Path, folder: Path) -> Path:
    """A line of 1 km through the place that the receiver itself gives."""
    latitude, longitude, height = (float(np.median(v)) for v in geodetic_from_ecef(read_positions(log).ecef_m))
    rows = [f"{latitude + 2e-5 * k:.9f},{longitude + 3e-5 * k:.9f},{height:.3f}" for k in range(-100, 101)]
    path = folder / "line.csv"
    path.write_text("# crs: EPSG:4979\nlatitude_deg,longitude_deg,height_m\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.slow
def test_ephemerides_count_from_when_they_are_complete(recordings: Path, tmp_path: Path) -> None:
    """A cold start: no position until subframes of enough satellites have been received whole."""
    log = recordings / "live" / "16dBatt_no_interference_coldstart.ubx.gz"
    data = gzip.decompress(log.read_bytes())
    trajectory = {"front": railfix.Trajectory.from_antenna_path(railfix.read_track([ubx_line(log, tmp_path)]))}
    engine = LiveEngine(
        railfix.EpochProcessor(railfix.Config(), trajectory), LiveSettings(period_s=1.0, no_input="skip")
    )
    state, statuses, records = ReceiverState(), [], 0
    for place in range(0, 500_000, 5_000):
        items = list(receive_bytes(data[place : place + 5_000], state))
        state = items[-1].after
        for received in items:
            if received.navigation is not None:
                engine.add_navigation(received.navigation)
                records += len(received.navigation.kepler)
            for epoch in received.epochs:
                engine.push("front", epoch, now_ns=tag_ns(epoch))
                for output in engine.poll(now_ns=tag_ns(epoch)):
                    placed = bool(np.isfinite(output.result.antennas["front"].chainage_m[-1]))
                    statuses.append((records, placed))
    assert not any(placed for known, placed in statuses if known < 3)
    assert any(placed for _, placed in statuses)


def test_two_channels_agree_and_a_difference_stops(logs: dict[str, tuple[Observations, ...]]) -> None:
    """Both antennas, so that the second process has what the first one has."""
    channels = TwoChannels(processor(), LiveSettings())
    try:
        alone = LiveEngine(processor(), LiveSettings())
        arrivals = [(tag_ns(epoch), name, epoch) for name in logs for epoch in logs[name][:20]]
        assert digests(played(channels, arrivals)) == digests(played(alone, arrivals))
        # A fault in one channel alone: its engine gets an epoch that the other does not.
        LiveEngine.push(channels, "front", logs["front"][20], now_ns=tag_ns(logs["front"][20]))
        with pytest.raises(ChannelsDisagreeError, match="first in the stage: corrected ranges"):
            channels.poll(now_ns=tag_ns(logs["front"][20]) + 50 * MS)
    finally:
        channels.close()
    ours = digests(played(LiveEngine(processor("front"), LiveSettings()), arrivals[:5]))
    theirs = [dict(item) for item in ours]
    theirs[3]["position"] = "0"
    theirs[3]["message"] = "0"
    with pytest.raises(ChannelsDisagreeError, match="first in the stage: position"):
        compare(ours, theirs)


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["--front", "tcp://nowhere"], 4, "expected a file, tcp://HOST:PORT"),
        (["--front", "ntrip://host:2101"], 4, "MOUNT"),
        (["--front", "missing.ubx"], 3, "no such file"),
        (["--front", "tcp://127.0.0.1:9"], 3, "connection cannot be opened"),
        (["--front", "FRONT", "--send", "xml@-"], 4, "FORM@TARGET"),
        (["--front", "FRONT", "--send", "json@udp://nowhere"], 4, "FORM@TARGET"),
        (["--front", "FRONT", "--live", "perod_s=1"], 4, "perod_s"),
        (["--front", "FRONT", "--metrics", "9100"], 4, "HOST:PORT"),
    ],
)
def test_what_is_wrong_is_one_sentence(words: list[str], code: int, says: str) -> None:
    files = demo_files()
    words = [str(files["front"]) if word == "FRONT" else word for word in words]
    done = RUNNER.invoke(app, ["live", *words, "--track", str(files["track"])])
    assert done.exit_code == code, done.output
    assert says in " ".join(done.output.split())
    assert "Traceback" not in done.output


def test_a_track_of_another_country_is_named_once(tmp_path: Path) -> None:
    """`railfix run` ends with this sentence; a session goes on, and its log has it."""
    files = demo_files()
    track = tmp_path / "far.csv"
    rows = "".join(f"47.{k:02d},8.5,500\n" for k in range(10, 20))
    track.write_text("latitude_deg,longitude_deg,height_m\n" + rows)
    front = tmp_path / "front.rnx"
    railfix.write_observations(railfix.read_observations(files["front"])[:15], front)
    words = ["live", "--front", str(front), "--nav", str(files["nav"]), "--track", str(track), "--log"]
    result = RUNNER.invoke(app, [*words, str(tmp_path / "live.log")])
    assert result.exit_code == 0, result.output
    log = (tmp_path / "live.log").read_text()
    assert log.count("km from where the front log was recorded; give the track of that line") == 1
