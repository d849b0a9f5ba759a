"""What each screen buys and costs on the real recordings: the commands, and the tables they print.

``python tests/recordings_ablate.py FOLDER`` with the recordings beside the checkout writes references, maps and
results to the folder and prints what ``docs/screens.md`` shows.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

from typer.testing import CliRunner

import recordings_truth
from railfix.cli import app

#: Recording: log, navigation, reference.
RECORDINGS: Final = {
    "urbannav_f9p": ("urbannav_tst/20210517.light-urban.tste.ublox.f9p.obs", "urbannav_tst/hksc137c.nav", "urbannav"),
    "urbannav_m8t": (
        "urbannav_tst/20210517.light-urban.tste.ublox.m8t.GC.obs",
        "urbannav_tst/hksc137c.nav",
        "urbannav",
    ),
    "gsdc": ("gsdc_pixel5_a/Pixel5_a.21o", "gsdc_pixel5_a/hour1180.21n", "gsdc"),
    "japan": (
        "japan_mosaic_2021265_with_GEONET3034/SEPT265G.21O",
        "japan_mosaic_2021265_with_GEONET3034/SEPT2650.21P",
        "japan",
    ),
}
#: Settings by the name of their table.
SETTINGS: Final = {"default": ["--set", "elevation.mask_deg=15"], "p1": ["--preset", "p1"]}


def prepared(data: Path, folder: Path) -> dict[str, Path]:
    """The reference of each recording as CSV, and the map made of it, 5 m."""
    truths = {}
    for name in sorted({reference for *_, reference in RECORDINGS.values()}):
        path = folder / f"{name}_truth.csv"
        recordings_truth.write_truth_csv(recordings_truth.TRUTHS[name](data), path)
        printed(["map", "from-positions", str(path), "--out", str(folder / f"{name}_line.csv")])
        truths[name] = path
    return truths


def printed(arguments: list[str]) -> str:
    """Output of a command.

    Raises
    ------
    RuntimeError
        It failed.
    """
    result = CliRunner(env={"COLUMNS": "120", "TERM": "dumb"}).invoke(app, arguments)
    if result.exit_code:
        raise RuntimeError(f"railfix {' '.join(arguments)}: {result.output}") from result.exception
    return result.stdout


def ablation(data: Path, folder: Path, recording: str, settings: str) -> str:
    """The table of one recording with one choice of settings, its command above it."""
    log, navigation, reference = RECORDINGS[recording]
    options = {
        "--front": str(data / "kinematic" / log),
        "--nav": str(data / "kinematic" / navigation),
        "--track": str(folder / f"{reference}_line.csv"),
        "--truth": str(folder / f"{reference}_truth.csv"),
        "--out": str(folder / f"{recording}_{settings}"),
    }
    words = ["ablate", *(word for pair in options.items() for word in pair), *SETTINGS[settings]]
    shown = [f"{option} {Path(value).name}" for option, value in options.items()]
    output = "\n".join(line.rstrip() for line in printed([*words, "--overwrite"]).splitlines() if "wrote" not in line)
    return f"$ railfix ablate {' '.join(shown)} {' '.join(SETTINGS[settings])}\n{output}"


def main() -> int:
    """Print all tables."""
    data = Path(__file__).resolve().parents[2] / "shared" / "data"
    if len(sys.argv) != 2 or not data.is_dir():
        print(f"give a folder to write to; the recordings are expected at {data}", file=sys.stderr)
        return 1
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    prepared(data, folder)
    for recording in RECORDINGS:
        for settings in SETTINGS:
            print(f"### {recording}, {settings}\n\n```console\n{ablation(data, folder, recording, settings)}\n```\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
