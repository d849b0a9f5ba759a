"""What each screen buys and costs: ``railfix ablate`` on the made-up run, against runs of each choice by itself."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import recordings_ablate
from railfix.cli import app
from railfix.evaluate.ablation import Ablation, ablate_files, choices
from railfix.gnss.observations import Observations
from railfix.io.logs import scan_observations
from railfix.io.reference_log import read_reference
from railfix.pipeline.config import parse_config
from railfix.run import RunInputs, RunOptions, run_files
from railfix.run import sources as run_sources
from railfix.simulate.demonstration import demo_inputs

pytestmark = [pytest.mark.requirement("B7"), pytest.mark.requirement("D2")]

RUNNER = CliRunner(env={"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"})
#: 70 s; the tunnel begins after 60 s.
PART = RunOptions.model_validate({"end": "2024-03-05T03:11:10"})
SCREENS = ("elevation", "doppler", "antenna_pair", "raim", "antenna_spacing")


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The truth of the made-up run, both antennas in one file."""
    path = tmp_path_factory.mktemp("truth") / "truth.csv"
    path.write_bytes(gzip.decompress((demo_inputs().track[0].parent / "truth.csv.gz").read_bytes()))
    return path


def inputs_with(truth: Path | None) -> RunInputs:
    demo = demo_inputs()
    return RunInputs(
        front=demo.front, rear=demo.rear, nav=demo.nav, track=demo.track, vehicle=demo.vehicle, truth=truth
    )


@pytest.fixture(scope="module")
def ablation(truth: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Ablation, list[int]]:
    """All choices on a part of the made-up run, and how often its logs were read."""
    readings: list[int] = []

    def counted(*arguments: Any, **options: Any) -> Iterator[Observations]:
        readings.append(1)
        return scan_observations(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_sources, "scan_observations", counted)
        out = tmp_path_factory.mktemp("ablation") / "out"
        made = ablate_files(inputs_with(truth), parse_config({"filter": "off"}), out=out, options=PART)
    return made, readings


def test_choices_are_all_none_each_alone_and_all_but_each() -> None:
    assert choices(("a", "b", "c")) == {
        "all": ("a", "b", "c"),
        "none": (),
        "only a": ("a",),
        "only b": ("b",),
        "only c": ("c",),
        "without a": ("b", "c"),
        "without b": ("a", "c"),
        "without c": ("a", "b"),
    }
    assert choices(("a",)) == {"all": ("a",), "none": ()}
    assert list(choices(("a", "b"))) == ["all", "none", "only a", "only b"]
    assert choices(()) == {"all": ()}


@pytest.mark.slow
def test_the_logs_are_read_once(ablation: tuple[Ablation, list[int]]) -> None:
    made, readings = ablation
    assert len(readings) == 2
    assert len(made.effects) == 2 * 12
    assert {effect.choice: effect.screens for effect in made.effects} == choices(SCREENS)
    assert any("screen cn0: left out" in note for note in made.notes)


@pytest.mark.parametrize("choice", ["all", "only raim", "without elevation"])
def test_a_choice_is_the_run_with_these_screens(
    ablation: tuple[Ablation, list[int]], truth: Path, tmp_path: Path, choice: str
) -> None:
    screens = choices(SCREENS)[choice]
    config = parse_config({"filter": "off", "screens": list(screens)})
    summary = run_files(demo_inputs(), config, out=tmp_path / "out", options=PART)
    rows = pl.read_parquet(summary.files["positions.parquet"])
    true = pl.read_csv(truth, schema_overrides={"time_gpst": pl.Datetime("ns")})
    joined = rows.join(true, on=["time_gpst", "antenna"], suffix="_true", maintain_order="left")
    for antenna in ("front", "rear"):
        (effect,) = (e for e in ablation[0].effects if (e.choice, e.antenna) == (choice, antenna))
        mine = joined.filter(pl.col("antenna") == antenna)
        tally = summary.tally.antennas[antenna]
        assert effect.epochs == tally.observed == mine.filter(pl.col("status") != "no_observation").height
        assert effect.rate == tally.positioned / effect.epochs
        assert effect.ok_rate == tally.status["ok"] / effect.epochs
        seen = mine.filter(pl.col("status") != "no_observation")
        assert effect.n_used == pytest.approx(seen["n_used"].mean(), rel=1e-12)
        assert effect.sigma_p50_m == pytest.approx(mine["along_sigma_m"].median(), rel=1e-9)
        # Along the antenna's own path instead of the line: millimetres in its canted curves.
        mine = mine.filter(pl.col("chainage_m").is_not_null())
        error = (mine["chainage_m"] - mine["chainage_m_true"]).to_numpy()
        good = (mine["status"].cast(pl.String) == "ok").to_numpy()
        for score, chosen in ((effect.coordinates, error), (effect.ok, error[good])):
            size = np.abs(chosen)
            assert score.positions == len(chosen)
            assert score.p50_m == pytest.approx(np.median(size), abs=1e-2)
            assert score.p95_m == pytest.approx(np.percentile(size, 95), abs=3e-2)
            if score is effect.ok:
                # A failed check can be a quarter of a kilometre off, where the two ways differ by more.
                assert score.mean_m == pytest.approx(chosen.mean(), abs=5e-3)
                assert score.std_m == pytest.approx(chosen.std(), abs=5e-3)
                assert score.max_m == pytest.approx(size.max(), abs=2e-2)
                assert score.wrong_place == 0.0


