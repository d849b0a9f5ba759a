"""Satellite corrections of SBAS: masks, issues, time-outs to the second, alarms, degradation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sbas_cases as cases
from railfix.core.errors import SettingsError
from railfix.io.rinex.navigation import read_navigation
from railfix.ranges.sbas import SatelliteState, SbasCorrections, SbasLimits, read_sbas
from railfix.ranges.sbas.standard import FAST_DEGRADATION_MPS2, FAST_TIMEOUT_S

pytestmark = pytest.mark.requirement("C1")

Rows = list[tuple[float, int, np.ndarray]]
#: One GPS satellite in the first slot, another in the second.
NUMBERS = (5, 7)
SATELLITE = np.array(["G05", "G07", "G09"])
OFF = SbasLimits(range_rate="off")
OK, TIMED_OUT = SatelliteState.OK, SatelliteState.TIMED_OUT


def at(*second: float) -> np.ndarray:
    return cases.START + np.array([round(s * 1e9) for s in second], dtype="timedelta64[ns]")


def base(*, until: int = 20, but: Sequence[str] = (), indicator: int = 0) -> Rows:
    """A GEO that says everything at once, and all but the long-lasting again every few seconds.

    `but` names what is said only the first time, in seconds 0 to 4.
    """
    rows: Rows = []

    def say(what: str, first: int, every: int, bits: object) -> None:
        for second in range(first, until, every):
            if second == first or what not in but:
                rows.append((second, 0, bits(second)))  # type: ignore[operator]

    say("mask", 0, 100, lambda s: cases.mask(s, NUMBERS))
    say("factors", 1, 60, lambda s: cases.factors(s, [indicator] * 2))
    say("parameters", 2, 60, lambda s: cases.parameters(s, rss_udre=1))
    say("long", 3, 60, lambda s: cases.long_term(s, [(1, 48, (1.0, -2.0, 3.0), 8), (2, 49, (0.5, 0.0, 0.0), 0)]))
    say("fast", 4, 6, lambda s: cases.fast(s, [1.5, -2.0], [3, 4], iodf=(s // 6) % 3))
    return rows


def engine(rows: Rows, limits: SbasLimits = OFF, **options: object) -> SbasCorrections:
    return SbasCorrections.from_log(cases.message_log(rows), limits=limits, **options)  # type: ignore[arg-type]


def states(rows: Rows, *second: float, limits: SbasLimits = OFF, satellite: int = 0) -> list[int]:
    return engine(rows, limits).satellites(at(*second), SATELLITE).state[:, satellite].tolist()


def test_corrections_are_those_sent() -> None:
    found = engine(base()).satellites(at(10.0), SATELLITE)
    assert found.state.tolist() == [[OK, OK, SatelliteState.NOT_IN_MASK]]
    assert found.fast_m[0, :2].tolist() == [1.5, -2.0]
    assert found.position_m[0, 0].tolist() == [1.0, -2.0, 3.0]
    assert found.clock_s[0, 0] == 8 * 2.0**-31
    assert found.iode.tolist() == [[48, 49, -1]]
    assert found.udrei.tolist() == [[3, 4, -1]]
    assert np.isnan(found.fast_m[0, 2])
    assert np.isnan(found.position_m[0, 2]).all()
    assert found.sigma_flt_m()[0, :2] == pytest.approx(np.sqrt([0.2830, 0.4678]))


@pytest.mark.parametrize("first", range(5))
def test_a_message_counts_from_its_reception(first: int) -> None:
    """A nanosecond before the last of what is needed came, the satellite is not corrected."""
    rows = [(s if s != first else 8.0, p, b) for s, p, b in base(until=5)]
    if first == 0:
        rows = [(s + 9.0 if s else 8.0, p, b) for s, p, b in base(until=5)]
    last = max(row[0] for row in rows)
    assert states(rows, last - 1e-9, last)[1] == OK
    assert states(rows, last - 1e-9, last)[0] != OK


def test_parts_of_a_millisecond_are_no_way_into_the_past() -> None:
    rows = [(s if s != 4 else 4.0004, p, b) for s, p, b in base(until=5)]
    assert states(rows, 4.0003, 4.002) == [SatelliteState.NO_FAST, OK]


@pytest.mark.parametrize("year", [1998, 2014, 2034, 2060])
def test_any_year_will_do(year: int) -> None:
    log = cases.message_log(base())
    shift = np.datetime64(f"{year}-06-01", "ns") - cases.START
    ours = SbasCorrections.from_log(replace(log, time=log.time + shift), limits=OFF)
    assert ours.satellites(at(3.9, 10.0, 29.0) + shift, SATELLITE).state[:, 0].tolist() == [
        SatelliteState.NO_FAST,
        OK,
        TIMED_OUT,
    ]


TIMEOUTS = [
    ("mask", 0, 600, 600, SatelliteState.NO_MASK),
    ("factors", 1, 240, 360, SatelliteState.NO_DEGRADATION),
    ("parameters", 2, 240, 360, SatelliteState.NO_DEGRADATION),
    ("long", 3, 240, 360, TIMED_OUT),
    ("fast", 4, 12, 18, TIMED_OUT),
]


@pytest.mark.parametrize("mode", ["precision", "en_route"])
@pytest.mark.parametrize(("what", "said", "precision", "en_route", "then"), TIMEOUTS)
def test_time_outs_are_exact(
    what: str, said: int, precision: int, en_route: int, then: SatelliteState, mode: str
) -> None:
    """The last second in which it counts, and a nanosecond after it."""
    last = said + (precision if mode == "precision" else en_route)
    limits = SbasLimits(range_rate="off", mode=mode)  # type: ignore[arg-type]
    assert states(base(until=last + 30, but=[what]), last, last + 0.001, limits=limits) == [OK, then]


@pytest.mark.parametrize("mode", ["precision", "en_route"])
@pytest.mark.parametrize("indicator", range(16))
def test_fast_corrections_time_out_by_their_indicator(indicator: int, mode: str) -> None:
    """Alarms (IODF 3) renew the UDREI and leave the fast correction to its own time-out (table A-8)."""
    rows = base(until=250, but=["fast"], indicator=indicator)
    rows += [(s, 0, cases.integrity(s, [3, 4], (3, 3, 3, 3))) for s in range(5, 250, 6)]
    last = 4 + FAST_TIMEOUT_S[mode][indicator]
    limits = SbasLimits(range_rate="off", mode=mode)  # type: ignore[arg-type]
    assert states(rows, last, last + 0.001, limits=limits) == [OK, TIMED_OUT]


def test_type_6_of_the_same_issue_renews_the_correction_of_another_does_not() -> None:
    rows = base(until=60, but=["fast"], indicator=15)
    same = rows + [(s, 0, cases.integrity(s, [2, 4])) for s in range(10, 60, 6)]
    other = rows + [(s, 0, cases.integrity(s, [2, 4], (1, 1, 1, 1))) for s in range(10, 60, 6)]
    assert states(same, 50) == [OK]
    assert states(other, 16, 17) == [OK, TIMED_OUT]
    assert engine(same).satellites(at(9.0, 10.0), SATELLITE).udrei[:, 0].tolist() == [3, 2]
    assert engine(other).satellites(at(9.0, 10.0), SATELLITE).udrei[:, 0].tolist() == [3, 3]
    assert engine(other).unused["UDREI of type 6 without a fast correction of the same IODF"] > 0


def test_an_alarm_stops_a_satellite_at_once() -> None:
    rows = [*base(), (11.0, 0, cases.integrity(11, [15, 14], (3, 3, 3, 3)))]
    found = engine(rows).satellites(at(10.9, 11.0, 16.0), SATELLITE)
    assert found.state[:, 0].tolist() == [OK, SatelliteState.DO_NOT_USE, OK]
    assert found.state[:, 1].tolist() == [OK, SatelliteState.NOT_MONITORED, OK]


def test_a_large_udrei_is_named() -> None:
    rows = [*base(), (11.0, 0, cases.fast(11, [1.5, -2.0], [12, 13], iodf=2))]
    assert states(rows, 12.0) == [SatelliteState.UDREI_TOO_LARGE]
    assert states(rows, 12.0, limits=SbasLimits(range_rate="off", mode="en_route")) == [OK]
    assert states(rows, 12.0, limits=SbasLimits(range_rate="off", mode="en_route", max_udrei=11)) == [
        SatelliteState.UDREI_TOO_LARGE
    ]


def test_corrections_of_another_mask_are_not_used() -> None:
    """Wrong IODP: counted, never applied; with the mask of that issue they are, for its satellites."""
    wrong = [*base(until=9), (9.0, 0, cases.fast(9, [100.0], [0], iodp=2))]
    found = engine(wrong).satellites(at(9.5), SATELLITE)
    assert found.fast_m[0, 0] == 1.5
    assert engine(wrong).unused["fast corrections without a mask of their IODP"] == 13
    right = [*base(until=9), (9.0, 0, cases.mask(9, [7, 9], 2)), (10.0, 0, cases.fast(10, [5.0, 6.0], [1, 2], iodp=2))]
    found = engine(right).satellites(at(9.5, 10.5), SATELLITE)
    assert found.state[:, 0].tolist() == [SatelliteState.NOT_IN_MASK] * 2
    assert found.fast_m[:, 1].tolist() == [-2.0, 5.0]
    assert found.udrei[1].tolist() == [3, 1, 2]


def test_a_fast_correction_goes_with_its_mask() -> None:
    """The long-term correction is of the new mask already, the fast one still of the old, which times out first."""
    rows = [row for row in base(until=620, but=["mask"]) if row[2][1] >> 2 != 2 or row[0] < 599]
    rows.append((590.0, 0, cases.mask(590, NUMBERS, 1)))
    rows.append((599.0, 0, cases.long_term(599, [(1, 48, (1.0, -2.0, 3.0), 8)], 1)))
    assert states(rows, 600.0, 600.001) == [OK, TIMED_OUT]


def test_type_24_corrects_like_types_2_and_25() -> None:
    rows = [row for row in base(until=20, but=["long", "fast"]) if row[0] not in (3, 4)]
    rows.append((5.0, 0, cases.mixed(5, [1.5, -2.0], [3, 4], [(1, 48, (1.0, -2.0, 3.0), 8), (2, 49, (0.5, 0, 0), 0)])))
    mixed, separate = engine(rows), engine(base())
    ours, theirs = mixed.satellites(at(6.0), SATELLITE), separate.satellites(at(6.0), SATELLITE)
    for name in ("state", "fast_m", "position_m", "clock_s", "iode", "udrei"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name), equal_nan=True), name


def test_velocity_code_1_moves_the_correction() -> None:
    """Hand-worked: 64 s after its reference time, rates of 2^-11 m/s and 2^-39."""
    rows = [row for row in base() if row[0] != 3]
    rows.append((3.0, 0, cases.moving(3, 1, 48, (1.0, -2.0, 3.0), (16, -32, 0), 8, 5, 43_200 - 48)))
    found = engine(rows).satellites(at(16.0), SATELLITE)
    assert found.position_m[0, 0] == pytest.approx([1.0 + 64 * 16 / 2048, -2.0 - 64 * 32 / 2048, 3.0], abs=1e-12)
    assert found.clock_s[0, 0] == pytest.approx(8 * 2.0**-31 + 64 * 5 * 2.0**-39, abs=1e-18)


def test_the_rate_is_that_of_two_corrections() -> None:
    """1.5 m, then 2.5 m 6 s later: 1/6 m/s from the first bit of the second on."""
    rows = [row for row in base(until=5, indicator=5) if row[0] != 4]
    rows += [(4.0, 0, cases.fast(4, [1.5], [3], iodf=0)), (10.0, 0, cases.fast(10, [2.5], [3], iodf=1))]
    limits = SbasLimits()
    found = engine(rows, limits).satellites(at(9.0, 10.0, 13.0), SATELLITE)
    assert found.state[:, 0].tolist() == [SatelliteState.NO_RANGE_RATE, OK, OK]
    assert found.rate_mps[1:, 0] == pytest.approx(1.0 / 6.0)
    assert found.fast_m[1:, 0] == pytest.approx([2.5 + 1.0 / 6.0, 2.5 + 4.0 / 6.0])
    assert found.rate_growth_m[1:, 0].tolist() == [0.0, 0.0]
    assert engine(rows, SbasLimits(range_rate="off")).satellites(at(13.0), SATELLITE).fast_m[0, 0] == 2.5
    steady = [row for row in base(until=5, indicator=0) if row[0] != 4] + rows[-2:]
    assert engine(steady, limits).satellites(at(9.0, 13.0), SATELLITE).fast_m[:, 0].tolist() == [1.5, 2.5]


@pytest.mark.parametrize(("first", "second", "grows"), [(0, 1, False), (1, 2, False), (2, 0, False), (1, 0, True),
                                                        (2, 1, True), (0, 2, True), (1, 1, True)])  # fmt: skip
def test_a_rate_grows_where_the_issues_do_not_follow_each_other(first: int, second: int, grows: bool) -> None:
    rows = [row for row in base(until=5, indicator=5) if row[0] != 4]
    rows += [(4.0, 0, cases.fast(4, [1.5], [3], iodf=first)), (10.0, 0, cases.fast(10, [2.5], [3], iodf=second))]
    found = engine(rows, SbasLimits()).satellites(at(13.0), SATELLITE)
    assert found.rate_growth_m[0, 0] == pytest.approx(0.0002 * 78.0 / 4.0 * 4.0 if grows else 0.0)


def test_after_an_alarm_the_rate_is_over_half_the_time_out() -> None:
    """a = 0.0006 (time-out 42 s), IODF 3 at 34 s: 10 and 16 s are equally near to 34 - 21 s, the later one is taken."""
    rows = [row for row in base(until=5, indicator=8) if row[0] != 4]
    sent = {4: 0.0, 10: 1.0, 16: 5.0, 22: 6.0, 28: 6.5}
    rows += [(s, 0, cases.fast(s, [v], [3], iodf=(s // 6) % 3)) for s, v in sent.items()]
    rows.append((34, 0, cases.fast(34, [8.0], [3], iodf=3)))
    found = engine(rows, SbasLimits()).satellites(at(36.0), SATELLITE)
    assert found.rate_mps[0, 0] == pytest.approx((8.0 - 5.0) / 18.0)
    assert found.rate_growth_m[0, 0] == pytest.approx(0.0006 * 3.0 / 2.0 * 3.0)
    one = [row for row in rows if row[0] != 16]
    assert engine(one, SbasLimits()).satellites(at(36.0), SATELLITE).rate_mps[0, 0] == pytest.approx(7.0 / 24.0)


def test_a_rate_carries_no_further_than_eight_times_its_base() -> None:
    """Two corrections 6 s apart carry 48 s from the first bit; alarms keep the UDREI alive meanwhile."""
    rows = [row for row in base(until=5, indicator=5) if row[0] != 4]
    rows += [(4.0, 0, cases.fast(4, [1.5], [3], iodf=0)), (10.0, 0, cases.fast(10, [2.5], [3], iodf=1))]
    rows += [(s, 0, cases.integrity(s, [3, 4], (3, 3, 3, 3))) for s in range(12, 70, 6)]
    assert states(rows, 57.0, 57.001, limits=SbasLimits()) == [OK, SatelliteState.NO_RANGE_RATE]


def test_a_rate_is_not_made_of_corrections_too_far_apart() -> None:
    """The shortest time-out of the mask counts: 18 s of the other satellite's ai 13."""
    rows = [row for row in base(until=5) if row[0] not in (1, 4)]
    rows.append((1.0, 0, cases.factors(1, [5, 13])))
    rows += [(4.0, 0, cases.fast(4, [1.5], [3], iodf=0)), (22.0, 0, cases.fast(22, [2.5], [3], iodf=1))]
    assert states(rows, 22.0, limits=SbasLimits()) == [OK]
    rows[-1] = (23.0, 0, cases.fast(23, [2.5], [3], iodf=1))
    assert states(rows, 23.0, limits=SbasLimits()) == [SatelliteState.NO_RANGE_RATE]


