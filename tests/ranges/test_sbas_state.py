"""SBAS messages that arrive one after another: corrections are those of the whole log at every epoch."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import sbas_cases as cases
from railfix.io.rinex import read_navigation
from railfix.ranges.sbas import SatelliteState, SbasCorrections, SbasLimits, SbasMessages, SbasState, read_sbas

pytestmark = pytest.mark.requirement("C1")
SATELLITES = np.array([f"G{number:02d}" for number in range(1, 33)])
PLACE = (36.0, 138.0)
OFF = SbasLimits(range_rate="off", incomplete="inflate")


def answers(corrections: SbasCorrections, time: np.ndarray, navigation=None) -> list[np.ndarray]:
    """Everything that corrections give at epochs, for directions that depend on the epoch alone."""
    fixes = corrections.satellites(time, SATELLITES, navigation)
    second = (time - cases.START) / np.timedelta64(1, "s")
    azimuth = (second[:, None] * 7.0 + np.arange(len(SATELLITES)) * 11.0) % 360.0
    elevation = 5.0 + (second[:, None] * 3.0 + np.arange(len(SATELLITES)) * 5.0) % 85.0
    place = tuple(np.full(len(time), value) for value in PLACE)
    delays = corrections.ionosphere(time, *place, elevation, azimuth)
    sight = np.stack([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], axis=-1)
    factor = corrections.delta_udre(time, fixes, sight, *place)
    # The row of a covariance is a number within the messages at hand; its effect is in `factor`.
    values = [getattr(fixes, item.name) for item in fields(fixes) if item.name != "covariance"]
    return [*values, *(getattr(delays, item.name) for item in fields(delays)), factor]


def arriving(messages: SbasMessages, time: np.ndarray, step: int, limits: SbasLimits, navigation=None, prn: int = 137):
    """The same, with messages handed over in portions of as many epochs, and forgotten behind them."""
    state, parts, most = SbasState(prn=prn, limits=limits), [], 0
    for start in range(0, len(time), step):
        chunk = time[start : start + step]
        after = chunk[-1] if start + step < len(time) else messages.time.max()
        before = time[start - 1] if start else np.datetime64("1980-01-01", "ns")
        state = state.add_messages(messages.take((messages.time > before) & (messages.time <= after)))
        parts.append(answers(state.corrections, chunk, navigation))
        state = state.drop_before(chunk[-1])
        most = max(most, len(state.messages))
    return [np.concatenate(columns) for columns in zip(*parts, strict=True)], most


@pytest.mark.parametrize(
    "limits",
    [
        SbasLimits(),
        *(pytest.param(v, marks=pytest.mark.slow) for v in (SbasLimits(mode="en_route", incomplete="inflate"), OFF)),
    ],
)
def test_an_hour_in_portions_is_the_whole_hour(recordings: Path, limits: SbasLimits) -> None:
    folder = recordings / "sbas" / "msas_20250215"
    messages = read_sbas(folder / "046r_sbas_prn137.txt")
    navigation = read_navigation(folder / "046r_rnx.nav")
    time = messages.time[0] + np.arange(-30, 3700, 10) * np.timedelta64(1, "s")
    expected = answers(SbasCorrections.from_log(messages, limits=limits), time, navigation)
    assert (expected[0] == SatelliteState.OK).sum() > 1000
    for step in (7, 60):
        found, _ = arriving(messages, time, step, limits, navigation)
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_forgetting_changes_nothing_over_a_day_of_messages() -> None:
    """The hour repeated: masks, regions of service (type 27, valid for a day) and corrections of each hour."""
    rows: list[tuple[float, int, np.ndarray]] = []
    for hour in range(30):
        base = 3600.0 * hour
        rows += [(base + s, 0, cases.mask(0, [1, 2, 3], iodp=hour % 4)) for s in (1.0, 300.0)]
        rows += [(base + s, 0, cases.fast(2, [1.0 + hour, 2.0, -1.0], [3, 4, 5], iodp=hour % 4)) for s in (10.0, 70.0)]
        rows += [
            (base + 20.0, 0, cases.parameters(0, cer=3, ccovariance=hour)),
            (base + 21.0, 0, cases.factors(0, [1] * 3)),
        ]
        still = [(slot, 40, (1.0, 2.0, hour / 8.0), 3.0) for slot in (1, 2)]
        rows.append((base + 30.0, 0, cases.long_term(0, still, iodp=hour % 4)))
        rows.append((base + 40.0, 0, cases.integrity(0, [3, 4, 5])))
    rows.append((5.0, 0, cases.service(0, inside=2, outside=9, regions=[(40, 130, 30, 145, 1)], messages=2)))
    second = cases.service(0, inside=3, outside=9, regions=[(60, 0, 50, 20, 1)], messages=2, number=2)
    rows += [(6.0, 0, second), (80_000.0, 0, second)]
    messages = cases.message_log(rows)
    time = cases.START + (np.arange(0, 30 * 3600, 140) * 10**9).astype("timedelta64[ns]")
    for limits in (OFF, SbasLimits()):
        expected = answers(SbasCorrections(messages, prn=137, limits=limits), time)
        found, most = arriving(messages, time, 24, limits)
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert most < len(messages) / 5
    assert set(np.unique(expected[-1])) == {1.0, 1.25}


def test_before_any_message_nothing_is_corrected() -> None:
    found = SbasState(prn=137).corrections.satellites(np.array([cases.START]), SATELLITES)
    assert (found.state == SatelliteState.NO_MASK).all()
    other = SbasState(prn=129).add_messages(cases.message_log([(1.0, 137, cases.mask(0, [1]))]))
    assert len(other.messages) == 0


def test_messages_of_an_earlier_time_take_their_place() -> None:
    """Portions that overlap in time give the log in the order of reception, whose files stay told apart."""
    first = cases.message_log([(1.0, 0, cases.mask(0, [1])), (9.0, 0, cases.fast(0, [1.0], [3]))])
    later = replace(
        cases.message_log([(5.0, 0, cases.fast(0, [2.0], [4]))]), sources=("another",), rejected={"line": 2}
    )
    joined = first.merge(later)
    assert joined.time.tolist() == sorted(joined.time.tolist())
    assert [joined.sources[number] for number in joined.source] == ["cases", "another", "cases"]
    assert (joined.rejected, len(first)) == ({"line": 2}, 2)
    assert first.merge(SbasMessages.none()) is first


def test_a_fast_correction_is_not_used_after_twenty_minutes_however_often_type_6_renews_it() -> None:
    rows = [(float(s), 0, cases.mask(0, [1])) for s in range(1, 1500, 300)]
    rows += [(2.0, 0, cases.fast(0, [1.0], [3]))]
    rows += [(float(s), 0, cases.integrity(0, [3])) for s in range(8, 1500, 6)]
    rows += [(float(s), 0, cases.long_term(0, [(1, 40, (0.0, 0.0, 0.0), 0.0)])) for s in range(3, 1500, 100)]
    corrections = SbasCorrections(cases.message_log(rows), prn=137, limits=OFF)
    time = cases.START + np.array([1200, 1202, 1203], dtype="timedelta64[s]").astype("timedelta64[ns]")
    found = corrections.satellites(time, np.array(["G01"])).state[:, 0]
    assert found.tolist() == [SatelliteState.OK, SatelliteState.OK, SatelliteState.NO_FAST]


def test_notes_count_what_a_whole_log_leaves_out_and_do_not_change_with_every_message() -> None:
    """What is counted within the messages kept so far would be told again as they come and go."""
    log = cases.message_log(
        [(1.0, 0, cases.mask(0, [1])), (2.0, 0, cases.integrity(0, [3])), (9.0, 0, cases.integrity(0, [3]))]
    )
    asked = SbasState(prn=137).corrections.notes
    assert SbasState(prn=137).add_messages(log).corrections.notes == asked
    first, *rest = SbasCorrections.from_log(log, prn=137).notes[-2:]
    assert first == asked[0]
    assert rest == ["PRN 137: 2 UDREI of type 6 without a fast correction of the same IODF, not used"]
