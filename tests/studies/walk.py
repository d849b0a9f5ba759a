"""Walk of one pseudorange from its log to the tables: ``python tests/studies/walk.py [off|track]``.

Three seconds of the demonstration are run. Printed are the functions of the package that are given the pseudorange, as
observed or corrected, up to the position and after it (results and tables), those among them that also return it, and
the classes whose instances hold it. Properties and special methods, which read a field or make an object, are apart.
"""

from __future__ import annotations

import sys
import tempfile
import threading
from datetime import datetime, timedelta
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

import railfix
from railfix.pipeline import processor
from railfix.pipeline.config import Config
from railfix.run import driver
from railfix.run.inputs import RunInputs, RunOptions
from railfix.simulate.demonstration import demo_files

SOURCE = str(Path(railfix.__file__).parent)
#: The first function that is called with the positions.
AFTER = "pipeline/results.antenna_results"
#: Epoch of the pseudorange, and how far nested containers are searched.
EPOCH, DEPTH = 5, 6


class Walk:
    """Functions and classes that have held one of some numbers."""

    def __init__(self, numbers: set[float]) -> None:
        self.numbers = np.array(sorted(numbers))
        self.given: dict[str, None] = {}
        self.fields: dict[str, None] = {}
        self.passed: dict[str, None] = {}
        self.classes: dict[str, None] = {}

    def holds(self, value: Any, depth: int = 0) -> bool:
        """Whether a value, or what it contains, has one of the numbers; classes of the package that do are kept."""
        if isinstance(value, np.ndarray):
            return value.dtype.kind == "f" and any(bool((np.abs(value - n) < 1e-6).any()) for n in self.numbers)
        if depth > DEPTH or isinstance(value, type):
            return False
        own = type(value).__module__.startswith("railfix")
        inside = value.__dict__ if own and hasattr(value, "__dict__") else value
        parts = [*inside.values()] if isinstance(inside, dict) else inside if isinstance(inside, (list, tuple)) else ()
        found = sum([self.holds(part, depth + 1) for part in parts]) > 0  # all of them: classes are kept
        if found and own:
            self.classes[type(value).__qualname__] = None
        return found

    def profile(self, frame: FrameType, event: str, result: Any) -> None:
        """Look at the arguments of a call, or at its result."""
        code = frame.f_code
        if not code.co_filename.startswith(SOURCE) or code.co_name.startswith("<") or code.co_name == "__init__":
            return
        name = f"{code.co_filename[len(SOURCE) + 1 : -3]}.{code.co_qualname}"
        if event == "call" and name not in self.given and name not in self.fields:
            names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
            if sum([self.holds(frame.f_locals.get(each)) for each in names]):
                (self.fields if is_field(frame) else self.given)[name] = None
        elif event == "return" and name in self.given and name not in self.passed and self.holds(result):
            self.passed[name] = None


def is_field(frame: FrameType) -> bool:
    """Whether a property or a special method is called."""
    own = getattr(type(frame.f_locals.get("self")), frame.f_code.co_name, None)
    return isinstance(own, (property, cached_property)) or frame.f_code.co_name.startswith("__")


def run(settings: Config) -> None:
    """Run the first three seconds of the demonstration."""
    files = demo_files()
    inputs = RunInputs(
        front=(files["front"],), rear=(files["rear"],), nav=(files["nav"],), track=(files["track"],),
        vehicle=files["vehicle"],
    )  # fmt: skip
    begin = railfix.read_observations(files["front"]).time[0].astype("datetime64[us]").astype(datetime)
    with tempfile.TemporaryDirectory() as folder:
        driver.run_files(
            inputs, settings, out=Path(folder) / "run", options=RunOptions(end=begin + timedelta(seconds=3))
        )


def numbers(settings: Config) -> set[float]:
    """The pseudorange as it was observed, with the satellite's clock, and corrected."""
    found: set[float] = set()
    correct = processor.correct_ranges

    def correct_ranges(obs: Any, channels: Any, *others: Any, **named: Any) -> Any:
        ranges, near = correct(obs, channels, *others, **named)
        states, at = ranges.satellites, (EPOCH, int(np.flatnonzero(ranges.reason[EPOCH] == 0)[-1]))
        code = float(ranges.code_m[at])
        found.update((code, float(code + states.clock_m[at] - states.group_delay_m[at])))
        found.add(float(ranges.corrected_code_m[at]))
        return ranges, near

    processor.correct_ranges = correct_ranges  # type: ignore[assignment]
    run(settings)
    processor.correct_ranges = correct
    return found


def main() -> None:
    """Print the walk."""
    settings = Config(filter=sys.argv[1] if len(sys.argv) > 1 else "track")
    walk = Walk(numbers(settings))
    threading.setprofile(walk.profile)
    sys.setprofile(walk.profile)
    run(settings)
    sys.setprofile(None)
    threading.setprofile(None)
    given = list(walk.given)
    position = given.index(AFTER)
    for title, names in (
        ("given it up to the position", given[:position]),
        ("given it after the position", given[position:]),
        ("properties and special methods that are given it", walk.fields),
        ("return it", walk.passed),
        ("classes", walk.classes),
    ):
        print(f"{title}: {len(names)}", *names, sep="\n  ")


if __name__ == "__main__":
    main()
