"""Errors of a base station: which of them an epoch of the train subtracts."""

import numpy as np
import pytest

from railfix.ranges.base_station import BaseErrors, BaseLimits

START = np.datetime64("2026-01-01T00:00:00", "ns")
HERE = np.array([-3962108.0, 3381309.0, 3668678.0])


def errors(seconds: list[float], channels: list[str], code: list[list[float]], arc: int = 7) -> BaseErrors:
    values = np.array(code, dtype=np.float64).reshape(len(seconds), len(channels))
    return BaseErrors(
        ecef_m=HERE,
        time=START + (np.array(seconds) * 1e9).astype("timedelta64[ns]"),
        satellite=np.array([c[:3] for c in channels]),
        signal=np.array([c[3:] for c in channels]),
        code_m=values,
        phase_m=values + 100.0,
        arc=np.full(values.shape, arc),
    )


def at(base: BaseErrors, seconds: float, channels: list[str], place: np.ndarray = HERE) -> tuple[np.ndarray, ...]:
    time = np.array([START + np.timedelta64(round(seconds * 1e9), "ns")])
    found = base.at(
        time, np.array([c[:3] for c in channels]), np.array([c[3:] for c in channels]), place[None], BaseLimits()
    )
    return found.code_m[0], found.phase_m[0], found.sigma_m[0]


@pytest.mark.requirement("A12")
@pytest.mark.parametrize(
    ("seconds", "code", "phase"),
    [
        (-0.2, None, None),
        (-0.04, 1.0, 101.0),
        (0.9, 1.0, 101.0),
        (1.0, 2.0, 102.0),
        (2.5, 2.0, None),
        (62.0, None, None),
    ],
)
def test_the_newest_errors_before_an_epoch_count_up_to_their_age(
    seconds: float, code: float | None, phase: float | None
) -> None:
    found = at(errors([0.0, 1.0], ["G011C"], [[1.0], [2.0]]), seconds, ["G011C"])
    np.testing.assert_array_equal(found[0], [np.nan if code is None else code])
    np.testing.assert_array_equal(found[1], [np.nan if phase is None else phase])


def test_another_signal_of_the_band_serves_and_another_satellite_does_not() -> None:
    base = errors([0.0], ["E011X", "E011C", "G051C", "G052W"], [[1.0, 2.0, 3.0, 4.0]])
    np.testing.assert_array_equal(
        at(base, 0.0, ["E011C", "E011X", "G051W", "G055X", "G061C"])[0], [2, 1, 3, np.nan, np.nan]
    )


def test_the_sigma_grows_with_the_distance_and_ends() -> None:
    base = errors([0.0], ["G011C"], [[1.0]])
    code, _, sigma = at(base, 0.0, ["G011C"], HERE + np.array([10e3, 0, 0]))
    assert code[0] == 1.0
    assert sigma[0] == pytest.approx(np.hypot(0.3, 0.04), rel=1e-3)
    assert np.isnan(at(base, 0.0, ["G011C"], HERE + np.array([101e3, 0, 0]))[0][0])


def test_later_errors_are_joined_by_channel_and_old_ones_left_out() -> None:
    both = errors([0.0], ["G011C", "G021C"], [[1.0, 2.0]]).merge(errors([1.0], ["E031C", "G021C"], [[4.0, 3.0]]))
    assert both.keys == [("E03", "1C"), ("G01", "1C"), ("G02", "1C")]
    np.testing.assert_array_equal(both.code_m, [[np.nan, 1, 2], [4, np.nan, 3]])
    assert both.arc.tolist() == [[-1, 7, 7], [7, -1, 7]]
    kept = both.drop_before(START + np.timedelta64(500, "ms"))
    assert kept.keys == [("E03", "1C"), ("G02", "1C")]
    np.testing.assert_array_equal(kept.code_m, [[4, 3]])
