"""Stated probability of places against their frequency: ``python tests/studies/posterior_score.py``.

Cold starts every 20 s on the course of each recording. A place is right where its arc length is that of the vehicle, so
that another lap of the same road, or the other direction of it, counts as another branch although it lies within the
error of the map. Places more than 50 m off on the map are wrong places. Starts 20 s apart share epochs: they are
fewer independent trials than their number.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import beta

import paths
import filter_score
from railfix.core.timescale import seconds
from railfix.track.trajectory import Trajectory

#: Seconds after the start at which places are judged.
AFTER_S = (0, 10, 60, 120)
#: A place this far from the vehicle's, or four sigmas, is another branch; and this far on the map a wrong place [m].
ANOTHER_M = 40.0
WRONG_M = 50.0
#: Beyond this the vehicle's place is not where its speed allows: it is sought further on [m].
_OFF_M = 10.0
#: Edges of the classes of stated probability.
CLASSES = (0.0, 0.5, 0.9, 0.99, 1.0 + 1e-12)


@dataclass(frozen=True)
class Judged:
    """Places some time after cold starts."""

    after_s: int
    probability: np.ndarray
    right: np.ndarray
    wrong: np.ndarray


def bounds(right: int, count: int, *, risk: float = 0.05) -> tuple[float, float]:
    """Frequencies that are consistent with so many successes (Clopper and Pearson, 1934)."""
    low = float(beta.ppf(0.5 * risk, right, count - right + 1)) if right else 0.0
    high = float(beta.ppf(1.0 - 0.5 * risk, right + 1, count - right)) if right < count else 1.0
    return low, high


def arc_of(reference: np.ndarray, time_s: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    """Arc length of the vehicle, lap by lap: the nearest place not far from that of the epoch before."""
    points, arc = np.asarray(trajectory.ecef_m), np.asarray(trajectory.arc_m)
    found = np.full(len(reference), np.nan)
    near, last = 0.0, time_s[0]
    for k, place in enumerate(reference):
        if not np.isfinite(place[0]):
            continue
        window = (arc >= near - 15.0) & (arc <= near + 15.0 + 25.0 * max(time_s[k] - last, 1.0))
        distance = np.linalg.norm(points - place, axis=1)
        if distance[window].min() > _OFF_M:
            window = arc >= near - 15.0
        index = np.flatnonzero(window)
        best = index[np.argmin(distance[index])]
        segment = min(best, len(arc) - 2)
        along = float((place - points[segment]) @ np.asarray(trajectory.tangent)[segment])
        near = found[k] = float(np.clip(arc[segment] + along, arc[0], arc[-1]))
        last = time_s[k]
    return found


def judged(case: filter_score.Case, *, every_s: float = 20.0) -> list[Judged]:
    """Places after cold starts every so many seconds."""
    t = seconds(case.epochs.time - case.epochs.time[0])
    truth = arc_of(case.reference, t, case.trajectory)
    rows: dict[int, list[tuple[float, bool, bool]]] = {after: [] for after in AFTER_S}
    for begin in np.arange(0.0, t[-1] - 30.0, every_s):
        first, end = (int(k) for k in np.searchsorted(t, [begin, begin + AFTER_S[-1] + 1.0]))
        if end - first < 10:
            continue
        found = case.part(first, end).run()
        error = case.part(first, end).error(found)
        started = np.flatnonzero(np.isfinite(found.arc_m))
        if not len(started):
            continue
        for after in AFTER_S:
            at = int(np.searchsorted(t[first:end], t[first + started[0]] + after))
            if at < len(found) and np.isfinite(found.arc_m[at]) and np.isfinite(truth[first + at]):
                away = abs(found.arc_m[at] - truth[first + at])
                right = away < max(ANOTHER_M, 4.0 * found.sigma_m[at])
                rows[after].append((float(found.probability[at]), bool(right), bool(error[at] > WRONG_M)))
    return [Judged(after, *(np.array([row[k] for row in listed]) for k in range(3))) for after, listed in rows.items()]


def lines_of(name: str, parts: Iterable[Judged]) -> list[str]:
    """A line for each class of stated probability: stated, found, its bounds."""
    parts = list(parts)
    lines = [
        f"{name}: wrong places " + ", ".join(f"{p.after_s} s {int(p.wrong.sum())} of {len(p.wrong)}" for p in parts)
    ]
    probability = np.concatenate([p.probability for p in parts])
    right = np.concatenate([p.right for p in parts]).astype(bool)
    for low, high in pairwise(CLASSES):
        mine = (probability >= low) & (probability < high)
        if mine.any():
            count, hits = int(mine.sum()), int(right[mine].sum())
            least, most = bounds(hits, count)
            stated = float(probability[mine].mean())
            verdict = "within" if least <= stated <= most else ("too sure" if stated > most else "too careful")
            lines.append(
                f"{name}: stated {low:.2f} to {min(high, 1.0):.2f}, mean {stated:.3f}; right {hits} of {count} = "
                f"{hits / count:.3f} ({least:.3f} to {most:.3f}): {verdict}"
            )
    return lines


def main() -> int:
    data = paths.DATA
    if not data.is_dir():
        print(f"the real recordings are not at {data}", file=sys.stderr)
        return 1
    everything: dict[int, list[Judged]] = {after: [] for after in AFTER_S}
    for case in filter_score.cases(data):
        parts = judged(case)
        for part in parts:
            everything[part.after_s].append(part)
        print("\n".join(lines_of(case.name, parts)), flush=True)
    for after, parts in everything.items():
        print("\n".join(lines_of(f"all, after {after} s", parts)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
