"""How far results of the filter move with each of its thresholds: ``python tests/studies/thresholds.py m8t f9p japan``.

Every number of `railfix.kernels.tracking.constants` and of `TrackingLimits` is halved and doubled (probabilities: a
tenth and ten times). Constants are compiled in: what runs here is a copy of the package that reads them from a library
of one C function (``cc`` is needed). The filter's measurements are computed once a recording. Each line has the changes
of the error's median and 95th percentile [m], of the epochs with a level on the ground and with the status `tracking`
[% of all], of the level's median [m], and how many epochs are over their level, largest change over the recordings.

``--length`` takes so many epochs of each. ``--faults`` takes every fault of `belief_campaign.faults` in a window of
120 s of each recording instead, and ``--only NAME ...`` some of the thresholds.
"""

from __future__ import annotations

import argparse
import ctypes
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import paths

LIBRARY = "double values[1000]; double value(long number) { return values[number]; }"
LOADED = """
import ctypes
_library = ctypes.CDLL({path!r})
value = _library.value
value.restype, value.argtypes = ctypes.c_double, [ctypes.c_long]
NAMES = {names!r}
_array = (ctypes.c_double * 1000).in_dll(_library, "values")
for _number, _name in enumerate(NAMES):
    _array[_number] = globals()[_name]
"""


def write_copy(folder: Path) -> None:
    """Write a copy of the package whose constants of the filter are read when it runs."""
    source, own = paths.ROOT / "src" / "railfix", folder / "railfix"
    shutil.copytree(source, own)
    (folder / "values.c").write_text(LIBRARY)
    library = folder / "values.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O2", "-o", library, folder / "values.c"], check=True)
    constants = own / "kernels" / "tracking" / "constants.py"
    text = constants.read_text(encoding="utf-8")
    names = re.findall(r"^([A-Z]\w+): Final = ", text, re.MULTILINE)
    scope: dict[str, Any] = {}
    exec(compile(text, str(constants), "exec"), scope)
    constants.write_text(text + LOADED.format(path=str(library), names=names), encoding="utf-8")

    def read_now(match: re.Match[str]) -> str:
        name = match.group(1)
        read = f"constants.value({names.index(name)})"
        return f"int({read})" if isinstance(scope[name], int) else read

    for path in [*(own / "kernels" / "tracking").glob("*.py"), *(own / "tracking").glob("*.py")]:
        if path != constants:
            path.write_text(re.sub(r"\bconstants\.([A-Z]\w+)", read_now, path.read_text(encoding="utf-8")), "utf-8")


@dataclass
class Trial:
    """A case, and the arguments of the filter with its levels."""

    case: Any
    given: tuple[Any, ...]


def prepare(case: Any) -> Trial:
    """Run the pipeline up to the filter."""
    from belief_campaign import make_processor, parse_config
    from railfix.pipeline import along_track

    given: list[Any] = []
    plain = along_track.track_with_levels

    def keep(*arguments: Any) -> Any:
        given.append(arguments)
        return plain(*arguments)

    along_track.track_with_levels = keep
    processor = make_processor(parse_config({"filter": "track"}), case.navigation, {"front": case.trajectory})
    processor.process({"front": case.observations})
    along_track.track_with_levels = plain
    return Trial(case, given[0])


def score(trials: list[Trial], change: dict[str, float]) -> np.ndarray:
    """Return median and 95th percentile of the error, shares of levels and of `tracking`, median level, epochs over."""
    from belief_campaign import joined, judged
    from railfix.tracking.bank import budget
    from railfix.tracking.levels import track_with_levels
    from railfix.tracking.packing import pack_parameters

    pack_parameters.cache_clear()
    budget.cache_clear()
    parts = []
    for trial in trials:
        epochs, line, state, levels, limits, sensors = trial.given
        limits = limits.replaced(**change) if change else limits
        parts.append(judged(trial.case, track_with_levels(epochs, line, state, levels, limits, sensors)[0]))
    found = joined(parts)
    error, level = found.straight_m[np.isfinite(found.straight_m)], found.ground_level_m
    return np.array([
        *np.percentile(error, [50, 95]), 100.0 * np.isfinite(level).mean(), 100.0 * found.tracking.mean(),
        np.median(level[np.isfinite(level)]), found.over_ground.sum(),
    ])  # fmt: skip


def variations(names: list[str]) -> dict[str, tuple[float, tuple[float, float]]]:
    """Return the value of each threshold, and the two that are tried."""
    from railfix.kernels.tracking import constants
    from railfix.tracking import TrackingLimits

    values = {name: getattr(constants, name) for name in constants.NAMES}
    values |= {name: value for name, value in dict(TrackingLimits()).items() if not isinstance(value, str)}
    small = ("PROBABILITY", "FLOOR", "prior", "risk")
    found = {}
    for name, value in values.items():
        factor = 10.0 if any(word in name for word in small) and value < 0.1 else 2.0
        pair = tuple(type(value)(each) for each in (value / factor, value * factor))
        found[name] = (value, pair)
    return {name: found[name] for name in names or found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--length", type=int)
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--only", nargs="+", default=[])
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        write_copy(Path(folder))
        sys.path.insert(0, folder)
        import belief_campaign
        from railfix.core.errors import RailfixError
        from railfix.kernels.tracking import constants

        array = (ctypes.c_double * 1000).in_dll(constants._library, "values")
        groups: dict[str, list[Trial]] = {}
        for name in args.recordings:
            case = belief_campaign.cases(paths.DATA)[name]()
            if args.faults:
                along, _ = belief_campaign.sights(case)
                first = len(case.observations) // 2
                part = case.part(first, first + 120)
                listed = belief_campaign.faults(part, along[first : first + 120], np.random.default_rng(7))
                groups[name] = [prepare(faulty) for _, faulty in listed]
            else:
                groups[name] = [prepare(case.part(0, args.length or len(case.observations)))]
        usual = {name: score(trials, {}) for name, trials in groups.items()}
        for name, row in usual.items():
            print(f"{name}: {len(groups[name])} trials,", np.round(row, 2).tolist(), flush=True)
        for name, (value, pair) in variations(args.only).items():
            shown = []
            for other in pair:
                number = constants.NAMES.index(name) if name in constants.NAMES else None
                if number is not None:
                    array[number] = other
                try:
                    change = {} if number is not None else {name: other}
                    rows = np.array([score(trials, change) - usual[group] for group, trials in groups.items()])
                    worst = rows[np.abs(rows).argmax(axis=0), np.arange(rows.shape[1])]
                    moved = "nothing" if not rows.any() else " ".join(f"{x:+.2f}" for x in worst)
                except (RailfixError, ArithmeticError) as error:  # a value that is out of range
                    moved = str(error).splitlines()[0]
                if number is not None:
                    array[number] = value
                shown.append(f"{other:g}: {moved}")
            print(f"{name} {value:g} | {' | '.join(shown)}", flush=True)


if __name__ == "__main__":
    main()
