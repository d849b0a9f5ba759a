"""Grossly wrong codes: a larger one never costs a position, or accuracy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers import synthetic
from helpers.pipeline_cases import clean_navigation, clean_observations
from railfix.gnss.observations import Observations
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.received import known_from_start
from railfix.pipeline.without_map import Located, NoPosition, locate
from railfix.positioning.gross_errors import gross_in_space, least_absolute

pytestmark = pytest.mark.requirement("A6")

#: Epochs of the made run, 25 s apart.
EPOCHS = slice(0, 2000, 250)


def observed() -> Observations:
    return clean_observations()["front"][EPOCHS.start : EPOCHS.stop : EPOCHS.step]


def located(observations: Observations) -> Located:
    config = Config()
    received = known_from_start(config, navigation=clean_navigation())
    return locate(observations, received, config, ChannelBook(config))


def with_errors(observations: Observations, satellites: list[str], size_m: float) -> Observations:
    wrong = np.isin(observations.satellite, satellites)
    sign = np.where(np.arange(len(wrong)) % 2 == 0, 1.0, -1.0)
    return replace(observations, code_m=observations.code_m + wrong * sign * size_m)


def test_least_absolute_position_is_a_minimum_and_ignores_one_error() -> None:
    """By perturbation: every step away has a larger sum of absolute residuals, clocks at their best."""
    line = synthetic.line()
    ranges = synthetic.ranges(line, np.array([100.0, 300.0]), systems="GGGGGGEEEEE", seed=4)
    far = replace(ranges, code_m=ranges.code_m + np.eye(11)[3] * 1e5)
    start = line.at_arc(np.array([100.0, 300.0])) + 2e5
    place = least_absolute(far, start)
    assert np.linalg.norm(place - line.at_arc(np.array([100.0, 300.0])), axis=1).max() < 10.0

    def total(at: np.ndarray) -> np.ndarray:
        sums = np.zeros(len(at))
        delta = far.code_m - synthetic.travelled_range(far.sat_ecef_m, at[:, None])
        for group in far.groups:  # the best clock for a sum of absolute values is a median of equal weights
            part = delta[:, group]
            sums += np.abs(part - np.median(part, axis=1, keepdims=True)).sum(axis=1)
        return sums

    best = total(place)
    for step in np.concatenate([np.eye(3), -np.eye(3)]) * 20.0:
        assert (total(place + step) > best).all()


def test_one_of_few_ranges_is_accused_only_where_no_other_explains() -> None:
    """Six ranges of one clock: two are redundant, and the wrong one is found; with five, nothing tells which it is."""
    line, arc = synthetic.line(), np.full(40, 200.0)
    for systems, least in (("G" * 6, 20), ("G" * 5, 0)):
        ranges = synthetic.ranges(line, arc, systems=systems, seed=4)
        wrong = replace(ranges, code_m=ranges.code_m + np.eye(len(systems))[2] * 2e3)
        found = gross_in_space(wrong, line.at_arc(arc))
        assert found[:, 2].sum() >= least
        assert not np.delete(found, 2, axis=1).any()


def test_epochs_without_position_have_a_reason() -> None:
    whole = observed()
    nothing = replace(whole, code_m=np.full_like(whole.code_m, np.nan))
    assert (located(nothing).no_position == NoPosition.NO_CODE).all()
    three = replace(whole, code_m=np.where(np.isin(whole.satellite, ["G10", "G15", "G20"]), whole.code_m, np.nan))
    assert (located(three).no_position == NoPosition.TOO_FEW_SATELLITES).all()
    other_day = replace(whole, time=whole.time + np.timedelta64(3, "D"))
    assert (located(other_day).no_position == NoPosition.NO_RECORD).all()
    four = replace(whole, code_m=np.where(np.isin(whole.satellite, ["G10", "G15", "G20", "G01"]), whole.code_m, np.nan))
    high = located(with_errors(four, ["G10"], 3e6))
    assert np.isnan(high.ecef_m).all()
    assert set(high.no_position.tolist()) <= {NoPosition.IMPLAUSIBLE_HEIGHT, NoPosition.NO_CONVERGENCE}
    five = np.isin(whole.satellite, ["G10", "G15", "G20", "G01", "G26"])
    apart = located(with_errors(replace(whole, code_m=np.where(five, whole.code_m, np.nan)), ["G10"], 5e3))
    assert np.isnan(apart.ecef_m).all()
    assert np.isnan(apart.sigma_m).all()
    assert NoPosition.INCONSISTENT in set(apart.no_position.tolist())