def test_a_rate_is_not_made_across_a_pause_of_monitoring() -> None:
    rows = [row for row in base(until=5, indicator=5) if row[0] != 4]
    rows += [(s, 0, cases.fast(s, [1.5], [g], iodf=i)) for s, g, i in ((4, 3, 0), (10, 14, 1), (16, 3, 2), (22, 3, 0))]
    assert states(rows, 4, 10, 16, 22, limits=SbasLimits()) == [
        SatelliteState.NO_RANGE_RATE,
        SatelliteState.NOT_MONITORED,
        SatelliteState.NO_RANGE_RATE,
        OK,
    ]


def test_degradation_by_hand() -> None:
    """A.4.5.1 with numbers: a = 0.0002, latency 2 s, IODF out of turn, B_rrc 0.04 m, two steps of 0.3 m."""
    rows: Rows = [
        (0, 0, cases.mask(0, NUMBERS)),
        (1, 0, cases.factors(1, [5, 0], latency=2)),
        (3, 0, cases.long_term(3, [(1, 48, (1.0, -2.0, 3.0), 8)])),
        (4, 0, cases.fast(4, [1.5], [3], iodf=0)),
        (10, 0, cases.fast(10, [2.5], [3], iodf=2)),
    ]
    fast = 0.0002 / 2.0 * (6.0 + 1.0 + 2.0) ** 2
    rate = (0.0002 * 78.0 / 4.0 + 0.04 / 6.0) * 7.0
    long = 2 * 0.3
    for squares in (0, 1):
        said = {"brrc": 20, "cltc_v0": 150, "iltc_v0": 7, "rss_udre": squares}
        found = engine([*rows, (2, 0, cases.parameters(2, **said))], SbasLimits()).satellites(at(16.0), SATELLITE)
        assert found.fast_growth_m[0, 0] == pytest.approx(fast)
        assert found.rate_growth_m[0, 0] == pytest.approx(rate)
        assert found.long_term_growth_m[0, 0] == pytest.approx(long)
        terms = np.array([np.sqrt(0.2830) * 1.5, fast, rate, long])
        expected = np.sqrt((terms**2).sum()) if squares else terms.sum()
        assert found.sigma_flt_m(1.5)[0, 0] == pytest.approx(expected)


