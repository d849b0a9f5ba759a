"""Messages, forms, metrics, watches and the clock of a session, step by step, against a reviewed text.

Positions and clocks are given, so that every number can be checked by hand. After an intended change,
``python tests/live/test_described_sessions.py`` writes the references again; review their difference.
"""

from __future__ import annotations

import asyncio
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import polars as pl
import pytest

if __name__ == "__main__":
    sys.path[:0] = [str(folder) for folder in sorted(Path(__file__).resolve().parents[1].iterdir()) if folder.is_dir()]

from described import check_described, describe, write_described
from pipeline_cases import clean_trajectories
from railfix.core.errors import RailfixError
from railfix.core.reasons import Status
from railfix.core.timescale import GPS_EPOCH, timedelta
from railfix.gnss.observations import Observations
from railfix.integrity.protection import LevelStatus
from railfix.io.train_message import MessageStatus, TrainMessage
from railfix.live import command, console, warm_up
from railfix.live.console import Metrics, PlaceWatch, SensorWatch
from railfix.live.engine import END_NS, EngineState, LiveEngine, LiveOutput
from railfix.live.forms import ROW_FORMS, _json_rows, cbor_bytes, forms, gga_sentence, wants, whole_message
from railfix.live.message import create_message, locate_train, no_input_message
from railfix.live.session import status_text
from railfix.live.settings import LiveSettings
from railfix.live.sinks import open_sink, parse_file_target
from railfix.live.sources import check_source, hidden, is_file
from railfix.live.state import belongs_to
from railfix.live.state_values import StateFormatError, decode, encode
from railfix.live.stream import FOREVER, Lag, Sensed, SensorLines, fresh_state
from railfix.live.train_ends import RunningEnd, TrainFrame
from railfix.motion.samples import GroundUnits, RadarSpeeds, SensorSamples, StationRanges
from railfix.motion.slip import MotionState
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor_state import State
from railfix.pipeline.received import no_navigation
from railfix.track import Trajectory
from railfix.tracking import Kind, TrackStatus
from run_made import LINE

pytestmark = pytest.mark.requirement("A8")
START: Final = np.datetime64("2024-03-05T00:00:10.25", "ns")
MS: Final = 1_000_000
NAN: Final = float("nan")


@dataclass
class Example:
    """A data class that is not of the package."""

    value: int


class Track(SimpleNamespace):
    """Filter of one epoch."""

    def __len__(self) -> int:
        return self.epochs


def single(
    chainage_m: float = 300.0, *, status: Status = Status.OK, level_m: float | None = 6.0, alarm: bool = False,
    used: int = 8, suspicion: int | None = None, seconds: float = 0.0,
) -> Any:  # fmt: skip
    """The last epoch of one antenna; the antenna lies at the arc of its chainage."""
    level = None if level_m is None else SimpleNamespace(
        level=SimpleNamespace(level_m=np.array([level_m])),
        status=np.array([LevelStatus.ALARM if alarm else LevelStatus.AVAILABLE]),
    )  # fmt: skip
    return SimpleNamespace(
        time=np.array([START + timedelta(seconds)]), arc_m=np.array([chainage_m]), along_sigma_m=np.array([1.234]),
        chainage_m=np.array([chainage_m]), status=np.array([status]), protection=level, n_used=np.array([used]),
        latitude_deg=np.array([35.5]), longitude_deg=np.array([-139.25]), height_m=np.array([61.5]),
        interference=None if suspicion is None else SimpleNamespace(suspicion=np.array([suspicion])),
    )  # fmt: skip


def filtered(
    chainage_m: float = 301.5, *, status: TrackStatus = TrackStatus.TRACKING, amount_m: float = NAN,
    speed: float = -12.5, epochs: int = 1, kinds: tuple[Kind, ...] = (), motion: MotionState = MotionState.NORMAL,
    probability: float = 0.9876,
) -> Any:  # fmt: skip
    used = np.zeros((1, len(Kind)), dtype=int)
    used[0, [*kinds]] = 1
    tracked = SimpleNamespace(
        arc_m=np.array([chainage_m]), sigma_m=np.array([0.456]), amount_m=np.array([amount_m]),
        level_m=np.array([amount_m]), status=np.array([status]), speed_mps=np.array([speed]),
        speed_sigma_mps=np.array([0.1]), probability=np.array([probability]), used=used,
    )  # fmt: skip
    return Track(
        tracked=tracked, chainage_m=np.array([chainage_m]), direction=np.sign(np.nan_to_num([speed])),
        standstill=np.array([speed == 0.0]), sensed=SimpleNamespace(state=np.array([motion])), epochs=epochs,
        latitude_deg=np.array([-35.75]), longitude_deg=np.array([139.5]), height_m=np.array([60.25]),
    )  # fmt: skip


