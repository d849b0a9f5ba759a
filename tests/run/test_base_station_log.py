"""Log of a base station: read in step with that of the train, at a place that is known."""

import contextlib
from pathlib import Path

import numpy as np
import pytest

from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss.observations import ObservationHeader, Observations
from railfix.run.checks import check_base
from railfix.run.inputs import RunOptions
from railfix.run.processor_setup import BaseLog, base_log
from railfix.run.sources import Log
from railfix.run.tally import AntennaTally, Tally
from railfix.track import Track
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("A12")
START = np.datetime64("2026-01-01T00:00:00", "ns")
PLACE = np.array([-3959403.8, 3385705.9, 3667525.9])


def part(seconds: list[float], place: np.ndarray = PLACE) -> Observations:
    values = np.full((len(seconds), 1), 2.2e7)
    return Observations(
        time=START + (np.array(seconds) * 1e9).astype("timedelta64[ns]"),
        satellite=np.array(["G01"]),
        signal=np.array(["1C"]),
        code_m=values,
        phase_cycles=values,
        doppler_hz=values,
        cn0_dbhz=values,
        loss_of_lock=np.zeros(values.shape, dtype=np.uint8),
        break_before=np.zeros(len(seconds), dtype=np.bool_),
        header=ObservationHeader(approximate_ecef_m=place),
    )


class Parts(Log):
    """A log whose parts are given."""

    def __init__(self, *parts: Observations) -> None:
        super().__init__(paths=(Path("station.obs"),), chunk_epochs=10)
        self._parts = parts

    def parts(self):  # type: ignore[no-untyped-def]
        yield from self._parts


def test_epochs_come_once_and_up_to_the_train() -> None:
    log = BaseLog(Parts(part([0.0, 1.0, 2.0]), part([3.0, 4.0, 5.0])), None)

    def until(second: float) -> list[float]:
        found = log.until(START + np.timedelta64(round(second * 1e9), "ns"))
        return [] if found is None else ((found.time - START) / np.timedelta64(1, "s")).tolist()

    assert [until(s) for s in (-1.0, 0.97, 1.5, 4.2, 4.9, 9.0, 12.0)] == [[], [0, 1], [], [2, 3, 4], [], [5], []]


def test_the_place_is_the_one_given_or_that_of_the_header() -> None:
    np.testing.assert_array_equal(BaseLog(Parts(part([0.0])), None).ecef_m, PLACE)
    given = ",".join(f"{float(v):.9f}" for v in geodetic_from_ecef(PLACE + 10.0))
    np.testing.assert_allclose(BaseLog(Parts(part([0.0])), given).ecef_m, PLACE + 10.0, atol=1e-3)
    with pytest.raises(SettingsError, match="--base-place '1,2': expected LAT,LON,HEIGHT"):
        BaseLog(Parts(part([0.0])), "1,2")


@pytest.mark.parametrize(
    ("late_s", "east_m", "words"),
    [
        (0.0, 0.0, ""),
        (59.0, 0.0, ""),
        (-3.0, 0.0, "of 2026-01-01 00:00 to 00:00 and the logs of 2025-12-31 23:59 to 23:59"),
        (120.0, 0.0, "have no time in common; give a log that overlaps"),
        (0.0, 2e5, "200 km from the line, expected 100 km at most"),
    ],
)
def test_a_station_of_another_time_or_place_does_not_match(late_s: float, east_m: float, words: str) -> None:
    log = BaseLog(Parts(part([0.0, 1.0, 2.0])), None)
    first, last = (START + np.timedelta64(round(1e9 * (2.0 + late_s - s)), "ns") for s in (1.0, 0.0))
    log.until(last)
    tally = Tally(antennas={"front": AntennaTally(first=first, last=last)})
    away = np.array([PLACE[1], -PLACE[0], 0.0]) / np.hypot(*PLACE[:2]) * east_m
    line = Trajectory.from_antenna_path(Track.from_ecef(PLACE + away + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 50.0]])))
    with pytest.raises(MismatchError, match=words) if words else contextlib.nullcontext():
        check_base(log, tally, {"front": line})


def test_what_is_missing_is_one_sentence() -> None:
    with pytest.raises(InputFileError, match=r"station.obs: its header has no position; .* \(--base-place\)"):
        BaseLog(Parts(part([0.0], np.full(3, np.nan))), None)
    with pytest.raises(InputFileError, match=r"station.obs: has no epoch"):
        BaseLog(Parts(), None)
    with pytest.raises(SettingsError, match="--base-place is given without --base"):
        base_log((), RunOptions(base_place="35,139,50"))
