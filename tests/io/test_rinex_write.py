"""Written RINEX files: read back by our reader and by georinex, packed reproducibly, whole or absent."""

from __future__ import annotations

import gzip
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hatanaka import crx2rnx
from hypothesis import example, given
from hypothesis import strategies as st

from railfix.core.errors import OutputError
from railfix.gnss import ObservationHeader, Observations, concatenate
from railfix.gnss.navigation import GlonassRecords, KeplerRecords, Navigation
from railfix.io import read_navigation, read_observations, write_navigation, write_observations
from railfix.io.rinex.write import RinexVersion, _format_f14_3, detect_packing
from railfix.simulate import Scenario, SkySettings, simulate_navigation
from railfix.simulate.scenario import ReceiverSettings

START = np.datetime64("2024-03-05T23:59:58.5", "ns")
CHANNELS = [("G01", "1C"), ("G01", "2W"), ("G12", "1C"), ("R05", "1C"), ("E11", "1C"), ("J02", "1C"), ("C19", "2I")]


def log(epochs: int = 40, seed: int = 3) -> Observations:
    """Ten channels with gaps, negative and tiny values, crossing midnight at tags off the round 0.1 s."""
    rng = np.random.default_rng(seed)
    shape = (epochs, len(CHANNELS))
    absent = rng.random(shape) < 0.15
    absent[5] = True  # an epoch without any satellite
    if epochs > 20:
        absent[:20, 2] = True
    doppler = rng.uniform(-5e3, 5e3, shape)
    doppler[0, 0] = -0.001
    lock = np.where(rng.random(shape) < 0.1, rng.integers(1, 4, shape), 0).astype(np.uint8)
    lock[absent] = 0
    values = {
        "code_m": rng.uniform(2e7, 4e7, shape),
        "phase_cycles": rng.uniform(-1e9, 1e9, shape),
        "doppler_hz": doppler,
        "cn0_dbhz": rng.uniform(5.0, 55.0, shape),
    }
    for value in values.values():
        value[absent] = np.nan
        value.flags.writeable = False
    breaks = np.zeros(epochs, dtype=bool)
    breaks[7] = True
    jitter = rng.integers(-3000, 3000, epochs) * 100
    return Observations(
        time=START + np.arange(epochs) * np.timedelta64(100, "ms") + jitter.astype("timedelta64[ns]"),
        satellite=np.array([c[0] for c in CHANNELS]),
        signal=np.array([c[1] for c in CHANNELS]),
        loss_of_lock=lock,
        break_before=breaks,
        header=ObservationHeader(
            marker="ROOF",
            receiver="RX",
            antenna="ANT",
            approximate_ecef_m=np.array([-3.7e6, 3.6e6, 3.7e6]),
            interval_s=0.1,
            glonass_channel={"R05": 1, "R06": -4},
            leap_seconds=18,
        ),
        **values,
    )


def columns_of(table: Observations) -> dict[tuple[str, str], int]:
    return {key: i for i, key in enumerate(zip(table.satellite.tolist(), table.signal.tolist(), strict=True))}


@given(st.lists(st.floats(-999_999_999.0, 9_999_999_999.0), min_size=1, max_size=20))
@example([0.0, -0.0, -0.0004, -0.0006, 0.9999, 9.9996, -1.0, -9.9996, 999_999.9996, -999_999_999.0])
def test_f14_3_is_the_number_in_fourteen_columns(values: list[float]) -> None:
    text = _format_f14_3(np.array(values)).tobytes().decode()
    for i, value in enumerate(values):
        cell = text[14 * i : 14 * i + 14]
        assert cell == f"{float(cell):14.3f}".replace("-0.000", " 0.000")
        # Half a thousandth, and the last bit of the product with 1000.
        assert abs(Decimal(cell) - Decimal(value)) <= Decimal("0.0005") + Decimal(abs(value)) * Decimal("2.3e-16")


@pytest.mark.requirement("A7")
@pytest.mark.parametrize("name", ["log.rnx", "log.rnx.gz", "log.crx", "log.crx.gz"])
def test_our_reader_gets_back_what_was_written(tmp_path: Path, name: str) -> None:
    written = log()
    write_observations(written, tmp_path / name)
    found = read_observations(tmp_path / name)
    assert (found.time == written.time).all()
    assert (found.break_before == written.break_before).all()
    columns = columns_of(found)
    assert set(columns) == set(CHANNELS)
    order = [columns[key] for key in CHANNELS]
    for field in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz"):
        np.testing.assert_allclose(getattr(found, field)[:, order], getattr(written, field), rtol=0, atol=5.001e-4)
    assert (found.loss_of_lock[:, order] == written.loss_of_lock).all()
    header = found.header
    assert (header.version, header.marker, header.receiver, header.antenna) == (3.04, "ROOF", "RX", "ANT")
    assert header.interval_s == 0.1
    assert header.leap_seconds == 18
    assert dict(header.glonass_channel) == {"R05": 1, "R06": -4}
    np.testing.assert_array_equal(header.approximate_ecef_m, written.header.approximate_ecef_m)


