"""Bad inputs for every command: kinds of files, what is done to them, and the command that reads each.

`CASES` has every kind of file with every fault; ``tests/cli/test_bad_inputs.py`` runs them through the command line.
"""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

import polars as pl
import pytest

from railfix.core.files import read_bytes
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs, demo_truth

#: Epochs of the demonstration that the commands work on.
SECONDS: Final = 20


@dataclass(frozen=True, kw_only=True)
class Desk:
    """A folder with one good input of every kind."""

    folder: Path

    def words(self, text: str) -> list[str]:
        """Words of a command; names of files stand in braces."""
        return [word.format(desk=self.folder, out=self.folder / "out") for word in text.split()]


def desk_in(folder: Path) -> Desk:
    """Make the good inputs."""
    inputs = demo_inputs()
    epochs = 0
    for name, path in {"front.obs": inputs.front[0], "rear.obs": inputs.rear[0]}.items():
        text = read_bytes(path).decode("ascii").splitlines(keepends=True)
        starts = [i for i, line in enumerate(text) if line.startswith(">")]
        epochs = min(len(starts) - 1, 10 * SECONDS)
        (folder / name).write_text("".join(text[: starts[epochs]]))
    (folder / "brdc.nav").write_bytes(read_bytes(inputs.nav[0]))
    shutil.copy(inputs.track[0], folder / "line.csv")
    assert inputs.vehicle is not None
    shutil.copy(inputs.vehicle, folder / "train.toml")
    (folder / "line.geojson").write_text(_geojson(folder / "line.csv"))
    truth = pl.read_csv(read_bytes(demo_truth()), infer_schema=False)
    times = truth["time_gpst"].unique().sort()
    truth.filter(pl.col("time_gpst") < times[10 * SECONDS]).write_csv(folder / "truth.csv")
    first = datetime.fromisoformat(times[0][:19])
    here = inputs.replaced(
        front=(folder / "front.obs",),
        rear=(folder / "rear.obs",),
        nav=(folder / "brdc.nav",),
        track=(folder / "line.csv",),
        vehicle=folder / "train.toml",
    )
    options = RunOptions(observations="write", end=first + timedelta(seconds=SECONDS))
    run_files(here, out=folder / "results", options=options)
    positions = pl.read_csv(folder / "truth.csv").filter(pl.col("antenna") == "front").head(10 * SECONDS)
    positions.select("time_gpst", "x_m", "y_m", "z_m").write_csv(folder / "rtk.csv")
    (folder / "rtk.pos").write_text(_pos(positions))
    distance = positions["chainage_m"].diff().fill_null(0.0).abs().cum_sum()
    pl.DataFrame({"time_gpst": positions["time_gpst"], "distance_m": distance}).write_csv(folder / "pulses.csv")
    rest = pl.DataFrame({"time_gpst": positions["time_gpst"], "acceleration_mps2": positions["acceleration_mps2"]})
    rest.write_csv(folder / "acceleration.csv")
    (folder / "sections.csv").write_text("from_m,to_m,environment\n0,500,open\n500,2000,city\n")
    (folder / "settings.toml").write_text('preset = "p1"\n[elevation]\nmask_deg = 12.0\n')
    (folder / "scenario.toml").write_text("duration_s = 1.0\n[receiver]\ncode_sigma_m = 0.5\n")
    (folder / "recipe.toml").write_text('base = "demo"\n[[runs]]\nname = "one"\nduration_s = 1.0\n')
    return Desk(folder=folder)


def _geojson(track: Path) -> str:
    lines = [line for line in track.read_text().splitlines() if not line.startswith("#")]
    rows = pl.read_csv("\n".join(lines).encode())
    points = rows.select("longitude_deg", "latitude_deg", "height_m").rows()
    geometry = {"type": "LineString", "coordinates": points}
    feature = {"type": "Feature", "properties": {"height_datum": "ellipsoidal"}, "geometry": geometry}
    return json.dumps({"type": "FeatureCollection", "features": [feature]})


def _pos(positions: pl.DataFrame) -> str:
    rows = ["%  GPST                  x-ecef(m)      y-ecef(m)      z-ecef(m)   Q  ns"]
    for time, x, y, z in positions.select("time_gpst", "x_m", "y_m", "z_m").iter_rows():
        rows.append(f"{time[:10].replace('-', '/')} {time[11:23]} {x:.4f} {y:.4f} {z:.4f} 1 9")
    return "\n".join(rows) + "\n"


