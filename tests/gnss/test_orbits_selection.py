"""Which record is taken, its validity, health by signal and group delays, as truth tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orbit_cases import HOUR, TOE, kepler, navigation
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.gnss.navigation import Navigation
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.gnss.orbits.prepared_records import group_delay_s, make_lookup, unhealthy

CODE = 23_000_000.0
NAT = np.datetime64("NaT", "ns")


def hours(value: float) -> np.timedelta64:
    return np.timedelta64(round(value * 3600e9), "ns")


def look(nav: Navigation, at_hours: Any, satellite: str, signal: str = "1C", **more: Any) -> SatelliteStates:
    time = np.array([TOE + hours(h) for h in np.atleast_1d(at_hours)])
    code = np.full((len(time), 1), CODE)
    return satellite_states(time, np.array([satellite]), np.array([signal]), code, nav, **more)


def record(satellite: str, toe_h: float, sent_h: float | None = None, **more: Any) -> dict[str, Any]:
    sent = NAT if sent_h is None else TOE + hours(sent_h)
    return {"satellite": satellite, "toe": TOE + hours(toe_h), "transmitted": sent, **more}


@pytest.mark.requirement("B0")
@pytest.mark.parametrize(
    ("satellite", "limit_h"), [("G05", 2.0), ("J02", 2.0), ("E11", 4.0), ("C20", 6.0), ("C03", 6.0), ("R07", 0.5)]
)
def test_validity_ends_where_the_constellation_says(satellite: str, limit_h: float) -> None:
    nav = navigation(record(satellite, 0.0))
    signal = "2I" if satellite[0] == "C" else "1C"
    found = look(nav, [-limit_h - 0.001, -limit_h, limit_h, limit_h + 0.001], satellite, signal)
    assert found.too_old[:, 0].tolist() == [True, False, False, True]
    assert np.isnan(found.clock_m[:, 0]).tolist() == [True, False, False, True]
    assert not found.no_record.any()
    np.testing.assert_allclose(found.age_s[1:3, 0], [-limit_h * 3600, limit_h * 3600])


def test_validity_follows_the_fit_interval_and_a_tighter_limit() -> None:
    nav = navigation(record("G05", 0.0, fit_interval_h=6.0))
    assert not look(nav, 2.9, "G05").too_old.any()
    assert look(nav, 3.1, "G05").too_old.all()
    assert look(nav, 1.1, "G05", max_age_s=3600.0).too_old.all()
    assert not look(nav, 0.9, "G05", max_age_s=3600.0).too_old.any()
    assert look(nav, 3.1, "G05", max_age_s=1e6).too_old.all(), "a looser limit does not stretch the validity"


@pytest.mark.requirement("B0")
def test_newest_record_transmitted_before_the_epoch_is_taken() -> None:
    """Not the nearest toe: at 1.1 h the record of toe 2 h is nearer but not on the air yet."""
    nav = navigation(record("G05", 0.0, -1.5), record("G05", 2.0, 1.4), record("G05", 2.0, 1.2))
    found = look(nav, [-1.4, 0.0, 1.1, 1.3, 1.5, 3.0], "G05")
    assert found.record[:, 0].tolist() == [0, 0, 0, 2, 1, 1]
    assert not found.future_record.any()


def test_record_transmitted_after_the_epoch_serves_only_where_nothing_else_is_and_is_flagged() -> None:
    nav = navigation(record("G05", 0.0, 0.5), record("G05", 2.0, 2.5))
    found = look(nav, [-1.0, 0.4, 0.6, 1.9, 2.4, 2.6], "G05")
    assert found.record[:, 0].tolist() == [0, 0, 0, 0, 1, 1]
    assert found.future_record[:, 0].tolist() == [True, True, False, False, True, False]
    assert not found.too_old.any()


@pytest.mark.requirement("B0")
def test_an_older_record_serves_where_the_newest_is_out_of_its_validity() -> None:
    """Expired before the older one does (a second receiver's file), or sent long before it begins."""
    expired = navigation(record("G05", 0.0, -1.5), record("G05", -1.5, -0.5, health=1))
    found = look(expired, [-0.7, -0.4, 0.4, 0.6, 1.9, 2.1], "G05")
    assert found.record[:, 0].tolist() == [0, 1, 1, 0, 0, 1]
    assert found.unhealthy[:, 0].tolist() == [False, True, True, False, False, False]
    assert found.too_old[:, 0].tolist() == [False] * 5 + [True]
    early = navigation(record("G05", 0.0, -1.5), record("G05", 3.0, 0.5))
    found = look(early, [0.4, 0.6, 1.1, 4.9], "G05")
    assert found.record[:, 0].tolist() == [0, 0, 1, 1]
    assert not found.future_record.any()


def test_a_tighter_limit_turns_to_another_record_too() -> None:
    nav = navigation(record("C20", 0.0, 0.1), record("C20", -2.0, 0.2))
    assert look(nav, 0.5, "C20", "2I").record.tolist() == [[1]]
    tight = look(nav, 0.5, "C20", "2I", max_age_s=3600.0)
    assert tight.record.tolist() == [[0]]
    assert not tight.too_old.any()


def test_of_records_all_in_the_future_the_nearest_is_taken() -> None:
    nav = navigation(record("E11", 0.0, 3.9), record("E11", 3.0, 3.2))
    found = look(nav, [1.0, 2.0], "E11")
    assert found.record[:, 0].tolist() == [0, 1]
    assert found.future_record.all()


def test_without_transmission_time_the_nearest_reference_time_counts() -> None:
    nav = navigation(record("C20", 0.0), record("C20", 1.0), record("C20", 2.0))
    found = look(nav, [-1.0, 0.45, 0.55, 1.55, 7.0], "C20", "2I")
    assert found.record[:, 0].tolist() == [0, 0, 1, 2, 2]
    assert not found.future_record.any()


def test_nonsense_transmission_time_is_not_believed() -> None:
    """A receiver wrote the transmission of two days before: the record must not serve from then on."""
    nav = navigation(record("C20", 0.0, 0.1), record("C20", 1.0, -48.0), record("C20", 2.0, 2.1))
    assert look(nav, [0.2, 1.2, 2.2], "C20", "2I").record[:, 0].tolist() == [0, 1, 2]


@pytest.mark.requirement("B0")
def test_unhealthy_newest_record_is_not_beaten_by_an_older_healthy_one() -> None:
    nav = navigation(record("G05", 0.0, -2.0), record("G05", 2.0, 0.0, health=63), record("G05", 4.0, 2.0))
    found = look(nav, [-0.5, 0.5, 2.5], "G05")
    assert found.unhealthy[:, 0].tolist() == [False, True, False]
    assert np.isfinite(found.clock_m).all(), "states are given; who refuses them is not decided here"


@pytest.mark.requirement("B0")
def test_the_newest_record_decides_on_health_where_corrections_refer_to_an_older_one() -> None:
    nav = navigation(record("G05", 0.0, -2.0), record("G05", 2.0, 0.0, health=63), record("G05", 4.0, 2.0))
    found = look(nav, [0.5, 1.9, 2.1], "G05", record=np.array([[0], [0], [1]]))
    assert found.record[:, 0].tolist() == [0, 0, 1]
    assert found.unhealthy[:, 0].tolist() == [True, True, True]
    assert not look(nav, [-0.5], "G05", record=np.array([[0]])).unhealthy.any()


@pytest.mark.requirement("B0")
def test_a_past_record_of_galileos_other_message_comes_before_one_of_the_future() -> None:
    inav, fnav = (record("E11", 1.0, sent, message=name) for name, sent in (("INAV", 0.9), ("FNAV", 0.2)))
    found = look(navigation(inav, fnav), [0.1, 0.5, 1.0], "E11")
    assert found.record[:, 0].tolist() == [0, 1, 0]
    assert found.future_record[:, 0].tolist() == [True, False, False]


def test_records_of_another_year_do_no_harm() -> None:
    """Ten years before, eight after: beside the right one, before a later one, and alone."""
    other = [record("G05", -87_660.0, -87_661.5), record("G05", 70_000.0, 69_999.0)]
    nav = navigation(*other, record("G05", 0.0, -1.0))
    found = look(nav, 0.5, "G05")
    assert found.record[0, 0] == 2
    assert not found.future_record.any()
    later = look(navigation(*other, record("G05", 1.0, 0.6)), 0.5, "G05")
    assert later.record[0, 0] == 2
    assert later.future_record.all()
    alone = look(navigation(*other), 0.5, "G05")
    assert alone.too_old.all()
    assert not alone.no_record.any()


def test_satellite_without_record_is_told_apart_from_one_too_old() -> None:
    nav = navigation(record("G05", 0.0))
    assert look(nav, 0.0, "G06").no_record.all()
    assert not look(nav, 0.0, "G06").too_old.any()
    assert look(nav, 0.0, "S29").no_record.all(), "a constellation that is not computed has no record"


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.sampled_from("ABC"), st.integers(-9, 9), st.integers(-3, 3)), min_size=1, max_size=12),
    st.lists(st.integers(-40, 40), min_size=1, max_size=8),
)
def test_search_is_the_exhaustive_one(rows: list[tuple[str, int, int]], at: list[int]) -> None:
    label = np.array([r[0] for r in rows])
    toe = np.array([TOE + hours(r[1]) for r in rows])
    sent = np.array([TOE + hours(r[1] + r[2] / 3) for r in rows])
    time = np.array([TOE + hours(h / 4 + 0.01) for h in at])
    lookup = make_lookup(label, toe, sent, np.full(len(rows), 7200.0))
    limit = np.full(len(rows), hours(2.0))
    for name in "ABC":
        found, valid, future = lookup.find(np.array([lookup.number.get(name, -1)]), time, limit)
        mine = np.flatnonzero(label == name)
        for k, t in enumerate(time):
            if not len(mine):
                assert found[0, k] == -1
                assert not valid[0, k]
                continue
            row, away = found[0, k], np.abs(toe[mine] - t)
            on_air = mine[sent[mine] <= t]
            newest = on_air[sent[on_air] == sent[on_air].max()] if len(on_air) else on_air
            newest = newest[toe[newest] == toe[newest].max()] if len(newest) else newest
            assert valid[0, k] == (away.min() <= limit[0])
            assert label[row] == name
            if len(newest) and abs(toe[newest[0]] - t) <= limit[0]:
                assert (sent[row], toe[row]) == (sent[newest[0]], toe[newest[0]])
                assert not future[0, k]
            elif valid[0, k] or not len(on_air):
                assert abs(toe[row] - t) == away.min()
                assert future[0, k] == (sent[row] > t)
            else:
                assert sent[row] == sent[newest[0]]
                assert not future[0, k]


