"""Levels of the filter at every epoch, from sub-filters over epochs a second apart."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from railfix.cli import app
from railfix.simulate.demonstration import demo_files
from railfix.tracking import GnssEpochs, SensorEpochs, Tracked, TrackingLimits, TrackState, TrackStatus, track
from railfix.tracking import levels as levels_of
from railfix.tracking.levels import AccumulatedIncrement, LevelState, carried_levels, decimate_epochs, track_with_levels
from tracking_cases import Ride, part, ride, wheel

LIMITS = TrackingLimits()


def _levels(
    case: Ride, epochs: GnssEpochs, pieces: list[slice], sensors: SensorEpochs | None = None
) -> tuple[Tracked, LevelState]:
    """Places and levels of a ride, cut into pieces."""
    sensors = sensors or SensorEpochs()
    state, level, parts = None, LevelState(), []
    for piece in pieces:
        some, sensed = part(epochs, piece), _part(sensors, piece)
        found, state, level = track_with_levels(some, case.line, state, level, LIMITS, sensed)
        parts.append(found)
    return Tracked(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Tracked)}), level


def _part(sensors: SensorEpochs, piece: slice) -> SensorEpochs:
    values = {f.name: getattr(sensors, f.name) for f in fields(sensors)}
    return SensorEpochs(**{n: v[piece] if isinstance(v, np.ndarray) else v for n, v in values.items()})


@pytest.mark.requirement("C2")
def test_at_one_epoch_a_second_the_level_is_that_of_the_bank_beside_the_filter() -> None:
    case = ride(60, noise=1.0, seed=5)
    sensors = wheel(case)
    beside, _ = track(case.epochs, case.line, limits=LIMITS, sensors=sensors, levels=True)
    found, _ = _levels(case, case.epochs, [slice(0, 60)], sensors)
    for name in ("arc_m", "level_m", "level_noise_m", "separation_m", "amount_m"):
        np.testing.assert_allclose(getattr(found, name), getattr(beside, name), rtol=0, atol=1e-6)


@pytest.mark.requirement("C2")
def test_the_level_holds_between_its_epochs_and_is_little_wider_there() -> None:
    case = ride(60, rate_hz=10.0, noise=1.0, seed=6)
    found, _ = _levels(case, case.epochs, [slice(0, 600)])
    error = np.abs(found.arc_m - case.arc_m)
    assert (error <= found.level_m)[50:].all()
    beside, _ = track(case.epochs, case.line, limits=LIMITS, levels=True)
    assert np.median(found.level_m[100:]) < np.median(beside.level_m[100:]) + 2.0
    # from one of its epochs to the next by the speed's bound and the acceleration
    tau, taken = 0.1 * ((np.arange(600) + 5) % 10), (np.arange(600) + 5) % 10 == 0
    last = np.maximum.accumulate(np.where(taken, np.arange(600), 0))
    least = (found.level_speed_mps * tau + 0.5 * LIMITS.level_acceleration_mps2 * tau**2)[100:]
    assert (found.level_m[100:] >= least).all()
    assert (found.level_noise_m == found.level_noise_m[last])[100:].all()


@pytest.mark.requirement("C2")
@pytest.mark.parametrize("fault", ["ramp 0.5", "step 50"])
def test_no_error_over_the_level_between_its_epochs_with_a_faulty_satellite(fault: str) -> None:
    case = ride(60, rate_hz=10.0, noise=1.0, seed=4)
    kind, size = fault.split()
    t = 0.1 * np.arange(600)
    bias = np.where(t >= 20.0, float(size) * (t - 20.0) if kind == "ramp" else float(size), 0.0)
    code, phase, rate = (getattr(case.epochs, name).copy() for name in ("code_m", "phase_m", "rate_mps"))
    code[:, 2] += bias
    phase[:, 2] += bias
    rate[:, 2] += np.gradient(bias, 0.1) if kind == "ramp" else 0.0
    found, _ = _levels(case, replace(case.epochs, code_m=code, phase_m=phase, rate_mps=rate), [slice(0, 600)])
    assert (np.abs(found.arc_m - case.arc_m) <= found.level_m)[50:].all()
    assert np.isfinite(found.level_m[50:]).mean() > 0.8


@pytest.mark.requirement("C2")
@pytest.mark.parametrize("cut", [1, 7, 35])
def test_cutting_changes_no_level(cut: int) -> None:
    case = ride(15, rate_hz=10.0, noise=1.0, seed=2)
    joined = case.epochs.phase_joined.copy()
    joined[33:37, 1] = False
    epochs, sensors = replace(case.epochs, phase_joined=joined), wheel(case)
    whole, _ = _levels(case, epochs, [slice(0, 150)], sensors)
    pieces, _ = _levels(case, epochs, [slice(k, k + cut) for k in range(0, 150, cut)], sensors)
    for name in ("arc_m", "level_m", "separation_m", "amount_m"):
        np.testing.assert_allclose(getattr(pieces, name), getattr(whole, name), rtol=0, atol=1e-6)


@pytest.mark.requirement("C2")
def test_thinned_epochs_have_what_was_measured_between() -> None:
    case = ride(4, rate_hz=10.0, noise=1.0)
    joined, phase = case.epochs.phase_joined.copy(), case.epochs.phase_m.copy()
    joined[12, 0], phase[13, 1], joined[14, 2] = False, np.nan, False
    way = np.arange(40.0)
    force = np.where(np.arange(40) == 27, np.nan, 0.1 * np.arange(40))
    sigma = np.full(40, 0.5)
    sensors = SensorEpochs(wheel_m=way, wheel_sigma_m=sigma, force_mps2=force, force_sigma_mps2=sigma)
    epochs = replace(case.epochs, phase_joined=joined, phase_m=phase)
    taken, some, sensed, since = decimate_epochs(epochs, sensors, AccumulatedIncrement(), 1.0)
    np.testing.assert_array_equal(taken, [0, 5, 15, 25, 35])
    np.testing.assert_array_equal(some.time, case.epochs.time[taken])
    assert sensed.wheel_m is not None
    assert sensed.wheel_sigma_m is not None
    assert sensed.force_mps2 is not None
    np.testing.assert_allclose(sensed.wheel_m, [0.0, 15.0, way[6:16].sum(), way[16:26].sum(), way[26:36].sum()])
    np.testing.assert_allclose(sensed.wheel_sigma_m, 0.5 * np.sqrt([1, 5, 10, 10, 10]))
    np.testing.assert_allclose(sensed.force_mps2, [0.0, 0.3, 1.05, 2.05, np.nan])
    np.testing.assert_allclose(sensed.force_sigma_mps2[:4], 0.5)
    assert sensed.radar_m is None
    whole = np.ones(some.phase_joined.shape, dtype=bool)
    whole[2, :3] = False
    np.testing.assert_array_equal(some.phase_joined[1:], whole[1:])
    assert since.epochs == 4
    np.testing.assert_allclose(since.total[0], way[36:].sum())


@pytest.mark.requirement("C2")
def test_the_bound_of_an_epoch_between_by_hand() -> None:
    case = ride(1, rate_hz=10.0)
    epochs = part(case.epochs, slice(2, 5))
    arc, status = np.array([102.0, 104.5, np.nan]), np.array([0, 0, 5], dtype=np.int8)
    found = replace(Tracked.empty(epochs.time, 10), arc_m=arc, status=status)
    # 0.2 s before the first: place 100 m, 10 m/s, level 5 m with 3 m and 2 m, bound of the speed 0.5 m/s, amount 7 m
    state = LevelState(
        since=AccumulatedIncrement(start=case.epochs.time[0], number=0),
        time=case.epochs.time[0],
        values=np.array([100.0, 10.0, 5.0, 6.0, 3.0, 0.5, 2.0, 0.0, 7.0, 0.0]),
    )
    none = np.empty(0, dtype=np.intp)
    levels, after = carried_levels(found, none, Tracked.empty(epochs.time[:0], 10), case.line, state, LIMITS)
    # 102 = 100 + 10 * 0.2: 5 + 0.5 * 0.2 + 3 * 0.2^2 / 2; then 1.5 m ahead of 103 m
    np.testing.assert_allclose(levels.level_m, [5.16, 5.0 + 1.5 + 0.15 + 0.135, np.nan], rtol=0, atol=1e-9)
    np.testing.assert_allclose(levels.ground_level_m, levels.level_m + 1.0, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(levels.status, status)
    np.testing.assert_allclose(levels.amount_m, [7.0 + 0.02 * 2.0, 7.0 + 0.02 * 3.0, np.nan], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(levels.level_noise_m, [3.0, 3.0, np.nan])
    assert after.time == state.time
    # in doubt the separation, 2 m, is in the standard deviation; else what is beyond three of them, with a level four
    branches = TrackStatus.SEVERAL_BRANCHES
    for own, before, after_m in (
        (TrackStatus.TRACKING, 1.5, 1.5),
        (TrackStatus.TRACKING, 0.1, np.sqrt(0.1**2 + 2.0**2 - 0.4**2)),
        (TrackStatus.DOUBTFUL, 1.5, 2.5),
        (branches, 1.5, 1.5),
        (branches, 0.1, np.sqrt(0.1**2 + 2.0**2 - 0.3**2)),
    ):
        found = replace(found, status=np.full(3, own, dtype=np.int8), sigma_m=np.full(3, before))
        told, _ = carried_levels(found, none, Tracked.empty(epochs.time[:0], 10), case.line, state, LIMITS)
        np.testing.assert_allclose(told.sigma_m[:2], after_m)


@pytest.mark.requirement("C2")
@pytest.mark.parametrize(("status", "bounded"), [(TrackStatus.COASTING, True), (TrackStatus.SEVERAL_BRANCHES, False)])
def test_a_filter_with_sub_filters_that_is_in_doubt_bounds_nothing(
    monkeypatch: pytest.MonkeyPatch, status: TrackStatus, bounded: bool
) -> None:
    case = ride(5)

    def doubtful(*inputs: object, **named: object) -> tuple[Tracked, TrackState]:
        place, after = track(*inputs, **named)  # type: ignore[arg-type]
        return replace(place, status=np.full(5, status, dtype=np.int8)), after

    monkeypatch.setattr(levels_of, "track", doubtful)
    levels, _, _ = track_with_levels(case.epochs, case.line, None, LevelState(), LIMITS, SensorEpochs())
    assert np.isfinite(levels.level_m[1:]).all() == bounded
    assert not np.isnan(levels.level_m).any()


@pytest.mark.requirement("C2")
def test_a_level_beyond_a_kilometre_is_none_and_the_place_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    case = ride(5)

    def diverged(*inputs: object, **named: object) -> tuple[Tracked, TrackState]:
        place, after = track(*inputs, **named)  # type: ignore[arg-type]
        far = {"level_m": np.full(5, 1500.0), "ground_level_m": np.full(5, 990.0)}
        return replace(place, status=np.full(5, TrackStatus.TRACKING, dtype=np.int8), **far), after

    monkeypatch.setattr(levels_of, "track", diverged)
    levels, _, _ = track_with_levels(case.epochs, case.line, None, LevelState(), LIMITS, SensorEpochs())
    assert np.isposinf(levels.level_m[1:]).all()
    assert np.isfinite(levels.ground_level_m[1:]).all()
    assert (levels.status == TrackStatus.TRACKING).all()


@pytest.mark.requirement("C2")
def test_the_summary_of_a_run_has_the_level_of_the_filter(tmp_path: Path) -> None:
    files = {name: str(path) for name, path in demo_files().items() if name in ("front", "nav", "track", "vehicle")}
    options = [word for name, path in files.items() for word in (f"--{name}", path)]
    done = CliRunner().invoke(
        app,
        ["run", *options, "--end", "2024-03-05T03:10:10", "--out", str(tmp_path / "out"), "--verbose"],
        env={"COLUMNS": "100"},
    )
    assert done.exit_code == 0, done.output
    train = pl.read_parquet(tmp_path / "out" / "train.parquet")["protection_level_m"]
    finite = train.filter(train.is_finite())
    summary = done.output.split("Filter along the track (train.csv)")[1]
    assert re.search(rf"indicative protection level, p50 │ +{finite.quantile(0.5):.2f} m", summary)
    assert len(finite) > 50
    for limit in (20, 50):
        within = int((finite <= limit).sum())
        assert re.search(rf"within {limit} m +│ +{within} │", summary)
    words = ["evaluate", str(tmp_path / "out"), "--reference", str(demo_files()["truth"]), "--verbose"]
    judged = CliRunner().invoke(app, words, env={"COLUMNS": "200"})
    assert judged.exit_code == 0, judged.output
    for kind in ("single epochs, separation", "filter along the track"):
        table = judged.output.split(f"Protection levels ({kind}) against errors")[1]
        assert re.search(r"front +usable +20 \(own\)", table.split("by environment")[0])
