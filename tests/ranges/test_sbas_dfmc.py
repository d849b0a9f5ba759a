"""Dual-frequency SBAS: layouts, corrections in force, integrity, traps."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import orbit_cases as cases
from railfix.core.errors import InputFileError
from railfix.core.reasons import Reason
from railfix.gnss.orbits.states import satellite_states
from railfix.io.rinex import read_navigation
from railfix.ranges.sbas import SbasMessages, read_sbas
from railfix.ranges.sbas.dfmc import DfmcService, DfmcState, residual_ionosphere_m, slot_satellite
from railfix.ranges.sbas.messages import message_type, with_parity
from railfix.ranges.sbas.sbas_sources import apply_dfmc
from railfix.simulate import sbas_stream as stream
from railfix.simulate.sbas_stream import write_sbas
from sbas_account import account

pytestmark = pytest.mark.requirement("C5")
START = np.datetime64("2026-03-01T06:00:00", "ns")
#: Satellites of the mask: G05, G12, E03.
SLOTS = (5, 12, 77)
TOD_S = 6 * 3600.0


def log(*messages: tuple[float, np.ndarray]) -> SbasMessages:
    time = START + np.array([round(t * 1e9) for t, _ in messages], dtype="timedelta64[ns]")
    bits, rows = np.array([bits for _, bits in messages], dtype=np.uint8), np.arange(len(messages))
    return SbasMessages(
        time=time, prn=np.full(len(rows), 137), type=message_type(bits, "L5"), bits=bits, parity_bits=rows * 0 + 24,
        source=rows * 0, line=rows + 1, sources=("made",), band="L5",
    )  # fmt: skip


def service(*messages: tuple[float, np.ndarray]) -> DfmcService:
    return DfmcService(log(*messages), prn=137)


def standard(*more: tuple[float, np.ndarray], **parameters: object) -> DfmcService:
    """A mask, type 37, and a correction of G05 with rates."""
    moved, rates = (1.0, -2.5, 0.0625, -3.125), (0.01, 0.0, -0.005, 0.02)
    sent = stream.correction(2, 5, 77, moved, rates, time_of_day_s=TOD_S)
    first = [(0.0, stream.mask(0, SLOTS)), (1.0, stream.parameters(1, **parameters)), (2.0, sent)]  # type: ignore[arg-type]
    return service(*sorted([*first, *more], key=lambda item: item[0]))


def at(found: DfmcService, second: float, satellite: str = "G05"):  # type: ignore[no-untyped-def]
    return found.satellites(np.array([START + np.timedelta64(round(second * 1e9), "ns")]), np.array([satellite]))


def test_slots_name_satellites() -> None:
    assert [slot_satellite(s) for s in (1, 32, 33, 38, 75, 110, 120, 158, 159, 195, 200)] == [
        "G01", "G32", "", "R01", "E01", "E36", "S20", "S58", "C01", "C37", "",
    ]  # fmt: skip


def test_a_message_by_hand() -> None:
    """Type 32 bit by bit: slot 5, issue 77, x -1 step of 1/16 m, clock +2 steps of 1/32 m, all else zero."""
    text = f"{0x6:04b}{32:06b}" + f"{5:08b}{77:010b}" + "1" * 11 + "0" * 22 + f"{2:012b}" + "0" * 33
    text += f"{round(TOD_S / 16):013b}" + "101" + f"{4:09b}" + "0" * 27 + "0" * 60 + f"{3:04b}" + "1111"
    assert len(text) == 226
    written = stream.correction(
        2, 5, 77, (-0.0625, 0, 0, 0.0625), time_of_day_s=TOD_S, covariance=(5, np.diag([4.0, 0, 0, 0])), dfrei=3
    )
    assert "".join(f"{b:08b}" for b in written)[:226] == text
    assert message_type(written[None], "L5").tolist() == [32]


def test_corrections_move_with_their_rates_and_belong_to_an_issue() -> None:
    found = at(standard(), 10.0)
    assert found.state[0, 0] == DfmcState.OK
    assert found.issue[0, 0] == 77
    quantised = np.round(np.array([0.01, 0.0, -0.005]) * 2**11) / 2**11
    np.testing.assert_allclose(found.position_m[0, 0], [1.0, -2.5, 0.0625] + 10.0 * quantised)
    assert found.clock_m[0, 0] == pytest.approx(-3.125 + 10.0 * round(0.02 * 2**12) / 2**12)
    # indicator 3, code 0: 0.5 m; the factor is the unit matrix, a line of sight along x has a factor of sqrt(2)
    assert found.sigma_along_m(np.array([[[1.0, 0.0, 0.0]]]))[0, 0] == pytest.approx(0.5 * np.sqrt(2.0))


@pytest.mark.parametrize(("age", "steps", "share"), [(10.5, 0, 0.5), (35.5, 0, 0.5), (36.5, 1, 1.0), (73.0, 2, 1.0)])
def test_sigma_grows_by_scale_covariance_and_age(age: float, steps: int, share: float) -> None:
    """Half the rate is asked for (the last four bits before the parity are 7), until an interval has passed."""
    sent = stream.correction(2, 5, 77, (0, 0, 0, 0), time_of_day_s=TOD_S)
    sent[27] ^= 2  # the first bit of the share
    more = (2.5, with_parity(sent[None])[0]), (2.5 + age - 1.0, stream.integrity(0, [3, 3, 3]))
    found = at(standard(*more, scale=4, covariance=0.5, degradation=(36.0, 0.02, 0.001)), 2.5 + age)
    expected = (0.5 + 4 * 0.125) * (np.sqrt(2.0) + 0.5) + steps * 0.02 + share * 0.001 * age
    assert found.sigma_along_m(np.array([[[0.0, 1.0, 0.0]]]))[0, 0] == pytest.approx(expected)


def test_limits_of_type_37() -> None:
    """35 steps of 6 s and 30 s are what SouthPAN sends; indicator 14 begins at 10 m."""
    assert int("".join(map(str, np.unpackbits(stream.parameters(1, valid_s=240.0))[10:16])), 2) == 35
    found = standard(*((t, stream.integrity(0, [14, 3, 3])) for t in (235.0, 242.0)), valid_s=240.0)
    assert at(found, 241.0).state[0, 0] == DfmcState.OK
    assert at(found, 241.0).sigma_m[0, 0] == pytest.approx(10.0)
    assert at(found, 242.5).state[0, 0] == DfmcState.TIMED_OUT


def test_beidou_is_corrected_by_the_iode_of_b_cnav1_and_glonass_not_at_all() -> None:
    slots, satellite, time = (40, 178), np.array(["C20", "R03"]), np.array([START + np.timedelta64(4, "s")])
    sent = [(float(k + 2), stream.correction(2, slot, 21, (1, 0, 0, 0.5), time_of_day_s=TOD_S))
            for k, slot in enumerate(slots)]  # fmt: skip
    own = service((0.0, stream.mask(0, slots)), (1.0, stream.parameters(1)), *sent)
    kinds = [{"message": name, "iode": iode} for name, iode in (("D1", 21), ("CNV1", 20), ("CNV1", 21))]
    records = cases.navigation(*({"satellite": "C20", "toe": START, **kind} for kind in kinds))
    found = own.satellites(time, satellite, records)
    assert found.state.tolist() == [[DfmcState.OK, DfmcState.NO_RECORD]]
    assert found.record.tolist() == [[2, -1]]
    states = satellite_states(time, satellite, np.array(["1P", "1C"]), np.full((1, 2), 2.3e7), records)
    moved, reason = apply_dfmc(states, found, satellite, np.array(["1P", "1C"]))
    assert reason.tolist() == [[0, int(Reason.SBAS_NOT_COVERED)]]
    assert moved.clock_m[0, 0] - states.clock_m[0, 0] == pytest.approx(0.5)
    assert apply_dfmc(states, found, satellite, np.array(["2I", "1C"]))[1][0, 0] == int(Reason.SBAS_NOT_COVERED)


def test_an_hour_of_services_under_test(recordings: Path) -> None:
    """SouthPAN and BDSBAS, 2025-02-15, of L1 and L5: without type 0, which they send for as long as they are tested."""
    folder = recordings / "sbas" / "msas_20250215"
    if not (folder / "046r_sbas.txt").is_file():
        pytest.skip("046r_sbas.txt of cssrlib-data is not beside the recordings")
    log = read_sbas(folder / "046r_sbas.txt", band="L5", broken_lines="skip")
    assert log.rejected["parity"] == log.rejected["preamble"] == 0
    time, navigation = log.time[log.prn == 130][300::10], read_navigation(folder / "046r_rnx.nav")
    untested = replace(log, **{f.name: getattr(log, f.name)[log.type != 0] for f in fields(log)[:7]})
    states = {}
    for prn, names in ((122, ["G24", "E27", "C19"]), (130, ["G24", "E27", "C19", "C20"])):
        assert (DfmcService(log, prn=prn).satellites(time, np.array(names)).state == DfmcState.STOPPED).all()
        own = DfmcService(untested, prn=prn)
        states[prn] = own.satellites(time, np.array(names), navigation).state.T
        assert set(own._read[37]["valid_32_s"]) == {240.0 if prn == 122 else 150.0}
    assert [(row == DfmcState.OK).any() for row in states[122]] == [True, True, False]
    assert (states[122][2] == DfmcState.NOT_IN_MASK).all()
    assert [np.mean(row == DfmcState.OK).round(2) for row in states[130]] == [1.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("second", "satellite", "state"),
    [
        (1.5, "G05", DfmcState.NO_CORRECTION),
        (3.0, "G12", DfmcState.NO_CORRECTION),
        (3.0, "G07", DfmcState.NOT_IN_MASK),
        (3.0, "J01", DfmcState.NOT_IN_MASK),
        (-1.0, "G05", DfmcState.NO_MASK),
        (0.5, "G05", DfmcState.NO_DEGRADATION),
        (15.0, "G05", DfmcState.TIMED_OUT),
    ],
)
def test_what_is_missing_has_a_name(second: float, satellite: str, state: DfmcState) -> None:
    assert at(standard(), second, satellite).state[0, 0] == state


@pytest.mark.parametrize(
    ("message", "state", "sigma"),
    [
        (stream.integrity(0, [4, 3, 3]), DfmcState.OK, 0.625),
        (stream.integrity(0, [15, 3, 3]), DfmcState.DO_NOT_USE, np.nan),
        (stream.integrity(0, [15, 3, 3], iodm=1), DfmcState.OK, 0.5),  # of another mask
        (stream.changes(0, [0, 1, 3], [9]), DfmcState.OK, 0.5),
        (stream.changes(0, [1, 0, 0], [6]), DfmcState.OK, 1.0),
        (stream.changes(0, [2, 0, 0]), DfmcState.OK, 0.625),
        (stream.changes(0, [3, 0, 0]), DfmcState.DO_NOT_USE, np.nan),
        (stream.message(63, 0), DfmcState.OK, 0.5),
    ],
)
def test_later_indicators_count(message: np.ndarray, state: DfmcState, sigma: float) -> None:
    found = at(standard((5.0, message)), 6.0)
    assert found.state[0, 0] == state
    np.testing.assert_allclose(found.sigma_m[0, 0], sigma)


def test_the_last_of_many_satellites_is_in_type_36() -> None:
    slots = [*range(1, 33), *range(75, 111)]  # 68 satellites: E36 is number 67
    grades = [15] * 14 + [7]
    found = service(
        (0.0, stream.mask(0, slots)),
        (1.0, stream.parameters(1)),
        (2.0, stream.correction(2, 110, 5, (0, 0, 0, 0), time_of_day_s=TOD_S)),
        (3.0, stream.integrity(3, grades, kind=36)),
    )
    assert at(found, 4.0, "E36").sigma_m[0, 0] == pytest.approx(1.25)


def test_type_0_stops_the_service_and_what_came_before_it() -> None:
    """Also where it carries the content of another type, as in tests of a service."""
    content = stream.integrity(5, [3, 3, 3])
    content[0] = (content[0] & 0xF0) | 0  # the type is 0 now
    content[1] &= 0x3F
    stop = with_parity(content[None])[0]
    found = standard((5.0, stop))
    assert at(found, 4.0).state[0, 0] == DfmcState.OK
    assert at(found, 6.0).state[0, 0] == DfmcState.STOPPED
    again = standard((5.0, stop), (66.0, stream.integrity(0, [3, 3, 3])))
    assert at(again, 67.0).state[0, 0] == DfmcState.NO_CORRECTION  # the correction was sent before the stop


def test_broken_and_foreign_messages_are_counted_and_left_out(tmp_path: Path) -> None:
    broken, foreign = stream.mask(0, SLOTS).copy(), stream.mask(0, SLOTS).copy()
    broken[10] ^= 4
    foreign[0] = 0x13  # no preamble of L5
    foreign = with_parity(foreign[None])[0]
    written = log((0.0, broken), (1.0, foreign), (2.0, stream.message(61, 2)), (3.0, stream.message(47, 3)))
    write_sbas(written, tmp_path / "l5.sbs")
    read = read_sbas(tmp_path / "l5.sbs", band="L5")
    assert account(read) == {
        "MSAS 137 type 47 SBAS almanacs": 1, "MSAS 137 type 61 reserved, not decoded": 1,
        "rejected: duplicate": 0, "rejected: line": 0, "rejected: parity": 1, "rejected: preamble": 1,
    }  # fmt: skip
    assert at(DfmcService(read, prn=137), 4.0).state[0, 0] == DfmcState.NO_MASK
    assert not read.notes
    with pytest.raises(InputFileError, match=r"type is 31, but the message on L1 has type \d+ \(setting sbas_band\)"):
        read_sbas(tmp_path / "l5.sbs")


def test_residual_ionosphere() -> None:
    np.testing.assert_allclose(residual_ionosphere_m(np.array([5.0, 90.0])), [40 / 286 + 0.018, 40 / 8361 + 0.018])