def both(inav: dict[str, Any], fnav: dict[str, Any]) -> Navigation:
    return navigation(
        {"satellite": "E11", "message": "INAV", "data_source": 517, "af0_s": 1e-4, **inav},
        {"satellite": "E11", "message": "FNAV", "data_source": 258, "af0_s": 2e-4, **fnav},
    )


@pytest.mark.requirement("A7")
@pytest.mark.parametrize(
    ("signal", "row"), [("1C", 0), ("1X", 0), ("1B", 0), ("7Q", 0), ("5Q", 1), ("5X", 1), ("8X", 0)]
)
def test_galileo_signals_take_the_message_of_their_clock(signal: str, row: int) -> None:
    found = look(both({}, {}), 0.2, "E11", signal)
    assert found.record[0, 0] == row
    assert found.clock_m[0, 0] == pytest.approx((1e-4, 2e-4)[row] * SPEED_OF_LIGHT, abs=20.0)


def test_galileo_takes_the_other_message_where_its_own_is_not_valid() -> None:
    nav = both({"toe": TOE - 5 * HOUR}, {"toe": TOE})
    assert look(nav, [-4.0, 0.0], "E11", "1C").record[:, 0].tolist() == [0, 1]
    only = navigation({"satellite": "E11", "message": "FNAV", "data_source": 258})
    assert look(only, 0.0, "E11", "1C").record[0, 0] == 0
    assert look(only, 0.0, "E11", "7Q").record[0, 0] == 0
    neither = both({"toe": TOE - 9 * HOUR}, {"toe": TOE - 7 * HOUR})
    assert look(neither, 0.0, "E11", "1C").too_old.all()


