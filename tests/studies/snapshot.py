"""Write the outputs of every command to a folder, and compare two such folders value by value.

A refactoring changes no number: run ``python tests/studies/snapshot.py write FOLDER`` before it and after it, then
``python tests/studies/snapshot.py compare BEFORE AFTER``. Numbers, statuses and reasons are compared exactly; run
times, versions and paths are not. With the recordings beside the checkout they are part of the snapshot.
"""

from __future__ import annotations

import gzip
import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import polars as pl

import paths

DEMO: Final = paths.ROOT / "data" / "demo"
DATA: Final = paths.ROOT.parent / "shared" / "data"

#: Options of the runs on the demonstration, by the name of their folder.
DEMO_RUNS: Final = {
    "default": ["--observations"],
    "p1": ["--preset", "p1"],
    "strict": ["--preset", "strict"],
    "smoothed": ["--set", "carrier=smoothed"],
    "float": ["--set", "carrier=float", "--observations"],
    "no-screens": ["--screens", "none"],
    "raim-level": ["--set", "raim_protection=on", "--set", "risk.local_prior=2e-5"],
    "plain-models": ["--set", "ionosphere=off", "--set", "troposphere=off", "--set", "noise.model=elevation"],
    "two-systems": ["--set", 'systems=["G","E"]', "--chunk", "137"],
}
#: Recordings: observations, navigation, reference of `recordings_truth`.
RECORDED: Final = {
    "f9p": ("kinematic/urbannav_tst/20210517.light-urban.tste.ublox.f9p.obs", "kinematic/urbannav_tst/hksc137c.nav"),
    "m8t": ("kinematic/urbannav_tst/20210517.light-urban.tste.ublox.m8t.GC.obs", "kinematic/urbannav_tst/hksc137c.nav"),
    "gsdc": ("kinematic/gsdc_pixel5_a/Pixel5_a.21o", "kinematic/gsdc_pixel5_a/hour1180.21n"),
    "japan": (
        "kinematic/japan_mosaic_2021265_with_GEONET3034/SEPT265G.21O",
        "kinematic/japan_mosaic_2021265_with_GEONET3034/SEPT2650.21P",
    ),
}
TRUTH_OF: Final = {"f9p": "urbannav", "m8t": "urbannav", "gsdc": "gsdc", "japan": "japan"}
#: Where the receiver of the SBAS log stood: latitude, longitude [deg], height [m].
PARKED_DEG: Final = (35.8729254, 138.3898229, 1004.46)
#: Keys of JSON files that two runs of the same code do not share.
VOLATILE: Final = {
    "version", "versions", "kernels", "railfix", "seconds", "command", "created", "started", "finished", "sha256",
    "wall_s", "positioning_s", "bytes",
}  # fmt: skip


def railfix(*arguments: object) -> None:
    """Run one command; its exit code and messages are part of the snapshot."""
    words = [str(word) for word in arguments]
    environment = {**os.environ, "COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "railfix", *words], capture_output=True, text=True, check=False, env=environment
    )
    if done.returncode not in (0, 6):
        print(f"railfix {' '.join(words)}: exit code {done.returncode}\n{done.stderr}", file=sys.stderr)


