"""Reading speed: one hour at 10 Hz, 18 satellites, 8 observables each (87 MB of RINEX 3).

Run as a program; prints seconds and ratios to pyrtklib5 and cssrlib where they are installed, and
the peak memory of reading by pieces for logs of growing length::

    python tests/benchmarks/bench_reading.py [--rounds 5] [--hours 1 3]
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SATELLITES = tuple(f"G{n:02d}" for n in (2, 5, 7, 8, 13, 15, 20, 27, 29, 30)) + tuple(
    f"E{n:02d}" for n in (1, 4, 9, 11, 19, 21, 31, 36)
)
TYPES = ("C1C", "L1C", "D1C", "S1C", "C5Q", "L5Q", "D5Q", "S5Q")
RATE_HZ = 10
_HEADER = (
    ("     3.04           OBSERVATION DATA    M", "RINEX VERSION / TYPE"),
    ("made-up log         railfix benchmark", "PGM / RUN BY / DATE"),
    ("TRAIN", "MARKER NAME"),
    ("G    8 " + " ".join(TYPES), "SYS / # / OBS TYPES"),
    ("E    8 " + " ".join(TYPES), "SYS / # / OBS TYPES"),
    ("     0.100", "INTERVAL"),
    ("  2026     1     1     0     0    0.0000000     GPS", "TIME OF FIRST OBS"),
    ("", "END OF HEADER"),
)


def _fixed(thousandths: NDArray[np.int64], width: int = 14) -> NDArray[np.uint8]:
    """Integers as F14.3 text: shape (..., width) of bytes, right-aligned, blank-padded."""
    magnitude = np.abs(thousandths)
    text = np.full((*thousandths.shape, width), ord(" "), dtype=np.uint8)
    for place, column in enumerate([width - 1, width - 2, width - 3, *range(width - 5, -1, -1)]):
        shown = (magnitude > 0) | (place < 4)
        text[..., column] = np.where(shown, ord("0") + magnitude % 10, ord(" "))
        magnitude //= 10
    text[..., width - 4] = ord(".")
    blanks = (text == ord(" ")).sum(axis=-1)
    rows = np.flatnonzero(thousandths.ravel() < 0)
    text.reshape(-1, width)[rows, blanks.ravel()[rows] - 1] = ord("-")
    return text


def _values(tag: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
    """Observables in thousandths of their unit, shape (epochs, satellites, types)."""
    n = len(SATELLITES)
    t = tag[:, None] / RATE_HZ
    doppler = 3000.0 * np.cos(np.arange(n) + t / 7200.0)
    code = 22e6 + 3e5 * np.arange(n) - 0.19 * doppler * t
    columns = []
    for ratio in (1.0, 0.746_753):
        phase = -doppler * t * ratio + 1e6 * np.arange(n)
        cn0 = 44.0 + 4.0 * np.sin(np.arange(n) + t / 100.0)
        for value, sigma in ((code, 0.3), (phase, 0.003), (doppler * ratio, 0.05), (cn0, 0.5)):
            columns.append(np.rint((value + rng.normal(0.0, sigma, value.shape)) * 1000.0))
    return np.stack(columns, axis=-1).astype(np.int64)


def write_log(path: Path, *, hours: float, seed: int = 1) -> None:
    """Write a log of `hours` at 10 Hz, about 87 MB an hour, in pieces of a minute."""
    rng = np.random.default_rng(seed)
    names = np.array(SATELLITES, dtype="S3").view(np.uint8).reshape(-1, 3)
    start = np.datetime64("2026-01-01T00:00:00", "ms")
    total = round(hours * 3600 * RATE_HZ)
    with path.open("wb") as file:
        file.writelines(f"{text:<60}{label:<20}\n".encode() for text, label in _HEADER)
        for first in range(0, total, 600):
            tag = np.arange(first, min(first + 600, total))
            fields = np.full((len(tag), len(names), len(TYPES), 16), ord(" "), dtype=np.uint8)
            fields[..., :14] = _fixed(_values(tag, rng))
            fields[:, :, [0, 1, 4, 5], 15] = ord("7")
            rows = np.full((len(tag), len(names), 3 + 16 * len(TYPES) + 1), ord("\n"), dtype=np.uint8)
            rows[:, :, :3] = names
            rows[:, :, 3:-1] = fields.reshape(*fields.shape[:2], -1)
            for k, stamp in enumerate(np.datetime_as_string(start + tag * (1000 // RATE_HZ), unit="ms")):
                date, clock = stamp.split("T")
                text = f"> {date.replace('-', ' ')} {clock[:2]} {clock[3:5]} {clock[6:]}0000  0{len(names):3d}\n"
                file.write(text.encode() + rows[k].tobytes())


def seconds(action: Callable[[], object], rounds: int) -> float:
    """Least time of several runs [s]."""
    best = float("inf")
    for _ in range(rounds):
        begin = time.perf_counter()
        action()
        best = min(best, time.perf_counter() - begin)
    return best


def read_with_railfix(path: Path) -> int:
    """Epochs read."""
    from railfix.io import read_observations

    return len(read_observations(path))


def read_with_pyrtklib5(path: Path) -> int:
    """Observation records (epochs times satellites) read by RTKLIB's C reader."""
    import pyrtklib5

    observations, navigation, station = pyrtklib5.obs_t(), pyrtklib5.nav_t(), pyrtklib5.sta_t()
    pyrtklib5.readrnx(str(path), 1, "", observations, navigation, station)
    count = int(observations.n)
    pyrtklib5.freeobs(observations)
    return count