@pytest.mark.requirement("B0")
@pytest.mark.parametrize(
    ("satellite", "health", "signal", "bad"),
    [
        ("G05", 0, "1C", False),
        ("G05", 1, "1C", True),
        ("G05", 63, "5Q", True),
        # QZSS, from the most significant bit: L1, L1C/A, L2C, L5, L1C, L1C/B.
        ("J02", 0b000001, "1C", False),
        ("J02", 0b000001, "1E", True),
        ("J02", 0b010000, "1C", True),
        ("J02", 0b100000, "1C", True),
        ("J02", 0b000010, "1C", False),
        ("J02", 0b000010, "1X", True),
        ("J02", 0b001000, "2X", True),
        ("J02", 0b001000, "5X", False),
        ("J02", 0b000100, "5X", True),
        ("J02", 0b111110, "1C", True),
        # Galileo: E1-B in bits 0 to 2, E5a in 3 to 5, E5b in 6 to 8.
        ("E11", 0b000_000_001, "1C", True),
        ("E11", 0b000_000_110, "1X", True),
        ("E11", 0b000_110_000, "1C", False),
        ("E11", 0b000_110_000, "5Q", True),
        ("E11", 0b010_000_000, "7Q", True),
        ("E11", 0b010_000_000, "1C", False),
        ("E11", 0b000_001_000, "8X", True),
        ("C20", 0, "2I", False),
        ("C20", 1, "2I", True),
    ],
)
def test_health_is_that_of_the_signal(satellite: str, health: int, signal: str, bad: bool) -> None:
    assert unhealthy(kepler({"satellite": satellite, "health": health}), signal).tolist() == [bad]


