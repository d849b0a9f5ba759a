"""Sentences of a run whose direction or size can be exchanged without an error: made values of known sign and size."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest

from railfix.pipeline.config import Config
from railfix.report.headline import _longest_outage
from railfix.run.driver import _describe_sign, _notes_of_levels
from railfix.run.sensor_checks import _sentences
from railfix.run.tally import AntennaTally, MapOffsetFound, Tally

pytestmark = pytest.mark.requirement("B7")


@pytest.mark.parametrize(
    ("across_m", "up_m", "side", "above"),
    [
        (3.0, 1.0, "right", "above"),
        (-3.0, 1.0, "left", "above"),
        (3.0, -9.0, "right", "below"),
        (-3.0, -9.0, "left", "below"),
    ],
)
def test_an_offset_of_the_map_has_its_side_its_height_and_its_cause(
    across_m: float, up_m: float, side: str, above: str
) -> None:
    found = MapOffsetFound(
        time=np.datetime64("2024-03-05T03:10:00", "ns"), across_m=across_m, up_m=up_m, across_sigma_m=0.5,
        up_sigma_m=0.7, statistic=50.0,
    )  # fmt: skip
    assert f"3.0 m (sigma 0.5 m) {side} of the line and {abs(up_m):.1f} m (sigma 0.7 m) {above} it" in found.text
    # nine metres in height are more of their sigma than three metres to the side
    assert ("geoid" in found.text) == (abs(up_m) == 9.0)
    assert ("a parallel track" in found.text) == (abs(up_m) == 1.0)


@pytest.mark.parametrize(("lag_s", "word"), [(0.6, "late"), (-0.6, "early")])
def test_time_tags_that_come_after_the_satellites_are_late(lag_s: float, word: str) -> None:
    found: Any = SimpleNamespace(unit="m/s", ratio=1.0, lag_s=lag_s)
    (text,) = _sentences("radar", found, "scale {:.1f} %")
    assert f"0.6 s {word} compared with" in text


@pytest.mark.parametrize(
    ("low_s", "high_s", "text"),
    [
        (-18.02, -17.98, "18.00 s early, so there is no protection level (they may be UTC, not GPS time)"),
        (-14.1, -13.9, "14.00 s early, so there is no protection level (they may be BeiDou time, not GPS time)"),
        (18.99, 19.03, "19.01 s late, so there is no protection level (they may be TAI, not GPS time)"),
        (17.98, 18.02, "18.00 s late, so there is no protection level (expected GPS time)"),
        (0.97, 1.01, "0.99 s late, so there is no protection level (expected GPS time)"),
        (-0.25, -0.15, "0.20 s early, so there is no protection level (expected GPS time)"),
        (-0.1, 1.5, "between -0.10 and +1.50 s off (+ late), so there is no protection level (they may drift)"),
        (-18.4, -17.6, "between -18.40 and -17.60 s off (+ late), so there is no protection level (they may drift)"),
    ],
)
def test_an_error_of_the_time_tags_has_its_size_its_sign_and_a_guess(low_s: float, high_s: float, text: str) -> None:
    assert _describe_sign("time_tags", (low_s, high_s)) == f"the time tags are {text}"


def test_the_end_of_an_outage_has_its_error_and_its_sigma() -> None:
    outages = pl.DataFrame(
        {
            "run": ["a (train)", "a (train)"],
            "antenna": ["front", "front"],
            "environment": ["tunnel", "cutting"],
            "duration_s": [7.5, 3.0],
            "travelled_m": [80.0, 20.0],
            "carried_by": ["wheel", ""],
            "outage_max_m": [1.5, 0.1],
            "end_error_m": [-0.25, 0.0],
            "end_sigma_m": [12.5, 1.0],
        }
    )
    run: Any = SimpleNamespace(name_in=lambda _, table: f"a ({table})")
    (text,) = _longest_outage(run, "front", SimpleNamespace(outages=outages))  # type: ignore[arg-type]
    assert "without satellites: tunnel, 7.5 s, 80 m, positions by wheel. In it" in text
    assert "at most 1.50 m; at its end, the error is −0.25 m, and the stated sigma is 12.5 m" in text


@pytest.mark.parametrize(("excluded", "noted"), [(30, True), (11, False)])
def test_more_exclusions_than_false_alarms_and_the_prior_explain_are_a_note(excluded: int, noted: bool) -> None:
    """10,000 epochs have ten false alarms at 1e-3; 100,000 ranges have some faults at the prior."""
    config = Config()
    antenna = AntennaTally(observed=10_000, used=100_000)
    antenna.first_reason["fault_excluded"] = excluded
    antenna.level_status["available"] = 10_000
    notes = list(_notes_of_levels(config, Tally(antennas={"front": antenna})))
    prior = config.risk.local_prior
    assert 100_000 * prior < 20.0 < 100.0 * 100_000 * prior
    assert any("RAIM has excluded" in note for note in notes) == noted
