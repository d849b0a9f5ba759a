"""Control centre: states against an independent table, simulated running, and a centre that is killed."""

from __future__ import annotations

import os
import random
import signal
import sys
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railfix.ground.centre import (
    CentreLimits,
    ReferenceCurve,
    Rejection,
    TrainRecord,
    TrainState,
    report_received,
    time_passed,
)
from railfix.ground.store import Store
from railfix.io.train_message import MessageStatus, TrainMessage
from railfix.simulate.demonstration import demo_truth

pytestmark = pytest.mark.requirement("F2")

LIMITS = CentreLimits()
STATIONS = np.array([0.0, 3000.0, 8000.0, 12000.0])
UP = ReferenceCurve.between_stations(STATIONS, speed_mps=20.0)
DOWN = ReferenceCurve.between_stations(STATIONS[::-1], speed_mps=20.0)
CURVES = {1: UP, -1: DOWN}


def message(sequence: int, place_m: float, *, facing: int = 1, age_s: float = 0.2, train: int = 7) -> TrainMessage:
    time = 1_400_000_000_000_000_000 + sequence * 1_000_000_000
    return TrainMessage(
        train=train,
        sequence=sequence,
        time_ns=time,
        sent_ns=time + round(age_s * 1e9),
        line=1,
        chainage_cm=round(place_m * 100),
        over_cm=500,
        under_cm=500,
        facing=facing,
        direction=facing,
        status=MessageStatus.POSITION,
        length_cm=6000,
    )


#: State, event -> state. Events: a counted report; silence up to 3 s, to 120 s, beyond.
TABLE = {
    ("unknown", "report"): "tracked", ("unknown", "short"): "unknown", ("unknown", "long"): "unknown",
    ("unknown", "beyond"): "unknown", ("tracked", "report"): "tracked", ("tracked", "short"): "tracked",
    ("tracked", "long"): "simulated", ("tracked", "beyond"): "error", ("simulated", "report"): "tracked",
    ("simulated", "short"): "simulated", ("simulated", "long"): "simulated", ("simulated", "beyond"): "error",
    ("error", "report"): "tracked", ("error", "short"): "error", ("error", "long"): "error",
    ("error", "beyond"): "error",
}  # fmt: skip

EVENTS = st.lists(
    st.one_of(
        st.tuples(st.just("report"), st.integers(0, 40), st.sampled_from([0.0, 0.2, 4.9, 5.1, -0.05, -0.9, -1.1])),
        st.tuples(st.just("nothing"), st.integers(0, 40), st.just(0.0)),
        st.tuples(st.just("other"), st.integers(0, 40), st.just(0.0)),
        st.tuples(st.just("time"), st.sampled_from([0.5, 1.0, 3.0, 3.5, 60.0, 119.0, 130.0]), st.just(0.0)),
    ),
    max_size=40,
)


@given(EVENTS)
@settings(max_examples=100)
def test_states_follow_the_table(events: list[tuple[str, float, float]]) -> None:
    """Random orders, losses, repeats, clock steps of the train; the table counts sequence and silence on its own."""
    record, now, state, newest, heard = TrainRecord(train=7), 100.0, "unknown", -1, 0.0
    for kind, value, age in events:
        if kind == "time":
            now += float(value)
        elif kind == "report":
            record, reason = report_received(record, message(int(value), 1000.0, age_s=age), now, limits=LIMITS)
            if value > newest:
                newest = value
                if -1.0 <= age <= 5.0:  # a clock that is behind by less counts
                    state, heard = TABLE[state, "report"], now
                    assert reason is None
                else:
                    assert reason is Rejection.TOO_OLD
            else:
                assert reason is Rejection.REPEATED
        elif kind == "nothing":
            empty = TrainMessage(train=7, sequence=int(value), time_ns=1, sent_ns=1, line=1)
            record, reason = report_received(record, empty, now, limits=LIMITS)
            assert reason is (Rejection.NO_PLACE if value > newest else Rejection.REPEATED)
            newest = max(newest, value)
        else:
            other = message(int(value), 500.0, train=8)
            assert report_received(record, other, now, limits=LIMITS) == (record, Rejection.OTHER_TRAIN)
        record = time_passed(record, now, curves=CURVES, limits=LIMITS)
        silent = now - heard
        state = TABLE[state, "short" if silent <= 3.0 else "long" if silent <= 120.0 else "beyond"]
        assert record.state.value == state
        assert record.sequence == newest


def test_a_train_that_only_runs_late_is_shown_where_it_is() -> None:
    """Ten minutes late on the reference curve: simulated running is by place, so its error is 0."""
    late = 600.0
    for running in (100.0, 130.0, 151.0):
        place = float(np.interp(running, UP.running_s, UP.chainage_m))
        record, _ = report_received(TrainRecord(train=7), message(1, place, age_s=0.0), running + late, limits=LIMITS)
        for ahead in (4.0, 20.0, 37.0):
            shown = time_passed(record, running + late + ahead, curves=CURVES, limits=LIMITS).shown_m
            true = np.interp(running + ahead, UP.running_s, UP.chainage_m)
            assert shown == pytest.approx(true, abs=0.05)


