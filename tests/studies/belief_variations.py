"""Cold starts with less than a recording has, or on another map of it: what the filter states against what is true.

``python tests/studies/belief_variations.py [FOLDER ...] [--kinds window half-sky] [--every 40] [--verbose]``,
recordings as in `belief_campaign`. Kinds: `window`, a map of the way of the minute before the start to the minute after
the end, on which no course comes back; `reverse`, the map from its end to its beginning; `gps`, one constellation;
`half-sky`, every 30 s another random half of the satellites; `outages`, 10 s of 40 s without any; `no-doppler`,
`no-phase`, `no-cn0`; `wander`, a map drawn to 2 m, and stated so. Several with a plus: ``window+half-sky``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Final

import numpy as np

import paths
import recordings_score
from belief_campaign import HEAD, Case, case_of_folder, cases, counts, first_of, joined, roughened, run, starts
from posterior_score import arc_of
from railfix.core.timescale import seconds
from railfix.track import Track
from railfix.track.trajectory import Trajectory

#: A part of a recording, changed; the whole recording is given first.
Variation = Callable[[Case, Case], Case]
_MINUTE: Final = np.timedelta64(60, "s")


def without(case: Case, gone: np.ndarray, names: tuple[str, ...] = ("code_m", "phase_cycles", "doppler_hz")) -> Case:
    """A case without some observations."""
    observations = case.observations
    left = {name: np.where(gone, np.nan, getattr(observations, name)) for name in names}
    return replace(case, observations=replace(observations, **left))


def since_start(case: Case) -> np.ndarray:
    return seconds(case.observations.time - case.observations.time[0])


def window(whole: Case, part: Case) -> Case:
    time, own = whole.observations.time, part.observations.time
    near = (time >= own[0] - _MINUTE) & (time <= own[-1] + _MINUTE) & np.isfinite(whole.reference_ecef_m[:, 0])
    line = recordings_score.trajectory_of(time[near], whole.reference_ecef_m[near])
    arc, known = np.full(len(own), np.nan), np.isfinite(part.reference_ecef_m[:, 0])
    arc[known] = arc_of(part.reference_ecef_m[known], since_start(part)[known], line)
    return replace(part, trajectory=line, reference_arc_m=arc)


def reverse(_: Case, part: Case) -> Case:
    old = part.trajectory
    new = Trajectory.from_antenna_path(Track.from_ecef(np.asarray(old.ecef_m)[::-1]))
    arc = np.interp(part.reference_arc_m, np.asarray(old.arc_m), np.asarray(new.arc_m)[::-1])
    return replace(part, trajectory=new, reference_arc_m=arc)


def gps(_: Case, part: Case) -> Case:
    return without(part, ~np.char.startswith(part.observations.satellite.astype(str), "G")[None, :])


def half_sky(_: Case, part: Case) -> Case:
    random, satellite = np.random.default_rng(1), part.observations.satellite
    names, block = np.unique(satellite), (since_start(part) // 30.0).astype(int)
    kept = random.random((block[-1] + 1, len(names))) < 0.5
    return without(part, ~kept[block][:, np.searchsorted(names, satellite)])


def outages(_: Case, part: Case) -> Case:
    return without(part, (since_start(part) % 40.0 >= 30.0)[:, None])


KINDS: Final[dict[str, Variation]] = {
    "window": window,
    "reverse": reverse,
    "gps": gps,
    "half-sky": half_sky,
    "outages": outages,
    "no-doppler": lambda _, part: without(part, np.True_, ("doppler_hz",)),
    "no-phase": lambda _, part: without(part, np.True_, ("phase_cycles",)),
    "no-cn0": lambda _, part: without(part, np.True_, ("cn0_dbhz",)),
    "wander": lambda _, part: roughened(part, 2.0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", help="folders with a case.toml, or names of recordings")
    parser.add_argument("--kinds", nargs="*", default=[k if k == "window" else f"window+{k}" for k in KINDS])
    parser.add_argument("--every", type=float, default=40.0)
    parser.add_argument("--length", type=float, default=150.0)
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    known = cases(paths.DATA) if paths.DATA.is_dir() else {}
    print(HEAD)
    for name in given.folders or list(known):
        whole = known[name]() if name in known else case_of_folder(Path(name))
        for kind in given.kinds:
            parts, failed = [], 0
            for begin, part in starts(whole, given.every, given.length):
                found = run(reduce(lambda case, one: KINDS[one](whole, case), kind.split("+"), part), {})
                bad = found.over | found.over_chainage
                parts.append(found)
                failed += bool(bad.any())
                if given.verbose and (bad | found.sure_and_wrong).any():
                    print(f"    start {begin:.0f} s: {first_of(found, bad | found.sure_and_wrong)}", flush=True)
            print(counts(f"{whole.name} {kind}", joined(parts), trials=len(parts), failed=failed), flush=True)


if __name__ == "__main__":
    main()