def demo_snapshot(out: Path) -> None:
    """Every command on the demonstration."""
    log = ["--front", DEMO / "front.crx.gz", "--rear", DEMO / "rear.crx.gz", "--nav", DEMO / "nav.rnx.gz"]
    line = ["--track", DEMO / "track.csv", "--vehicle", DEMO / "vehicle.toml"]
    truth = DEMO / "truth.csv.gz"
    for name, options in DEMO_RUNS.items():
        railfix("run", *log, *line, *options, "--out", out / name)
    railfix("error-model", out / "default", "--reference", truth, "--out", out / "model.toml")
    railfix("run", *log, *line, "--error-model", out / "model.toml", "--out", out / "with-model")
    railfix("evaluate", out / "default", "--reference", truth, "--out", out / "evaluate")
    railfix("ablate", *log, *line, "--truth", truth, "--out", out / "ablate")
    railfix("cn0-curve", DEMO / "front.crx.gz", "--nav", DEMO / "nav.rnx.gz", "--out", out / "curve.toml")
    railfix("run", *log, *line, "--cn0-curve", out / "curve.toml", "--out", out / "with-curve")
    railfix("simulate", "demo", "--seconds", 60, "--out", out / "simulated", "--plain")
    thinned = out / "rtk.csv"
    rows = pl.read_csv(truth.read_bytes() if truth.suffix != ".gz" else gzip.decompress(truth.read_bytes()))
    rows = rows.filter(pl.col("antenna") == "front").with_row_index("row").filter(pl.col("row") // 300 % 2 == 0)
    rows.select("time_gpst", "x_m", "y_m", "z_m").write_csv(thinned)
    railfix("reference", "--rtk", thinned, *log[:2], "--nav", DEMO / "nav.rnx.gz", *line, "--out", out / "reference")
    railfix("map", "from-positions", thinned, "--out", out / "line.csv")


def recordings_snapshot(out: Path) -> None:
    """Runs on the recordings, with maps made from their references."""
    import recordings_truth

    for name, (observations, navigation) in RECORDED.items():
        folder = out / name
        folder.mkdir(parents=True)
        recordings_truth.write_truth_csv(
            recordings_truth.TRUTHS[TRUTH_OF[name]](next((DATA / "kinematic").glob(f"{TRUTH_OF[name]}*"))),
            folder / "truth.csv",
        )
        railfix("map", "from-positions", folder / "truth.csv", "--out", folder / "line.csv", "--spacing", 5)
        log = ["--front", DATA / observations, "--nav", DATA / navigation, "--track", folder / "line.csv"]
        for run, options in {"default": ["--observations"], "float": ["--set", "carrier=float"]}.items():
            railfix("run", *log, *options, "--out", folder / run)
        railfix("run", *log, "--preset", "p1", "--set", "carrier=smoothed", "--out", folder / "p1-smoothed")
        railfix("evaluate", folder / "default", "--reference", folder / "truth.csv", "--out", folder / "evaluate")
        railfix("error-model", folder / "default", "--reference", folder / "truth.csv", "--out", folder / "model.toml")


def sbas_snapshot(out: Path) -> None:
    """SBAS corrections on the parked log, on a line of two kilometres through the place."""
    folder = DATA / "sbas" / "msas_20080526_crescent"
    stem = folder / "cres_20080526.bin"
    log = ["--front", f"{stem}.obs", "--nav", f"{stem}.nav", "--sbas", f"{stem}.sbs"]
    out.mkdir(parents=True)
    line = ["latitude_deg,longitude_deg,height_m"]
    line += [f"{PARKED_DEG[0] + k * 4e-5:.9f},{PARKED_DEG[1] + k * 5e-5:.9f},{PARKED_DEG[2]}" for k in range(-200, 201)]
    (out / "line.csv").write_text("\n".join(line) + "\n")
    railfix("run", *log, "--track", out / "line.csv", "--observations", "--out", out / "default")
    railfix("run", *log, "--track", out / "line.csv", "--set", "sbas_prn=137", "--out", out / "prn137")


def write(out: Path) -> None:
    """Write the snapshot; the demonstration and the recordings side by side."""
    if out.exists():
        shutil.rmtree(out)
    out.mkdir(parents=True)
    jobs = [(demo_snapshot, out / "demo")]
    if DATA.is_dir():
        jobs += [(recordings_snapshot, out / "recordings"), (sbas_snapshot, out / "sbas")]
    with ThreadPoolExecutor(2) as pool:
        for future in [pool.submit(job, folder) for job, folder in jobs]:
            future.result()


def _plain(value: object) -> object:
    """A JSON value without what changes from run to run."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items() if key not in VOLATILE}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, str) and ("/" in value or value.startswith("20")):
        return Path(value).name if "/" in value else value
    return value


def _differences(one: object, two: object, where: str = "") -> list[str]:
    """Places where two JSON values differ."""
    if isinstance(one, dict) and isinstance(two, dict):
        found = []
        for key in sorted({*one, *two}):
            if key not in one or key not in two:
                found.append(f"{where}.{key} only {'after' if key not in one else 'before'}")
            else:
                found += _differences(one[key], two[key], f"{where}.{key}")
        return found
    if isinstance(one, list) and isinstance(two, list) and len(one) == len(two):
        return [d for i, (a, b) in enumerate(zip(one, two, strict=True)) for d in _differences(a, b, f"{where}[{i}]")]
    return [] if one == two else [f"{where}: {one!r} -> {two!r}"]


def _compare_table(one: Path, two: Path) -> list[str]:
    before, after = pl.read_parquet(one), pl.read_parquet(two)
    found = [f"column {c} only before" for c in before.columns if c not in after.columns]
    found += [f"column {c} only after" for c in after.columns if c not in before.columns]
    if before.height != after.height:
        return [*found, f"{before.height} rows -> {after.height}"]
    for name in [c for c in before.columns if c in after.columns]:
        a, b = before[name], after[name]
        if a.dtype != b.dtype:
            found.append(f"column {name}: {a.dtype} -> {b.dtype}")
        elif not a.equals(b, null_equal=True):
            differing = int((~a.eq_missing(b)).sum())
            worst = ""
            if a.dtype.is_float():
                worst = f", largest difference {(a - b).abs().fill_nan(None).max()}"
            if differing:
                found.append(f"column {name}: {differing} of {len(a)} values differ{worst}")
    return found


def compare(before: Path, after: Path) -> int:
    """Print where two snapshots differ; 1 where they do."""
    names = sorted({p.relative_to(f) for f in (before, after) for p in f.rglob("*") if p.is_file()})
    different = 0
    for name in names:
        one, two = before / name, after / name
        if name.suffix in {".html", ".png", ".md"}:
            continue
        if not (one.exists() and two.exists()):
            found = [f"only {'after' if two.exists() else 'before'}"]
        elif name.suffix == ".parquet":
            found = _compare_table(one, two)
        elif name.suffix == ".json":
            found = _differences(_plain(json.loads(one.read_text())), _plain(json.loads(two.read_text())))
        else:
            skip = lambda text: [line for line in text.splitlines() if "/" not in line]  # noqa: E731
            a, b = skip(one.read_text(errors="replace")), skip(two.read_text(errors="replace"))
            found = [f"line {i + 1}: {x} -> {y}" for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y][:3]
            found += [f"{len(a)} lines -> {len(b)}"] if len(a) != len(b) else []
        if found:
            different += 1
            print(f"{name}:")
            for line in found[:12]:
                print(f"    {line}")
    print(f"{len(names)} files compared, {different} differ")
    return 1 if different else 0


def main() -> int:
    words = sys.argv[1:]
    if len(words) == 2 and words[0] == "write":
        write(Path(words[1]).resolve())
        return 0
    if len(words) == 3 and words[0] == "compare":
        return compare(Path(words[1]), Path(words[2]))
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