def test_pieces_equal_the_whole(tmp_path: Path) -> None:
    whole = log(50)
    write_observations(whole, tmp_path / "whole.rnx")
    for size in (1, 7, 50):
        write_observations((whole[i : i + size] for i in range(0, 50, size)), tmp_path / "pieces.rnx")
        assert (tmp_path / "pieces.rnx").read_bytes() == (tmp_path / "whole.rnx").read_bytes()
    # Blocks of text inside the writer as well.
    long = log(2500)
    write_observations(long, tmp_path / "long.rnx")
    lines = (tmp_path / "long.rnx").read_text().splitlines()
    assert sum(line.startswith(">") for line in lines) == 2500


def test_a_piece_may_have_fewer_channels(tmp_path: Path) -> None:
    first, second = log(10), log(10, seed=4)
    second = Observations(
        time=second.time + np.timedelta64(5, "s"),
        satellite=second.satellite[3:5],
        signal=second.signal[3:5],
        **{n: getattr(second, n)[:, 3:5] for n in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")},
        break_before=second.break_before,
    )
    write_observations([first, second], tmp_path / "log.rnx")
    found, whole = read_observations(tmp_path / "log.rnx"), concatenate([first, second])
    assert (found.time == whole.time).all()
    a, b = columns_of(found), columns_of(whole)
    np.testing.assert_allclose(
        found.code_m[:, [a[key] for key in CHANNELS]], whole.code_m[:, [b[key] for key in CHANNELS]], atol=5.001e-4
    )


def test_packed_files_hold_the_plain_text_and_no_date(tmp_path: Path) -> None:
    written = log()
    for name in ("a.rnx", "a.rnx.gz", "a.crx", "a.crx.gz"):
        write_observations(written, tmp_path / name)
    plain = (tmp_path / "a.rnx").read_bytes()
    assert gzip.decompress((tmp_path / "a.rnx.gz").read_bytes()) == plain
    crx = (tmp_path / "a.crx").read_bytes()
    # The Hatanaka form has no trailing blanks in the header.
    assert [x.rstrip() for x in crx2rnx(crx).splitlines()] == [x.rstrip() for x in plain.splitlines()]
    assert gzip.decompress((tmp_path / "a.crx.gz").read_bytes()) == crx
    assert crx.split(b"\n")[1][40:60] == b" " * 20
    head = (tmp_path / "a.crx.gz").read_bytes()[:10]
    assert head[3] == 0, "no name"
    assert head[4:8] == bytes(4), "no time"
    assert all(len(line) == 80 for line in plain.split(b"END OF HEADER")[0].split(b"\n")[:-1])
    assert not any(line.endswith(b" ") for line in plain.split(b"END OF HEADER")[1].split(b"\n")[1:])


def test_the_name_tells_the_packing() -> None:
    names = {"front.crx.gz": "crx.gz", "a.24d": "crx", "a.24d.gz": "crx.gz", "b.rnx": "plain", "b.24o.gz": "gz"}
    assert {name: detect_packing(name) for name in names} == names


def test_columns_asked_for(tmp_path: Path) -> None:
    written = log()[:3]
    letters = "GREJC"
    asked = {s: [k + g for k in "CS" for g in dict.fromkeys(g for n, g in CHANNELS if n[0] == s)] for s in letters}
    write_observations(
        written, tmp_path / "a.rnx", observables=asked, created=np.datetime64("2024-03-06T01:02:03", "ns")
    )
    found = read_observations(tmp_path / "a.rnx")
    assert np.isfinite(found.code_m).any()
    assert np.isnan(found.phase_cycles).all()
    assert "20240306 010203 UTC" in (tmp_path / "a.rnx").read_text()


def altered(**changes: object) -> Observations:
    table = log()[:8]
    names = ("time", "satellite", "signal", "code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
    values = {name: np.array(getattr(table, name)) for name in (*names, "break_before")}
    for name, value in changes.items():
        values[name].flat[0] = value
    return Observations(**values)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (altered(code_m=1e10), "F14.3"),
        (altered(phase_cycles=-1e9), "F14.3"),
        (altered(time=START + np.timedelta64(1, "ns")), "100 ns"),
        (log()[:0], "no epoch"),
    ],
)
def test_what_rinex_cannot_hold_is_refused(tmp_path: Path, table: Observations, message: str) -> None:
    (tmp_path / "old.rnx").write_text("old")
    with pytest.raises(ValueError, match=message):
        write_observations(table, tmp_path / "old.rnx")
    assert [p.name for p in tmp_path.iterdir()] == ["old.rnx"]
    assert (tmp_path / "old.rnx").read_text() == "old"