@pytest.mark.parametrize(("facing", "start"), [(1, 4000.0), (-1, 7000.0)])
def test_a_train_ten_percent_slower_is_off_by_a_tenth(facing: int, start: float) -> None:
    """At an even 20 m/s the simulated place runs ahead by 0.1 v t; the jump at the next report is minus that."""
    record, _ = report_received(TrainRecord(train=7), message(1, start, facing=facing, age_s=0.0), 0.0, limits=LIMITS)
    for t in (5.0, 20.0, 60.0):
        record = time_passed(record, t, curves=CURVES, limits=LIMITS)
        true = start + facing * 0.9 * 20.0 * t
        assert facing * (record.shown_m - true) == pytest.approx(0.1 * 20.0 * t, abs=0.05)
    record, _ = report_received(record, message(2, true, facing=facing), 60.5, limits=LIMITS)
    assert record.state is TrainState.TRACKED
    assert record.jump_m == pytest.approx(-120.0, abs=0.05)


def test_simulated_running_starts_at_a_station_and_ends_at_the_next() -> None:
    record, _ = report_received(TrainRecord(train=7), message(1, 3000.0, age_s=0.0), 0.0, limits=LIMITS)
    assert time_passed(record, 4.0, curves=CURVES, limits=LIMITS).shown_m == pytest.approx(3004.0, abs=0.1)
    near, _ = report_received(TrainRecord(train=7), message(1, 7500.0, age_s=0.0), 0.0, limits=LIMITS)
    assert time_passed(near, 119.0, curves=CURVES, limits=LIMITS).shown_m == pytest.approx(8000.0)


def test_the_end_of_the_authority_is_an_error() -> None:
    record, _ = report_received(TrainRecord(train=7), message(1, 4000.0, age_s=0.0), 0.0, limits=LIMITS)
    record = time_passed(record, 20.0, curves=CURVES, authority_m=4300.0, limits=LIMITS)
    assert (record.state, record.shown_m) == (TrainState.ERROR, 4300.0)


def test_station_or_section_and_progress() -> None:
    assert UP.station_at(3010.0) == 1
    assert UP.station_at(3100.0) is None
    assert UP.progress(4250.0) == (1, 25.0)
    assert DOWN.progress(4250.0) == (1, 75.0)  # section from 8000 to 3000 m, in running direction
    assert UP.progress(13_000.0) == (2, 100.0)


def test_closed_form_of_the_run_curve() -> None:
    """3000 m at 20 m/s and 0.5 m/s^2: 20 / 0.5 + 3000 / 20 = 190 s; 400 m on the way up to 20 m/s."""
    assert np.interp(190.0, UP.running_s, UP.chainage_m) == pytest.approx(3000.0)
    assert np.interp(40.0, UP.running_s, UP.chainage_m) == pytest.approx(400.0)


def _centre(path: str, pipe: Connection) -> None:
    """Store reports and acknowledge each, until killed."""
    with Store(f"sqlite:///{path}") as store:
        records = store.records()
        while True:
            sequence = pipe.recv()
            record = records.get(7, TrainRecord(train=7))
            record, reason = report_received(record, message(sequence, 10.0 * sequence), 0.0, limits=LIMITS)
            if reason is None:
                store.save(record)
                records[7] = record
            pipe.send(sequence)


def test_the_last_of_several_records_of_a_train_is_kept(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path / 'centre.db'}") as store:
        store.save(TrainRecord(train=3, sequence=1), TrainRecord(train=1, sequence=5))
        store.save(TrainRecord(train=1, sequence=6), TrainRecord(train=1, sequence=7))
        assert [(train, record.sequence) for train, record in store.records().items()] == [(1, 7), (3, 1)]


