"""What each screen buys and costs: the commands, and the tables they print, that docs/screens.md is taken from.

``python tests/studies/recordings_ablate.py FOLDER`` with the recordings beside the checkout writes references, maps and
results to the folder, and the tables to tests/references/results/screens.md.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

from typer.testing import CliRunner

import paths
import multipath_run
import recordings_truth
from railfix.cli import app
from railfix.core.files import read_bytes

DOCUMENT: Final = paths.ROOT / "tests" / "references" / "results" / "screens.md"

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
SETTINGS: Final = {
    "default": ["--set", "elevation.mask_deg=15"],
    "strict": ["--preset", "strict", "--set", "elevation.mask_deg=15"],
    "p1": ["--preset", "p1"],
}
#: Recordings by their heading.
HEADINGS: Final = {
    "urbannav_f9p": "UrbanNav TST, u-blox F9P (G E C J), 1 Hz, urban",
    "urbannav_m8t": "UrbanNav TST, u-blox M8T (G C), 1 Hz, urban",
    "gsdc": "GSDC, Pixel 5 (G), 1 Hz, phone in a car",
    "japan": "Japan, mosaic-X5 (G E J), 1 Hz, open sky",
    "walls": "Made-up run with walls, two antennas, 10 Hz (`tests/studies/multipath_run.py`)",
}


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


def options_of(data: Path, folder: Path, recording: str) -> dict[str, Path]:
    """The files of a recording by the option that takes them."""
    if recording == "walls":
        files = multipath_run.write_walls(folder / "walls")
        names = {"--front": "front", "--rear": "rear", "--nav": "nav", "--track": "track", "--vehicle": "vehicle"}
        options = {option: files[name] for option, name in names.items()}
        truth = folder / "walls" / "truth.csv"
        truth.write_bytes(read_bytes(files["truth"]))
        return options | {"--truth": truth}
    log, navigation, reference = RECORDINGS[recording]
    return {
        "--front": data / "kinematic" / log,
        "--nav": data / "kinematic" / navigation,
        "--track": folder / f"{reference}_line.csv",
        "--truth": folder / f"{reference}_truth.csv",
    }


def ablation(options: dict[str, Path], folder: Path, settings: str) -> str:
    """The table of one recording with one choice of settings, its command above it."""
    words = ["ablate", *(word for option, path in options.items() for word in (option, str(path)))]
    output = printed([*words, "--out", str(folder), *SETTINGS[settings], "--overwrite"])
    shown = " ".join(f"{option} {path.name}" for option, path in options.items())
    command = f"$ railfix ablate {shown} \\\n    {' '.join(SETTINGS[settings])} --out {folder.name}\n"
    kept = [line.rstrip() for line in output.splitlines() if not line.startswith(("wrote", "note: screen", "note: no"))]
    return command + "\n".join(kept)


def tables(data: Path, folder: Path) -> str:
    """All tables as Markdown."""
    prepared(data, folder)
    parts = []
    for recording, heading in HEADINGS.items():
        parts.append(f"### {heading}\n")
        options = options_of(data, folder, recording)
        for settings in SETTINGS:
            text = ablation(options, folder / f"{recording}_{settings}", settings)
            if settings == "strict":
                # the screens are those of the default; what it drops shows in the first lines
                text = "\n".join(line for line in text.splitlines() if not line.startswith(("only", "without")))
            parts.append(f"```console\n{text}\n```\n")
    return "\n".join(parts)


def main() -> int:
    """Write the tables."""
    data = paths.ROOT.parent / "shared" / "data"
    if len(sys.argv) != 2 or not data.is_dir():
        print(f"give a folder to write to; the recordings are expected at {data}", file=sys.stderr)
        return 1
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    made = tables(data, folder)
    DOCUMENT.write_text(made, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
