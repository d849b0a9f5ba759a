"""Where satellites can serve on a line, by chainage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from railfix.core.errors import MismatchError
from railfix.evaluate import intervals
from railfix.evaluate.evaluation_inputs import RunFolder
from railfix.report.plots.campaign import plot_service, service_charts

pytestmark = pytest.mark.requirement("G4")

EPOCHS = 400


def folder(path: Path, *, length_m: float = 400.0, filtered: bool = True) -> RunFolder:
    """A run at 1 m/s: no position from 200 to 299 m, a level of 15 m before and 50 m after it."""
    place = np.arange(EPOCHS, dtype=np.float64)
    dark = (place >= 200.0) & (place < 300.0)
    positions = pl.DataFrame(
        {
            "time_gpst": np.datetime64("2024-05-01", "ns") + place.astype(np.int64) * np.timedelta64(1, "s"),
            "antenna": ["front"] * EPOCHS,
            "status": np.where(dark, "too_few_satellites", "ok"),
            "chainage_m": pl.Series(np.where(dark, np.nan, place)).fill_nan(None),
            "n_used": np.where(dark, 1, np.where(place < 200.0, 9, 6)),
            "n_rejected": np.where(place < 200.0, 1, 2),
            "conventional_offset_m": pl.Series(np.where(dark, np.nan, np.where(place < 200.0, 2.0, 9.0))).fill_nan(
                None
            ),
        }
    )
    if filtered:
        positions = positions.with_columns(
            protection_level_m=np.where(place < 200.0, 15.0, 50.0),
            filter=pl.Series(np.where(dark & (place > 250.0), "lost", np.where(dark, "coasting", "tracking"))),
        )
    record = {"line": {"track": {"name": "line", "length_m": length_m}}}
    return RunFolder(path=path, positions_path=path, positions=positions, record=record)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> dict[str, RunFolder]:
    """Runs by the name of their folder, in place of files."""
    found: dict[str, RunFolder] = {}

    def read(path: Path, *, table: str = "positions") -> RunFolder:
        run = found[path.name]
        if table == "positions":
            return run
        rows = run.positions.with_columns(status=pl.col("filter"))
        return RunFolder(path=path, positions_path=path, positions=rows, record=run.record, table=table)

    def tables(path: Path) -> list[str]:
        return ["positions", "train"] if "filter" in found[path.name].positions.columns else ["positions"]

    monkeypatch.setattr(intervals, "read_run", read)
    monkeypatch.setattr(intervals, "list_position_tables", tables)
    return found


def test_epochs_are_counted_by_stretch(runs: dict[str, RunFolder], tmp_path: Path) -> None:
    runs["a"], runs["b"] = folder(tmp_path / "a"), folder(tmp_path / "b")
    found = intervals.compute_service([Path("a"), Path("b")], stretch_m=100.0, limit_m=20.0)
    assert found["from_m"].to_list() == [0.0, 100.0, 200.0, 300.0]
    assert found["epochs"].to_list() == [200, 200, 200, 200]
    assert found["runs"].to_list() == [2, 2, 2, 2]
    assert found["satellites_median"].to_list() == [9.0, 9.0, 1.0, 6.0]
    assert found["rejected_share"].to_list() == pytest.approx([0.1, 0.1, 2.0 / 3.0, 0.25])
    assert found["reflection_p95_m"].to_list() == [2.0, 2.0, None, 9.0]
    assert found["ok_share"].to_list() == [1.0, 1.0, 0.0, 1.0]
    assert found["tracking_share"].to_list() == pytest.approx([1.0, 1.0, 0.51, 1.0])
    assert found["level_p95_m"].to_list() == [15.0, 15.0, np.inf, 50.0]
    assert found["within_limit_share"].to_list() == [1.0, 1.0, 0.0, 0.0]
    charts = service_charts(found, 20.0)
    assert [len(chart.layers) for chart in charts] == [2, 1, 3, 3]
    assert not any(chart.empty for chart in charts)
    assert {chart.common_axis for chart in charts} == {"chainage"}
    plot_service(found, tmp_path / "service.png", title="a", limit_m=20.0)
    assert (tmp_path / "service.png").read_bytes().startswith(b"\x89PNG")


def test_runs_without_a_filter_have_no_levels(runs: dict[str, RunFolder], tmp_path: Path) -> None:
    runs["a"] = folder(tmp_path / "a", filtered=False)
    found = intervals.compute_service([Path("a")], stretch_m=200.0)
    assert found["ok_share"].to_list() == [1.0, 0.5]
    assert found["tracking_share"].to_list() == [None, None]
    assert found["within_limit_share"].to_list() == [None, None]


def test_runs_on_different_maps_are_not_mixed(runs: dict[str, RunFolder], tmp_path: Path) -> None:
    runs["a"], runs["b"] = folder(tmp_path / "a"), folder(tmp_path / "b", length_m=900.0)
    with pytest.raises(MismatchError, match="one map"):
        intervals.compute_service([Path("a"), Path("b")])
