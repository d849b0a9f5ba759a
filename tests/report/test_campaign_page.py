"""The page on a campaign: figures by hand, the worst epochs, runs that failed or have no reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from railfix.report.campaign import report_campaign, write_campaign_page
from report_page import Page, fetched
from run_made import reference, write_reference, write_run

pytestmark = pytest.mark.requirement("G1", "G4")


def campaign(folder: Path, *, judged: bool) -> pl.DataFrame:
    """Runs A and B 1 and 2 m off, B once 70 m; C failed."""
    time = np.arange(200.0)
    place = 100.0 + 5.0 * time
    write_reference(folder / "truth.csv", reference(time, place))
    rows = []
    for name, off in (("A", 1.0), ("B", 2.0)):
        answer = place + off
        answer[150] += 68.0 if name == "B" else 0.0
        level = np.where(time < 100, 10.0, 20.0)
        write_run(folder / "runs" / name, time, answer, protection_level_m=level)
        found = {"epochs": 200, "positioning_rate": 1.0, "ok_rate": 0.9, "folder": f"runs/{name}"}
        rows.append({"train": name, "status": "done", "error": None, **found})
    rows.append({"train": "C", "status": "failed", "error": "front.obs: <no log>"})
    truth = str(folder / "truth.csv") if judged else None
    return pl.DataFrame(rows, infer_schema_length=None).with_columns(reference=pl.lit(truth, dtype=pl.String))


def test_errors_of_the_runs_and_the_worst_epoch(tmp_path: Path) -> None:
    found = report_campaign(campaign(tmp_path, judged=True), tmp_path)
    assert found.notes == ()
    runs, failed, worst = found.tables
    rows = {row[0]: dict(zip(runs.head, row, strict=True)) for row in runs.rows}
    assert [rows["A"][head] for head in ("error p50 m", "error p95 m", "largest m")] == ["1.00", "1.00", "1.00"]
    assert [rows["B"][head] for head in ("error p50 m", "largest m", "errors over level")] == ["2.00", "70.00", "1"]
    assert [rows["B"][head] for head in ("level p50 m", "level p95 m", "rate %", "ok %")] == [
        "15.00", "20.00", "100.00", "90.00",
    ]  # fmt: skip
    assert rows["C"]["error p50 m"] == "–"
    assert failed.rows == [["C", "front.obs: <no log>"]]
    first = dict(zip(worst.head, worst.rows[0], strict=True))
    assert (first["run"], first["error m"], first["level m"]) == ("B", "+70.00", "20.00")
    assert first["GPS time"] == "2024-03-05 01:02:30.000"
    assert "--at '2024-03-05 01:02:30' --antenna front" in first["command to explain"]
    assert [chart.name for chart in found.charts] == ["campaign-plan", "campaign-error", "campaign-level"]
    assert any(layer.label == "error 10 m and more" and len(layer.x) == 1 for layer in found.charts[0].layers)
    assert "the worst run is B, with a 95th percentile of 2.00 m and a largest value of 70.00 m" in found.sentences
    assert len(found.sentences) <= 5

    page = write_campaign_page(found, tmp_path / "campaign.html", title="three <runs>")
    text = page.read_text()
    assert fetched(text) == []
    assert "front.obs: &lt;no log&gt;" in text
    assert [figure["data-name"] for figure in Page(text).figures] == [chart.name for chart in found.charts]


def test_without_a_reference_the_levels_count(tmp_path: Path) -> None:
    found = report_campaign(campaign(tmp_path, judged=False), tmp_path)
    (worst,) = (table for table in found.tables if table.name == "worst")
    assert {row[worst.head.index("level m")] for row in worst.rows} == {"10.00", "20.00"}
    assert [chart.name for chart in found.charts] == ["campaign-plan", "campaign-level"]
    assert any("no reference was given" in sentence for sentence in found.sentences)


def test_a_reference_of_another_time_is_a_note(tmp_path: Path) -> None:
    rows = campaign(tmp_path, judged=True)
    late = np.arange(10.0) + 9e5
    write_reference(tmp_path / "truth.csv", reference(late, 100.0 + late * 1e-3))
    found = report_campaign(rows, tmp_path)
    assert len(found.notes) == 2
    assert "A: " in found.notes[0]


def test_a_campaign_without_results_has_a_page(tmp_path: Path) -> None:
    rows = campaign(tmp_path, judged=True).filter(status="failed")
    found = report_campaign(rows.drop("epochs").with_columns(epochs=pl.lit(None, dtype=pl.Int64)), tmp_path)
    assert found.charts == ()
    assert "0 of 1 run done" in found.sentences[0]
    assert write_campaign_page(found, tmp_path / "campaign.html", title="none").is_file()