def read_with_cssrlib(path: Path) -> int:
    """Epochs read."""
    from cssrlib.gnss import rSigRnx
    from cssrlib.rinex import rnxdec

    decoder = rnxdec()
    decoder.setSignals([rSigRnx(system + name) for system in "GE" for name in TYPES])
    decoder.decode_obsh(str(path))
    epochs = 0
    while decoder.decode_obs().t.time != 0:
        epochs += 1
    return epochs


def peak_memory_mb(path: Path) -> float:
    """Peak memory of a process that scans a log in pieces [MB]; `getrusage` would give that of its parent if larger."""
    program = (
        "import re, sys\n"
        "from pathlib import Path\n"
        "from railfix.io.rinex import scan_observations\n"
        "total = sum(len(piece) for piece in scan_observations(sys.argv[1], epochs=600))\n"
        "print(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(path)], check=True, capture_output=True, text=True)
    return float(done.stdout) / 1024.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="runs of each reader; the best counts")
    parser.add_argument("--hours", type=float, nargs="*", default=[1.0, 3.0], help="logs for the peak memory")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="railfix-bench-") as folder:
        log = Path(folder) / "hour.obs"
        write_log(log, hours=1.0)
        size_mb = log.stat().st_size / 1e6
        own = seconds(lambda: read_with_railfix(log), options.rounds)
        print(f"one hour at 10 Hz, {len(SATELLITES)} satellites, {len(TYPES)} observables: {size_mb:.1f} MB")
        print(f"railfix    {own:8.3f} s   {size_mb / own:7.0f} MB/s")
        if importlib.util.find_spec("pyrtklib5"):
            other = seconds(lambda: read_with_pyrtklib5(log), options.rounds)
            print(f"pyrtklib5  {other:8.3f} s   railfix is {other / own:.1f} times as fast (wanted: 1.5)")
        if importlib.util.find_spec("cssrlib"):
            part = Path(folder) / "part.obs"
            write_log(part, hours=1.0 / 60.0)
            other = 60.0 * seconds(lambda: read_with_cssrlib(part), 1)
            print(f"cssrlib    {other:8.1f} s   railfix is {other / own:.0f} times as fast (wanted: 20)")
            print("           (read for one minute of the log, scaled to the hour)")
        for hours in options.hours:
            long = Path(folder) / "long.obs"
            write_log(long, hours=hours)
            size = long.stat().st_size / 1e6
            print(f"peak memory of reading {hours:g} h ({size:.0f} MB) in pieces: {peak_memory_mb(long):.0f} MB")
            long.unlink()


if __name__ == "__main__":
    main()
