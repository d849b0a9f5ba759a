"""Bad inputs for every command: kinds of files, what is done to them, and the command that reads each.

`CASES` has every kind of file with every fault; ``tests/cli/test_bad_inputs.py`` runs them through the command line.
"""

from __future__ import annotations

import gzip
import json
import re
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final

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

#: Mistakes by name: a command, its exit code, words of its sentence, and files that are written first.
MISTAKES: Final[dict[str, Any]] = tomllib.loads(
    (Path(__file__).parents[1] / "references" / "mistakes.toml").read_text(encoding="utf-8")
)


def edited(desk: Path, source: str, expression: str, replacement: str | Callable[[re.Match[str]], str]) -> str:
    """Return the text of a file of the desk with an expression replaced, line by line; it has to be found."""
    text, count = re.subn(expression, replacement, (desk / source).read_text(), flags=re.MULTILINE)
    assert count, f"{source} has nothing like {expression}"
    return text


#: Every kind of file and every fault is in the third that is run at each change; the nightly run has them all.
CASES: Final = [
    pytest.param(kind, fault, marks=[] if (row + column) % 3 == 0 else [pytest.mark.slow])
    for row, kind in enumerate(COMMANDS)
    for column, fault in enumerate(FAULTS)
]
