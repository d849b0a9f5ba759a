"""An SBAS message that arrives at a live session after two hours of one a second: milliseconds until its corrections.

The recorded hour of `../shared/data/sbas/msas_20250215`, twice::

    python tests/benchmarks/bench_sbas.py
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from railfix.ranges.sbas import SbasMessages, SbasState, read_sbas

HOUR = Path(__file__).parents[3] / "shared" / "data" / "sbas" / "msas_20250215" / "046r_sbas_prn137.txt"
ARRIVALS = 100


def arrivals(log: SbasMessages) -> tuple[list[float], int]:
    """Milliseconds of the last messages of a log, and how many are kept at its end."""
    state = SbasState(prn=137).add_messages(log.take(np.arange(len(log) - ARRIVALS)))
    took_ms = []
    for row in range(len(log) - ARRIVALS, len(log)):
        message = log.take(np.array([row]))
        began = time.perf_counter()
        state = state.add_messages(message).drop_before(message.time[0])
        _ = state.corrections
        took_ms.append(1e3 * (time.perf_counter() - began))
    return took_ms, len(state.messages)


def main() -> None:
    """Print median and largest."""
    hour = read_sbas(HOUR)
    took_ms, kept = arrivals(replace(hour, time=hour.time - np.timedelta64(3600, "s")).merge(hour))
    print(f"median {np.median(took_ms):.1f} ms, largest {max(took_ms):.1f} ms, {kept} messages kept")


if __name__ == "__main__":
    main()
