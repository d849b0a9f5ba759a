"""A line that closes on itself: the filter goes round (requirement E5)."""

from __future__ import annotations

import numpy as np
import pytest

from railfix import kernels
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line, TrackStatus, track
from tracking_cases import LATITUDE, LONGITUDE, bent_line, ride

RADIUS_M = 400.0
POINTS = 250


def ring(laps: float, *, apart_m: float = 0.0, backward: bool = False) -> Trajectory:
    """A circle, walked so many times; `apart_m` further out after each lap."""
    turn = np.arange(0.0, laps + 1e-9, 1.0 / POINTS)
    angle = 2.0 * np.pi * turn * (-1.0 if backward else 1.0)
    radius = RADIUS_M + apart_m * turn
    axes = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    flat = radius[:, None] * (np.sin(angle)[:, None] * axes[0] + np.cos(angle)[:, None] * axes[1])
    return Trajectory.from_track(Track.from_ecef(ecef_from_geodetic(LATITUDE, LONGITUDE, 40.0) + flat))


def test_where_a_line_closes() -> None:
    closed = Line.of(ring(1.0))
    length = closed.arc_m[-1]
    # The end is the start; both lie on the other's vertex, of which no segment ends there.
    assert closed.joins_m == pytest.approx((length, 0.0), abs=1e-3)
    overlapping = Line.of(ring(1.2))
    assert overlapping.joins_m == pytest.approx((length, 0.2 * length), abs=0.5)
    np.testing.assert_allclose(
        overlapping.round_m(np.array([-5.0, 10.0, 1.2 * length + 5.0])), [length, 0.0, -length], atol=0.5
    )


@pytest.mark.parametrize("line", [bent_line(), ring(0.9), ring(1.0, apart_m=4.0)], ids=["bent", "gap", "4 m beside"])
def test_open_lines_do_not_close(line: Trajectory) -> None:
    assert np.isnan(Line.of(line).joins_m).all()
    assert Line.of(line).bounds_m == pytest.approx((0.0, line.arc_m[-1]))


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("kernel", ["numpy", "numba"])
@pytest.mark.parametrize("backward", [False, True], ids=["rising", "falling"])
def test_the_filter_goes_round(kernel: str, backward: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if kernel == "numba":
        pytest.importorskip("numba", reason="railfix[fast] is not installed")
    monkeypatch.setattr(kernels, "CHOSEN", kernel)
    closed, laps = ring(1.0), ring(3.0, backward=backward)
    length = closed.arc_m[-1]
    case = ride(300, trajectory=laps, start_m=100.0, noise=1.0)
    found, _ = track(case.epochs, Line.of(closed))
    true = np.mod(-case.arc_m if backward else case.arc_m, length)
    error = np.mod(found.arc_m - true + 0.5 * length, length) - 0.5 * length
    assert case.arc_m[-1] > 1.5 * length
    assert np.abs(error[30:]).max() < 3.0
    assert ((found.arc_m[30:] > -5.0) & (found.arc_m[30:] < length + 5.0)).all()
    assert (found.status[30:] == TrackStatus.TRACKING).all()