def result(**antennas: tuple[Any, Any]) -> Any:
    fusion = {name: track for name, (_, track) in antennas.items() if track is not None}
    return SimpleNamespace(antennas={name: own for name, (own, _) in antennas.items()}, fusion=fusion, notes=())


def plain_line() -> dict[str, Trajectory]:
    """Both antennas on a line without a vehicle file."""
    return dict.fromkeys(("front", "rear"), Trajectory.from_antenna_path(LINE))


def output(of: Any, frame: TrainFrame, settings: LiveSettings, running: int) -> LiveOutput:
    place = locate_train(of, frame)
    return LiveOutput(message=create_message(of, place, settings, frame, running), result=of, place=place)


def _short(message: TrainMessage) -> str:
    """Return the fields of a message that are not as in an empty one."""
    fields = type(message).model_fields
    kept = {name: value for name, value in message if name not in ("train", "line") and value != fields[name].default}
    return " ".join(f"{name}={value}" for name, value in kept.items())


def _messages(_: Path) -> Iterator[Iterable[str]]:
    """Messages of every status of single epochs and filter, of trains with and without ends, of the best antenna."""
    settings = LiveSettings(train=7, line=9)
    frame = TrainFrame.of(plain_line(), settings)
    for own in (
        single(), single(NAN), single(status=Status.UNCERTAIN), single(status=Status.JAMMING_SUSPECTED),
        single(alarm=True), single(level_m=None), single(level_m=float("inf")), single(used=0, suspicion=2),
    ):  # fmt: skip
        for track in (
            None, filtered(), filtered(epochs=0), filtered(NAN, status=TrackStatus.OFF_MAP),
            filtered(amount_m=4.0, speed=0.0),
            filtered(status=TrackStatus.COASTING), filtered(status=TrackStatus.COASTING, amount_m=9.001, speed=NAN),
            filtered(status=TrackStatus.LOST, amount_m=3.0), filtered(probability=1.5), filtered(probability=NAN),
        ):  # fmt: skip
            yield [_short(output(result(front=(own, track)), frame, settings, 1).message)]
    for kinds, motion in product(((), *((kind,) for kind in Kind)), (MotionState.NORMAL, MotionState.INERTIAL_SLIDE)):
        found = result(front=(single(), filtered(kinds=kinds, motion=motion)))
        yield [_short(output(found, frame, settings, 1).message)]
    yield [_short(no_input_message(settings, frame, -1, 123_456_789))]
    vehicle = clean_trajectories()
    ends = ({}, {"front_offset_m": 7.5}, {"length_m": 40.0}, {"front_offset_m": 7.5, "length_m": 40.0})
    for trajectories, more, facing in product((vehicle, plain_line()), ends, (None, -1, 0, 1)):
        own = LiveSettings(facing=facing, **more)
        frame = TrainFrame.of(trajectories, own)
        yield frame.notes
        for running in (-1, 0, 1):
            near = result(
                front=(single(level_m=6.0), filtered(speed=1.0)), rear=(single(281.8, level_m=5.0, used=9), None)
            )
            yield [str(frame.ends(running)), _short(output(near, frame, own, running).message)]