def test_degradation_of_a_moving_correction_by_hand() -> None:
    """0 inside the interval after the reference time, else a step and a ramp."""
    rows = [row for row in base(until=40) if row[0] not in (2, 3)]
    rows.append((2.0, 0, cases.parameters(2, cltc_lsb=100, cltc_v1=400, iltc_v1=10)))
    rows.append((3.0, 0, cases.moving(3, 1, 48, (1.0, -2.0, 3.0), (0, 0, 0), 8, 0, 43_200 + 16)))
    found = engine(rows).satellites(at(6.0, 20.0, 36.0), SATELLITE)
    assert found.long_term_growth_m[:, 0] == pytest.approx([0.2 + 0.02 * 10.0, 0.0, 0.2 + 0.02 * 10.0])


def test_en_route_adds_its_own_term_to_what_precision_approach_would_not_use() -> None:
    rows = [row for row in base(until=20) if row[0] != 2]
    rows.append((2.0, 0, cases.parameters(2, cer=3)))
    limits = SbasLimits(range_rate="off", mode="en_route")
    found = engine(rows, limits).satellites(at(28.0, 29.0), SATELLITE)
    assert found.en_route_m[:, 0].tolist() == [0.0, 1.5]


def test_without_degradation_data_a_satellite_is_refused_or_inflated() -> None:
    rows = [row for row in base() if row[0] != 2]
    assert states(rows, 10.0) == [SatelliteState.NO_DEGRADATION]
    found = engine(rows, SbasLimits(range_rate="off", incomplete="inflate")).satellites(at(10.0), SATELLITE)
    assert found.inflated[0, 0]
    assert found.sigma_flt_m()[0, 0] == pytest.approx(np.sqrt(0.2830) + 8.0)


