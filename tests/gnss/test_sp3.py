"""SP3: reading, time systems, gaps, and interpolation against orbits that are known exactly."""

from __future__ import annotations

import gzip
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from orbit_cases import TOE, kepler, navigation
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.errors import InputFileError
from railfix.gnss.navigation import PreciseEphemeris
from railfix.gnss.orbits import satellite_states
from railfix.gnss.orbits.ephemerides import Orbits, kepler_state
from railfix.io.sp3 import read_sp3

START = TOE - np.timedelta64(2, "h")
SATELLITES = ("E14", "G05", "J02")


def truth(seconds_after_toe: np.ndarray, satellite: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity (n, 3) and clock (n,) [s] of a made satellite, relativity left out of the clock."""
    records = kepler({"satellite": satellite})
    position, velocity, relativity = kepler_state(Orbits.from_records(records), seconds_after_toe)
    clock = records.af0_s[0] + records.af1[0] * seconds_after_toe
    return np.array(position).T, np.array(velocity).T, clock + 0.0 * relativity


def text(
    *, epochs: int = 17, step_s: int = 900, start: np.datetime64 = START, system: str = "GPS", version: str = "d",
    satellites: tuple[str, ...] = SATELLITES, skip: tuple[int, ...] = (),
) -> str:  # fmt: skip
    lines = [
        f"#{version}P2024  3 13  6  0  0.00000000 {epochs:7d} d+D   IGS20 FIT TST",
        "## 2305 280800.00000000   900.00000000 60382 0.2500000000000",
        f"+  {len(satellites):3d}   " + "".join(satellites) + "  0" * (17 - len(satellites)),
        *["+        " + "  0" * 17] * 4,
        *["++       " + "  0" * 17] * 5,
        f"%c M  cc {system} ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc",
        "%c cc cc ccc ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc",
        "%f  1.2500000  1.025000000  0.00000000000  0.000000000000000",
        "%f  0.0000000  0.000000000  0.00000000000  0.000000000000000",
        "%i    0    0    0    0      0      0      0      0         0",
        "%i    0    0    0    0      0      0      0      0         0",
        *["/* MADE FOR A TEST"] * 4,
    ]
    for k in range(epochs):
        if k in skip:
            continue
        time = start + k * np.timedelta64(step_s, "s")
        t = (time - TOE) / np.timedelta64(1, "s")
        date = time.astype("datetime64[s]").item()
        lines.append(f"*  {date:%Y} {date.month:2d} {date.day:2d} {date.hour:2d} {date.minute:2d} {date.second:11.8f}")
        for name in satellites:
            position, _, clock = truth(np.array([float(t)]), name)
            x, y, z = position[0] / 1e3
            lines.append(f"P{name}{x:14.6f}{y:14.6f}{z:14.6f}{clock[0] * 1e6:14.6f} 10 10 10 100")
    return "\n".join([*lines, "EOF"]) + "\n"


def written(folder: Path, content: str, name: str = "a.sp3") -> Path:
    path = folder / name
    path.write_text(content)
    return path


@pytest.mark.requirement("A7")
def test_what_is_written_is_read(tmp_path: Path) -> None:
    found = read_sp3(written(tmp_path, text()))
    assert found.satellite.tolist() == list(SATELLITES)
    np.testing.assert_array_equal(found.time, START + np.arange(17) * np.timedelta64(900, "s"))
    t = (found.time - TOE) / np.timedelta64(1, "s")
    for column, name in enumerate(SATELLITES):
        position, _, clock = truth(t, name)
        assert np.abs(found.position_ecef_m[:, column] - position).max() <= 0.5001e-3, "written to the millimetre"
        assert np.abs(found.clock_s[:, column] - clock).max() <= 0.5001e-12


def test_packed_files_and_the_letterless_first_version(tmp_path: Path) -> None:
    packed = tmp_path / "b.sp3.gz"
    packed.write_bytes(gzip.compress(text(satellites=("G05",), version="a").replace("PG05", "P  5").encode()))
    assert read_sp3(packed).satellite.tolist() == ["G05"]


@pytest.mark.parametrize(
    ("system", "shift_s"), [("GPS", 0), ("GAL", 0), ("QZS", 0), ("BDT", 14), ("UTC", 18), ("GLO", 18)]
)
def test_time_systems_become_gps_time(system: str, shift_s: int, tmp_path: Path) -> None:
    found = read_sp3(written(tmp_path, text(system=system)))
    assert found.time[0] == START + np.timedelta64(shift_s, "s")


def test_absent_positions_and_clocks_are_nan(tmp_path: Path) -> None:
    lines = text().splitlines()
    rows = [i for i, line in enumerate(lines) if line.startswith("PG05")]
    lines[rows[0]] = "PG05" + f"{0.0:14.6f}" * 3 + " 999999.999999"
    lines[rows[1]] = lines[rows[1]][:46] + " 999999.999999"
    lines[rows[2]] = lines[rows[2]][:46]
    found = read_sp3(written(tmp_path, "\n".join(lines)))
    assert np.isnan(found.position_ecef_m[:, 1]).any(axis=-1).tolist() == [True] + [False] * 16
    assert np.isnan(found.clock_s[:, 1]).tolist() == [True] * 3 + [False] * 14


def test_files_are_joined_and_the_first_one_counts(tmp_path: Path) -> None:
    first = written(tmp_path, text(epochs=8), "1.sp3")
    second = text(epochs=14).replace("-250.", "-777.")
    found = read_sp3([first, written(tmp_path, second, "2.sp3")])
    assert len(found.time) == 14
    assert (found.clock_s[:8] > -260e-6).all()
    assert (found.clock_s[8:] < -770e-6).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: "  3.05 NAVIGATION\n" + s, "first line begins with #a"),
        (lambda s: s.replace("GPS ccc", "TAI ccc"), "time system 'TAI'"),
        (lambda s: s.split("*")[0], "has no satellite position"),
        (lambda s: s.replace("PG05", "PGX5", 1), "line 25"),
        (lambda s: s.replace("*  2024  3 13", "*  2024 13 13", 1), "line 23"),
        (lambda s: s.replace("*  2024", "*  0024", 1), "line 23"),
        (lambda s: s.replace("*  2024  3 13  6", "*  2024  3 13 -1", 1), "line 23"),
        (lambda s: s.replace(" 0.00000000\nPE14", "        inf\nPE14", 1), "line 23"),
        (lambda s: s.replace("PG05", "PG-1", 1), "line 25"),
        (lambda s: s[: s.index("-250.")] + "garbage.0000\n", "line 24"),
        (lambda s: "\n".join(x for x in s.splitlines() if not x.startswith("*")), "before the first epoch"),
    ],
)
def test_broken_files_are_named_with_their_line(change: Any, message: str, tmp_path: Path) -> None:
    path = written(tmp_path, change(text()))
    with pytest.raises(InputFileError, match=message) as caught:
        read_sp3(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@cache
def short_file() -> str:
    return text(epochs=14)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_anywhere_is_an_error_or_an_ephemeris(tmp_path: Path, data: st.DataObject) -> None:
    content = short_file()
    at = data.draw(st.integers(0, len(content) - 1))
    put = data.draw(st.text(alphabet="0123456789 .-+*#PGERx\n", max_size=3))
    length = data.draw(st.sampled_from([0, 1, 1, 30]))
    path = written(tmp_path, content[:at] + put + content[at + length :])
    error = None
    try:
        found = read_sp3(path)
    except InputFileError as raised:
        error = raised
    if error is not None:
        assert str(path) in str(error)
        return
    assert (np.diff(found.time) > np.timedelta64(0, "ns")).all()
    assert not np.isinf(found.position_ecef_m).any()


def test_too_few_epochs_are_refused_when_read_and_when_used(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="at least 13"):
        read_sp3(written(tmp_path, text(epochs=10)))
    short = precise(10)
    with pytest.raises(ValueError, match="at least 13"):
        states(short, np.array([0.0]), "G05")


def precise(epochs: int = 33, step_s: float = 900.0, satellites: tuple[str, ...] = SATELLITES) -> PreciseEphemeris:
    """A precise ephemeris to the last digit, its middle at TOE."""
    t = (np.arange(epochs) - (epochs - 1) / 2) * step_s
    columns = [truth(t, name) for name in satellites]
    return PreciseEphemeris(
        time=TOE + (t * 1e9).astype("timedelta64[ns]"),
        satellite=np.array(satellites),
        position_ecef_m=np.stack([c[0] for c in columns], axis=1),
        clock_s=np.stack([c[2] for c in columns], axis=1),
    )


def states(
    ephemeris: PreciseEphemeris, after_toe_s: np.ndarray, satellite: str, code_m: float = 0.0, **row: Any
) -> Any:
    nav = replace(navigation({"satellite": satellite, **row}), precise=ephemeris)
    time = TOE + np.rint(after_toe_s * 1e9).astype("timedelta64[ns]")
    return satellite_states(time, np.array([satellite]), np.array(["1C"]), np.full((len(time), 1), code_m), nav)


@pytest.mark.requirement("A7")
@pytest.mark.parametrize("satellite", SATELLITES)
def test_interpolation_meets_the_orbit(satellite: str) -> None:
    """Between epochs 15 minutes apart: position to 1 mm (3 mm on the orbit of eccentricity 0.17), clock too."""
    t = np.array([-3001.0, -450.0, -0.5, 0.0, 449.0, 1234.567, 3599.9])
    found = states(precise(), t, satellite, code_m=2.4e7)
    records = kepler({"satellite": satellite})
    sent = t - 2.4e7 / SPEED_OF_LIGHT
    sent -= truth(sent, satellite)[2]
    position, velocity, _ = kepler_state(Orbits.from_records(records), sent)
    limit = 3e-3 if satellite == "E14" else 1e-3
    assert np.linalg.norm(found.position_ecef_m[:, 0] - np.array(position).T, axis=-1).max() < limit
    assert np.abs(found.velocity_ecef_mps[:, 0] - np.array(velocity).T).max() < 1e-4
    # -2 r.v / c^2 of the true orbit: a centimetre from the form with the eccentricity, which knows no perturbation.
    relativity = -2.0 * (np.array(position) * np.array(velocity)).sum(axis=0) / SPEED_OF_LIGHT**2
    clock = records.af0_s[0] + records.af1[0] * sent + relativity
    assert np.abs(found.clock_m[:, 0] - SPEED_OF_LIGHT * clock).max() < 1e-3
    assert not found.no_record.any()
    assert (found.age_s == 0.0).all()


@pytest.mark.requirement("A7")
@pytest.mark.parametrize("satellite", SATELLITES)
@pytest.mark.parametrize("step_s", [900.0, 300.0])
def test_interpolation_meets_the_orbit_all_day(step_s: float, satellite: str) -> None:
    """Every phase between the epochs, six or more from the ends of the file: 1 cm at 15 minutes, 1 um at 5."""
    t = np.linspace(-10.0 * step_s, 10.0 * step_s, 3001)
    found = states(precise(33, step_s), t, satellite, code_m=2.4e7)
    sent = t - 2.4e7 / SPEED_OF_LIGHT
    sent -= truth(sent, satellite)[2]
    away = np.linalg.norm(found.position_ecef_m[:, 0] - truth(sent, satellite)[0], axis=-1)
    assert away.max() < (1e-6 if step_s == 300.0 else 1e-2)


@pytest.mark.requirement("A7")
def test_states_are_those_of_rtklib(tmp_path: Path) -> None:
    rtk = pytest.importorskip("pyrtklib5")
    from pyrtklib_orbits import instant, satellite_number

    path = written(tmp_path, text(epochs=33, start=TOE - np.timedelta64(4, "h"), version="c"), "made.sp3")
    theirs = rtk.nav_t()
    rtk.readsp3(str(path), theirs, 0)
    assert theirs.ne == 33
    ephemeris = read_sp3(path)
    for name in SATELLITES:
        for t in (-2700.0, -13.0, 0.0, 777.7, 2701.0):
            found = states(ephemeris, np.array([t]), name)
            # The instant of transmission is found with the clock of the file, relativity left out (1.5 mm of orbit).
            sent = rtk.timeadd(instant(TOE), t - float(truth(np.array([t]), name)[2][0]))
            place, clock, variance = rtk.Arr1Ddouble(6), rtk.Arr1Ddouble(2), rtk.Arr1Ddouble(1)
            assert rtk.peph2pos(sent, satellite_number(name), theirs, 0, place, clock, variance) == 1
            assert np.linalg.norm(found.position_ecef_m[0, 0] - [place[i] for i in range(3)]) < 1e-3
            assert np.linalg.norm(found.velocity_ecef_mps[0, 0] - [place[i] for i in (3, 4, 5)]) < 5e-3
            assert abs(found.clock_m[0, 0] - SPEED_OF_LIGHT * clock[0]) < 1e-3


def test_outside_the_file_and_in_its_gaps_there_is_no_state() -> None:
    whole = precise(33)
    keep = np.ones(33, dtype=bool)
    keep[20:23] = False
    gap = PreciseEphemeris(
        time=whole.time[keep],
        satellite=whole.satellite,
        position_ecef_m=whole.position_ecef_m[keep],
        clock_s=whole.clock_s[keep],
    )
    t = np.array([-14_401.0, -14_400.0, 2700.0, 2701.0, 5000.0, 6301.0, 14_400.0, 14_401.0])
    found = states(gap, t, "G05")
    expected = [True, False, True, True, True, False, False, True]
    assert np.isnan(found.position_ecef_m[:, 0, 0]).tolist() == expected
    assert found.no_record[:, 0].tolist() == expected
    missing = whole.clock_s.copy()
    missing[16, 1] = np.nan
    found = states(replace(whole, clock_s=missing), np.array([-1000.0, -10.0, 10.0, 1000.0]), "G05")
    assert found.no_record[:, 0].tolist() == [False, True, True, False]


def test_satellites_absent_from_it_are_not_taken_from_broadcast_silently() -> None:
    ephemeris = precise(satellites=("E14", "J02"))
    found = states(ephemeris, np.array([0.0]), "G05")
    assert found.no_record.all()
    assert np.isnan(found.position_ecef_m).all()


def test_health_and_group_delay_come_from_broadcast_of_any_age() -> None:
    old = {"toe": TOE - np.timedelta64(30, "D"), "health": 1}
    found = states(precise(), np.array([0.0]), "G05", **old)
    assert found.unhealthy.all()
    assert not found.too_old.any()
    assert found.group_delay_m[0, 0] == pytest.approx(-1.1e-8 * SPEED_OF_LIGHT)
    inav = states(precise(satellites=("E11",)), np.array([0.0]), "E11")
    assert inav.group_delay_m[0, 0] == pytest.approx(-3.3e-9 * SPEED_OF_LIGHT), "SP3 clocks of Galileo are of E1/E5a"
    nothing = replace(navigation({"satellite": "E11"}), precise=precise())
    alone = satellite_states(np.array([TOE]), np.array(["G05"]), np.array(["1C"]), np.zeros((1, 1)), nothing)
    assert alone.no_record.all(), "without a broadcast record its group delay and health are unknown"


def test_chunks_give_the_same_bits() -> None:
    t = np.sort(np.random.default_rng(4).uniform(-14_000, 14_000, 9001))
    ephemeris = precise()
    whole = states(ephemeris, t, "J02", code_m=3.6e7)
    for part in (slice(0, 1), slice(17, 24), slice(4000, 5000), slice(4095, 9001)):
        piece = states(ephemeris, t[part], "J02", code_m=3.6e7)
        np.testing.assert_array_equal(piece.position_ecef_m, whole.position_ecef_m[part])
        np.testing.assert_array_equal(piece.velocity_ecef_mps, whole.velocity_ecef_mps[part])
        np.testing.assert_array_equal(piece.clock_m, whole.clock_m[part])


def test_orbits_of_another_radius_and_clocks_of_zero_are_absent(tmp_path: Path) -> None:
    lines = text().splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("PG05"))
    zero = next(k for k, line in enumerate(lines) if line.startswith("PJ02"))
    x, y, z = (float(lines[first][4 + 14 * i : 18 + 14 * i]) for i in range(3))
    lines[first] = lines[first][:4] + "".join(f"{0.5 * v:14.6f}" for v in (x, y, z)) + lines[first][46:]
    lines[zero] = lines[zero][:46] + f"{0.0:14.6f}" + lines[zero][60:]
    path = tmp_path / "made.sp3"
    path.write_text("\n".join(lines) + "\n")
    found = read_sp3(path)
    gps, qzss = (int(np.flatnonzero(found.satellite == name)[0]) for name in ("G05", "J02"))
    assert np.isnan(found.position_ecef_m[0, gps]).all()
    assert np.isfinite(found.position_ecef_m[1:, gps]).all()
    assert np.isnan(found.clock_s[0, qzss])
    assert np.isfinite(found.clock_s[1:, qzss]).all()