def test_files_hold_the_effects(ablation: tuple[Ablation, list[int]]) -> None:
    made = ablation[0]
    rows = pl.read_csv(made.files["ablation.csv"])
    assert rows.height == 24
    assert rows["choice"].to_list() == [effect.choice for effect in made.effects]
    front = rows.row(0, named=True)
    first = made.effects[0]
    assert (front["screens"], front["antenna"]) == (" ".join(SCREENS), "front")
    assert front["coordinates_p95_m"] == pytest.approx(first.coordinates.p95_m)
    assert front["conventional_p95_m"] > front["coordinates_p95_m"]
    record = json.loads(made.files["ablation.json"].read_text())
    assert {item["input"] for item in record["inputs"]} == {"front", "rear", "nav", "track", "vehicle", "truth"}
    assert record["settings_used"]["screens"] == list(SCREENS)
    assert [row["choice"] for row in record["choices"]] == rows["choice"].to_list()


def command(out: Path, *options: str) -> list[str]:
    demo = demo_inputs()
    files = ["--front", demo.front[0], "--nav", demo.nav[0], "--track", demo.track[0]]
    end = ["--end", "2024-03-05T03:10:02"]
    return ["ablate", *map(str, files), "--out", str(out), *end, *options]


def test_without_truth_rates_alone_are_told(tmp_path: Path) -> None:
    result = RUNNER.invoke(app, command(tmp_path / "out", "--without", "doppler", "--filter", "off"))
    assert result.exit_code == 0, result.output
    assert "front: 20 epochs" in result.output
    assert "p95" not in result.output
    rows = pl.read_csv(tmp_path / "out" / "ablation.csv")
    assert rows["choice"].to_list() == ["all", "none", "only elevation", "only raim"]
    assert rows["coordinates_p50_m"].null_count() == 4
    for name in ("antenna_pair", "antenna_spacing", "cn0"):
        assert f"screen {name}: left out" in " ".join(result.output.split())
    again = RUNNER.invoke(app, command(tmp_path / "out"))
    assert again.exit_code == 8


def test_without_any_screen_there_is_one_choice(tmp_path: Path) -> None:
    assert RUNNER.invoke(app, command(tmp_path / "out", "--screens", "none", "--filter", "off")).exit_code == 0


def test_the_table_keeps_its_lines_where_the_terminal_is_narrow(truth: Path, tmp_path: Path) -> None:
    result = RUNNER.invoke(app, command(tmp_path / "out", "--truth", str(truth), "--filter", "off"))
    assert result.exit_code == 0, result.output
    (line,) = [line for line in result.output.splitlines() if line.startswith("without raim")]
    assert len(line.split()) == 2 + 4 + 8


