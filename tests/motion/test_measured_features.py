"""Features of a line as runs have measured them: by made series, and by the command on simulated runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.errors import InputFileError
from railfix.motion.features import Feature
from railfix.run.locate import find_features, read_measured

pytestmark = pytest.mark.requirement("E3")
RUNNER = CliRunner(env={"COLUMNS": "160", "TERM": "dumb", "NO_COLOR": "1"})


def measured(seed: int, *, noise: float = 1.0, gap: bool = False) -> pl.DataFrame:
    """A value every 2 m: a curve of 400 m with transitions from 300 to 360 and 600 to 660 m, a rise from 800 m on.

    The middles of the changes are at 330, 630 and 800 m.
    """
    random = np.random.default_rng(seed)
    at = np.arange(0.0, 1000.0, 2.0) + random.uniform(0.0, 2.0)
    curvature = np.interp(at, [300.0, 360.0, 600.0, 660.0], [0.0, 1.0 / 400.0, 1.0 / 400.0, 0.0])
    gradient = np.where(at > 800.0, 12.0, 0.0) + noise * random.standard_normal(len(at))
    table = pl.DataFrame(
        {
            "measured_chainage_m": at,
            "measured_gradient_permille": gradient,
            "measured_curvature_1pm": curvature + noise * 2e-5 * random.standard_normal(len(at)),
        }
    )
    return table.filter((pl.col("measured_chainage_m") - 500.0).abs() > 40.0) if gap else table


def test_changes_are_found_at_their_middles_and_repeat() -> None:
    """As in table 1 of P2: the same places by every run, within decimetres."""
    runs = [measured(seed, gap=seed == 2) for seed in range(4)]
    of_map = [
        Feature(arc_m=331.0, quantity="curvature", change=0.002),
        Feature(arc_m=802.0, quantity="gradient", change=-0.01),
    ]
    found = find_features(runs, of_map)
    assert [each.feature.quantity for each in found] == ["curvature", "curvature", "gradient"]
    places = [each.feature.arc_m for each in found]
    np.testing.assert_allclose(places, [330.0, 630.0, 800.0], atol=0.5)
    assert [np.sign(each.feature.change) for each in found] == [1.0, -1.0, 1.0]
    assert [len(each.places_m) for each in found] == [4, 4, 4]
    assert max(np.std(each.places_m) for each in found) < 0.5
    assert found[0].map_m == 331.0
    assert np.isnan([each.map_m for each in found[1:]]).all()  # none there, and one of the other direction


def test_noise_and_a_gap_make_no_feature() -> None:
    flat = measured(1).with_columns(measured_curvature_1pm=pl.lit(0.0), measured_gradient_permille=pl.lit(0.0))
    random = np.random.default_rng(5)
    noisy = flat.with_columns(pl.Series("measured_gradient_permille", 10.0 * random.standard_normal(len(flat))))
    assert find_features([flat]) == []
    assert find_features([noisy]) == []
    apart = pl.concat([flat.head(100), flat.tail(100).with_columns(pl.col("measured_gradient_permille") + 20.0)])
    assert find_features([apart]) == []  # nothing is known of what lies between


def test_slips_and_what_comes_just_before_them_are_left_out(tmp_path: Path) -> None:
    at = np.arange(0.0, 100.0, 2.0)
    time = np.datetime64("2024-03-05T03:10:00", "ns") + (at / 20.0 * 1e9).astype("timedelta64[ns]")
    table = pl.DataFrame(
        {
            "time_gpst": time,
            "antenna": "front",
            "motion": np.where((at > 49.0) & (at < 53.0), "inertial_spin", "normal"),
            "measured_chainage_m": at,
            "measured_gradient_permille": np.where(at < 49.0, 0.0, np.nan),
            "measured_curvature_1pm": 0.0,
        }
    )
    table.with_columns(pl.col("measured_gradient_permille").fill_nan(0.0)).write_parquet(tmp_path / "train.parquet")
    kept = read_measured(tmp_path)["measured_chainage_m"].to_numpy()
    assert kept.max() == 98.0
    assert not ((kept > 50.0 - 30.0) & (kept < 52.0 + 30.0)).any()
    assert len(kept) == (at <= 20.0).sum() + (at >= 84.0).sum()


def test_a_folder_without_a_measured_line_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match=r"train.parquet.*has no measured properties .*; give a folder written by"):
        read_measured(tmp_path)
    nothing = {name: [None] for name in ("measured_chainage_m", "measured_gradient_permille", "measured_curvature_1pm")}
    start = np.array(["2024-03-05T03:10:00"], dtype="datetime64[ns]")
    columns = {"time_gpst": start, "antenna": ["front"], "motion": ["init"]}
    pl.DataFrame({**columns, **nothing}).write_parquet(tmp_path / "train.parquet")
    with pytest.raises(InputFileError, match="has no measured gradient and curvature; run with --tachometer"):
        read_measured(tmp_path)


@pytest.mark.slow
def test_the_command_lists_what_two_runs_measured_beside_the_map(tmp_path: Path) -> None:
    sets = ["--set", "sensors.tachometer={}", "--set", "sensors.inertial={}"]
    for seed in ("1", "2"):
        made = tmp_path / seed
        said = RUNNER.invoke(app, ["simulate", "demo", "--seed", seed, "--seconds", "110", *sets, "--out", str(made)])
        assert said.exit_code == 0, said.output
        files = {"front": "front.crx.gz", "nav": "nav.rnx.gz", "track": "track.csv", "vehicle": "vehicle.toml"}
        given = [f"--{name}={made / file}" for name, file in files.items()]
        given += [f"--{name}={made / name}.parquet" for name in ("tachometer", "inertial")]
        said = RUNNER.invoke(app, ["run", *given, "--set", "tracking.level=off", "--out", str(tmp_path / f"run{seed}")])
        assert said.exit_code == 0, said.output
    command = ["map", "features", str(tmp_path / "1" / "track.csv"), "--out", str(tmp_path / "f.csv")]
    said = RUNNER.invoke(app, [*command, *(f"--run={tmp_path / f'run{seed}'}" for seed in ("1", "2"))])
    assert said.exit_code == 0, said.output
    assert "2 of 2" in said.output
    curves = pl.read_csv(tmp_path / "f.csv").filter(pl.col("quantity") == "curvature")
    assert len(curves) >= 3
    assert (curves["runs"] == 2.0).all()
    assert curves["spread_m"].max() < 1.0
    assert (curves["chainage_m"] - curves["map_chainage_m"]).abs().max() < 2.0
    said = RUNNER.invoke(app, [*command, "--overwrite", f"--run={tmp_path / 'none'}"])
    assert said.exit_code == 3
    assert "has no measured properties" in said.output
