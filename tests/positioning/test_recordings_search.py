"""Section search and constrained position on every epoch of the recordings and of the demonstration.

The ranges are those that the pipeline itself hands to `search` and `position_on_line`. A sample of the
epochs in the usual run; all with ``-m slow`` (``-s`` prints the counts).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

import recordings_score
import synthetic
from exhaustive_search import exhaustive_search
from pipeline_cases import demo_observations, processor
from railfix.core.epoch_rows import take_epochs
from railfix.positioning import approximate, line_fix, normal_equations, section_search
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.normal_equations import Constrained, SinglePoint
from railfix.positioning.range_arrays import UNTIED_M, Ranges
from railfix.positioning.section_search import Section
from railfix.track.trajectory import Trajectory

#: Points times channels looked at together, to keep the exhaustive search in memory.
BLOCK = 64


@dataclass
class Calls:
    """What went into the two stages, and what came out."""

    searches: list[tuple[Ranges, Trajectory, Section]] = field(default_factory=list)
    positions: list[tuple[Ranges, Trajectory, Constrained]] = field(default_factory=list)


@pytest.fixture
def calls(monkeypatch) -> Calls:
    found = Calls()

    def find_section(ranges: Ranges, line: Line, point: SinglePoint, **limits) -> Section:
        result = section_search.find_section(ranges, line, point, **limits)
        for trajectory, rows in AntennaRows.on(line).lines:
            found.searches.append((take_epochs(ranges, rows), trajectory, take_epochs(result, rows)))
        return result

    def position_on_line(ranges: Ranges, line: Line, vertex: np.ndarray, **limits) -> Constrained:
        result = normal_equations.position_on_line(ranges, line, vertex, **limits)
        for trajectory, rows in AntennaRows.on(line).lines:
            found.positions.append((take_epochs(ranges, rows), trajectory, take_epochs(result, rows)))
        return result

    for module in (line_fix, approximate, recordings_score):
        monkeypatch.setattr(module, "find_section", find_section)
    for module in (line_fix, recordings_score):
        monkeypatch.setattr(module, "position_on_line", position_on_line)
    return found


def run_demo(_: Path) -> None:
    """Both antennas, every screen on."""
    processor().process(demo_observations())


def run_demo_with_three(_: Path) -> None:
    """Three satellites: no 3-D position, so coarse to fine."""
    few = {}
    for name, whole in demo_observations().items():
        mean = np.nanmean(whole.cn0_dbhz, axis=0)
        keep = np.zeros(len(whole.satellite), dtype=bool)
        keep[[i for i in np.argsort(-mean) if whole.satellite[i][0] == "G"][:3]] = True
        few[name] = replace(whole, code_m=np.where(keep, whole.code_m, np.nan))
    processor().process(few)


def run_geonet(recordings: Path) -> None:
    for station in ("0759", "3040"):
        for azimuth in (0, 45, 90, 135):
            recordings_score.geonet(recordings, station, azimuth)


RUNS: dict[str, Callable[[Path], object]] = {
    **recordings_score.RECORDINGS,
    "geonet": run_geonet,
    "demo": run_demo,
    "demo with three satellites": run_demo_with_three,
}


def sampled(count: int, at_most: int | None, seed: int) -> np.ndarray:
    if at_most is None or count <= at_most:
        return np.arange(count)
    return np.sort(np.random.default_rng(seed).choice(count, at_most, replace=False))


def compare_searches(calls: Calls, at_most: int | None) -> tuple[int, int]:
    """Epochs compared, and those where a point of the same q was picked."""
    compared = ties = 0
    for ranges, trajectory, found in calls.searches:
        pick = sampled(len(ranges), at_most, 3)
        for part in np.array_split(pick, max(1, len(pick) // BLOCK)):
            some = ranges.take(part)
            vertex, q = exhaustive_search(some, trajectory)
            other = np.flatnonzero(found.vertex[part] != vertex)
            for t in other:
                # Two points that fit equally well to the rounding of a range: 1e-8 m of 2e7 m.
                picked = found.vertex[part][t]
                assert picked >= 0
                scale = np.sqrt(q[t, vertex[t]] * some.weight[t].sum()) * 1e-7
                assert q[t, picked] - q[t, vertex[t]] <= scale
            has = vertex >= 0
            least = q[np.arange(len(part)), np.maximum(vertex, 0)][has]
            assert found.q[part][has] == pytest.approx(least, rel=1e-3, abs=1e-3)
            compared += int(has.sum())
            ties += len(other)
    return compared, ties


def optimum(ranges: Ranges, t: int, line: Trajectory, at: int, arc: float) -> float:
    """Distance along one section by a general optimiser: clocks, their offsets and the map error as unknowns.

    An offset between clocks is an observation of its own: clock less offset less a common clock, with its sigma.
    """
    used = ranges.weight[t] > 0
    clocks = np.zeros((len(used), len(ranges.groups)))
    for g, group in enumerate(ranges.groups):
        clocks[group, g] = 1.0
    seen = clocks[used].any(axis=0)
    clocks = clocks[used][:, seen]
    root, sat, code = np.sqrt(ranges.weight[t][used]), ranges.sat_ecef_m[t][used], ranges.code_m[t][used]
    first, tangent, across, up = line.ecef_m[at], line.tangent[at], line.across[at], line.up[at]
    start = line.arc_m[at]
    ties = None
    if ranges.ties is not None:
        offset, sigma = ranges.ties.offset_m[t][seen], ranges.ties.sigma_m[t][seen]
        known = sigma < UNTIED_M
        if known.sum() > 1:
            # A clock of sigma 0 is the common one itself, to a tenth of a millimetre.
            ties = (known, offset[known], np.maximum(sigma[known], 1e-4))
    count = clocks.shape[1]

    def residual(x: np.ndarray) -> np.ndarray:
        place = first + (x[0] - start) * tangent + x[1] * across + x[2] * up
        fitted = (code - synthetic.travelled_range(sat, place) - clocks @ x[3 : 3 + count]) * root
        rest = [x[1] / line.sigma_plan_m, x[2] / line.sigma_height_m]
        if ties is not None:
            rest.extend((x[3 : 3 + count][ties[0]] - ties[1] - x[-1]) / ties[2])
        return np.concatenate([fitted, rest])

    size = 3 + count + (ties is not None)
    half = 0.5 * np.eye(size)

    def jacobian(x: np.ndarray) -> np.ndarray:
        return np.stack([residual(x + e) - residual(x - e) for e in half], axis=1)

    initial = np.zeros(size)
    initial[0] = arc + 0.7
    base = code - synthetic.travelled_range(sat, first)
    initial[3:] = np.median(base)
    found = least_squares(residual, initial, jac=jacobian, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return float(found.x[0])


def compare_positions(calls: Calls, at_most: int | None) -> tuple[int, float]:
    """Epochs that settled inside a section, and the largest difference [m]."""
    compared, worst = 0, 0.0
    for ranges, line, found in calls.positions:
        at = np.maximum(found.section, 0)
        along = found.arc_m - line.arc_m[at]
        # A position clamped to a point where two sections meet, or to an end, is no optimum of either.
        inside = (found.section >= 0) & (along > 1e-6) & (along < line.length_m[at] - 1e-6) & (found.dilution < 20.0)
        epochs = np.flatnonzero(inside)
        for t in epochs[sampled(len(epochs), at_most, 4)]:
            difference = abs(optimum(ranges, t, line, int(found.section[t]), found.arc_m[t]) - found.arc_m[t])
            assert difference < 1e-3, (t, difference)
            compared, worst = compared + 1, max(worst, difference)
    return compared, worst


@pytest.mark.requirement("A3")
@pytest.mark.parametrize("name", RUNS)
@pytest.mark.every(5)
def test_search_equals_exhaustive_search(recordings: Path, calls: Calls, name: str):
    RUNS[name](recordings)
    compared, ties = compare_searches(calls, 150)
    assert compared >= 100
    assert ties == 0


@pytest.mark.requirement("A3")
@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_search_equals_exhaustive_search_on_every_epoch(recordings: Path, calls: Calls, name: str):
    RUNS[name](recordings)
    compared, ties = compare_searches(calls, None)
    print(f"{name}: section search equals exhaustive search on {compared} epochs, {ties} of them equally good points")
    assert compared > 0


@pytest.mark.requirement("A4")
@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_position_equals_a_general_optimiser_on_every_epoch(recordings: Path, calls: Calls, name: str):
    RUNS[name](recordings)
    compared, worst = compare_positions(calls, None)
    print(f"{name}: constrained position equals the optimiser on {compared} epochs, at most {1e3 * worst:.3f} mm apart")
    assert compared > 0