def _forms(_: Path) -> Iterator[Iterable[str]]:
    """Every form of outputs with and without position, speed, bound and input, and which outputs a form takes."""
    settings = LiveSettings(reference=5, reference_m=100.0, length_m=40.0, front_offset_m=7.5, facing=1)
    frame = TrainFrame.of(clean_trajectories(), settings)
    cases = [
        output(result(front=(own, track)), frame, settings, running)
        for own, track, running in (
            (single(), filtered(), 1), (single(), None, 1), (single(NAN, level_m=None), None, 1),
            (single(), filtered(status=TrackStatus.COASTING, amount_m=9.0), -1), (single(alarm=True), filtered(), 1),
            (single(), filtered(), 0), (single(level_m=400_000.0), filtered(speed=0.0), 1),
        )
    ]  # fmt: skip
    blind = replaced(cases[0], result=None, place=None, message=no_input_message(settings, frame, 1, 5 * 10**17))
    no_end = TrainFrame.of(plain_line(), LiveSettings())
    cases += [blind, output(result(front=(single(), filtered())), no_end, LiveSettings(), 1)]
    for case in cases:
        for name, form in forms(settings).items():
            if name not in (*ROW_FORMS, "json", "cbor"):  # their content: `_messages`, and tests of the format
                yield [f"{name}: {form(case)!r}"]
        yield [f"gga: {gga_sentence(case)!r}"]
    yield [f"{len(cbor_bytes(cases[0]))} bytes in a stream, {len(whole_message(cbor_bytes, cases[0]))} in a datagram"]
    for part, name in product(("both", "rows", "message"), forms(settings)):
        yield [f"{name} takes an output of {part}: {wants(forms(settings)[name], replaced(cases[0], part=part))}"]
    table = pl.DataFrame(
        {"time_gpst": pl.Series(np.array([START])), "a": [NAN], "b": [float("inf")], "c": [-float("inf")], "d": [0.1]}
    )
    yield [repr(_json_rows(pl.concat([table, table.with_columns(d=pl.lit(1e-9))])))]
    metrics = Metrics(started=0.0, processing_s=deque([0.002, 0.004, 0.009]))
    for number, case in enumerate(cases):
        yield [status_text(case, metrics)]
        metrics.messages[MessageStatus.POSITION] += 1000
        metrics.lost["tcp://a"] += number
        metrics.sinks = [SimpleNamespace(dropped=number, failed=number // 4)]  # type: ignore[list-item]


def replaced(of: LiveOutput, **values: Any) -> LiveOutput:
    return replace(of, **values)


def _ends(_: Path) -> Iterator[Iterable[str]]:
    """The end that runs ahead along paths of position, bound and direction of motion."""
    for begin, steps in (
        (0, [(100, 2, 1), (120, 2, 1), (154, 2, 1), (154.1, 2, 1), (90, 2, -1), (49.9, 2, -1), (49.9, NAN, -1)]),
        (1, [(100, 2, -1), (60, 5, -1), (43, 5, -1), (39.9, 5, -1), (39, 5, 1), (99.8, 5, 1), (99.8, 5, 0)]),
        (
            -1,
            [(0, 1, 1), (49, 1, 1), (52.1, 1, 0), (52.1, 1, 1), (500, 1, -1), (448, 1, -1), (NAN, 1, -1), (447, 1, -1)],
        ),
        (0, [(100, 2, 0), (110, 2, 0), (50, 2, 0), (104.1, 2, -1), (45, 2, -1), (45, 2, 1)]),
    ):
        running = RunningEnd(direction=begin)
        for place, bound, moving in steps:
            before, running = running, running.after(float(place), float(bound), moving)
            yield [f"{place} {bound} {moving}: {running}", f"  {running.sentence(before)}"]


def _console(_: Path) -> Iterator[Iterable[str]]:
    """Metrics and summary; the watches with fake checks, which show what they were given and when."""
    with pytest.MonkeyPatch.context() as patch:
        now = [10.0]
        patch.setattr(console.time, "monotonic", lambda: now[0])
        metrics = Metrics(started=3.0)
        yield metrics.text().splitlines(), metrics.summary()
        kinds = {"both": MessageStatus.POSITION, "rows": MessageStatus.POSITION, "message": MessageStatus.NO_INPUT}
        messages = [SimpleNamespace(part=part, message=SimpleNamespace(status=kinds[part])) for part in kinds]
        for at, taken in ((10.0, messages[:1]), (10.125, messages), (11.0, messages[1:])):
            now[0] = at
            metrics.took(0.3, taken)  # type: ignore[arg-type]
        metrics.epochs, metrics.skipped = {"paired": 3, "late": 1}, Counter({'a "b"\\': 2, "none": 0})
        metrics.lost["tcp://a"] = 1200
        metrics.hangups = 4
        sinks = (("json@-", 5, 0), ("b", 0, 6))
        metrics.sinks = [SimpleNamespace(name=n, dropped=d, failed=f) for n, d, f in sinks]  # type: ignore[list-item]
        yield metrics.text().splitlines(), metrics.summary()
        yield from _watch(patch)
        yield from _observed(patch)
        said: list[str] = []
        check = iter([RailfixError("elsewhere")])
        patch.setattr(console, "ENOUGH_TO_STOP", 3)
        thrown = (console.MismatchError(str(error)) for error in check)
        patch.setattr(console, "check_same_place", lambda _: (_ for _ in ()).throw(next(thrown)))
        added = lambda tally, _: setattr(tally, "conventional", tally.conventional + 1)  # noqa: E731
        patch.setattr(console.AntennaTally, "add_conventional", added)
        places = PlaceWatch(said.append)
        for _ in range(5):
            places.take(SimpleNamespace(result=SimpleNamespace(antennas={"front": None})))  # type: ignore[arg-type]
            places.take(SimpleNamespace(result=None))  # type: ignore[arg-type]
            yield [f"place watch has said {said}"]


def _observed(patch: pytest.MonkeyPatch) -> Iterator[Iterable[str]]:
    """Sentences on balises are logged where the line has any, for outputs with rows."""
    patch.setattr(command, "balise_notes", lambda name, passings: [f"{name}: {passings}"])
    for balises, part in product((None, object()), ("both", "rows", "message")):
        said: list[str] = []
        log = SimpleNamespace(say=said.append, shows_status=False, show=None)
        inputs = SimpleNamespace(out=None, sensors={}, state=None)
        engine = SimpleNamespace(processor=SimpleNamespace(balises=balises))
        hooks, streams = command._hooks(inputs, LiveSettings(), engine, log, None, full="drop")  # type: ignore[arg-type]
        own = SimpleNamespace(antennas={}, fusion={"front": SimpleNamespace(passings="B1")})
        assert hooks.observe is not None
        for found in (own, None):
            hooks.observe(LiveOutput(message=None, result=found, part=part))  # type: ignore[arg-type]
        yield [f"balises {balises is not None}, {part}: {said} {hooks.sensed} {hooks.save} {hooks.show} {streams}"]


def _watch(patch: pytest.MonkeyPatch) -> Iterator[Iterable[str]]:
    """Positions each 5 s with the radar each second; the sensors are checked after ten minutes, the radar each."""
    said: list[str] = []

    class Checks:
        def __init__(self, places: list[pl.DataFrame], speeds: list[pl.DataFrame]) -> None:
            self.places, self.speeds = places[0], speeds[0]

        def notes(self, samples: SensorSamples, *_: Any) -> list[str]:
            times, metres = self.speeds["time_gpst"], self.places["chainage_m"].sum()
            speeds = f"{len(self.speeds)} speeds {self.speeds['speed_mps'].sum():.1f}"
            return [f"{len(self.places)} places {metres:.0f} m, {speeds}, {len(samples.radar)} rows to {times[-1]}"]

    patch.setattr(console, "SensorChecks", Checks)
    patch.setattr(console.RadarWatch, "take_samples", lambda _self, radar, time, speeds: [SimpleNamespace(
        sentence=f"radar {len(radar)} rows, {len(time)} times to {time[-1]}, speeds {speeds.sum():.1f}")])  # fmt: skip
    cases = ((False, False, 700, 0), (True, False, 700, 0), (False, True, 1300, 0), (True, False, 1300, 640))
    for table, dark, length_s, still_s in cases:  # `still_s`: until then one speed alone
        said.clear()
        processor = SimpleNamespace(trajectories=clean_trajectories(), units=None, config=SimpleNamespace(sensors=None))
        watch = SensorWatch(processor, said.append)  # type: ignore[arg-type]

        def radar(first: int, count: int) -> SensorSamples:
            time = START + timedelta(np.arange(first, first + count, dtype=float))
            return SensorSamples(radar=RadarSpeeds(time=time, speed_mps=np.full(count, 10.0)))

        if table:
            watch.take(Sensed(sensor="radar", samples=radar(0, length_s), until=FOREVER))
        for second in range(0, length_s, 5):
            if not table:
                for part in range(second, second + 5):
                    watch.take(Sensed(sensor="radar", samples=radar(part, 1), until=START + timedelta(float(part))))
            status = Status.UNCERTAIN if second % 50 == 10 or dark else Status.OK
            own = single(100.0 + second, seconds=float(second), status=status)
            track = filtered(
                100.0 + second,
                kinds=(Kind.DOPPLER,) if second % 20 and not 10 < second < still_s else (),
                speed=NAN if second == 5 else 1.0,
            )
            before = len(said)
            given = [{"front": (own, track)}] * 2 + [{"rear": (own, track)}, {"front": (own, None)}]  # counts once
            for result_ in (result(**antennas) for antennas in given):
                watch.take(LiveOutput(message=None, result=result_))  # type: ignore[arg-type]
            watch.take(LiveOutput(message=None, result=None))  # type: ignore[arg-type]
            if len(said) > before:
                yield [f"table {table}, dark {dark}, {second} s: {said[before:]}"]
        stores = (watch._place_ns, watch._speed_ns, watch._samples, watch._blocks, watch._radar.radar)
        kept = tuple(map(len, stores))
        watch.judge()
        yield [f"kept {kept}; {len(said)} sentences, the last {said[-1:]}"]


class Processor(SimpleNamespace):
    """Takes epochs and returns their tags as positions; what it was given is noted."""

    def screen(self, epochs: dict[str, Observations], state: Any, **given: Any) -> Any:
        named: dict[str, Any] = {name: _count(value) for name, value in given.items() if value is not None}
        named.pop("sensors", None)
        sensors = given["sensors"]
        if sensors is not None:
            named["radar"], named["silent"] = len(sensors.radar), sorted(sensors.silent)
        self.given.append(f"{'no state' if state is None else 'state'} {named}")
        return (epochs, state)

    def position(self, *screened: Any) -> Any:
        return screened

    def along_track(self, epochs: dict[str, Observations], _: Any) -> Any:
        antennas = {}
        for name, epoch in epochs.items():
            seconds = _second(epoch)
            place = 300.0 + 18.2 * (name == "front") + 40.0 * seconds
            antennas[name] = single(place, seconds=seconds)
        notes = self.notes_later.pop(0) if self.notes_later else None
        state = State(received=None if notes is None else SimpleNamespace(notes=notes))  # type: ignore[arg-type]
        found = result(**{name: (own, None) for name, own in antennas.items()})
        found.notes = (*(notes or ()), *(f"epoch {note}" for note in notes or ()), "a note")
        return found, state


def _count(value: Any) -> int:
    return len(value) if hasattr(value, "__len__") else 1


def _second(epoch: Observations) -> float:
    return float((epoch.time[0] - START) / np.timedelta64(1, "s"))


def epoch_at(milliseconds: float) -> Observations:
    blank = np.full((1, 1), NAN)
    return Observations(
        time=np.array([START + np.timedelta64(round(milliseconds * MS), "ns")]), satellite=np.array(["G01"]),
        signal=np.array(["1C"]), code_m=blank, phase_cycles=blank, doppler_hz=blank, cn0_dbhz=blank,
        loss_of_lock=np.zeros((1, 1), dtype=bool), break_before=np.zeros(1, dtype=bool),
    )  # fmt: skip


def _engine(*antennas: str, sensors: tuple[str, ...] = (), **settings: Any) -> LiveEngine:
    processor = Processor(
        notes=("a note",), received=SimpleNamespace(notes=(), navigation=no_navigation()),
        trajectories={name: clean_trajectories()[name] for name in antennas}, balises=None, units=None, given=[],
        notes_later=[], config=SimpleNamespace(antenna_pair=SimpleNamespace(tag_tolerance_s=0.01)),
    )  # fmt: skip
    return LiveEngine(processor, LiveSettings(**settings), sensors)  # type: ignore[arg-type]


def _shown(engine: LiveEngine, at_ms: float, outputs: list[LiveOutput]) -> Iterator[str]:
    for found in outputs:
        tags = {} if found.result is None else {n: float(_second(a)) for n, a in found.result.antennas.items()}
        given = engine.processor.given.pop(0) if found.result is not None and engine.processor.given else ""  # type: ignore[attr-defined]
        message = found.message
        words = (found.part, message.sequence, message.status.name, "sent", message.sent_ns, tags, given)
        yield f"  {at_ms:g} ms: {' '.join(map(str, words))}"
    while engine.reports:
        yield f"  {at_ms:g} ms: {engine.reports.popleft()}"


def _play(engine: LiveEngine, steps: list[tuple[float, str, float]], *, live: bool) -> Iterator[str]:
    """Push epochs (antenna, tag) or poll ("") at times [ms]; after each the wait."""
    for at, name, tag in steps:
        now = round(at * MS)
        if name in ("front", "rear"):
            engine.push(name, epoch_at(tag), now_ns=now)
        yield from _shown(engine, at, engine.poll(now_ns=now, sent_ns=now if live else None))
        yield f"  {at:g} ms: wait {engine.wait_s(now_ns=now):.4f} s"
    yield f"  {dict(sorted(engine.counts.items()))}"


def _sessions(_: Path) -> Iterator[Iterable[str]]:
    """Scripts of epochs and polls of an engine; every output, report, wait and count."""
    pairs = [
        (100.0 * k + late, name, 100.0 * k) for k in range(4) for name, late in (("front", 0.0), ("rear", 5.0 + 10 * k))
    ]
    for live in (False, True):
        steps = [*pairs, (400.0, "", 0), (460.0, "", 0), (700, "", 0)]
        yield ["pairs", *_play(_engine("front", "rear"), steps, live=live)]
        early = [(0.0, "front", 0.0), (30.0, "front", 100.0), (60.0, "front", 200.0), (100.0, "", 0), (149.0, "", 0),
                 (200, "front", 300), (260, "", 0), (351, "", 0), (450, "", 0), (452, "", 0)]  # fmt: skip
        yield ["early and silent", *_play(_engine("front"), early, live=live)]
        order = [(0, "front", 500), (100, "front", 600), (110, "front", 600), (120, "front", 550), (200, "front", 700),
                 (300, "front", 100), (400, "front", 200), (500, "front", 300), (600, "front", 400.6),
                 (700, "front", 250)]  # fmt: skip
        yield ["order and restart", *_play(_engine("front", restart_epochs=3), order, live=live)]
        behind = [(max(100.0 * k, 3000.0 if k > 4 else 0.0), "front", 100.0 * k) for k in range(34)]
        yield ["behind", *_play(_engine("front", behind_s=1.0, no_input="skip"), behind, live=live)]
    late = [(0.0, "front", 0.0), (300.0, "", 0), (310.0, "rear", 0.0), (320.0, "rear", 300.0), (700.0, "", 0)]
    yield ["a late antenna", *_play(_engine("front", "rear", no_input="skip"), late, live=False)]
    engine = _engine("front", "rear", pair_wait_s=5.0, no_input="skip")
    queued = [*_play(engine, [(float(k), "front", 100.0 * k) for k in range(103)], live=False)]
    yield ["queue", *queued[:2], *queued[50:53], *queued[-2:]]
    left = [*_shown(engine, 0, engine.poll(now_ns=END_NS))]
    yield [f"{len(left)} left", left[0], left[-1], str(dict(engine.counts))]
    slow = _engine("front", "rear", period_s=5.0, pair_wait_s=3.0)
    yield ["a period of 5 s", *_play(slow, [(0.0, "front", 0.0), (2000.0, "", 0), (3100.0, "", 0)], live=False)]
    yield from _sensed_and_heard()
    yield from _changes()
    yield from _resumed()
    lag = Lag(behind_s=1.0)
    before = -1
    for k in range(80):
        delay = 0 if k < 5 else 2000 if k < 45 else 100 if k < 60 else 3000 + 250 * (k % 2)
        skipped = lag.skips(k * 100 * MS, (k * 100 + delay) * MS)
        if len(lag.reports) > before or k % 10 == 0:
            yield [f"lag {k}: {skipped} {lag.skipped} {lag.reports[-1:]}"]
        before = len(lag.reports)


def _sensed_and_heard() -> Iterator[Iterable[str]]:
    """Epochs that wait for a sensor; data of satellites and of a base station before and between epochs."""
    engine = _engine("front", sensors=("radar", "tachometer"), no_input="skip", sensor_wait_s=0.05)

    def heard(sensor: str, first: int, to: int) -> None:
        time = START + np.arange(first, to, 50) * np.timedelta64(MS, "ns")
        samples = SensorSamples(radar=RadarSpeeds(time=time, speed_mps=np.ones(len(time))))
        end = START + np.timedelta64(to * MS, "ns")
        engine.add_samples(Sensed(sensor=sensor, samples=samples if sensor == "radar" else SensorSamples(), until=end))

    lines = []
    for at, name, tag in ((0.0, "front", 0.0), (40.0, "", 0), (51.0, "", 0)):
        lines += _play(engine, [(at, name, tag)], live=False)
    heard("radar", 0, 150)
    heard("tachometer", 0, 100)
    lines += _play(engine, [(100, "front", 100.0), (200, "front", 200.0), (249, "", 0), (251, "", 0)], live=False)
    yield lines
    engine = _engine("front", no_input="skip")
    for at in (0, 100, 100, 50, 200):
        engine.add_base(epoch_at(at))
    engine.add_navigation(no_navigation())
    lines = _play(engine, [(0.0, "front", 0.0)], live=False)
    yield lines
    engine.add_sbas(SimpleNamespace(merge=lambda _: None))  # type: ignore[arg-type]
    engine.add_base(epoch_at(300))
    yield _play(engine, [(100.0, "front", 100.0), (200.0, "front", 200.0)], live=False)


def _changes() -> Iterator[Iterable[str]]:
    """Replacements of requested data that begin, change and end."""
    engine = _engine("front", no_input="skip")
    engine.processor.notes_later += [("b", "c"), ("b", "c"), ("c", "d"), ()]  # type: ignore[attr-defined]
    yield _play(engine, [(100.0 * k, "front", 100.0 * k) for k in range(5)], live=False)
    engine, seen = _engine("front", "rear", no_input="skip"), []

    def add(front: tuple[np.ndarray, ...], rear: tuple[np.ndarray, ...]) -> bool:
        seen.append(f"order at {front[1][-1]:.1f} and {rear[1][-1]:.1f} m")
        return len(seen) > 2

    engine._order = SimpleNamespace(add=add, note="the antennas are exchanged")  # type: ignore[assignment]
    pairs = [(100.0 * k, name, 100.0 * k) for k in range(12) for name in ("front", "rear")]
    yield [*_play(engine, pairs, live=False), *seen]


def _resumed() -> Iterator[Iterable[str]]:
    """A saved state is continued within a minute after it, and is left out otherwise."""
    tag = int((START - GPS_EPOCH).astype(np.int64))
    for age_s in (0.1, 60.0, 60.001, 0.0, -5.0, None):
        engine = _engine("front", no_input="skip")
        yield [str(engine.export_state(reserved=3))]
        if age_s is not None:
            done = tag - round(age_s * 1e9)
            saved = EngineState(
                state=State(), done_ns=done, last_tag={"front": done}, sequence=41, running=RunningEnd(direction=1)
            )
            engine.resume(saved)
            yield [f"{age_s}: {engine.export_state(reserved=3).sequence}"]
        yield [*_play(engine, [(0.0, "front", 0.0), (100.0, "front", 100.0)], live=False)]
        state = engine.export_state(reserved=2)
        yield [f"{state.sequence} {state.done_ns - tag} {state.last_tag} {state.running.direction}"]
        engine.start(now_ns=5)
        yield [f"due {engine._due_ns}"]


def _streams(_: Path) -> Iterator[Iterable[str]]:
    """Lines of sensors, whole, cut, wrong and of a time alone; sources and targets by their texts."""
    for sensor, header, rows in (
        ("tachometer", "time_gpst,pulse,direction",
         ("T01,4,1", "T02,5,-1", "T02,,", "T03,6", "T03,x,1", "T03,nan,1", "T04,,1")),
        ("radar", " speed_mps , time_gpst",
         ("1.5,T01", "2.5,T00", "inf,T03", ",T03", "2.5,NaT", ",NaT", "2.5, T04 ", "# 9,T05")),
        ("ranging", "time_gpst,unit,range_m,sigma_m",
         ("T01,A,5,0.1", "T02,,5,0.1", "T02,A,,0.1", "T02,B,6,", "T03,,,")),
        ("balises", "time_gpst,balise", ("T01,B1", "T02,", "T03,B2,")),
        ("inertial", "time_gpst,force_forward_mps2", ("T01,1",)),
    ):  # fmt: skip
        lines = SensorLines(sensor=sensor, source="test")
        for text in (header, *rows, header):
            data = text.replace("T0", "2024-03-05T03:10:0").encode() + b"\n"
            try:
                for piece in (data[:3], data[3:]):
                    found = lines.take(piece)
            except RailfixError as error:
                yield [f"{sensor} {text!r}: {error}"]
                break
            samples = [line for line in describe(getattr(found.samples, sensor)) if ":" in line]
            yield [f"{sensor} {text!r}: until {found.until}, {found.skipped} skipped", *samples]
    lines.take(b"x" * 9000)
    yield [f"rest {len(lines.rest)}"]
    units = GroundUnits(name=np.array(["A"]), ecef_m=np.zeros((1, 3)))
    ranges = StationRanges(
        time=np.full(3, START), station=np.array(["A", "B", "C"]), range_m=np.ones(3), sigma_m=np.ones(3)
    )
    sensed = Sensed(sensor="ranging", samples=SensorSamples(ranging=ranges), until=START)
    yield [f"unsurveyed {sensed.count_unsurveyed(units)} {sensed.count_unsurveyed(None)}"]
    date = np.datetime64("2024-03-05T01:00:00", "ns")
    yield [str(fresh_state("file:a", date).stream.time), str(fresh_state("file:a").stream.time)]
    live_time = fresh_state("tcp://a:1").stream.time
    yield [f"of now: {bool(abs(live_time - np.datetime64('now')) < np.timedelta64(60, 's'))}"]
    for source in (
        "-", "a.ubx", "file:a.ubx", "tcp://h:1", "tcp://h", "tcp://:1", "tcp://h:x", "ntrip://h:1", "ntrip://h:1/",
        "ntrips://u:p@h:2/M", "serial:/dev/x?baud=9600", "serial:/dev/x?baud=x", "serial:?baud=1", "ftp://h/a", "tcp://h:0",
    ):  # fmt: skip
        try:
            check_source(source)
            said = "taken"
        except RailfixError as error:
            said = str(error)
        yield [f"{hidden(source)}: {said}; a file {is_file(source)}"]
    for value in (PlaceWatch(str), Example(1), {"a": (1.5, b"x", slice(1, 2)), 3: {4}}, np.array([None])):
        try:
            said = repr(decode(encode(value)))
        except StateFormatError as error:
            said = str(error).replace(f"{__name__}.", "")
        yield [f"{type(value).__name__} in a state: {said}"]
    priors = [{"satellite_prior": dict(pairs)} for pairs in ((("G", 1e-5), ("E", 2e-5)), (("E", 2e-5), ("G", 1e-5)))]
    heads = [belongs_to({}, {"settings": parse_config({"risk": risk})}, ("front",)) for risk in priors]
    yield [f"the order of keys in settings changes nothing: {heads[0] == heads[1]}, {list(heads[0])}"]
    targets = "json@- json @a word@a json@ json@udp://h json@tcp-server://:5 json@udp://h:x json@/"
    for target in targets.split():
        try:
            sink: Any = asyncio.run(open_sink(target))
            said = f"{sink.name} {sink.dropped} {sink.failed}"
        except RailfixError as error:
            said = str(error)
        yield [f"{target}: file {parse_file_target(target)}; {said}"]


def _prepared(_: Path) -> Iterator[Iterable[str]]:
    """What is processed to compile the kernels: settings, epochs in one call and one by one; sentences."""
    calls: list[str] = []

    def processed(epochs: dict[str, Observations], state: Any = None) -> tuple[None, int]:
        calls.append(f"  {', '.join(f'{n} {len(e)} from {_second(e):g}' for n, e in epochs.items())}, state {state}")
        return None, len(calls)

    def made(config: Any, *_: Any) -> Any:
        calls.append(f"filter {config.filter}, {config.systems}, mask {config.elevation.mask_deg}, {config.protection}")
        return SimpleNamespace(process=processed)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(warm_up, "make_processor", made)
        process = SimpleNamespace(wait=lambda: calls.append("waited"))
        popen = SimpleNamespace(Popen=lambda words: calls.append(f"started {words[1:]}") or process)
        patch.setattr(warm_up, "subprocess", popen)
        patch.setattr(warm_up.kernels, "is_compiled", lambda: False)
        patch.setattr(warm_up.kernels, "record_compiled", lambda: calls.append("recorded"))
        noted = _noted(calls, (np.zeros((1, 2)), np.zeros((1, 2, 3)), *np.zeros((3, 1, 2))))
        patch.setattr(warm_up.kernels.off_tangent, "forms_of_hypotheses", noted)
        patch.setattr(warm_up.kernels.off_tangent, "risk_beyond", _noted(calls, 0.0))
        patch.setattr(warm_up.sys, "stderr", SimpleNamespace(isatty=lambda: True, write=calls.append))
        patch.setattr(warm_up.time, "monotonic", iter([1.0, 8.4]).__next__)
        yield [f"compiled {warm_up.prepare_kernels()}", *calls]
        calls.clear()
        patch.setattr(warm_up.kernels, "is_compiled", lambda: True)
        yield [f"compiled {warm_up.prepare_kernels()}", *calls]
        logs = warm_up._read_logs()
        for name, log in logs.items():
            largest = describe(np.nanmax(log.code_m, axis=0), "largest codes")
            yield [name, *describe(log.satellite, "satellites"), *largest]
        ran = lambda _self, _state, *more, **named: calls.append(f"run {more} {named}")  # noqa: E731
        patch.setattr(warm_up.Recursion, "run", ran)
        warm_up.compile_filter()
        yield calls


def _noted(calls: list[str], answer: Any) -> Callable[..., Any]:
    def called(*arguments: Any) -> Any:
        flat = [part for one in arguments for part in (one if isinstance(one, tuple) else (one,))]
        calls.append(" ".join(f"{a.shape}{a.dtype}" if isinstance(a, np.ndarray) else str(a) for a in flat))
        return answer

    return called


CASES: Final[dict[str, Callable[[Path], Iterable[Iterable[str]]]]] = {
    "live_messages": _messages,
    "live_forms": _forms,
    "live_ends": _ends,
    "live_console": _console,
    "live_sessions": _sessions,
    "live_streams": _streams,
    "live_prepared": _prepared,
}


@pytest.mark.parametrize("name", CASES)
def test_sessions_do_what_was_reviewed(name: str, tmp_path: Path) -> None:
    check_described(name, CASES[name](tmp_path))


if __name__ == "__main__":
    write_described(CASES, sys.argv[1:])
