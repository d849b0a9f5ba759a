"""The benchmark: cases with hashes, railfix and other programs by one code, held-out cases kept apart."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from conftest import ROOT
from railfix.cli import app
from railfix.core.errors import InputFileError, MismatchError, RailfixError, SettingsError
from railfix.core.files import file_sha256, read_bytes
from railfix.evaluate import EvaluationOptions, evaluate_run, public_data
from railfix.evaluate.benchmark import RTKLIB_SINGLE, rows_at_epochs, run_benchmark
from railfix.evaluate.cases import read_case, read_cases, write_case
from railfix.pipeline.config import Config
from railfix.simulate.demonstration import demo_inputs, demo_truth

pytestmark = pytest.mark.requirement("G3")

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})
EPOCHS = 60
#: What the other program's positions are beside the ground truth [m], and how many of them there are.
OFF_M, THEIRS = 2.0, 50


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case of the first seconds of the demonstration: front antenna, and positions that are off by 2 m."""
    folder = tmp_path_factory.mktemp("cases")
    case, inputs = folder / "demo", demo_inputs()
    case.mkdir()
    text = read_bytes(inputs.front[0]).decode("ascii").splitlines(keepends=True)
    starts = [number for number, line in enumerate(text) if line.startswith(">")]
    (case / "front.obs").write_text("".join(text[: starts[EPOCHS]]))
    (case / "brdc.nav").write_bytes(read_bytes(inputs.nav[0]))
    shutil.copy(inputs.track[0], case / "line.csv")
    assert inputs.vehicle is not None
    shutil.copy(inputs.vehicle, case / "train.toml")
    truth = pl.read_csv(read_bytes(demo_truth()), infer_schema=False).filter(antenna="front")
    truth.head(EPOCHS).write_csv(case / "truth.csv")
    (case / "other.pos").write_text(_other_positions(truth))
    write_case(case, _content())
    return folder


def _other_positions(truth: pl.DataFrame) -> str:
    """Solution file of RTKLIB: the last of the first positions of the truth, moved toward where the train goes."""
    place = truth.select(pl.col("x_m", "y_m", "z_m").cast(pl.Float64)).to_numpy()
    travelled = np.linalg.norm(place - place[0], axis=1)
    ahead = int(np.argmax(travelled > 5.0))
    place = place[:EPOCHS] + OFF_M * (place[ahead] - place[0]) / travelled[ahead]
    rows = ["%  GPST  x-ecef(m)  y-ecef(m)  z-ecef(m)  Q  ns"]
    for time, (x, y, z) in list(zip(truth["time_gpst"].head(EPOCHS), place, strict=True))[-THEIRS:]:
        rows.append(f"{time[:10].replace('-', '/')} {time[11:23]} {x:.4f} {y:.4f} {z:.4f} 5 9")
    return "\n".join(rows) + "\n"


def _content(**changes: Any) -> dict[str, Any]:
    return {
        "licence": "MIT",
        "fetch": "comes with railfix",
        "held_out": False,
        "files": {
            "front": ["front.obs"],
            "nav": ["brdc.nav"],
            "track": ["line.csv"],
            "vehicle": "train.toml",
            "truth": "truth.csv",
        },
        "positions": {"theirs": {"file": "other.pos"}},
        "scenario": {"environment": "simulated", "rate_hz": 10.0},
        "evaluation": {"replicates": 1},
        **changes,
    }


