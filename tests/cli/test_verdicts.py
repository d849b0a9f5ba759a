"""What a script reads of a command: the verdict in one line of JSON, and exit code 7 where nothing can be used."""

from __future__ import annotations

import json
import shutil

import pytest
from typer.testing import CliRunner

from bad_inputs import Desk
from railfix.cli import app

pytestmark = pytest.mark.requirement("G5")

RUNNER = CliRunner(env={"COLUMNS": "300"})
_LOG = "--front {desk}/front.obs --nav {desk}/brdc.nav"
#: No satellite is above this elevation.
_NONE = "--set elevation.mask_deg=89"
#: Commands with ``--json``, and names in the object that they print; that of `campaign` is in its own test.
VERDICTS = {
    f"run {_LOG} --track {{desk}}/line.csv --out {{out}} --set filter=off": ("antennas", "causes", "notes", "files"),
    "locate --log {desk}/front.obs --nav {desk}/brdc.nav --out {out}.pos": ("epochs", "positions", "sigma_m", "files"),
    "evaluate {desk}/results --reference {desk}/truth.csv": ("antennas", "notes", "files"),
    "doctor {desk}/front.obs {desk}/brdc.nav {desk}/line.csv": ("files", "problems", "command"),
}
#: Commands whose inputs can be read and hold nothing that they can use; `none.csv` has times without positions.
NOTHING = {
    "run": f"run {_LOG} --track {{desk}}/line.csv --out {{out}} {_NONE}",
    "run, line from the log": f"run {_LOG} --track {{desk}}/two.geojson --out {{out}} {_NONE}",
    "locate": f"locate --log {{desk}}/front.obs --nav {{desk}}/brdc.nav --out {{out}}.pos {_NONE}",
    "which-track": f"which-track {_LOG} --map {{desk}}/line.geojson {_NONE}",
    "ablate": f"ablate {_LOG} --track {{desk}}/line.csv --truth {{desk}}/truth.csv --out {{out}} "
    "--set min_satellites=99",
    "reference": "reference --rtk {desk}/none.csv --track {desk}/line.csv --out {out}",
    "reference, off the line": "reference --rtk {desk}/rtk.csv --track {desk}/line.csv --out {out} --lateral 1e-6",
    "evaluate": "evaluate {desk}/results --reference {desk}/none.csv",
    "error-model": "error-model {desk}/results --reference {desk}/none.csv --out {out}",
    "map match": "map match {desk}/line.geojson --log {desk}/none.csv --out {out}.csv",
    "map route": "map route {desk}/line.geojson --positions {desk}/none.csv --out {out}.csv",
    "map from-positions": "map from-positions {desk}/none.csv --out {out}.csv",
    "map from-positions, no fix": "map from-positions {desk}/single.pos --out {out}.csv",
}  # fmt: skip


@pytest.fixture(scope="module")
def desk(good: Desk) -> Desk:
    rows = "".join(f"2024-03-05T03:10:{k:02d},,,\n" for k in range(20))
    (good.folder / "none.csv").write_text(f"time_gpst,latitude_deg,longitude_deg,height_m\n{rows}")
    (good.folder / "single.pos").write_text((good.folder / "rtk.pos").read_text().replace(" 1 9\n", " 5 9\n"))
    track = json.loads((good.folder / "line.geojson").read_text())
    (good.folder / "two.geojson").write_text(json.dumps(track | {"features": 2 * track["features"]}))
    return good


@pytest.mark.parametrize("command", VERDICTS, ids=lambda text: text.split()[0])
def test_the_verdict_is_one_line_of_json(desk: Desk, command: str) -> None:
    result = RUNNER.invoke(app, [*desk.words(command), "--json"])
    shutil.rmtree(desk.folder / "out", ignore_errors=True)
    (desk.folder / "out.pos").unlink(missing_ok=True)
    assert result.exit_code == 0, result.output
    assert result.stdout.count("\n") == 1
    assert set(VERDICTS[command]) <= set(json.loads(result.stdout))


@pytest.mark.parametrize("name", NOTHING)
def test_where_nothing_can_be_used_the_exit_code_is_7(desk: Desk, name: str) -> None:
    result = RUNNER.invoke(app, desk.words(NOTHING[name]))
    shutil.rmtree(desk.folder / "out", ignore_errors=True)
    assert result.exit_code == 7, result.output
    assert result.stderr.startswith("railfix: error: ")
    assert result.stderr.count("\n") == 1
