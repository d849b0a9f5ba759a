"""Maps that ``railfix map survey`` makes of single recordings, against the reference: ``survey_score.py [NAME...]``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

import paths
from railfix.core.arrays import Floats
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.pipeline.config import Config
from railfix.run.inputs import LogReading
from railfix.run.locate import survey_files
from railfix.track.survey.line import Survey
from railfix.track.survey.runs import SurveyLimits
from recordings_truth import Truth, gsdc_truth, japan_truth, urbannav_truth

#: Logs, navigation and truth of each recording, in its folder of ``kinematic``.
RECORDINGS: Final[dict[str, tuple[str, str, str, Callable[[Path], Truth]]]] = {
    "m8t": ("urbannav_tst", "20210517.light-urban.tste.ublox.m8t.GC.obs", "hksc137c.nav", urbannav_truth),
    "f9p": ("urbannav_tst", "20210517.light-urban.tste.ublox.f9p.obs", "hksc137c.nav", urbannav_truth),
    "pixel": ("gsdc_pixel5_a", "Pixel5_a.21o", "hour1180.21n", gsdc_truth),
    "japan": ("japan_mosaic_2021265_with_GEONET3034", "SEPT265G.21O", "SEPT2650.21P", japan_truth),
}
_STEP_S: Final = 0.05


def errors_across_m(survey: Survey, truth: Truth) -> Floats:
    """Distance in plan of every point of the map from the way of the reference, shape (V,) [m]."""
    time, ecef = truth
    since = (time - time[0]) / np.timedelta64(1, "s")
    dense = np.stack([np.interp(np.arange(0.0, since[-1], _STEP_S), since, ecef[:, i]) for i in range(3)], axis=1)
    latitude, longitude, _ = geodetic_from_ecef(ecef[0])
    plan = enu_axes(latitude, longitude)[:2].T
    found: Floats = cKDTree((dense - ecef[0]) @ plan).query((survey.track.ecef_m - ecef[0]) @ plan)[0]
    return found


def main(names: Sequence[str]) -> int:
    """Print one line a recording."""
    recordings = paths.DATA
    for name in names or RECORDINGS:
        folder, log, nav, truth = RECORDINGS[name]
        files = recordings / "kinematic" / folder
        survey = survey_files(
            [files / log],
            [files / nav],
            Config(),
            limits=SurveyLimits(),
            name=name,
            reading=LogReading(broken_lines="count"),
        ).survey
        error = errors_across_m(survey, truth(recordings))
        print(
            f"{name}: {survey.track.chainage_m[-1]:,.1f} m, {'closed' if survey.closed else 'open'}; across 50 % "
            f"{np.percentile(error, 50):.2f} m, 95 % {np.percentile(error, 95):.2f} m, largest {error.max():.2f} m; "
            f"95 % within {np.percentile(error / survey.sigma_plan_m, 95):.2f} of the stated sigma; "
            f"{survey.beside_m:,.0f} m not used",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
