"""Print reference numbers of delays, by pyrtklib5 (RTKLIB in C).

Run from the repository's root, with pyrtklib5 installed:

    python tests/references/make_delay_references.py > tests/references/delays.json
"""

from __future__ import annotations

import json
import sys
from importlib.metadata import version
from itertools import product
from pathlib import Path

import numpy as np

sys.path.extend(str(Path(__file__).resolve().parents[1] / folder) for folder in ("helpers", "oracles"))

import orbit_cases
import pyrtklib_orbits

KLOBUCHAR = [1.1176e-08, 2.2352e-08, -1.1921e-07, -5.9605e-08, 1.2902e05, 1.6384e05, -1.9661e05, -2.6214e05]


def delays() -> dict[str, list[dict[str, object]]]:
    troposphere = [
        {"latitude_deg": a, "height_m": h, "elevation_deg": e, "relative_humidity": q,
         "delay_m": pyrtklib_orbits.troposphere_m(a, h, e, q)}
        for a, h, e, q in product((-33.5, 0.0, 35.0, 67.0), (-50.0, 0.0, 812.0, 4000.0), (5.0, 37.0, 90.0), (0.0, 0.7))
    ]  # fmt: skip
    ionosphere = [
        {"after_toe_s": t, "latitude_deg": a, "longitude_deg": b, "elevation_deg": e, "azimuth_deg": z,
         "delay_m": pyrtklib_orbits.ionosphere_m(
             orbit_cases.TOE + np.timedelta64(t, "s"), (a, b), e, z, KLOBUCHAR)}
        for t, (a, b), e, z in product(
            (0, 9000, 40_000), ((35.0, 139.0), (-70.0, -60.0), (0.0, 10.0), (75.0, 179.5)),
            (5.0, 35.0, 90.0), (0.0, 123.0, 300.0),
        )
    ]  # fmt: skip
    return {"troposphere": troposphere, "ionosphere": ionosphere}


if __name__ == "__main__":
    print(
        json.dumps(
            {
                "program": f"pyrtklib5 {version('pyrtklib5')}",
                "made_by": "tests/references/make_delay_references.py",
                "klobuchar": KLOBUCHAR,
                **delays(),
            },
            indent=0,
        )
    )
