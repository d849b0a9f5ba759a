"""Faults of several kinds at a time: errors over the level go undetected no more often than the risk allows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import raim_cases
import raim_oracle as oracle
from railfix.core.geodesy import range_with_rotation
from railfix.integrity.protection import RiskBudget, protection_level, risk
from railfix.integrity.protection.solution_separation import MapDeviation
from railfix.integrity.raim import linear_model
from railfix.positioning.range_arrays import Ranges

pytestmark = pytest.mark.requirement("C2")

EPOCHS = 80
#: Movements of the position, over the sigma of its distance from that without the faults.
SIZES = (3.5, 5.0)
#: Priors so large that each hypothesis below is likelier than the risk by itself: 1e-5.
RISK = RiskBudget(
    risk_per_hour=1e-5,
    samples_per_hour=1.0,
    exclusion_share=0.0,
    false_alarm=0.01,
    satellite_prior=dict.fromkeys("GEC", 0.02),
    local_prior=0.0,
    map_prior=0.05,
    side_prior=0.05,
    constellation_prior={"E": 0.02, "C": 0.02},
)
SIDE = (0, 1, 4, 8)
FEW, MANY = "GGGEEEEECCCC", "GGGGEEEECCCC"
#: Satellites, those that are faulty, whether the map is wrong, and the probability of just these faults.
CASES = {
    "map and two": (MANY, (1, 9), True, 0.05 * 0.02**2),
    "map and a constellation": (FEW, (3, 4, 5, 6, 7), True, 0.05 * 0.02),
    "map and a side with one": (FEW, (*SIDE, 5), True, 0.05 * 0.05 * 0.02),
    "a side and two": (FEW, (*SIDE, 5, 9), False, 0.05 * 0.02**2),
    "a constellation and two": (FEW, (3, 4, 5, 6, 7, 1, 9), False, 0.02**3),
    "a constellation and a side": (FEW, (0, 1, 3, 4, 5, 6, 7, 8), False, 0.02 * 0.05),
    "three": (MANY, (1, 5, 9), False, 0.02**3),
}


def hidden(ranges: Ranges, systems: str, arc: np.ndarray, members: tuple[int, ...], *, wrong_map: bool) -> np.ndarray:
    """Faults that move the position by one sigma of its distance from that without them and show least, (T, M + 2).

    Of the ranges and, across and up, of the map [m].
    """
    faults = np.zeros((len(arc), len(systems) + 2))
    rows = [*members, *((len(systems), len(systems) + 1) if wrong_map else ())]
    for t in range(len(arc)):
        case = oracle.problem_on_line(ranges, t, arc[t], raim_cases.LINE)
        inverse = np.linalg.pinv(case.design, rcond=1e-12)
        projector, gain = np.eye(len(case.observed)) - case.design @ inverse, inverse[0] * case.scale_of[0]
        own = np.linalg.pinv(projector[np.ix_(rows, rows)], rcond=1e-9, hermitian=True) @ gain[rows]
        faults[t, rows] = own / np.sqrt(own @ gain[rows])
    return faults * np.concatenate([case.sigma_m, [raim_cases.LINE.sigma_plan_m, raim_cases.LINE.sigma_height_m]])


def exceeded(systems: str, members: tuple[int, ...], *, wrong_map: bool) -> float:
    """Share of epochs with an error over the level and no separation over its threshold, at the worst of some sizes."""
    arc, rng = np.linspace(100.0, 1900.0, EPOCHS), np.random.default_rng(5)
    ranges = raim_cases.made(arc, systems, seed=7, sigma_m=np.linspace(0.7, 2.5, len(systems)))
    _, los = range_with_rotation(ranges.sat_ecef_m, raim_cases.LINE.at_arc(arc)[:, None, :])
    section = raim_cases.LINE.segment_at(arc)[0]
    axes = np.stack([raim_cases.LINE.across[section], raim_cases.LINE.up[section]], axis=1)
    faults = hidden(ranges, systems, arc, members, wrong_map=wrong_map)
    sigma, drawn = np.array([1.0, 2.0]), rng.normal(size=(EPOCHS, 2))
    sides = np.tile(np.isin(np.arange(len(systems)), SIDE), (EPOCHS, 1, 1))
    largest = 0.0
    for size in SIZES:
        # A map that is wrong by some metres: the antenna is beside it by as much the other way.
        beside = -size * faults[:, -2:]
        code = ranges.code_m + size * faults[:, :-2] - np.einsum("tmi,tai,ta->tm", los, axes, beside)
        moved = linear_model(replace(ranges, code_m=code), raim_cases.LINE, arc)
        known = (beside + sigma * drawn, np.tile(np.diag(sigma**-2.0), (EPOCHS, 1, 1)))
        got = protection_level(moved, list(systems), risk=RISK, map_error=MapDeviation(seen=known), sides=sides)
        over = (np.abs(moved.step_m[:, 0]) > got.level_m) & got.consistent
        largest = max(largest, float(over.mean()))
    return largest


@pytest.mark.parametrize("kind", CASES)
@pytest.mark.every(3)
def test_faults_together_stay_within_the_level(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And would not, were they neither hypotheses nor taken off the risk: the injected faults can be seen."""
    systems, members, wrong_map, likely = CASES[kind]
    found = exceeded(systems, members, wrong_map=wrong_map)
    allowed = RISK.risk_per_sample / likely
    assert found <= allowed + 4.0 * np.sqrt(allowed / EPOCHS)

    def least(classes: risk._Classes, *_: object) -> np.ndarray:
        return np.where(classes.each > 0.0, classes.least, -1)

    monkeypatch.setattr(risk._Classes, "choose", least)
    monkeypatch.setattr(risk._Classes, "rest", lambda classes, _: np.zeros(len(classes.each)))
    careless = exceeded(systems, members, wrong_map=wrong_map)
    assert careless > found
