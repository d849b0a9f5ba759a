"""Events against the interlocking: ``python tests/studies/ground_sequences.py [--events 4] [--random 100000]``.

All sequences of so many events of trains after each other, toward each other, and of three (`explored_line`), each
world once; and random sequences of forty steps (`attacked_line`), and of 120 with hauled, divided and joined trains,
vehicles that report nothing and older copies of the database (`changed_line`). Printed: their numbers, and violations.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import paths  # noqa: F401
from attacked_line import AttackedLine, run_sequence
from changed_line import ChangedLine
from explored_line import explore
from test_ground_explored import PLACES, running


def run_random(first: int, most: int, seconds: float, *, steps: int, kind: type[AttackedLine]) -> bool:
    """Print what random sequences do; return whether one has violated a promise."""
    busy = time.process_time()
    violations, seen, end, count = Counter[str](), Counter[str](), time.monotonic() + seconds, 0
    while count < most and time.monotonic() < end:
        line = run_sequence(first + count, steps=steps, kind=kind)
        violations += line.violations
        if line.violations:
            print(f"seed {first + count}: {dict(line.violations)}", flush=True)
        seen += line.seen
        count += 1
    print(
        f"{kind.__name__}: {count} random sequences of {steps} steps from seed {first} on, "
        f"{time.process_time() - busy:.0f} s of the processor, violations: {dict(violations) or 'none'}; {dict(seen)}",
        flush=True,
    )
    return bool(violations)


def main() -> None:
    """Print a line a kind."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=int, default=4)
    parser.add_argument("--random", type=int, default=100_000)
    parser.add_argument("--changed", type=int, default=20_000, help="sequences of 120 steps with changes of trains")
    parser.add_argument("--first", type=int, default=0, help="seed of the first random one: goes on after a part")
    parser.add_argument("--seconds", type=float, default=36_000.0, help="end the random ones after this time")
    given = parser.parse_args()
    violated = False
    for name in PLACES if given.events else ():
        worlds, sequence = explore(running(name), given.events)
        print(f"{name}: {worlds} worlds of up to {given.events} events, {sequence or 'no violation'}", flush=True)
        violated |= sequence is not None
    for count, steps, kind in ((given.random, 40, AttackedLine), (given.changed, 120, ChangedLine)):
        violated |= run_random(given.first, count, given.seconds, steps=steps, kind=kind)
    raise SystemExit(int(violated))


if __name__ == "__main__":
    main()