@pytest.mark.parametrize("kills", [8, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_killed_centre_loses_no_acknowledged_report(tmp_path: Path, kills: int) -> None:
    rng, context = random.Random(5), get_context("fork")
    path, sequence, acknowledged = str(tmp_path / "centre.db"), 0, -1
    for _ in range(kills):
        here, there = context.Pipe()
        process = context.Process(target=_centre, args=(path, there), daemon=True)
        process.start()
        for _ in range(rng.randrange(1, 12)):
            here.send(sequence)
            sequence += 1
        for _ in range(rng.randrange(0, 8)):
            if not here.poll(0.5):
                break
            acknowledged = here.recv()
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        while here.poll(0):  # acknowledged before it was killed, read late
            try:
                acknowledged = here.recv()
            except (EOFError, OSError):
                break
        with Store(f"sqlite:///{path}") as store:
            stored = store.records()
        if acknowledged >= 0:
            assert stored[7].sequence >= acknowledged
        for record in stored.values():
            assert record.sequence < sequence
            assert record.message == message(record.sequence, 10.0 * record.sequence)
            assert record.state is TrainState.UNKNOWN


def test_one_number_far_ahead_locks_no_train_out() -> None:
    """However often it comes; after an outage the number may be as far ahead as a train counts meanwhile."""
    record, reasons = TrainRecord(train=7), []
    far, repeated = Rejection.FAR_AHEAD, Rejection.REPEATED
    for now_s, number, expected in (
        (1.0, 5, None), (1.0, 1 << 60, far), (1.0, (1 << 60) + 1, far), (2.0, 6, None), (3.0, 1_500, far),
        (50.0, 1_500, None), (51.0, 7, repeated),
    ):  # fmt: skip
        record, reason = report_received(record, message(9, 50.0).replaced(sequence=number), now_s, limits=LIMITS)
        reasons.append(reason is expected)
        if expected is far:
            assert record.rejected == far.value
    assert all(reasons)
    assert record.sequence == 1_500


def test_a_start_on_board_begins_anew_whatever_the_clocks_say() -> None:
    """Numbers begin again, an hour earlier by its clock; what is late of the start before counts for nothing."""
    record = TrainRecord(train=7)
    hour_ns = 3_600_000_000_000
    for number, session, hours, expected in (
        (900, 4, 1, None), (1, 5, 0, None), (901, 4, 1, Rejection.EARLIER_START), (2, 5, 0, None),
        (1, 5, 0, Rejection.REPEATED), (1, 6, 2, None), (3, 5, 0, Rejection.EARLIER_START),
    ):  # fmt: skip
        sent = message(9, 50.0)
        sent = sent.replaced(
            sequence=number,
            session=session,
            time_ns=sent.time_ns + hours * hour_ns,
            sent_ns=sent.sent_ns + hours * hour_ns,
        )
        record, reason = report_received(record, sent, 1.0, limits=LIMITS)
        assert reason is expected


def test_documents_and_log_are_kept(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'centre.db'}"
    with Store(url) as store:
        store.save(documents={"interlocking": "first"})
        store.save(documents={"interlocking": "second"})
        for k in range(5):
            store.note(k, f"line {k}", train=k)
    with Store(url) as store:
        assert store.document("interlocking") == "second"
        assert store.document("other") is None
        assert store.log(last=2) == [(3, 3, "line 3"), (4, 4, "line 4")]


@pytest.mark.parametrize("facing", [1, -1])
def test_a_run_with_a_coverage_hole_is_simulated_and_resynchronised(facing: int) -> None:
    """The demonstration run at 1 Hz, out of coverage for 40 s; the other way round the line is mirrored."""
    truth = pl.read_csv(demo_truth(), schema_overrides={"time_gpst": pl.Datetime("ns")}).filter(antenna="front")
    seconds = (truth["time_gpst"] - truth["time_gpst"][0]).dt.total_nanoseconds().to_numpy() / 1e9
    place = truth["chainage_m"].to_numpy()
    place = place if facing > 0 else 10_000.0 - place
    ends = np.sort([place.min() - 500.0, place.max() + 500.0])[::facing]
    curve = ReferenceCurve.between_stations(ends, speed_mps=15.0)
    last, hole = 90, range(25, 65)  # the train turns back at 100 s
    record, shown = TrainRecord(train=7), []
    for second in range(last):
        true = float(np.interp(second, seconds, place))
        if second not in hole:
            report = message(second + 1, true, facing=facing, age_s=0.0)
            record, reason = report_received(record, report, float(second), limits=LIMITS)
            assert reason is None
        record = time_passed(record, float(second), curves={facing: curve}, limits=LIMITS)
        if record.state is TrainState.SIMULATED:
            shown.append((second, record.shown_m))
        elif record.state is TrainState.TRACKED and second not in hole:
            assert record.shown_m == pytest.approx(true, abs=0.006)
    assert [second for second, _ in shown] == list(range(hole[0] + 3, hole[-1] + 1))  # silent for more than 3 s
    # by place on the curve, from the last report on
    begun, first = np.interp(hole[0] - 1, seconds, place), hole[0] - 1
    running = np.interp(facing * begun, facing * curve.chainage_m, curve.running_s)
    for second, simulated in shown:
        expected = np.interp(running + second - first, curve.running_s, curve.chainage_m)
        assert simulated == pytest.approx(expected, abs=0.02)
    back = hole[-1] + 1
    assert record.jump_m == pytest.approx(facing * (np.interp(back, seconds, place) - shown[-1][1]), abs=0.02)
    assert abs(record.jump_m) > 1.0