#: Each kind of file, and a command that reads it.
_LOG: Final = "--front {desk}/front.obs --nav {desk}/brdc.nav"
_BOTH: Final = _LOG + " --rear {desk}/rear.obs --track {desk}/line.csv --vehicle {desk}/train.toml --out {out}"
_REFERENCE: Final = (
    "reference --rtk {desk}/rtk.csv --track {desk}/line.csv --vehicle {desk}/train.toml --out {out} --spacing 9"
)
COMMANDS: Final = {
    "front.obs": "run " + _BOTH,
    "brdc.nav": "cn0-curve {desk}/front.obs --nav {desk}/brdc.nav --out {out}",
    "line.csv": "map check {desk}/line.csv --out {out}",
    "line.geojson": "map check {desk}/line.geojson --out {out}",
    "train.toml": "run " + _BOTH,
    "settings.toml": "run " + _BOTH + " --config {desk}/settings.toml",
    "truth.csv": "ablate " + _BOTH + " --truth {desk}/truth.csv",
    "rtk.csv": "map from-positions {desk}/rtk.csv --out {out}.csv",
    "rtk.pos": "map from-positions {desk}/rtk.pos --out {out}.csv",
    "pulses.csv": _REFERENCE + " --pulses {desk}/pulses.csv",
    "acceleration.csv": _REFERENCE + " --acceleration {desk}/acceleration.csv",
    "sections.csv": "evaluate {desk}/results --reference {desk}/truth.csv --sections {desk}/sections.csv --out {out}",
    "results/run.json": "report {desk}/results --out {out}.html",
    "results/positions.parquet": "evaluate {desk}/results --reference {desk}/truth.csv --out {out}",
    "results/observations.parquet": "plot-screens {desk}/results --out {out}",
    "scenario.toml": "simulate {desk}/scenario.toml --out {out}",
    "recipe.toml": "simulate {desk}/recipe.toml --out {out} --only one",
}

Fault = Callable[[Path], None]


def _text(change: Callable[[str], str]) -> Fault:
    def fault(path: Path) -> None:
        text = path.read_bytes().decode("latin-1")
        path.unlink()
        path.write_bytes(change(text).encode("latin-1"))

    return fault


def _bytes(change: Callable[[bytes], bytes]) -> Fault:
    def fault(path: Path) -> None:
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(change(content))

    return fault


