"""The evaluation of a run folder of a real recording equals the scores worked out on arrays."""

from __future__ import annotations

from pathlib import Path

import pytest

import recordings_score
import recordings_truth
from railfix.evaluate import evaluate_run
from railfix.run import RunInputs, run_files
from railfix.track import from_positions, write_track_csv

pytestmark = pytest.mark.requirement("D2")

CONFIG = recordings_score.TABLES["all screens, failed checks kept"]


@pytest.mark.parametrize("name", [pytest.param("urbannav_f9p", marks=pytest.mark.slow), "japan"])
def test_a_run_of_a_recording_has_the_figures_of_the_arrays(recordings: Path, tmp_path: Path, name: str):
    """Maps and references go through files of 0.1 mm, so figures agree to millimetres, not to the bit."""
    if name == "urbannav_f9p":
        folder = recordings / "kinematic" / "urbannav_tst"
        log, nav = folder / "20210517.light-urban.tste.ublox.f9p.obs", folder / "hksc137c.nav"
        truth = recordings_truth.urbannav_truth(folder)
    else:
        folder = recordings / "kinematic" / "japan_mosaic_2021265_with_GEONET3034"
        log, nav = folder / "SEPT265G.21O", folder / "SEPT2650.21P"
        truth = recordings_truth.japan_truth(folder)
    track = tmp_path / "track.csv"
    write_track_csv(from_positions(*truth, spacing_m=5.0), track)
    reference = recordings_truth.write_truth_csv(truth, tmp_path / "reference.csv")
    run_files(RunInputs(front=(log,), nav=(nav,), track=(track,)), CONFIG, out=tmp_path / "run")
    found = evaluate_run(tmp_path / "run", reference)
    outcome = recordings_score.RECORDINGS[name](recordings, CONFIG)
    assert found.runs[0].method == {"front": "trajectory"}
    for position, figures in (("constrained", outcome.constrained), ("conventional", outcome.conventional)):
        told = {key: found.figure(key, position=position) for key in ("observed", "positions", "rate", "wrong_places")}
        assert told["observed"] == figures.epochs
        assert told["positions"] == figures.positions
        assert told["rate"] == pytest.approx(figures.rate)
        assert told["wrong_places"] == round(figures.wrong_place * figures.positions)
        for key in ("mean_m", "std_m", "p50_m", "p95_m", "max_m"):
            assert found.figure(key, position=position) == pytest.approx(getattr(figures, key), abs=5e-3), key
    if name == "urbannav_f9p":
        assert found.figure("p50_m") == pytest.approx(1.42, abs=0.006)
        assert found.figure("p95_m") == pytest.approx(4.49, abs=0.006)