def test_galileo_without_predicted_accuracy_and_sick_glonass_are_unhealthy() -> None:
    assert unhealthy(kepler({"satellite": "E11", "accuracy_m": -1.0}), "1C").all()
    assert not unhealthy(kepler({"satellite": "E11", "accuracy_m": np.nan}), "1C").any()
    for satellite in ("G11", "J02", "C11"):
        stated = [
            unhealthy(kepler({"satellite": satellite, "accuracy_m": a}), "1C").any() for a in (48.0, 64.0, 8192.0)
        ]
        assert stated == [False, True, True]
    nav = navigation({"satellite": "R07", "health": 1}, {"satellite": "R08"})
    assert look(nav, 0.1, "R07").unhealthy.all()
    assert not look(nav, 0.1, "R08").unhealthy.any()


def delay_m(signal: str, satellite: str, **more: Any) -> float:
    clock = more.pop("clock", "broadcast")
    return float(group_delay_s(kepler({"satellite": satellite, **more}), signal, clock=clock)[0]) * SPEED_OF_LIGHT


@pytest.mark.requirement("A7")
def test_group_delay_of_each_constellation_and_signal() -> None:
    tgd = -1.1e-8 * SPEED_OF_LIGHT
    assert delay_m("1C", "G05") == pytest.approx(tgd)
    assert delay_m("2W", "G05") == pytest.approx(tgd * (77 / 60) ** 2)
    assert delay_m("5Q", "J02") == pytest.approx(tgd), "LNAV has no ISC"
    bgd_a, bgd_b = -3.3e-9 * SPEED_OF_LIGHT, -4.1e-9 * SPEED_OF_LIGHT
    assert delay_m("1C", "E11") == pytest.approx(bgd_b)
    assert delay_m("7Q", "E11") == pytest.approx(bgd_b * (154 / 118) ** 2)
    assert delay_m("1C", "E11", message="FNAV") == pytest.approx(bgd_a)
    assert delay_m("5Q", "E11", message="FNAV") == pytest.approx(bgd_a * (154 / 115) ** 2)
    assert delay_m("2I", "C20") == pytest.approx(2.3e-8 * SPEED_OF_LIGHT)
    assert delay_m("7I", "C20") == pytest.approx(1.7e-8 * SPEED_OF_LIGHT)
    assert delay_m("6I", "C20") == 0.0
    for signal in ("1P", "5P", "7D"):
        assert np.isnan(delay_m(signal, "C20")), signal
    assert np.isnan(delay_m("6C", "E11"))


@pytest.mark.parametrize(
    ("satellite", "message", "first", "second", "ratio", "clock"),
    [
        ("G05", "LNAV", "1W", "2W", 77 / 60, "broadcast"),
        ("E11", "FNAV", "1C", "5Q", 154 / 115, "broadcast"),
        ("E11", "INAV", "1C", "7Q", 154 / 118, "broadcast"),
        ("E11", "INAV", "1C", "5Q", 154 / 115, "ionosphere_free"),
        ("C20", "D1", "2I", "6I", 763 / 620, "ionosphere_free"),
    ],
)
def test_clock_is_that_of_its_pair_free_of_ionosphere(
    satellite: str, message: str, first: str, second: str, ratio: float, clock: str
) -> None:
    """By definition the pair that a clock refers to has no group delay in its ionosphere-free combination."""
    a, b = (delay_m(s, satellite, message=message, clock=clock) for s in (first, second))
    assert a != 0.0
    assert (ratio**2 * a - b) / (ratio**2 - 1) == pytest.approx(0.0, abs=1e-9)


def test_second_galileo_pair_follows_from_both_delays() -> None:
    """I/NAV holds both BGDs: on E5a its difference to E1 must be that of BGD E5a/E1 whichever clock is used."""
    inav = delay_m("1C", "E11") - delay_m("5Q", "E11")
    fnav = delay_m("1C", "E11", message="FNAV") - delay_m("5Q", "E11", message="FNAV")
    assert inav == pytest.approx(fnav)


def test_group_delay_reaches_the_states() -> None:
    nav = navigation({"satellite": "G05"}, {"satellite": "R07"})
    assert look(nav, 0.0, "G05").group_delay_m[0, 0] == pytest.approx(-1.1e-8 * SPEED_OF_LIGHT)
    assert look(nav, 0.0, "R07").group_delay_m[0, 0] == 0.0