def test_one_table_judges_railfix_and_other_programs_by_the_same_code(cases: Path, tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as executor:
        table, notes = run_benchmark(cases, Config(), out=tmp_path, executor=executor)
    rows = {row["position"]: row for row in table.iter_rows(named=True)}
    own = ["railfix filter", "railfix single epochs", "railfix 3-D single point"]
    assert [*rows][:3] == own
    assert table["error"].null_count() == len(table)
    theirs = rows["theirs"]
    assert theirs["observed"] == EPOCHS
    assert theirs["rate"] == pytest.approx(THEIRS / EPOCHS)
    assert theirs["p50_m"] == pytest.approx(OFF_M, abs=0.01)
    assert theirs["distance_max_m"] == pytest.approx(OFF_M, abs=0.01)
    assert theirs["time_to_first_s"] == pytest.approx((EPOCHS - THEIRS) / 10.0)
    assert theirs["over_level"] is None
    if RTKLIB_SINGLE in rows:
        single = rows["railfix 3-D single point"]
        assert abs(rows[RTKLIB_SINGLE]["p50_m"] - single["p50_m"]) < 1.0
    else:
        assert "not installed" in notes[0]

    # the figures are those of `railfix evaluate`
    run = tmp_path / "runs/case=demo"
    figures = evaluate_run(run, read_case(cases / "demo").truth, options=EvaluationOptions(replicates=1))
    for name in ("rate", "p50_m", "p95_m", "max_m", "distance_p95_m", "wrong_places"):
        assert rows["railfix single epochs"][name] == figures.figure(name), name
    filtered = rows["railfix filter"]
    counts = [filtered[name] for name in ("nominal", "misleading", "hazardously_misleading", "unavailable")]
    assert sum(counts) + filtered["unavailable_misleading"] == filtered["judged"]

    record = json.loads((tmp_path / "benchmark.json").read_text())
    assert record["cases"]["demo"]["scenario"]["environment"] == "simulated"
    assert record["cases"]["demo"]["sha256"]["front.obs"] == file_sha256(cases / "demo/front.obs")
    lines = (tmp_path / "benchmark.md").read_text().splitlines()
    assert len(lines) == 3 + len(table)
    assert {"Availability", "TTFF"} <= set(lines[2].split())
    assert len({line.count("|") for line in lines}) == 1


def test_a_position_belongs_to_the_nearest_epoch() -> None:
    time = np.datetime64("2024-03-05T10:00:00", "ns") + np.arange(4) * np.timedelta64(1, "s")
    milli = np.timedelta64(1, "ms")
    found = np.array([time[2] - 300 * milli, time[2] + 100 * milli, time[0] + 500 * milli, np.datetime64("NaT")])
    assert rows_at_epochs(time, found).tolist() == [-1, -1, 1, -1]
    # no nearer than 0.4 of the interval is none, and one epoch has no interval
    assert rows_at_epochs(time, time[:2] + 400 * milli).tolist() == [-1] * 4
    assert rows_at_epochs(time[:1], found[:1]).tolist() == [-1]


def _changed(cases: Path, folder: Path, change: Callable[[Path], object]) -> Path:
    shutil.copytree(cases, folder / "cases")
    change(folder / "cases/demo")
    return folder / "cases"


def _add_line(case: Path) -> None:
    with (case / "truth.csv").open("a") as file:
        file.write("\n")


def _rewritten(old: str, new: str) -> Callable[[Path], object]:
    return lambda case: (case / "case.toml").write_text((case / "case.toml").read_text().replace(old, new))


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (_add_line, InputFileError, r"truth.csv: has the SHA-256 \w{12}..., but case.toml states .*; fetch it again"),
        (lambda case: (case / "other.pos").unlink(), InputFileError, "other.pos: there is no such file; fetch it"),
        (lambda case: (case / "case.toml").unlink(), InputFileError, "no folder in it has a case.toml"),
        (_rewritten('"other.pos" =', '"another.pos" ='), SettingsError, "sha256 has no entry for other.pos; add its"),
        (_rewritten("held_out = false\n", ""), SettingsError, "case.toml: setting held_out is missing"),
        (_rewritten("licence =", "license ="), SettingsError, "unknown setting license.* did you mean 'licence'"),
        (_rewritten('truth = "truth.csv"\n', ""), SettingsError, "setting files.truth is missing; give the file"),
        (_rewritten('truth = "', 'cn0_curve = "c.toml"\ntruth = "'), SettingsError, "files.cn0_curve is a setting"),
        (lambda case: (case / "case.toml").write_text("= 1"), InputFileError, "case.toml: is not valid TOML"),
    ],
)
def test_a_wrong_case_is_refused_in_one_sentence(
    cases: Path, tmp_path: Path, change: Callable[[Path], object], error: type[RailfixError], words: str
) -> None:
    folder = _changed(cases, tmp_path, change)
    with ThreadPoolExecutor(1) as executor, pytest.raises(error, match=words):
        run_benchmark(folder, Config(), out=tmp_path / "out", executor=executor)
    assert not (tmp_path / "out").exists()


def test_the_command_ends_with_a_sentence(tmp_path: Path) -> None:
    result = RUNNER.invoke(app, ["benchmark", str(tmp_path / "none"), "--out", str(tmp_path / "out")])
    assert result.exit_code == InputFileError.exit_code, result.output
    assert result.stderr.startswith(f"railfix: error: {tmp_path / 'none'}: there is no such folder")


def test_a_failed_case_is_a_row(cases: Path, tmp_path: Path) -> None:
    def spoil(case: Path) -> None:
        (case / "front.obs").write_text("no log\n")
        write_case(case, _content())

    folder = _changed(cases, tmp_path, spoil)
    with ThreadPoolExecutor(1) as executor:
        table, _ = run_benchmark(folder, Config(), out=tmp_path / "out", executor=executor)
    assert table["case"].to_list() == ["demo"]
    assert "front.obs" in table["error"][0]
    assert "failed" in (tmp_path / "out/benchmark.md").read_text()


def test_settings_made_from_a_held_out_case_are_refused(cases: Path, tmp_path: Path) -> None:
    folder = _changed(cases, tmp_path, lambda case: write_case(case, _content(held_out=True)))
    curve = tmp_path / "curve.toml"
    curve.write_text(f'[[file]]\nname = "front.obs"\nsha256 = "{file_sha256(folder / "demo/front.obs")}"\n')
    with ThreadPoolExecutor(1) as executor, pytest.raises(MismatchError, match="made from the held-out case demo"):
        run_benchmark(folder, Config(cn0_curve=curve), out=tmp_path / "out", executor=executor)


def test_no_test_and_no_setting_reads_a_held_out_case() -> None:
    """The sources of held-out cases are named where the case is made, and nowhere else in code, tests or settings.

    Cases beside the checkout that are marked so are looked for by the names and hashes of their files as well.
    """
    words = {Path(name).stem for name in public_data.DRIVE_FILES.values()} | {public_data.DRIVE}
    beside = ROOT.parent / "shared" / "data"
    for path in beside.glob("**/case.toml"):
        if (case := read_case(path.parent)).content.held_out:
            words |= {*case.content.sha256.values(), path.parent.name}
    allowed = {ROOT / "src/railfix/evaluate/public_data.py", ROOT / "tests/studies/benchmark_cases.py", Path(__file__)}
    kinds = {".py", ".toml", ".json", ".csv", ".yaml", ".txt"}
    read = {
        (word, path.relative_to(ROOT).as_posix())
        for folder in ("src", "tests", "data")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in kinds and path not in allowed
        for word in words
        if word in path.read_text(encoding="utf-8", errors="replace")
    }
    assert read == set()


def test_a_folder_that_is_a_case_is_one(cases: Path) -> None:
    assert [case.name for case in read_cases(cases / "demo")] == ["demo"]
