"""A recording from the package index as a case: ``python tests/studies/public_recording.py FOLDER``.

The wheel `gnss-benchmark` (MIT) has a drive of 20 minutes through a town (Septentrio mosaic-X5, 1 Hz, November 2020)
and a station 14 km away. RTKLIB's `rnx2rtkp` makes the ground truth from both, forward and backward (mostly float: some
decimetres), `railfix map from-positions` the map. It is held out: no test reads it, and neither settings nor constants
were chosen with it. Then::

    python tests/studies/belief_campaign.py FOLDER --whole --every 20 --mask 20 10 --calibration
    railfix benchmark FOLDER --out OUT
"""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import polars as pl

import paths  # noqa: F401  where case_files is
from case_files import write_case

WHEEL = "gnss-benchmark==2.3.0"
INSIDE = "gnss_benchmark/datasets/mosaicx5_multi_dynamic"
FILES = {
    "rover.rnx": "CARD00ESP_R_20203341240_20M_01S_MO.rnx",
    "base.rnx": "MARE00ESP_R_20203341240_20M_01S_MO.rnx",
    "nav.rnx": "CARD00ESP_R_20203340900_15H_MN.rnx",
}
#: Options of rnx2rtkp: kinematic, both directions, L1 and L2 (E5b), GPS, Galileo and GLONASS without its integers.
OPTIONS = {
    "pos1-posmode": "kinematic",
    "pos1-frequency": "l1+2",
    "pos1-soltype": "combined",
    "pos1-elmask": "15",
    "pos1-navsys": "45",
    "pos2-armode": "continuous",
    "pos2-gloarmode": "off",
    "out-solformat": "llh",
    "out-height": "ellipsoidal",
    "ant2-postype": "rinexhead",
}
#: Positions with a larger standard deviation in height are no truth [m].
LARGEST_SIGMA_M = 1.5
CASE = {
    "licence": "MIT",
    "fetch": "python tests/studies/public_recording.py FOLDER (wheel gnss-benchmark 2.3.0)",
    "held_out": True,
    "files": {"front": ["rover.rnx"], "nav": ["nav.rnx"], "track": ["track.csv"], "truth": "truth.csv"},
    "scenario": {
        "date": "2020-11-29",
        "environment": "town and roads around it",
        "vehicle": "car",
        "receiver": "Septentrio mosaic-X5",
        "rate_hz": 1.0,
        "reference": "RTKLIB, kinematic, both directions, station at 14 km",
        "reference_accuracy_m": 0.5,
    },
}


def truth_of(solution: Path) -> pl.DataFrame:
    """Positions of a solution file that are good enough, with whole time tags."""
    lines = [line.split() for line in solution.read_text().splitlines() if not line.startswith("%")]
    good = [words for words in lines if max(map(float, words[7:10])) < LARGEST_SIGMA_M]
    columns = ("latitude_deg", "longitude_deg", "height_m")
    tags = [f"{words[0].replace('/', '-')}T{words[1]}" for words in good]
    return pl.DataFrame({"time_gpst": tags, **{name: [w[k] for w in good] for k, name in enumerate(columns, 2)}})


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run([sys.executable, "-m", "pip", "download", "-q", "--no-deps", "-d", folder, WHEEL], check=True)
    with zipfile.ZipFile(next(folder.glob("gnss_benchmark-*.whl"))) as wheel:
        for name, source in FILES.items():
            (folder / name).write_bytes(wheel.read(f"{INSIDE}/{source}"))
    (folder / "rtk.conf").write_text("".join(f"{key}={value}\n" for key, value in OPTIONS.items()))
    solution = folder / "rtk.pos"
    subprocess.run(
        ["rnx2rtkp", "-k", folder / "rtk.conf", "-o", solution, *(folder / name for name in FILES)],
        check=True,
        stderr=subprocess.DEVNULL,
    )
    truth = truth_of(solution)
    truth.write_csv(folder / "truth.csv")
    words = ["map", "from-positions", folder / "truth.csv", "--out", folder / "track.csv", "--overwrite"]
    subprocess.run([sys.executable, "-m", "railfix", *words], check=True)
    write_case(folder, CASE)
    print(f"{len(truth)} positions of ground truth; case: {folder}")


if __name__ == "__main__":
    main()
