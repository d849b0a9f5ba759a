"""The package as a notebook meets it: lazy names, short reprs, the xarray layout of georinex."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import railfix
import railfix.core
import railfix.ground
import railfix.motion
from railfix import Config, EpochProcessor, read_navigation, read_observations
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.gnss.observations import Observations
from railfix.simulate.demonstration import demo_files

georinex = pytest.importorskip("georinex")
#: georinex merges datasets by a default of xarray that will change.
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning")


@pytest.mark.parametrize("package", [railfix, railfix.core, railfix.motion, railfix.ground])
def test_every_name_of_the_package_can_be_imported(package: object) -> None:
    names = package.__all__  # type: ignore[attr-defined]
    assert len(names) > 15
    assert all(getattr(package, name) is not None for name in names)


@pytest.mark.requirement("A7")
def test_the_help_of_a_run_loads_no_numerics() -> None:
    scipy = [f"scipy.{part}" for part in ("special", "spatial", "linalg", "integrate", "ndimage", "optimize", "stats")]
    heavy = [*scipy, "numba", "matplotlib", "networkx", "pandas", "xarray", "georinex", "filterpy"]
    program = f"import sys, railfix.cli.run; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_import_loads_no_array_library() -> None:
    program = "import sys, railfix; print('numpy' in sys.modules, 'EpochProcessor' in dir(railfix))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]


@pytest.fixture(scope="module")
def demo() -> dict[str, object]:
    files = demo_files()
    track = railfix.read_track(files["track"])
    vehicle = railfix.read_vehicle(files["vehicle"])
    front = railfix.read_observations(files["front"])[:20]
    navigation = railfix.read_navigation(files["nav"])
    trajectory = railfix.antenna_trajectory(track, vehicle, "front")
    processor = railfix.EpochProcessor(railfix.Config(), {"front": trajectory}, navigation=navigation)
    result, _ = processor.process({"front": front})
    return {
        "Track": track,
        "Trajectory": trajectory,
        "Observations": front,
        "Navigation": navigation,
        "KeplerRecords": navigation.kepler,
        "GlonassRecords": navigation.glonass,
        "Result": result,
        "AntennaResult": result.antennas["front"],
    }


NAMES = "Track Trajectory Observations Navigation KeplerRecords GlonassRecords Result AntennaResult".split()


@pytest.mark.parametrize("name", NAMES)
def test_objects_show_themselves_in_one_line_and_as_a_table(demo: dict[str, object], name: str) -> None:
    shown = repr(demo[name])
    assert shown.startswith(f"<{name}")
    assert "\n" not in shown
    assert len(shown) < 200
    html = demo[name]._repr_html_()  # type: ignore[attr-defined]
    assert html.startswith("<table>")
    assert html.count("<tr>") >= 2
    assert len(html) < 20_000


@pytest.mark.requirement("S3")
def test_settings_show_what_is_not_as_by_default_and_say_how_to_change_them() -> None:
    assert repr(Config()) == "Config()"
    assert repr(Config(min_satellites=4, elevation={"mask_deg": 10.0})) == (
        "Config(elevation=ElevationLimits(mask_deg=10.0), min_satellites=4)"
    )
    with pytest.raises(SettingsError, match=r"^Config cannot be changed; .* settings\.replaced\(min_satellites=3\)$"):
        Config().min_satellites = 3


@pytest.mark.requirement("S3")
def test_arguments_of_another_type_are_named_with_what_was_expected(demo: dict[str, object]) -> None:
    track, trajectory, navigation = demo["Track"], demo["Trajectory"], demo["Navigation"]
    make: Any = EpochProcessor
    with pytest.raises(SettingsError, match=r"antenna front: expected Trajectory, got Track; antenna_trajectory"):
        make(Config(), {"front": track})
    with pytest.raises(SettingsError, match="navigation: expected Navigation, got str; read_navigation returns one"):
        make(Config(), {"front": trajectory}, navigation="nav.rnx")
    with pytest.raises(SettingsError, match="config: expected Config, got dict"):
        make({}, {"front": trajectory})
    processor: Any = EpochProcessor(Config(), {"front": trajectory}, navigation=navigation)  # type: ignore[arg-type,dict-item]
    assert repr(processor).startswith("<EpochProcessor: front, filter track; screens elevation, ")
    with pytest.raises(SettingsError, match="observations of antenna front: expected Observations, got str"):
        processor.process({"front": "front.rnx"})
    for read in (read_observations, read_navigation):
        with pytest.raises(SettingsError, match="expected a path or several paths, got NoneType"):
            read(None)  # type: ignore[arg-type]


def same_observations(first: Observations, second: Observations) -> None:
    assert np.array_equal(first.satellite, second.satellite)
    assert np.array_equal(first.signal, second.signal)
    assert np.array_equal(first.time, second.time)
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock", "break_before"):
        assert np.array_equal(getattr(first, name), getattr(second, name), equal_nan=name.endswith(("_m", "s", "z")))
    assert first.header.glonass_channel == second.header.glonass_channel
    assert first.header.approximate_ecef_m == pytest.approx(second.header.approximate_ecef_m, nan_ok=True)
    assert first.header.receiver_clock_applied == second.header.receiver_clock_applied


def cut(source: Path, target: Path, lines: int) -> Path:
    """The file up to the last epoch that begins before a number of lines."""
    text = railfix.core.files.read_text_lines(source)
    end = max(k for k in range(lines) if not text[k].startswith(" ") and text[k][:1] == ">")
    target.write_text("\n".join(text[:end]) + "\n", encoding="latin-1")
    return target


def test_observations_survive_the_layout_of_georinex(demo: dict[str, object]) -> None:
    log = demo["Observations"]
    assert isinstance(log, Observations)
    same_observations(railfix.observations_from_xarray(railfix.observations_to_xarray(log)), log)


def test_georinex_loads_the_same_observations(tmp_path: Path) -> None:
    """The shipped log as georinex loads it, and as railfix reads it, are the same both ways."""
    path = tmp_path / "front.rnx"
    railfix.write_observations(railfix.read_observations(demo_files()["front"])[:12], path)
    log = railfix.read_observations(path)
    theirs = georinex.load(path, useindicators=True)
    same_observations(railfix.observations_from_xarray(theirs), log)
    ours = railfix.observations_to_xarray(log)
    assert ours.sv.values.tolist() == sorted(theirs.sv.values.tolist())
    for name in ours.data_vars:
        if name[0] in "CLDS" and not name.endswith("lli"):
            np.testing.assert_array_equal(ours[name].values, theirs[name].sel(sv=ours.sv).values, err_msg=name)


@pytest.mark.requirement("A7")
@pytest.mark.slow
def test_observations_are_read_through_georinex_beside_our_own_reader(tmp_path: Path) -> None:
    whole = railfix.read_observations(demo_files()["front"])
    paths = [tmp_path / "two.rnx", tmp_path / "one.rnx"]
    for path, part in zip(paths, (slice(8, 16), slice(0, 12)), strict=True):
        railfix.write_observations(whole[part], path)
    half = np.timedelta64(50, "ms")  # georinex cuts time tags to 1 us
    span = {"systems": "GE", "start": whole.time[2] - half, "end": whole.time[14] - half}
    ours = railfix.read_observations(paths[::-1], broken_lines="count", **span)
    theirs = railfix.read_observations(paths, reader="georinex", **span)
    assert len(theirs) == 12
    assert theirs.system.tolist() == ours.system.tolist()
    assert (abs(theirs.time - ours.time) <= np.timedelta64(1, "us")).all()
    same_observations(replace(theirs, time=ours.time), ours)
    with pytest.raises(MismatchError, match="no epoch lies in the requested time span"):
        railfix.read_observations(paths, reader="georinex", start="2030-01-01")
    (tmp_path / "log.ubx").write_bytes(b"\xb5\x62" + bytes(200))
    with pytest.raises(MismatchError, match=r"log.ubx is a receiver's log"):
        railfix.read_observations(tmp_path / "log.ubx", reader="georinex")
    (tmp_path / "text").write_text("no log")
    with pytest.raises(InputFileError, match=r"text: georinex cannot read it"):
        railfix.read_observations(tmp_path / "text", reader="georinex")


@pytest.mark.slow
def test_georinex_loads_the_same_recorded_observations(recordings: Path, tmp_path: Path) -> None:
    path = cut(recordings / "static/ESBC_2020177/ESBC00DNK_R_20201770000_01D_30S_MO.crx.gz", tmp_path / "a.rnx", 400)
    log = railfix.read_observations(path, broken_lines="count")
    theirs = georinex.load(path, useindicators=True)
    found = railfix.observations_from_xarray(theirs)[: len(log)]
    assert len(log) > 5
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz"):
        for k, key in enumerate(zip(log.satellite.tolist(), log.signal.tolist(), strict=True)):
            column = np.flatnonzero((found.satellite == key[0]) & (found.signal == key[1]))
            assert column.size == 1, key
            np.testing.assert_array_equal(getattr(found, name)[:, column[0]], getattr(log, name)[:, k])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.assign_attrs(time_system="IRN"), "time_system is 'IRN'"),
        (lambda d: d.isel(time=slice(None, None, -1)), "time must rise"),
        (lambda d: d[["break_before"]], "no observation types"),
    ],
)
def test_another_dataset_is_named(demo: dict[str, object], change: object, message: str) -> None:
    data = railfix.observations_to_xarray(demo["Observations"])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=message):
        railfix.observations_from_xarray(change(data))  # type: ignore[operator]


@pytest.mark.slow
def test_the_help_leads_on() -> None:
    run = subprocess.run(
        [sys.executable, "-c", "import railfix; help(railfix)"], capture_output=True, text=True, check=True
    )
    assert "read_observations" in run.stdout
    assert "docs/example.md" in run.stdout