def _missing(path: Path) -> None:
    path.unlink()


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _dangling(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def _loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def _digits(text: str) -> str:
    """Every number of the second half becomes one that no sensor measures."""
    half = len(text) // 2
    return text[:half] + "".join("9" if c.isdigit() else c for c in text[half:])


FAULTS: Final[dict[str, Fault]] = {
    "missing": _missing,
    "folder": _folder,
    "dangling_link": _dangling,
    "link_to_itself": _loop,
    "empty": _bytes(lambda _: b""),
    "blank_lines": _bytes(lambda _: b"\n \n\n"),
    "zeros": _bytes(lambda content: b"\0" * len(content)),
    "noise": _bytes(lambda _: bytes(range(256)) * 40),
    "latin_1": _bytes(lambda content: b"\xe9\xff" + content),
    "byte_order_mark": _bytes(lambda content: b"\xef\xbb\xbf" + content),
    "utf_16": _bytes(lambda content: content.decode("latin-1").encode("utf-16")),
    "cut_in_half": _bytes(lambda content: content[: len(content) // 2 + 3]),
    "one_byte": _bytes(lambda content: content[:1]),
    "gzip_cut": _bytes(lambda content: gzip.compress(content)[:-20]),
    "zip_archive": _bytes(lambda _: b"PK\x03\x04" + b"\0" * 100),
    "deep_nesting": _bytes(lambda _: b"[" * 100_000),
    "deep_toml": _bytes(lambda _: b"a = " + b"[" * 20_000),
    "wide_cell": _text(lambda text: text + "x" * 200_000 + "\n"),
    "quoted_cell": _text(lambda text: text + '"' + "x" * 200_000),
    "huge_numbers": _text(_digits),
    "letters": _text(lambda text: text.replace("1", "l")),
    "minus": _text(lambda text: text.replace("3", "-3")),
    "not_numbers": _text(lambda text: text.replace("5", "nan")),
    "exponents": _text(lambda text: text.replace(".", "e")),
    "carriage_returns": _text(lambda text: text.replace("\n", "\r")),
    "other_file": _bytes(lambda _: b"time,a,b\n1,2,3\n"),
}

_RUN: Final = f"run {_LOG} --track {{desk}}/line.csv --out {{out}}"
#: Files that are written, a command with a mistake in it, its exit code, and words of its sentence.
MISTAKES: Final[dict[str, tuple[dict[str, str], str, int, str]]] = {
    "semicolons": (
        {"s.csv": "latitude_deg;longitude_deg;height_m\n47,1,2;8,5;400\n47,1;8,5;400\n"}, "map check {desk}/s.csv", 3,
        "s.csv, line 2: column latitude_deg: '47,1,2' is not a number",
    ),
    "height_sigma": (
        {}, "run --front {desk}/front.obs --nav {desk}/brdc.nav --track {desk}/line.csv --height-sigma 1e9 "
        "--out {desk}/o", 4, "--height-sigma: Input should be less than or equal to 1000",
    ),
    "heights_in_millimetres": (
        {"mm.csv": "latitude_deg,longitude_deg,height_m\n" + "".join(f"35.0{k},135.45,162000\n" for k in range(9))},
        "run --front {desk}/front.obs --nav {desk}/brdc.nav --track {desk}/mm.csv --out {desk}/o", 5,
        "expected metres between -1,000 and 9,000: are they in millimetres?",
    ),
    "span_after_the_log": (
        {}, "run --front {desk}/front.obs --nav {desk}/brdc.nav --track {desk}/line.csv --start 2030-01-01 "
        "--out {desk}/o", 5, "the log is of 2024-03-05T03:10:00 to 2024-03-05T03:10",
    ),
    "span_before_the_log": (
        {}, "run --front {desk}/front.obs --nav {desk}/brdc.nav --track {desk}/line.csv --end 2020-01-01 "
        "--out {desk}/o", 5, "the log begins at 2024-03-05T03:10:00 (GPS time)",
    ),
    "header_misspelt": (
        {"s.csv": "# sigma_plan: 3\nlatitude_deg,longitude_deg,height_m\n47,8,400\n47.1,8,400\n"},
        "map check {desk}/s.csv", 3, "the line '# sigma_plan: 3': is '# sigma_plan_m' meant?",
    ),
    "base_off_the_earth": (
        {},
        "which-track --front {desk}/front.obs --base {desk}/rear.obs --base-place 95,8,400 --nav {desk}/brdc.nav "
        "--map {desk}/line.geojson", 4, "expected a latitude to 90",
    ),
    "rover_as_base": (
        {},
        "which-track --front {desk}/front.obs --base {desk}/front.obs --base-place 35,139,4 --nav {desk}/brdc.nav "
        "--map {desk}/line.geojson", 4, "is the log of the train; give that of the base station",
    ),
    "alarm_limit_of_the_universe": ({}, _RUN + " --set alarm_limit_m=1e12", 4, "setting alarm_limit_m"),
    "pulses_of_letters": (
        {"s.csv": "time_gpst,pulse\n2024-03-05T03:10:00,abc\n2024-03-05T03:10:01,5\n"},
        _RUN + " --tachometer {desk}/s.csv", 3, "s.csv: row 2: pulse is 'abc', a number was expected; correct the row",
    ),
    "pulse_missing": (
        {"s.csv": "time_gpst,pulse,direction\n2024-03-05T03:10:00,1,1\n2024-03-05T03:10:01,,1\n"},
        _RUN + " --tachometer {desk}/s.csv", 3, "s.csv: row 3: pulse is None, a number was expected",
    ),
    "speed_of_letters": (
        {"s.csv": "time_gpst,speed_mps\n2024-03-05T03:10:00,fast\n"},
        _RUN + " --radar {desk}/s.csv", 3, "s.csv: row 2: speed_mps is 'fast', a number was expected",
    ),
    "time_missing": (
        {"s.csv": "time_gpst,speed_mps\n2024-03-05T03:10:00,1\n,1\n"},
        _RUN + " --radar {desk}/s.csv", 3, "s.csv: row 3: time_gpst is empty; remove the row",
    ),
    "sensor_without_rows": (
        {"s.csv": "time_gpst,pulse\n"},
        _RUN + " --tachometer {desk}/s.csv", 3, "s.csv: has no rows; expected those of the tachometer",
    ),
    "sensor_of_another_day": (
        {"s.csv": "time_gpst,pulse\n2020-01-01T00:00:00,1\n2020-01-01T00:00:01,2\n"},
        _RUN + " --tachometer {desk}/s.csv", 5, "have no time in common; give those of that day",
    ),
    "units_without_ranges": (
        {"s.csv": "unit,x_m,y_m,z_m\nA,1,2,3\n"},
        _RUN + " --ranging-units {desk}/s.csv", 4, "--ranging-units is given without --ranging",
    ),
    "switch_for_a_number": (
        {"s.toml": "[elevation]\nmask_deg = true\n"},
        _RUN + " --config {desk}/s.toml", 4, "setting elevation.mask_deg: a number was expected, got True",
    ),
    "word_for_a_list": (
        {"s.toml": 'systems = "GE"\n'},
        _RUN + " --config {desk}/s.toml", 4, "setting systems: Input should be a list, got 'GE'",
    ),
    "setting_out_of_its_group": (
        {"s.toml": "mask_deg = 5.0\n"},
        _RUN + " --config {desk}/s.toml", 4, "is 'elevation.mask_deg' meant?",
    ),
    "track_as_vehicle": ({}, _RUN + " --vehicle {desk}/line.csv", 3, "; a vehicle file was expected"),
    "log_as_navigation": (
        {}, "run --front {desk}/front.obs --nav {desk}/rear.obs --track {desk}/line.csv --out {out}", 3,
        "is a RINEX observation file (--front, --rear)",
    ),
    "reference_is_the_run_itself": (
        {}, "evaluate {desk}/results --reference {desk}/results/positions.csv", 5,
        "is a table of the run itself; give a reference that was measured otherwise",
    ),
    "reference_of_one_antenna": (
        {}, "evaluate {desk}/results --reference {desk}/rtk.pos", 3, "give a CSV file with one (railfix reference",
    ),
    "table_misspelt": (
        {}, "evaluate {desk}/results --reference {desk}/truth.csv --table trian", 4, "known are positions, train",
    ),
    "background_is_a_table": (
        {}, "report {desk}/results --out {out}.html --background {desk}/line.csv", 3, "is not valid JSON (",
    ),
    "bins_of_letters": (
        {}, "error-model {desk}/results --reference {desk}/truth.csv --elevations 10,five --out {out}", 4,
        "--elevations: Input should be a valid number",
    ),
    "sectors_none": (
        {}, "error-model {desk}/results --reference {desk}/truth.csv --sectors 0 --out {out}", 4,
        "--sectors: Input should be greater",
    ),
    "bin_of_no_width": (
        {}, "cn0-curve {desk}/front.obs --nav {desk}/brdc.nav --bin 0 --out {out}", 4,
        "--bin: setting bin_deg: Input should be greater than or equal to 0.1, got 0.0",
    ),
    "map_of_two_antennas": (
        {}, "map from-positions {desk}/truth.csv --out {out}.csv", 3,
        "has positions of front and rear; give those of one antenna",
    ),
    "positions_far_from_the_map": (
        {"s.csv": "latitude_deg,longitude_deg,height_m\n50.0,14.0,300\n50.1,14.0,300\n"},
        "map match {desk}/line.geojson --log {desk}/s.csv --out {out}.csv", 5, "is it the map of that line",
    ),
    "heights_would_be_overwritten": (
        {"s.csv": "chainage_m,height_m\n0,1\n"},
        "map route {desk}/line.geojson --heights {desk}/s.csv --out {desk}/s.csv --overwrite", 8,
        "is an input, which is never overwritten",
    ),
    "duration_negative": ({}, "simulate demo --seconds -5 --out {out}", 4, "--seconds: Input should be"),
    "scenario_setting_misspelt": (
        {}, "simulate demo --set receiver.code_sigma=1 --out {out}", 4,
        "with the settings of the command line: unknown setting receiver.code_sigma",
    ),
}  # fmt: skip

#: Every kind of file and every fault is in the third that is run at each change; the nightly run has them all.
CASES: Final = [
    pytest.param(kind, fault, marks=[] if (row + column) % 3 == 0 else [pytest.mark.slow])
    for row, kind in enumerate(COMMANDS)
    for column, fault in enumerate(FAULTS)
]
