"""The C/N0 curve: fit, file, command."""

from __future__ import annotations

import hashlib
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from conftest import ROOT
from railfix.cli import app
from railfix.core.errors import InputFileError, MismatchError, OutputError, SettingsError
from railfix.gnss.observations import ObservationHeader
from railfix.io import read_navigation, read_observations
from railfix.ranges.cn0_curve import KINDS, Cn0Curve, Cn0CurveSource, Cn0Mean, satellite_kind
from railfix.ranges.cn0_curve_file import read_cn0_curve, write_cn0_curve
from railfix.ranges.cn0_curve_fit import Cn0Samples, CurveFit, fit_cn0_curve
from railfix.ranges.cn0_curve_log import _notes, cn0_curve_from_log, satellite_elevation_deg
from railfix.screens import cn0_screen

pytestmark = pytest.mark.requirement("B1")

runner = CliRunner()

DEMO = ROOT / "data" / "demo"
SATELLITES, SIGNALS = np.array(["G01", "G02", "C30", "C02"]), np.array(["1C", "1C", "2I", "2I"])


def sky(
    epochs: int = 4000, *, noise_db: float = 0.8, outliers: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """C/N0 that rises as 35 + 15 sin(el), satellites of BeiDou's high orbits 4 dB below."""
    rng = np.random.default_rng(2)
    elevation = rng.uniform(0, 90, (epochs, 4))
    cn0 = 35 + 15 * np.sin(np.radians(elevation)) + noise_db * rng.standard_normal((epochs, 4))
    cn0[:, 3] -= 4.0
    cn0[rng.random(cn0.shape) < outliers] -= 20.0
    return cn0, elevation, SATELLITES, SIGNALS


def test_fit_finds_the_mean_by_kind_and_signal() -> None:
    curve = fit_cn0_curve([sky()])
    assert [(mean.kind, mean.signal) for mean in curve.means] == [("C", "2I"), ("C-HIGH", "2I"), ("G", "1C")]
    at = np.linspace(3, 87, 50)
    truth = 35 + 15 * np.sin(np.radians(at))
    for mean in curve.means:
        np.testing.assert_allclose(mean.at(at), truth - 4.0 * (mean.kind == "C-HIGH"), atol=0.25)
        np.testing.assert_allclose(mean.spread_db, 0.8, atol=0.5)
        assert mean.count.sum() == (8000 if mean.kind == "G" else 4000)
    table = curve.mean_dbhz(np.full((2, 4), 30.0), satellite=SATELLITES, signal=np.array(["1C", "5Q", "2I", "2I"]))
    np.testing.assert_allclose(table[0], [42.5, np.nan, 42.5, 38.5], atol=0.25)


def test_outliers_do_not_move_the_mean_and_nan_is_left_out() -> None:
    cn0, elevation, satellite, signal = sky(outliers=0.08)
    cn0[::7] = np.nan
    elevation[::11] = np.nan
    curve = fit_cn0_curve([(cn0, elevation, satellite, signal)])
    mean = curve.means[2]
    np.testing.assert_allclose(mean.mean_dbhz, 35 + 15 * np.sin(np.radians(mean.elevation_deg)), atol=0.2)


@pytest.mark.parametrize(("away_dbhz", "noted"), [(-14.0, True), (14.0, False)])
def test_a_sky_that_is_not_open_is_noted_and_one_that_is_too_good_is_not(away_dbhz: float, noted: bool) -> None:
    """A fiftieth of the samples lie 14 dB-Hz below the others, or above."""
    elevation = np.tile(np.linspace(5.0, 85.0, 400), 25)[:, None]
    cn0 = np.where(np.arange(len(elevation)) % 50 == 0, 45.0 + away_dbhz, 45.0)[:, None]
    samples = Cn0Samples()
    samples.add(cn0, elevation, np.array(["G01"]), np.array(["1C"]))
    notes = _notes(fit_cn0_curve(samples), samples, 86_400.0)
    assert [("of the open-sky samples lie" in note) for note in notes] == ([True] if noted else [])


def test_pieces_give_the_same_curve() -> None:
    cn0, elevation, satellite, signal = sky(900)
    whole = fit_cn0_curve([(cn0, elevation, satellite, signal)])
    parts = fit_cn0_curve((cn0[i : i + 7], elevation[i : i + 7], satellite, signal) for i in range(0, 900, 7))
    order = [2, 0, 3, 1]
    turned = fit_cn0_curve([(cn0[:, order], elevation[:, order], satellite[order], signal[order])])
    for a, b, c in zip(whole.means, parts.means, turned.means, strict=True):
        # the sum of a bin is rounded by the order of its samples
        np.testing.assert_allclose(a.mean_dbhz, b.mean_dbhz, rtol=1e-14)
        np.testing.assert_allclose(a.mean_dbhz, c.mean_dbhz, rtol=1e-14)
        np.testing.assert_array_equal(a.count, c.count)


@settings(max_examples=30)
@given(levels=st.lists(st.floats(20, 55), min_size=2, max_size=12), at=st.floats(-10, 90))
def test_the_curve_stays_between_neighbouring_means(levels: list[float], at: float) -> None:
    middles = 2.5 + 5.0 * np.arange(len(levels))
    mean = Cn0Mean(
        kind="G", signal="1C", elevation_deg=middles, mean_dbhz=np.array(levels), spread_db=np.ones(len(levels)),
        count=np.ones(len(levels), dtype=np.int64),
    )  # fmt: skip
    np.testing.assert_allclose(mean.at(middles), levels)
    value = float(mean.at(at))
    if at < 0:
        assert np.isnan(value)
        return
    i = int(np.clip(np.searchsorted(middles, at), 1, len(levels) - 1))
    low, high = sorted((levels[i - 1], levels[i]))
    assert low - 1e-9 <= value <= high + 1e-9


def test_too_few_samples_make_no_curve() -> None:
    cn0, elevation, satellite, signal = sky(4000)
    cn0[:, 2:] = np.nan
    cn0[elevation > 18] = np.nan
    assert len(fit_cn0_curve([(cn0, elevation, satellite, signal)]).means) == 1
    with pytest.raises(ValueError, match="bins"):
        fit_cn0_curve([(cn0, elevation, satellite, signal)], fit=CurveFit(least_bins=5))
    for wrong in ({"bin_deg": 0.0}, {"least_samples": 0}, {"clip_sigma": 0.0}):
        with pytest.raises(SettingsError, match=next(iter(wrong))):
            CurveFit(**wrong)


@pytest.mark.parametrize(
    ("satellite", "kind"),
    [("G05", "G"), ("C05", "C-HIGH"), ("C11", "C"), ("C13", "C-HIGH"), ("C40", "C-HIGH"), ("C61", "C-HIGH"),
     ("C35", "C"), ("J02", "J"), ("J07", "J-GEO"), ("R24", "R")],
)  # fmt: skip
def test_kinds(satellite: str, kind: str) -> None:
    assert satellite_kind(satellite) == kind
    assert kind in KINDS


# -- the file -----------------------------------------------------------------------------------------------

SOURCE = Cn0CurveSource(
    antenna='NOV703GGG.R2    NONE "x" \\', receiver="TRE_G3T\tDELTA",
    marker="駅", file=({"name": "day.crx.gz", "sha256": "ab" * 32},),
    start="2021-01-01T00:00:00", end="2021-01-01T23:59:30", epochs=2880, position_ecef_m=(1.5, -2.25, 3.0),
    railfix_version="0.1.0",
)  # fmt: skip


def written(folder: Path) -> Path:
    write_cn0_curve(fit_cn0_curve([sky()], source=SOURCE), folder / "curve.toml")
    return folder / "curve.toml"


def test_file_there_and_back(tmp_path: Path) -> None:
    path = written(tmp_path)
    curve, back = fit_cn0_curve([sky()], source=SOURCE), read_cn0_curve(path)
    assert back.source == curve.source
    for a, b in zip(curve.means, back.means, strict=True):
        assert (a.kind, a.signal) == (b.kind, b.signal)
        np.testing.assert_allclose(b.mean_dbhz, a.mean_dbhz, atol=0.0051)
        np.testing.assert_array_equal(b.count, a.count)
        np.testing.assert_array_equal(b.elevation_deg, a.elevation_deg)
    assert [p.name for p in tmp_path.iterdir()] == ["curve.toml"]
    assert tomllib.loads(path.read_text())["source"]["file"][0]["name"] == "day.crx.gz"
    write_cn0_curve(back, tmp_path / "again.toml")
    assert (tmp_path / "again.toml").read_text() == path.read_text()
    with pytest.raises(OutputError, match="cannot be written"):
        write_cn0_curve(back, tmp_path / "absent" / "curve.toml")


#: What is done to a good file, and what the error names.
BROKEN = {
    "other format": (("curve 1", "curve 2"), "format"),
    "no toml": (("[source]", "[source"), "TOML"),
    "unknown entry": (("[source]", "colour = 1\n[source]"), "colour"),
    "unknown source": (("marker", "maker"), "maker"),
    "text for epochs": (("epochs = 2880", 'epochs = "many"'), "epochs"),
    "no curve": (("[[curve]]", "[[curves]]"), "curves"),
    "other kind": (('kind = "G"', 'kind = "X"'), "kind: one of G, J"),
    "signal": (('signal = "1C"', 'signal = "L1"\nband = 1'), "unknown entry curve.2.band; known are count"),
    "missing column": (("spread_db", "spread"), "spread_db"),
    "not rising": (("2.5,\n    7.5", "7.5,\n    7.5"), "ascending"),
    "out of range": (("2.5,\n    7.5", "2.5,\n    97.5"), "97.5"),
    "nan": (("2.5,\n    7.5", "2.5,\n    nan"), "nan"),
    "shorter": (("2.5,\n    7.5,\n", "2.5,\n"), "same number"),
    "list of texts": (("[\n    2.5,", '[\n    "2.5",'), "2.5"),
    "twice": (('kind = "C-HIGH"', 'kind = "C"'), "two curves"),
    "position": (("position_ecef_m = [", 'position_ecef_m = ["a", '), "position"),
    "sha": (("sha256", "sha1"), "sha256"),
}


@pytest.mark.parametrize(("change", "named"), BROKEN.values(), ids=BROKEN.keys())
def test_broken_files_are_told_in_one_sentence(tmp_path: Path, change: tuple[str, str], named: str) -> None:
    path = written(tmp_path)
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(InputFileError, match=named) as error:
        read_cn0_curve(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value).strip()


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    (tmp_path / "empty").write_text("")
    for name in ("binary", "empty", "absent", "."):
        with pytest.raises(InputFileError):
            read_cn0_curve(tmp_path / name)


def test_another_antenna_or_receiver_is_said() -> None:
    curve = Cn0Curve(means=fit_cn0_curve([sky()]).means, source=Cn0CurveSource(antenna="A1   NONE", receiver="R1"))
    assert curve.notes_for(ObservationHeader(antenna="A1 NONE", receiver="R1")) == ()
    (note,) = curve.notes_for(ObservationHeader(antenna="A1 NONE", receiver="R2"))
    assert "'R1'" in note
    assert "'R2'" in note
    assert len(curve.notes_for(ObservationHeader())) == 2


# -- the command --------------------------------------------------------------------------------------------


def call(*arguments: object) -> tuple[int, str]:
    result = runner.invoke(app, ["cn0-curve", *(str(a) for a in arguments)], env={"COLUMNS": "160"})
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def test_command_on_the_demonstration(tmp_path: Path) -> None:
    """200 s are no day: each satellite stays in its bin, and the note says so."""
    out, plot = tmp_path / "curve.toml", tmp_path / "curve.png"
    code, printed = call(
        DEMO / "front.crx.gz", "--nav", DEMO / "nav.rnx.gz", "--out", out, "--plot", plot, "--bin", 10
    )  # fmt: skip
    assert code == 0, printed
    assert "0.1 h long" in printed
    curve = read_cn0_curve(out)
    assert curve.source.receiver == "SIMULATED"
    digests = {file.name: file.sha256 for file in curve.source.file}
    assert digests["nav.rnx.gz"] == hashlib.sha256((DEMO / "nav.rnx.gz").read_bytes()).hexdigest()
    assert curve.source.epochs == 2000
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["curve.png", "curve.toml"]


@pytest.mark.requirement("B1")
@pytest.mark.parametrize(("receiver", "said"), [("SIMULATED", False), ("ANOTHER 9", True)])
def test_a_run_says_that_the_curve_is_of_another_receiver(tmp_path: Path, receiver: str, said: bool) -> None:
    curve, out = tmp_path / "curve.toml", tmp_path / "run"
    code, printed = call(DEMO / "front.crx.gz", "--nav", DEMO / "nav.rnx.gz", "--out", curve, "--bin", 10)
    assert code == 0, printed
    curve.write_text(curve.read_text().replace("SIMULATED", receiver))
    words = ["run", "--front", DEMO / "front.crx.gz", "--nav", DEMO / "nav.rnx.gz", "--track", DEMO / "track.csv"]
    words += ["--cn0-curve", curve, "--end", "2024-03-05T03:10:03", "--filter", "off", "--out", out]
    result = runner.invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    assert ("front: C/N0 curve was made with receiver 'ANOTHER 9'" in result.output) is said


def test_command_says_what_is_wrong(tmp_path: Path) -> None:
    good = [DEMO / "front.crx.gz", "--nav", DEMO / "nav.rnx.gz", "--out", tmp_path / "c.toml"]
    for more, exit_code, named in (
        (["--position", "-35.6,-40.0,10"], 5, "below the horizon"),
        (["--position", "35.6"], 4, "LAT,LON,HEIGHT"),
        (["--position", "95,10,0"], 4, "degrees"),
        (["--bin", "0"], 4, "--bin"),
        (["--plot", tmp_path / "absent" / "x.png"], 8, "does not exist"),
    ):
        code, printed = call(*good, *more)
        assert code == exit_code, printed
        assert named in printed
        assert "Traceback" not in printed
    code, _ = call(DEMO / "nav.rnx.gz", "--nav", DEMO / "nav.rnx.gz", "--out", tmp_path / "c.toml")
    assert code == 3
    assert list(tmp_path.iterdir()) == []


def test_a_log_without_position_asks_for_it(recordings: Path, tmp_path: Path) -> None:
    folder = recordings / "kinematic" / "gsdc_pixel5_a"
    log, nav = folder / "Pixel5_a.21o", folder / "hour1180.21n"
    with pytest.raises(SettingsError, match="--position"):
        cn0_curve_from_log([log], [nav])
    with pytest.raises(MismatchError, match="no orbit"):
        cn0_curve_from_log([DEMO / "front.crx.gz"], [nav])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_day_of_open_sky(recordings: Path, tmp_path: Path) -> None:
    folder = recordings / "static" / "ESBC_2020177"
    log, nav = next(folder.glob("*MO.crx.gz")), next(folder.glob("*MN.rnx.gz"))
    made = cn0_curve_from_log([log], [nav])
    write_cn0_curve(made.curve, tmp_path / "esbc.toml")
    curve = read_cn0_curve(tmp_path / "esbc.toml")
    for system, signal in (("G", "1C"), ("E", "1C"), ("C", "2I")):
        mean = next(m for m in curve.means if (m.kind, m.signal) == (system, signal))
        assert mean.count.sum() > 10_000
        assert (np.diff(mean.at([5, 15, 25, 35, 45, 60])) > 0).all()
    assert any("GPS 1W" in note for note in made.notes), "two kinds of satellites on one signal"
    # the curve on its own day: almost nothing of an open sky is refused
    day = read_observations(log)
    first = np.flatnonzero(np.isin(day.signal, ("1C", "2I")) & np.isin(day.system, list("GJEC")))
    elevation = satellite_elevation_deg(day, read_navigation(nav), day.header.approximate_ecef_m)[:, first]
    result = cn0_screen(
        day.cn0_dbhz[:, first], elevation, satellite=day.satellite[first], signal=day.signal[first], curve=curve
    )
    high = elevation >= 20.0
    judged = np.isfinite(result.curve.metric) & high
    shares = [float((r.reject & high).sum() / judged.sum()) for r in (result.curve, result.floor)]
    print(f"ESBC above 20 deg: curve refuses {shares[0]:.5f}, floor 30 dB-Hz {shares[1]:.5f}")
    assert shares[0] < 1e-3
    assert shares[1] < 1e-2


# -- pictures -----------------------------------------------------------------------------------------------
