"""Signal strength against the curve and the floor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from railfix.core.errors import SettingsError
from railfix.io import read_observations
from railfix.ranges.cn0_curve import Cn0Curve, Cn0Mean
from railfix.screens import Cn0Limits, cn0_screen

pytestmark = pytest.mark.requirement("B1")

#: 35 at 10 deg, 45 at 50 deg and above; at the middles of the bins the curve is exact.
CURVE = Cn0Curve(
    means=(
        Cn0Mean(
            kind="G", signal="1C", elevation_deg=np.array([10.0, 30.0, 50.0]), mean_dbhz=np.array([35.0, 41.0, 45.0]),
            spread_db=np.ones(3), count=np.array([100, 100, 100]),
        ),
    )
)  # fmt: skip
NAN = np.nan

#: C/N0, elevation -> refused by the floor, by the curve (floor 30, deficit 10).
TRUTH_TABLE = [
    (45.0, 50.0, False, False),
    (35.0, 50.0, False, False),  # exactly 10 below
    (34.9, 50.0, False, True),
    (34.9, 90.0, False, True),  # above the highest bin its mean holds
    (31.0, 30.0, False, False),  # exactly 10 below
    (30.0, 30.0, False, True),  # exactly at the floor
    (29.9, 10.0, True, False),  # a low satellite may be weak for the curve
    (24.9, 10.0, True, True),
    (20.0, 0.0, True, True),  # half of the lowest bin ends at 0
    (20.0, -0.1, True, False),  # below the curve: NaN
    (20.0, NAN, True, False),
    (NAN, 50.0, False, False),
    (0.0, 50.0, True, True),  # 0 is a value
]


def test_truth_table() -> None:
    cn0, elevation, floor, curve = (np.array(column) for column in zip(*TRUTH_TABLE, strict=True))
    elevation.flags.writeable = cn0.flags.writeable = False
    result = cn0_screen(
        cn0[:, None],
        elevation[:, None],
        satellite=np.array(["G07"]),
        signal=np.array(["1C"]),
        curve=CURVE,
        limits=Cn0Limits(floor_dbhz=30.0),
    )
    assert result.floor.reject[:, 0].tolist() == floor.tolist()
    assert result.curve.reject[:, 0].tolist() == curve.tolist()
    assert np.isnan(result.curve.metric[[9, 10, 11], 0]).all()
    assert result.curve.metric[2, 0] == pytest.approx(10.1)


@pytest.mark.parametrize(
    ("curve", "limits", "words"),
    [
        (None, Cn0Limits(floor_dbhz=30.0), ["floor"] * 3),
        (None, Cn0Limits(floor_dbhz=None), ["nothing"] * 3),
        (CURVE, Cn0Limits(floor_dbhz=30.0), ["curve and floor", "floor", "floor"]),
        (CURVE, Cn0Limits(floor_dbhz=None), ["curve", "nothing", "nothing"]),
        (CURVE, Cn0Limits(deficit_dbhz=None, floor_dbhz=30.0), ["floor"] * 3),
    ],
)
def test_what_judges(curve: Cn0Curve | None, limits: Cn0Limits, words: list[str]) -> None:
    satellite, signal = np.array(["G01", "G01", "E01"]), np.array(["1C", "5Q", "1C"])
    result = cn0_screen(
        np.full((2, 3), 12.0), np.full((2, 3), 40.0), satellite=satellite, signal=signal, curve=curve, limits=limits
    )
    assert result.floor.reject.all(axis=0).tolist() == ["floor" in word for word in words]
    assert result.curve.reject.all(axis=0).tolist() == ["curve" in word for word in words]


@given(cn0=st.lists(st.floats(0, 60), min_size=4, max_size=4), weaker=st.floats(0.0, 20.0), elevation=st.floats(0, 90))
def test_a_weaker_signal_is_never_better(cn0: list[float], weaker: float, elevation: float) -> None:
    satellite, signal = np.array(["G01", "G02", "G03", "G04"]), np.array(["1C"] * 4)
    now = np.array([cn0])
    at = np.full((1, 4), elevation)
    strong = cn0_screen(now, at, satellite=satellite, signal=signal, curve=CURVE)
    weak = cn0_screen(now - weaker, at, satellite=satellite, signal=signal, curve=CURVE)
    assert not (strong.floor.reject & ~weak.floor.reject).any()
    assert not (strong.curve.reject & ~weak.curve.reject).any()


@pytest.mark.parametrize("wrong", [{"deficit_dbhz": 0.0}, {"floor_dbhz": 0.0}, {"deficit_dbhz": np.nan}])
def test_limits_are_checked(wrong: dict[str, float]) -> None:
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        Cn0Limits(**wrong)


#: Log, and the share of its first-band signals that the floor of 30 dB-Hz refuses, least and largest.
FLOORS = {
    "kinematic/japan_mosaic_2021265_with_GEONET3034/SEPT265G.21O": (0.0, 0.05),
    "kinematic/gsdc_pixel5_a/Pixel5_a.21o": (0.3, 0.9),
    "kinematic/urbannav_tst/20210517.light-urban.tste.ublox.f9p.obs": (0.1, 0.5),
    "kinematic/urbannav_tst/20210517.light-urban.tste.ublox.m8t.GC.obs": (0.4, 0.8),
    "dual/mosaic_x2_99cm/rover.obs": (0.0, 0.1),
}


@pytest.mark.parametrize("name", FLOORS)
def test_recordings(recordings: Path, name: str) -> None:
    log = read_observations(recordings / name)
    first = np.flatnonzero(np.isin(log.signal, ("1C", "2I")) & np.isin(log.system, list("GJEC")))
    cn0 = log.cn0_dbhz[:, first]
    judged = np.isfinite(cn0)
    for floor in (20.0, 25.0, 30.0):
        result = cn0_screen(
            cn0, np.full(cn0.shape, np.nan), satellite=log.satellite[first], signal=log.signal[first],
            limits=Cn0Limits(floor_dbhz=floor),
        )  # fmt: skip
        share = result.floor.reject.sum() / judged.sum()
        print(f"{name}: floor {floor:g} dB-Hz refuses {share:.3f}")
    assert FLOORS[name][0] <= share <= FLOORS[name][1]
