"""Print reference numbers of orbits, clocks and delays, by pyrtklib5 (RTKLIB in C), for made records.

Run from the repository's root, with pyrtklib5 installed:

    python tests/references/make_orbit_references.py > tests/references/orbits.json
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

#: Seconds of the epochs after toe.
KEPLER_S = (-7111.25, -1800.0, 0.0, 17.345678, 3600.0, 7111.5)
GLONASS_S = (-1777.25, -60.0, -12.5, 0.0, 59.9, 1000.0, 1777.125)
CODE_M = 24_123_456.789
KLOBUCHAR = [1.1176e-08, 2.2352e-08, -1.1921e-07, -5.9605e-08, 1.2902e05, 1.6384e05, -1.9661e05, -2.6214e05]


def states() -> list[dict[str, object]]:
    found = []
    kepler = orbit_cases.kepler(*[{"satellite": name} for name in orbit_cases.KINDS])
    glonass = orbit_cases.glonass({"satellite": "R07"})
    ephemerides = [(str(s), pyrtklib_orbits.kepler_ephemeris(kepler, i)) for i, s in enumerate(kepler.satellite)]
    ephemerides += [("R07", pyrtklib_orbits.glonass_ephemeris(glonass, 0))]
    for name, ephemeris in ephemerides:
        for seconds in GLONASS_S if name == "R07" else KEPLER_S:
            time = orbit_cases.TOE + np.timedelta64(round(seconds * 1e9), "ns")
            position, clock = pyrtklib_orbits.state(ephemeris, time, CODE_M)
            found.append({"satellite": name, "after_toe_s": seconds, "position_ecef_m": position, "clock_m": clock})
    return found


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
                "made_by": "tests/references/make_orbit_references.py",
                "code_m": CODE_M,
                "klobuchar": KLOBUCHAR,
                "states": states(),
                **delays(),
            },
            indent=0,
        )
    )