def test_the_filter_has_a_row_and_one_without_each_of_its_sources(truth: Path, tmp_path: Path) -> None:
    """The tunnel of the demonstration begins 60 s after the start; a made wheel carries through it."""
    true = pl.read_csv(truth, schema_overrides={"time_gpst": pl.Datetime("ns")}).filter(antenna="front")
    t = (true["time_gpst"] - true["time_gpst"][0]).dt.total_nanoseconds().to_numpy() / 1e9
    way = true["chainage_m"].to_numpy() - true["chainage_m"][0]
    pulses = np.arange(1.0, np.floor(way[t < 75.0].max() / 0.045))
    when = np.datetime64("2024-03-05T03:10:00", "ns") + (
        np.interp(0.045 * pulses, way[t < 75.0], t[t < 75.0]) * 1e9
    ).astype("timedelta64[ns]")
    wheel = tmp_path / "pulses.csv"
    pl.DataFrame({"time_gpst": when, "pulse": pulses.astype(np.int64), "direction": 1}).write_csv(wheel)
    config = parse_config(
        {
            "filter": "track",
            "screens": ["elevation"],
            "sensors": {"tachometer": {"wheel_diameter_m": 0.045 * 60 / np.pi, "pulses_per_turn": 60}},
        }
    )
    inputs = inputs_with(truth).replaced(rear=(), tachometer=wheel)
    options = RunOptions.model_validate({"start": "2024-03-05T03:10:50", "end": "2024-03-05T03:11:12"})
    made = ablate_files(inputs, config, out=tmp_path / "out", options=options)
    effects = {effect.choice: effect for effect in made.effects}
    assert list(effects) == ["all", "none", "filter", *(f"filter without {n}" for n in ("phase", "doppler", "wheel"))]
    assert effects["filter"].sources == ("code", "phase", "doppler", "wheel")
    assert effects["filter without wheel"].sources == ("code", "phase", "doppler")
    outage = {name: effect.outage for name, effect in effects.items()}
    assert (outage["all"].positions, outage["filter"].positions) == (0, 73)  # type: ignore[union-attr]
    assert outage["filter"].max_m < 2.0  # type: ignore[union-attr]
    rows = pl.read_csv(made.files["ablation.csv"])
    assert rows.filter(choice="filter")["outage_max_m"].item() == pytest.approx(outage["filter"].max_m)  # type: ignore[union-attr]
    run = run_files(inputs.replaced(truth=None), config, out=tmp_path / "run", options=options)
    train = pl.read_parquet(run.files["train.parquet"]).join(true, on="time_gpst", suffix="_true")
    train = train.filter(pl.col("sources").str.contains("code"))
    error = (train["chainage_m"] - train["chainage_m_true"]).abs().to_numpy()
    assert np.median(error) == pytest.approx(effects["filter"].coordinates.p50_m, abs=0.02)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--screens", "rain"], 4, "unknown screen 'rain'"),
        (["--truth", "nowhere.csv"], 3, "nowhere.csv"),
        (["--set", "min_satellites=3000"], 7, "there is no position"),
    ],
)
def test_errors_have_their_exit_codes(tmp_path: Path, options: list[str], code: int, words: str) -> None:
    result = RUNNER.invoke(app, command(tmp_path / "out", *options))
    assert result.exit_code == code
    assert words in result.output
    assert not (tmp_path / "out").exists()


def test_a_truth_of_another_day_does_not_belong_to_the_log(truth: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.csv"
    other.write_text(truth.read_text().replace("2024-03-05", "2024-03-06"))
    result = RUNNER.invoke(app, command(tmp_path / "out", "--truth", str(other)))
    assert result.exit_code == 5
    assert "no time in common" in result.output


def test_only_fixed_positions_are_truth(truth: Path, tmp_path: Path) -> None:
    table = pl.read_csv(truth).filter(pl.col("antenna") == "front").head(10)
    path = tmp_path / "rtk.csv"
    quality = pl.Series("quality", [1, 2, 1, 5, 1, 1, 2, 2, 1, 1])
    # in any order, each instant once
    pl.concat([table.with_columns(quality)] * 2).reverse().write_csv(path)
    found = read_reference(path, ["front"])["front"]
    assert len(found.time) == 6
    assert (np.diff(found.time) > np.timedelta64(0, "ns")).all()


@pytest.mark.slow
def test_the_document_shows_what_the_recordings_give(recordings: Path, tmp_path: Path) -> None:
    """Figures that docs/screens.md is taken from, to the last digit or two (`tests/studies/recordings_ablate.py`)."""
    document = recordings_ablate.DOCUMENT.read_text(encoding="utf-8")
    recordings_ablate.prepared(recordings, tmp_path)
    for recording in ("urbannav_f9p", "gsdc"):
        options = recordings_ablate.options_of(recordings, tmp_path, recording)
        made = recordings_ablate.ablation(options, tmp_path / f"{recording}_default", "default").splitlines()
        assert made[0] in document
        start = document.index("\n".join(made[:2]))
        shown = document[start:].splitlines()[: len(made)]
        for one, other in zip(made[7:], shown[7:], strict=True):
            if one.startswith("note"):
                assert one == other
                continue
            mine, told = one.split(), other.split()
            assert len(mine) == len(told)
            for a, b in zip(mine, told, strict=True):
                assert a == b or float(a) == pytest.approx(float(b), abs=0.06, rel=0.02)