def test_a_channel_without_column_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="G01 2W has no observation type"):
        write_observations(log(), tmp_path / "a.rnx", observables={s: ["C1C"] for s in "GREJC"})
    with pytest.raises(ValueError, match="X1C"):
        write_observations(log(), tmp_path / "a.rnx", observables={"G": ["X1C"]})
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_observations(log(), tmp_path / "none" / "a.rnx")
    (tmp_path / "is_folder").mkdir()
    with pytest.raises(OutputError):
        write_observations(log(), tmp_path / "is_folder")


# ---------------------------------------------------------------- navigation


def navigation(second: Literal["L2", "L5"] = "L2") -> Navigation:
    """Five constellations, three issues each, with transmission in the week before toe; B-CNAV1 with L5."""
    receiver = ReceiverSettings(signals_per_satellite=2, second=second)
    start, sky = np.datetime64("2024-03-03T00:10:00", "ns"), SkySettings(systems="GJEC")
    scenario = Scenario(start=start, sky=sky, receiver=receiver)
    made = simulate_navigation(scenario)
    rng = np.random.default_rng(1)
    toe = np.datetime64("2024-03-03T00:15:18", "ns") + np.arange(3) * np.timedelta64(1800, "s")
    sent = toe - np.timedelta64(600, "s")
    sent[1] = np.datetime64("NaT", "ns")
    place, course = np.linalg.qr(rng.normal(0.0, 1.0, (3, 3, 2)))[0].transpose(2, 0, 1)  # circular orbits of GLONASS
    glonass = GlonassRecords(
        satellite=np.array(["R01", "R02", "R24"]),
        toe=toe,
        transmitted=sent,
        clock_bias_s=rng.normal(0, 1e-4, 3),
        relative_frequency=rng.normal(0, 1e-12, 3),
        position_ecef_m=25.508e6 * place,
        velocity_ecef_mps=3953.0 * course - 7.2921151467e-5 * np.cross([0.0, 0.0, 1.0], 25.508e6 * place),
        acceleration_ecef_mps2=rng.normal(0, 1e-6, (3, 3)),
        health=np.array([0, 1, 0]),
        frequency_channel=np.array([1, -4, 6]),
        age_days=np.array([0.0, 1.0, 0.0]),
    )
    codes = np.where(np.isin(made.kepler.satellite.astype("<U1"), ["G", "J"]), 2, made.kepler.data_source)
    kepler = replace(made.kepler, data_source=codes)
    return Navigation(kepler=kepler, glonass=glonass, klobuchar=made.klobuchar, leap_seconds=made.leap_seconds)


@pytest.mark.requirement("A7")
@pytest.mark.parametrize(
    ("name", "second", "version"), [("nav.rnx", "L2", "3.04"), ("nav.rnx.gz", "L2", "3.04"), ("nav.rnx", "L5", "4.02")]
)
def test_navigation_reads_back(tmp_path: Path, name: str, second: Literal["L2", "L5"], version: RinexVersion) -> None:
    written = navigation(second)
    assert ("CNV1" in written.kepler.message) == (second == "L5")
    write_navigation(written, tmp_path / name, version=version)
    found = read_navigation(tmp_path / name)
    assert found.leap_seconds == 18
    np.testing.assert_array_equal(found.klobuchar["G"], written.klobuchar["G"])
    for table in ("kepler", "glonass"):
        a, b = getattr(written, table), getattr(found, table)
        assert len(a) == len(b)
        first, second = (np.lexsort((t.toe, t.satellite)) for t in (a, b))
        for field in type(a).__dataclass_fields__:
            x, y = getattr(a, field)[first], getattr(b, field)[second]
            if x.dtype.kind == "f":
                np.testing.assert_allclose(y, x, rtol=2e-12, atol=0, err_msg=field)
            elif x.dtype.kind == "M":
                assert (np.isnat(x) == np.isnat(y)).all(), field
                assert (x[~np.isnat(x)] == y[~np.isnat(x)]).all(), field
            else:
                assert (x == y).all(), field


def test_what_has_no_navigation_form_is_refused(tmp_path: Path) -> None:
    made = navigation()
    with pytest.raises(ValueError, match="Hatanaka"):
        write_navigation(made, tmp_path / "nav.rnx", packing="crx")
    fields = {name: getattr(made.kepler, name)[:1] for name in KeplerRecords.__dataclass_fields__}
    odd = KeplerRecords(**(fields | {"satellite": np.array(["I01"])}))
    with pytest.raises(ValueError, match="'I'"):
        write_navigation(Navigation(kepler=odd, glonass=made.glonass), tmp_path / "nav.rnx")
    with pytest.raises(ValueError, match="records of CNV1 cannot be written; leave them out"):
        write_navigation(navigation("L5"), tmp_path / "nav.rnx")
    assert not list(tmp_path.iterdir())
