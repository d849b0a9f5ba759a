"""Events against the interlocking: ``python tests/studies/ground_sequences.py [--events 4] [--random 100000]``.

All sequences of so many events of trains after each other, toward each other, and of three (`explored_line`), each
world once; and random sequences of forty steps (`attacked_line`). Printed: their numbers, and violations.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import paths  # noqa: F401
from attacked_line import run_sequence
from explored_line import explore
from test_ground_explored import PLACES, running


def main() -> None:
    """Print a line a kind."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=int, default=4)
    parser.add_argument("--random", type=int, default=100_000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first random one: goes on after a part")
    parser.add_argument("--seconds", type=float, default=36_000.0, help="end the random ones after this time")
    given = parser.parse_args()
    violated = False
    for name in PLACES if given.events else ():
        worlds, sequence = explore(running(name), given.events)
        print(f"{name}: {worlds} worlds of up to {given.events} events, {sequence or 'no violation'}", flush=True)
        violated |= sequence is not None
    busy = time.process_time()
    violations, seen, end, count = Counter[str](), Counter[str](), time.monotonic() + given.seconds, 0
    while count < given.random and time.monotonic() < end:
        line = run_sequence(given.first + count)
        violations += line.violations
        if line.violations:
            print(f"seed {given.first + count}: {dict(line.violations)}", flush=True)
        seen += line.seen
        count += 1
    print(
        f"{count} random sequences from seed {given.first} on, {time.process_time() - busy:.0f} s of the processor, "
        f"violations: {dict(violations) or 'none'}; {dict(seen)}"
    )
    raise SystemExit(int(violated or bool(violations)))


if __name__ == "__main__":
    main()