def sight() -> np.ndarray:
    line = np.array([[[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]])
    return line


def test_the_covariance_scales_sigma_along_the_line_of_sight() -> None:
    """R = 2^(3-5) [[4, 2, 0, 1], [0, 8, 0, 0], [0, 0, 4, -2], [0, 0, 0, 6]], I = (0.6, 0, 0.8, 1), C = 0.5."""
    rows = [row for row in base() if row[0] != 2]
    rows += [
        (2.0, 0, cases.parameters(2, ccovariance=5)),
        (5.0, 0, cases.covariance(5, 1, 3, (4, 8, 4, 6), (2, 0, 1, 0, 0, -2))),
    ]
    ours = engine(rows, SbasLimits(range_rate="off", incomplete="inflate"))
    found = ours.satellites(at(10.0), SATELLITE)
    factor = ours.delta_udre(at(10.0), found, sight(), np.array([35.0]), np.array([139.0]))
    product = np.array([4 * 0.6 + 1.0, 0.0, 4 * 0.8 - 2.0, 6.0]) / 4.0
    assert factor[0, 0] == pytest.approx(np.linalg.norm(product) + 0.5 * 0.25)
    assert factor[0, 1] == 1.0
    assert found.inflated[0].tolist() == [False, True, False]
    assert states(rows, 10.0, satellite=1) == [SatelliteState.NO_DEGRADATION]


@pytest.mark.parametrize(("mode", "last"), [("precision", 245), ("en_route", 365)])
def test_covariances_time_out(mode: str, last: int) -> None:
    """While any is in force every satellite needs one; the last that times out ends that."""
    rows = [*base(until=last + 10), (5.0, 0, cases.covariance(5, 1, 3, (4, 8, 4, 6), (2, 0, 1, 0, 0, -2)))]
    limits = SbasLimits(range_rate="off", mode=mode)  # type: ignore[arg-type]
    assert states(rows, last, last + 0.001, limits=limits, satellite=1) == [SatelliteState.NO_DEGRADATION, OK]
    assert engine(rows, limits).satellites(at(last, last + 0.001), SATELLITE).covariance[:, 0].tolist() == [0, -1]


def test_regions_of_service_by_hand() -> None:
    """A rectangle of priority 0 with factor 2, half of one of priority 1 with factor 5; 100 outside."""
    rows = base()
    rows += [
        (5.0, 0, cases.service(5, inside=4, outside=15, regions=[(40, 130, 30, 140, 1)], messages=2, number=1)),
        (11.0, 0, cases.service(11, inside=7, outside=15, regions=[(40, 130, 20, 150, 0)], messages=2, number=2,
                               priority=1)),
    ]  # fmt: skip
    latitude, longitude = np.array([35.0, 39.0, 31.0, 35.0, 50.0]), np.array([135.0, 149.0, 131.0, 145.0, 135.0])
    time = at(*[12.0] * 5)
    ours = engine(rows)
    found = ours.satellites(time, SATELLITE)
    line = np.broadcast_to(sight(), (5, 3, 3))
    # (40, 130) and (20, 150) are the ends of the long side; (40, 150) is the right angle.
    assert ours.delta_udre(time, found, line, latitude, longitude)[:, 0].tolist() == [5.0, 5.0, 2.0, 5.0, 100.0]
    early = at(*[6.0] * 5)
    missing = ours.delta_udre(early, ours.satellites(early, SATELLITE), line, latitude, longitude)
    assert np.isnan(missing).all()
    assert (
        ours.delta_udre(at(4.5), ours.satellites(at(4.5), SATELLITE), sight(), latitude[:1], longitude[:1])[0, 0] == 1
    )


@pytest.mark.parametrize(("first", "second"), [(4, 7), (7, 4)])
def test_of_regions_of_equal_priority_the_smaller_factor_counts(first: int, second: int) -> None:
    regions = [(40, 130, 30, 140, 1)]
    rows = base()
    rows += [(5.0, 0, cases.service(5, inside=first, outside=15, regions=regions, messages=2, number=1, priority=2)),
             (11.0, 0, cases.service(11, inside=second, outside=15, regions=regions, messages=2, number=2,
                                    priority=2))]  # fmt: skip
    ours = engine(rows)
    found = ours.satellites(at(12.0), SATELLITE)
    assert ours.delta_udre(at(12.0), found, sight(), np.array([35.0]), np.array([135.0]))[0, 0] == 2.0


def test_a_new_issue_of_regions_counts_when_it_is_whole() -> None:
    """Until then the old one does."""
    old = cases.service(5, inside=4, outside=15, regions=[(40, 130, 30, 140, 1)], issue=1)
    new = [cases.service(s, inside=7, outside=15, regions=[(40, 130, 30, 140, 1)], issue=2, messages=2, number=n)
           for s, n in ((9, 1), (11, 2))]  # fmt: skip
    rows = [*base(), (5.0, 0, old), (9.0, 0, new[0]), (11.0, 0, new[1])]
    ours, time = engine(rows), at(10.0, 11.0)
    found = ours.satellites(time, SATELLITE)
    line = np.broadcast_to(sight(), (2, 3, 3))
    assert ours.delta_udre(time, found, line, np.full(2, 35.0), np.full(2, 135.0))[:, 0].tolist() == [2.0, 5.0]


def test_type_0_stops_the_geo_for_a_minute_and_clears_what_it_said() -> None:
    rows = [*base(until=200), (30.5, 0, cases.message(0, 30))]
    stopped = SatelliteState.GEO_STOPPED
    assert states(rows, 30.4, 30.5, 90.4) == [OK, stopped, stopped]
    # Mask, factors, parameters and long-term corrections come again by 123 s.
    assert states(rows, 90.5, 99.9)[0] == SatelliteState.NO_MASK
    assert states(rows, 130.0) == [OK]
    assert "sent 1 messages of type 0 (do not use for safety): after each, the GEO" in " ".join(engine(rows).notes)


def test_type_0_may_stand_for_type_2() -> None:
    rows = [*base(until=9), (9.0, 0, cases.fast(9, [4.0], [2], kind=0, iodf=1)), (15.0, 0, cases.message(0, 15))]
    limits = SbasLimits(range_rate="off", type0="as_type2")
    found = engine(rows, limits).satellites(at(10.0, 15.0), SATELLITE)
    assert found.fast_m[0, 0] == 4.0
    assert found.state[1, 0] == SatelliteState.GEO_STOPPED
    assert states(rows, 10.0) == [SatelliteState.GEO_STOPPED]
    assert "read as type 2" in " ".join(engine(rows, limits).notes)


def test_two_geos_do_not_mix() -> None:
    """One GEO's masks and corrections never reach the other's; the better one is taken and named."""
    one = [(s, 129, b) for s, _, b in base(until=10)]
    two = [(s, 137, b) for s, _, b in base(until=40)]
    two = [(s, p, cases.fast(int(s), [3.0, 3.5], [3, 4], iodf=int(s) // 6 % 3) if s >= 4 else b) for s, p, b in two]
    log = cases.message_log(one + two)
    best = SbasCorrections.from_log(log, limits=OFF)
    assert best.prn == 137
    assert "best SBAS PRN by usable fast corrections: 137" in " ".join(best.notes)
    asked = SbasCorrections.from_log(log, prn=129, limits=OFF)
    assert asked.satellites(at(9.0), SATELLITE).fast_m[0, 0] == 1.5
    assert best.satellites(at(9.0), SATELLITE).fast_m[0, 0] == 3.0
    assert states(one, 30.0) == asked.satellites(at(30.0), SATELLITE).state[:, 0].tolist() == [TIMED_OUT]
    with pytest.raises(ValueError, match="no SBAS message of PRN 120; it has 129, 137"):
        SbasCorrections.from_log(log, prn=120)


def test_the_record_must_have_the_issue_of_the_correction(recordings: Path) -> None:
    """IODE match; while a new issue has no record, the last correction of the old one is used on."""
    folder = recordings / "sbas" / "msas_20080526_crescent"
    navigation = read_navigation(folder / "cres_20080526.bin.nav")
    log = read_sbas(folder / "cres_20080526.bin.sbs").of(137)
    ours = SbasCorrections.from_log(log, limits=SbasLimits(range_rate="off", incomplete="inflate"))
    time = log.time[0] + np.arange(0, 310, 10) * np.timedelta64(1, "s")
    satellite = np.array([f"G{i:02d}" for i in range(1, 33)])
    found, bare = ours.satellites(time, satellite, navigation), ours.satellites(time, satellite)
    good = found.state == OK
    record = found.record[good]
    assert good.sum() > 100
    assert (navigation.kepler.iode[record] == found.iode[good]).all()
    assert (navigation.kepler.satellite[record] == np.broadcast_to(satellite, good.shape)[good]).all()
    refused = found.state == SatelliteState.IODE_MISMATCH
    assert refused.any()
    assert (bare.state[refused] == OK).all()
    known = set(zip(navigation.kepler.satellite.tolist(), navigation.kepler.iode.tolist(), strict=True))
    for t, k in np.argwhere(refused):
        assert (satellite[k], found.iode[t, k]) not in known
    assert (found.record[~good] == -1).all()


def test_an_older_issue_serves_where_the_newest_has_no_record(recordings: Path) -> None:
    navigation = read_navigation(recordings / "sbas" / "msas_20080526_crescent" / "cres_20080526.bin.nav")
    rows = [row for row in base(until=30) if row[0] != 3]
    rows += [
        (3.0, 0, cases.long_term(3, [(1, 48, (1.0, 0.0, 0.0), 0)])),
        (9.0, 0, cases.long_term(9, [(1, 99, (2.0, 0.0, 0.0), 0)])),
    ]
    log = cases.message_log(rows)
    shift = np.datetime64("2008-05-26T06:30:00", "ns") - cases.START
    ours = SbasCorrections.from_log(replace(log, time=log.time + shift), limits=OFF)
    found = ours.satellites(at(10.0) + shift, SATELLITE, navigation)
    assert (found.state[0, 0], found.iode[0, 0], found.position_m[0, 0, 0]) == (OK, 48, 1.0)
    assert ours.satellites(at(10.0) + shift, SATELLITE).iode[0, 0] == 99
    later = [(s, p, b) for s, p, b in base(until=260) if b[1] >> 2 != 25]
    later += [rows[-2], *((s, 0, cases.long_term(s, [(1, 99, (2.0, 0.0, 0.0), 0)])) for s in (9, 100, 200))]
    log = cases.message_log(later)
    ours = SbasCorrections.from_log(replace(log, time=log.time + shift), limits=OFF)
    found = ours.satellites(at(243.0, 243.001) + shift, SATELLITE, navigation)
    assert found.state[:, 0].tolist() == [OK, SatelliteState.IODE_MISMATCH]


def test_nothing_of_the_future_and_nothing_of_other_epochs(recordings: Path) -> None:
    """Results at an epoch are those of the log cut there, and those of the epoch asked for alone."""
    log = read_sbas(recordings / "sbas" / "msas_20250215" / "046r_sbas_prn137.txt")
    satellite = np.array([f"G{i:02d}" for i in range(1, 33)])
    random = np.random.default_rng(5)
    time = log.time[0] + random.integers(300_000, 3_600_000, 12) * np.timedelta64(1, "ms")
    whole = SbasCorrections.from_log(log)
    all_at_once = whole.satellites(time, satellite)
    assert (all_at_once.state == OK).sum() > 60
    place = [np.full(len(time), v) for v in (35.7, 139.7)]
    sky = [np.tile([20.0, 50.0, 80.0], (len(time), 1)), np.tile([10.0, 130.0, 250.0], (len(time), 1))]
    delays = whole.ionosphere(time, *place, *sky)
    for i, instant in enumerate(time):
        one = np.array([instant])
        cut = SbasCorrections.from_log(log.take(log.time <= instant), prn=137)
        for engine_, name in ((cut, "cut"), (whole, "alone")):
            single = engine_.satellites(one, satellite)
            for field in ("state", "fast_m", "position_m", "clock_s", "udrei", "iode"):
                got, expected = getattr(single, field)[0], getattr(all_at_once, field)[i]
                assert np.array_equal(got, expected, equal_nan=True), (name, field)
            assert np.array_equal(single.sigma_flt_m()[0], all_at_once.sigma_flt_m()[i], equal_nan=True)
            alone = engine_.ionosphere(one, *(v[:1] for v in place), *(v[:1] for v in sky))
            assert np.array_equal(alone.delay_m[0], delays.delay_m[i], equal_nan=True)
            assert np.array_equal(alone.sigma_uire_m[0], delays.sigma_uire_m[i], equal_nan=True)


@pytest.mark.parametrize("seed", range(4))
def test_any_bits_give_corrections_or_a_reason(seed: int) -> None:
    """Messages of random content: what is OK has all its numbers, what is not has none."""
    random = np.random.default_rng(seed)
    rows = base(until=900)
    for second in range(900):
        kind = int(random.choice([1, 2, 3, 6, 7, 10, 18, 24, 25, 26, 27, 28, 9, 12, 17, 40, 63]))
        bits = np.packbits(random.integers(0, 2, 256, dtype=np.uint8))
        bits[1] = kind << 2 | bits[1] & 3
        rows.append((second + 0.5, 0, bits))
    time = at(*np.arange(0.0, 950.0, 7.3))
    satellite = np.array([*(f"G{i:02d}" for i in range(1, 33)), "R07", "S37", "J02", "E01"])
    for limits in (SbasLimits(), SbasLimits(mode="en_route", incomplete="inflate", type0="as_type2")):
        ours = engine(rows, limits)
        found = ours.satellites(time, satellite)
        ok = found.state == OK
        assert ok.any()
        for values in (found.fast_m, found.clock_s, found.position_m.sum(axis=-1), found.sigma_flt_m()):
            assert np.isfinite(values[ok]).all()
            assert np.isnan(values[~ok]).all()
        place = np.full(len(time), 36.0), np.full(len(time), 138.0)
        sky = np.full((len(time), 4), 30.0), np.tile([0.0, 90.0, 180.0, 270.0], (len(time), 1))
        air = ours.ionosphere(time, *place, *sky)
        assert np.isfinite(air.sigma_uire_m[air.state == 0]).all()
        assert np.isnan(air.sigma_uire_m[air.state != 0]).all()
        line = np.broadcast_to([0.0, 0.6, 0.8], (*found.state.shape, 3))
        assert ours.delta_udre(time, found, line, *place).shape == found.state.shape


def test_a_log_without_corrections_refuses_everything() -> None:
    found = engine([(0, 0, cases.message(63, 0))]).satellites(at(1.0), SATELLITE)
    assert set(found.state.ravel().tolist()) == {SatelliteState.NO_MASK}
    empty = engine([(0, 0, cases.mask(0, NUMBERS))])
    assert empty.satellites(at(1.0), SATELLITE).state.tolist() == [
        [SatelliteState.NO_FAST, SatelliteState.NO_FAST, SatelliteState.NOT_IN_MASK]
    ]


def test_tables_are_those_of_do_229d() -> None:
    """Degradation and time-outs belong together: what is left at the time-out stays within 0.3 m or so."""
    assert len(FAST_DEGRADATION_MPS2) == 16
    precision, en_route = FAST_TIMEOUT_S["precision"], FAST_TIMEOUT_S["en_route"]
    assert all(1.5 * p == e for p, e in zip(precision, en_route, strict=True))
    assert list(precision) == sorted(precision, reverse=True)


def test_misspelt_limits_are_refused() -> None:
    with pytest.raises(SettingsError, match="setting mode: Input should be 'precision' or 'en_route'"):
        SbasLimits(mode="pa")  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="setting max_udrei: Input should be less than or equal to 13"):
        SbasLimits(max_udrei=15)


def test_a_satellite_of_sbas_needs_no_long_term_correction_and_gets_none_of_another() -> None:
    rows = [(1.0, 0, cases.mask(1, [1, 129])), (2.0, 0, cases.fast(2, [1.0, 2.0], [3, 3]))]
    rows.append((3.0, 0, cases.long_term(3, [(1, 40, (8.0, 4.0, 2.0), 100.0)])))
    engine = SbasCorrections(
        cases.message_log(rows), prn=137, limits=SbasLimits(range_rate="off", incomplete="inflate")
    )
    time = cases.START + np.array([5], dtype="timedelta64[s]").astype("timedelta64[ns]")
    found = engine.satellites(time, np.array(["G01", "S29"]))
    assert found.state.tolist() == [[SatelliteState.OK, SatelliteState.OK]]
    assert found.position_m[0].tolist() == [[8.0, 4.0, 2.0], [0.0, 0.0, 0.0]]
    assert (found.clock_s[0, 0], found.clock_s[0, 1]) == (100.0 * 2.0**-31, 0.0)
    assert found.iode.tolist() == [[40, -1]]


@pytest.mark.parametrize(("earlier", "expected"), [(2.0, 0.0), (3.0, (0.0058 * 1.0 / 2.0 + 1.0 / 5.0) * 2.0)])
def test_a_rate_after_an_alarm_does_not_degrade_over_half_the_time_out(earlier: float, expected: float) -> None:
    """Time-out 12 s (ai = 15), Brrc 1 m, IODF 3: nothing over exactly 6 s, (a |5 - 6| / 2 + Brrc / 5) t over 5 s."""
    rows = [(0.5, 0, cases.mask(0, [1])), (0.6, 0, cases.factors(0, [15])), (0.7, 0, cases.parameters(0, brrc=500))]
    rows.append((0.8, 0, cases.long_term(0, [(1, 40, (0.0, 0.0, 0.0), 0.0)])))
    rows += [(earlier, 0, cases.fast(2, [1.0], [3])), (8.0, 0, cases.fast(2, [4.0], [3], iodf=3))]
    engine = SbasCorrections(cases.message_log(rows), prn=137)
    time = cases.START + np.array([9], dtype="timedelta64[s]").astype("timedelta64[ns]")
    found = engine.satellites(time, np.array(["G01"]))
    assert found.state.item() == SatelliteState.OK
    assert found.rate_mps.item() == pytest.approx(3.0 / (8.0 - earlier))
    assert found.rate_growth_m.item() == pytest.approx(expected, abs=1e-12)
