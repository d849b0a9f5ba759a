"""The compiled recursion of the filter gives what numpy gives."""

from __future__ import annotations

from dataclasses import fields, replace
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from railfix import kernels
from railfix.tracking import GnssEpochs, Line, SensorEpochs, Tracked, TrackState, track
from tracking_cases import bent_line, part, reflected, ride, without_epochs

pytestmark = pytest.mark.skipif(find_spec("numba") is None, reason="numba is not installed (railfix[fast])")


def _with(
    chosen: str,
    epochs: GnssEpochs,
    line: Line,
    state: TrackState | None = None,
    sensors: SensorEpochs | None = None,
    *,
    levels: bool = True,
) -> tuple[Tracked, TrackState]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "CHOSEN", chosen)
        return track(epochs, line, state, sensors=sensors, levels=levels)


def _assert_equal(given: Tracked, expected: Tracked, tolerance: float) -> None:
    for field in fields(Tracked):
        one, other = getattr(given, field.name), getattr(expected, field.name)
        if other.dtype.kind == "f":
            # The bound of the speed in a sub-filter's first seconds, begun with hundreds of metres, is ill-conditioned.
            loose = 50.0 * tolerance if field.name == "level_speed_mps" else tolerance
            np.testing.assert_allclose(one, other, rtol=loose, atol=loose, err_msg=field.name)
        else:
            np.testing.assert_array_equal(one, other, err_msg=field.name)


def _case(name: str) -> tuple[GnssEpochs, Line, SensorEpochs | None]:
    """Rides that take every branch: outliers, slips, clock steps, gaps, branches, sensors, ends, new satellites."""
    random = np.random.default_rng(8)
    if name == "branches":
        case = ride(120, trajectory=bent_line(1500.0, turn_deg=190.0), noise=1.0, code_sigma_m=8.0)
        return case.epochs, case.line, None
    case = ride(60 if name == "10 Hz" else 140, rate_hz=10.0 if name == "10 Hz" else 1.0, noise=1.0, seed=5)
    epochs, sensors = case.epochs, None
    if name == "sensors":
        size = len(case.arc_m)
        way = np.diff(case.arc_m, prepend=np.nan)
        sensors = SensorEpochs(
            wheel_m=way / 1.01, wheel_sigma_m=np.full(size, 0.02), wheel_sign="unknown",
            radar_m=np.where(random.random(size) < 0.5, way, np.nan), radar_sigma_m=np.full(size, 0.1),
            force_mps2=np.diff(case.speed_mps, prepend=np.nan) + 0.02 * random.normal(size=size),
            force_sigma_mps2=np.full(size, 0.05),
            place_m=np.where(np.arange(size) == 60, case.arc_m, np.nan), place_sigma_m=np.full(size, 0.2),
        )  # fmt: skip
        gap = np.zeros(size, dtype=bool)
        gap[80:100] = True
        return without_epochs(epochs, gap), case.line, sensors
    if name == "faults":
        code, rate, joined = epochs.code_m.copy(), epochs.rate_mps.copy(), epochs.phase_joined.copy()
        code[random.random(code.shape) < 0.1] += 60.0
        rate[70:80, ::2] += 8.0
        code[100:, :4] = np.nan
        code[:, 6:][:40] = np.nan
        joined[random.random(code.shape) < 0.1] = False
        step = 299_792.458 * (np.arange(len(code)) >= 50)[:, None]
        epochs = replace(epochs, code_m=code + step, phase_m=epochs.phase_m + step, phase_joined=joined, rate_mps=rate)
    if name == "one wall":
        epochs = reflected(case, 80)
    if name == "off map":
        away = np.zeros(len(case.arc_m), dtype=bool)
        away[40:60] = away[:3] = True
        epochs = replace(epochs, off_map=away)
    if name == "gap":
        gap = np.zeros(len(case.arc_m), dtype=bool)
        gap[40:43] = gap[60:95] = True
        epochs = without_epochs(epochs, gap)
    return epochs, case.line, sensors


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("name", ["plain", "10 Hz", "branches", "sensors", "faults", "gap", "one wall", "off map"])
def test_the_compiled_filter_gives_what_numpy_gives(name: str) -> None:
    epochs, line, sensors = _case(name)
    expected, one = _with("numpy", epochs, line, sensors=sensors)
    given, other = _with("numba", epochs, line, sensors=sensors)
    assert one.bank is not None
    assert other.bank is not None
    assert set(other.bank.without) == set(one.bank.without)
    _assert_equal(given, expected, 1e-6)
    assert other.direction == one.direction
    assert other.measured == one.measured
    np.testing.assert_array_equal(other.seen, one.seen)


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("name", ["sensors", "faults", "branches", "off map"])
def test_epochs_one_by_one_give_what_the_whole_gives(name: str) -> None:
    epochs, line, sensors = _case(name)
    whole, _ = _with("numba", epochs, line, sensors=sensors)
    state, parts = None, []
    for k in range(len(epochs)):
        own = None
        if sensors is not None:
            values = {f.name: getattr(sensors, f.name) for f in fields(sensors)}
            own = SensorEpochs(**{n: v[k : k + 1] if isinstance(v, np.ndarray) else v for n, v in values.items()})
        result, state = _with("numba", part(epochs, slice(k, k + 1)), line, state, own)
        parts.append(result)
    for name_of in ("arc_m", "sigma_m", "speed_mps", "probability", "wheel_scale"):
        joined = np.concatenate([getattr(result, name_of) for result in parts])
        np.testing.assert_allclose(joined, getattr(whole, name_of), rtol=0.0, atol=1e-9, err_msg=name_of)
    np.testing.assert_array_equal(np.concatenate([result.status for result in parts]), whole.status)


def test_a_wheel_wrong_in_the_kernel_would_be_seen() -> None:
    epochs, line, sensors = _case("sensors")
    assert sensors is not None
    assert sensors.wheel_m is not None
    expected, _ = _with("numpy", epochs, line, sensors=sensors)
    given, _ = _with("numba", epochs, line, sensors=replace(sensors, wheel_m=sensors.wheel_m * 1.0001))
    with pytest.raises(AssertionError):
        _assert_equal(given, expected, 1e-6)


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("size", range(1, 12))
def test_factors_and_products_by_four_rows_at_a_time_are_those_of_numpy(size: int) -> None:
    algebra: Any = import_module("railfix.kernels.tracking.algebra")
    random = np.random.default_rng(size)
    root, right = random.normal(size=(size, size)), random.normal(size=(size, 5))
    matrix = np.stack([np.full((size, size), np.nan), root @ root.T + np.eye(size)])
    factor, lower, inverse, product = (np.full((12, 12), np.nan) for _ in range(4))
    lower[:] = 0.0
    log_determinant = algebra.factorise.py_func(matrix, 1, size, factor)
    algebra.invert_factor.py_func(factor, size, lower)
    algebra.square.py_func(lower, size, inverse[None], 0)
    algebra.multiply.py_func(matrix, 1, right, size, 4, product)
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(matrix[1])[1], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(inverse[:size, :size], np.linalg.inv(matrix[1]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(product[:size, :4], matrix[1] @ right[:, :4], rtol=1e-12, atol=1e-12)
