"""The filter along the track on epochs with known truth, against second formulas and by cutting."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.constants import CONTRADICTION_LOST
from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import GnssEpochs, Kind, Line, TrackingLimits, TrackStatus, track
from railfix.tracking.chunk import prepare_chunk
from railfix.tracking.search import places
from railfix.tracking.state import Monitors, TrackState
from tracking_cases import (
    ORIGIN_M,
    bent_line,
    corner_line,
    part,
    reflected,
    ride,
    wheel,
    with_codes_behind,
    without_epochs,
)


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("start_m", [190.0, 201.0, 208.0])
def test_a_start_does_not_depend_on_where_the_map_has_its_points(start_m: float) -> None:
    """Points 40 m apart, or one: at the vertices alone the place 20 m off left a second one 75 m away in doubt."""
    found = []
    for step in (40.0, 1.0):
        points = ORIGIN_M[0] + np.arange(0.0, 2001.0, step)[:, None] * ORIGIN_M[1]
        case = ride(5, trajectory=Trajectory.from_antenna_path(Track.from_ecef(points)), start_m=start_m, noise=1.0)
        state = TrackState()
        chunk = prepare_chunk(part(case.epochs, slice(0, 1)), state, TrackingLimits())
        found.append(places(chunk, 0, case.line, TrackingLimits()))
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    assert np.abs(found[0][0] - start_m) < 10.0


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("order", [[9, 8, 7, 6, 5, 4, 3, 2, 1, 0], [1, 4, 2, 9, 0, 7]])
def test_a_chunk_with_its_channels_in_another_order_goes_on_with_the_phases_of_the_last(order: list[int]) -> None:
    case = ride(60, noise=1.0)
    names = [f.name for f in fields(GnssEpochs) if getattr(case.epochs, f.name) is not None]
    late = part(case.epochs, slice(40, None))
    columns = {name: getattr(late, name) for name in names if getattr(late, name).shape[1:2] == (10,)}
    turned = {name: values[:, order] for name, values in columns.items()}
    turned |= {name: getattr(late, name)[order] for name in ("satellite", "signal", "clock")}
    _, state = track(part(case.epochs, slice(0, 40)), case.line)
    found, _ = track(replace(late, **turned), case.line, state)
    absent = [k for k in range(10) if k not in order]
    code, phase, rate = (np.array(values) for values in (late.code_m, late.phase_m, late.rate_mps))
    for values in (code, phase, rate):
        values[:, absent] = np.nan
    expected, _ = track(replace(late, code_m=code, phase_m=phase, rate_mps=rate), case.line, state)
    np.testing.assert_allclose(found.arc_m, expected.arc_m, atol=1e-6)
    np.testing.assert_allclose(found.weight, expected.weight[..., order], atol=1e-6)


@pytest.mark.requirement("A8")
def test_a_satellite_whose_signals_take_turns_is_the_same_epoch_by_epoch() -> None:
    """Its error goes on with either signal; its phase goes on with its own alone."""
    epochs, line = ride(60, noise=1.0).epochs, ride(60).line
    both = np.append(np.arange(10), 3)  # the fourth satellite has two signals
    fourth = np.arange(60) % 7 == 5  # in some epochs only the second one
    values = {f.name: getattr(epochs, f.name) for f in fields(GnssEpochs) if getattr(epochs, f.name) is not None}
    values |= {name: value[:, both] for name, value in values.items() if value.shape[1:2] == (10,)}
    values |= {name: values[name][both] for name in ("satellite", "signal", "clock")}
    values["signal"][-1] = "1W"
    for name in ("code_m", "phase_m", "rate_mps"):
        values[name] = np.array(values[name])
        values[name][fourth, 3], values[name][~fourth, -1] = np.nan, np.nan
    values["phase_joined"] = np.array(values["phase_joined"])
    values["phase_joined"][1:, [3, -1]] = (fourth[1:] == fourth[:-1])[:, None]
    mixed = GnssEpochs(**values)
    whole, _ = track(mixed, line)
    state, arcs = None, []
    for k in range(60):
        one = part(mixed, slice(k, k + 1))
        found, state = track(one, line, state)
        arcs.append(found.arc_m[0])
    np.testing.assert_allclose(np.array(arcs), whole.arc_m, atol=1e-9)


@pytest.mark.requirement("E5")
def test_a_satellite_with_a_wrong_code_loses_its_weight() -> None:
    case = ride(noise=1.0)
    code = case.epochs.code_m.copy()
    code[50:80, [1, 4, 7]] += np.array([60.0, -45.0, 80.0])
    result, _ = track(replace(case.epochs, code_m=code), case.line)
    assert np.abs(result.arc_m - case.arc_m)[20:].max() < 3.0
    assert result.weight[50:80, 0][:, [1, 4, 7]].max() < 0.2
    assert np.median(result.weight[50:80, 0][:, [0, 2, 3]]) > 0.6


@pytest.mark.requirement("E5")
def test_errors_stay_within_their_sigmas() -> None:
    ratio = []
    for seed in range(8):
        case = ride(100, noise=1.0, seed=seed)
        result, _ = track(case.epochs, case.line)
        ratio.append(((result.arc_m - case.arc_m) / result.sigma_m)[20:])
    assert np.sqrt(np.mean(np.concatenate(ratio) ** 2)) < 1.5


@pytest.mark.requirement("E5")
def test_a_gap_is_coasted_and_left_again() -> None:
    case = ride(120, noise=1.0)
    gap = np.zeros(120, dtype=bool)
    gap[60:80] = True
    result, _ = track(without_epochs(case.epochs, gap), case.line)
    assert (result.status[60:80] == TrackStatus.COASTING).all()
    assert (np.diff(result.sigma_m[59:80]) > 0).all()
    assert (np.abs(result.arc_m - case.arc_m) < 4.0 * result.sigma_m)[20:].all()
    assert np.abs(result.arc_m - case.arc_m)[90:].max() < 3.0


@pytest.mark.requirement("E5")
@pytest.mark.requirement("E2")
def test_a_wheel_carries_through_a_gap_and_its_diameter_is_learnt() -> None:
    case = ride(150, trajectory=bent_line(4000.0), noise=0.3)
    gap = np.zeros(150, dtype=bool)
    gap[110:140] = True
    result, _ = track(without_epochs(case.epochs, gap), case.line, sensors=wheel(case, scale=0.02))
    assert result.wheel_scale[109] == pytest.approx(0.02, abs=0.004)
    moved = case.arc_m[139] - case.arc_m[109]
    assert abs(result.arc_m[139] - case.arc_m[139]) < 2.0 + 0.003 * moved
    assert (result.status[110:140] == TrackStatus.TRACKING).all()


@pytest.mark.requirement("E5")
def test_a_clock_step_of_a_millisecond_moves_nothing() -> None:
    case = ride(80)
    step = 299_792.458 * (np.arange(80) >= 50)[:, None]
    moved = replace(case.epochs, code_m=case.epochs.code_m + step, phase_m=case.epochs.phase_m + step)
    result, _ = track(moved, case.line)
    assert np.abs(result.arc_m - case.arc_m)[20:].max() < 0.1


@pytest.mark.requirement("E5")
def test_a_few_satellites_of_one_wall_do_not_stop_the_train() -> None:
    """They agree with each other on rest; at 15 m/s a second before no train is."""
    case = ride(noise=1.0, seed=3)
    epochs = reflected(case, 80)
    result, _ = track(epochs, case.line)
    error = np.abs(result.arc_m - case.arc_m)
    assert result.status[80] == TrackStatus.COASTING
    assert result.speed_mps[80] == pytest.approx(15.0, abs=2.0)
    assert error[80:].max() < 4.0
    believed, _ = track(epochs, case.line, limits=TrackingLimits(trusted_satellites=0))
    assert np.abs(believed.arc_m - case.arc_m)[80:82].min() > 8.0


@pytest.mark.requirement("E5")
def test_emergency_braking_is_followed() -> None:
    """3 m/s2 down to rest, by all satellites and by a wheel with three; three alone are an epoch behind at most."""
    case = ride(
        noise=1.0,
        speed_mps=lambda t: np.where(t < 60.0, np.minimum(0.5 * t, 15.0), np.maximum(15.0 - 3.0 * (t - 60.0), 0.0)),
    )
    seen, names = (np.arange(10) < 3) | (np.arange(len(case.epochs)) < 20)[:, None], ("code_m", "phase_m", "rate_mps")
    few = replace(case.epochs, **{n: np.where(seen, getattr(case.epochs, n), np.nan) for n in names})
    found, _ = track(case.epochs, case.line)
    by_wheel, _ = track(few, case.line, sensors=wheel(case))
    for result in (found, by_wheel):
        assert (result.status[60:70] == TrackStatus.TRACKING).all()
        assert np.abs(result.speed_mps - case.speed_mps)[58:70].max() < 0.5
    alone, _ = track(few, case.line)
    followed = alone.status[60:66] == TrackStatus.TRACKING
    assert (followed[1:] | followed[:-1]).all()
    assert np.abs(alone.speed_mps - case.speed_mps)[60:66].max() < 4.0
    assert np.abs(alone.arc_m - case.arc_m)[58:75].max() < 5.0


@pytest.mark.requirement("E5")
def test_a_place_put_wrong_is_lost_and_sought_again() -> None:
    case = ride(120, noise=1.0)
    _, state = track(part(case.epochs, slice(0, 50)), case.line)
    mean = state.mean.copy()
    mean[:, 0] += 800.0
    later, _ = track(part(case.epochs, slice(50, 120)), case.line, replace(state, mean=mean))
    assert TrackStatus.LOST in later.status
    assert np.abs(later.arc_m[-20:] - case.arc_m[-20:]).max() < 3.0


def _looped(trajectory_length: float) -> tuple[GnssEpochs, np.ndarray, Line]:
    """A ride on a line that comes back beside itself 12 m away: two branches for every code."""
    case = ride(100, trajectory=bent_line(trajectory_length, turn_deg=190.0), noise=1.0, code_sigma_m=8.0)
    return case.epochs, case.arc_m, case.line


@pytest.mark.requirement("E5")
def test_probabilities_sum_to_one_and_motion_decides() -> None:
    epochs, arc, line = _looped(1500.0)
    result, state = track(epochs, line, limits=TrackingLimits())
    assert np.exp(state.hypothesis["log_probability"]).sum() == pytest.approx(1.0)
    assert np.nanmax(result.probability) <= 1.0 + 1e-12
    assert np.abs(result.arc_m - arc)[-20:].max() < 8.0


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("seed", range(3))
def test_a_place_10_m_behind_a_corner_is_corrected_within_10_s(seed: int) -> None:
    """Along the street before it the train that has turned seems to stand: places beside are tried and taken."""
    case = ride(
        75, trajectory=corner_line(), start_m=300.0, rate_hz=5.0, noise=1.0, code_sigma_m=6.0, seed=seed,
        speed_mps=lambda t: np.full(len(t), 6.0),
    )  # fmt: skip
    result, _ = track(with_codes_behind(case, 10.0, 600.0), case.line)
    error, corner = np.abs(result.arc_m - case.arc_m), int(np.searchsorted(case.arc_m, 600.0))
    assert error[corner - 1] > 8.0
    assert error[corner + 50 :].max() < 5.0


@pytest.mark.requirement("C6")
def test_a_corner_does_not_decide_between_laps() -> None:
    """Behind a corner the train seems to stand on every lap: places beside the one in the lead alone would win."""
    case = ride(
        75, trajectory=corner_line(4800.0), start_m=2700.0, rate_hz=5.0, noise=1.0, code_sigma_m=6.0,
        speed_mps=lambda t: np.full(len(t), 6.0),
    )  # fmt: skip
    result, _ = track(with_codes_behind(case, 10.0, 3000.0), case.line)
    corner = int(np.searchsorted(case.arc_m, 3000.0))
    assert result.probability[corner:].max() < 0.9
    assert np.abs(result.arc_m % 2400.0 - case.arc_m % 2400.0)[corner + 50 :].max() < 5.0


@pytest.mark.requirement("C6")
@pytest.mark.parametrize(("speed_mps", "stop_s"), [(2.0, 60), (15.0, 60), (40.0, 60), (6.0, 33)])
def test_a_train_that_leaves_the_map_has_no_level(speed_mps: float, stop_s: int) -> None:
    """Codes and motion go on beyond an open end, where the place may not follow; so does a train that stops there."""
    whole = bent_line()
    points = np.asarray(whole.ecef_m)[np.asarray(whole.arc_m) <= 1500.0]
    start_m = 1500.0 - 30.0 * speed_mps
    case = ride(
        60, trajectory=whole, start_m=start_m, noise=0.5, speed_mps=lambda t: np.where(t < stop_s, speed_mps, 0.0)
    )
    result, _ = track(case.epochs, Line(Trajectory.from_antenna_path(Track.from_ecef(points))), levels=True)
    over = np.abs(np.clip(result.arc_m, 0.0, 1500.0) - case.arc_m) > result.level_m
    assert not over.any()
    assert np.isfinite(result.level_m[20:30]).all()
    if stop_s == 60:
        assert not np.isin(result.status[45:], [TrackStatus.TRACKING, TrackStatus.COASTING]).any()


@pytest.mark.requirement("E5")
def test_a_jump_of_50_m_at_the_mouth_of_a_tunnel_moves_the_answer_by_less_than_a_fifth() -> None:
    """All codes agree on a place 50 m ahead for five epochs after the gap: the wheel has carried the right one."""
    case = ride(150, trajectory=bent_line(4000.0), noise=0.3)
    gap = np.zeros(150, dtype=bool)
    gap[90:120] = True
    blank = without_epochs(case.epochs, gap)
    ahead, _ = case.line.at(case.arc_m + 50.0)
    here, _ = case.line.at(case.arc_m)
    sats = case.epochs.sat_ecef_m
    moved = np.linalg.norm(sats - ahead[:, None], axis=2) - np.linalg.norm(sats - here[:, None], axis=2)
    code = blank.code_m + np.where((np.arange(150) >= 120) & (np.arange(150) < 125), 1.0, 0.0)[:, None] * moved
    result, _ = track(replace(blank, code_m=code), case.line, sensors=wheel(case))
    assert np.abs(result.arc_m - case.arc_m)[85:].max() < 10.0


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("level", ["off", "on"])
@pytest.mark.parametrize(
    "garbage", ["no channel", "nothing measured", "wild codes", "one satellite", "same instant", "huge"]
)
def test_no_input_raises(garbage: str, level: str) -> None:
    case = ride(40, noise=1.0)
    epochs, random = case.epochs, np.random.default_rng(2)
    if garbage == "no channel":
        none = np.zeros(10, dtype=bool)
        per_channel = (
            "sat_ecef_m",
            "sat_velocity_mps",
            "code_m",
            "code_sigma_m",
            "phase_m",
            "phase_joined",
            "rate_mps",
        )
        values = {name: getattr(epochs, name)[:, none] for name in (*per_channel, "cn0_dbhz")}
        names = {n: getattr(epochs, n)[none] for n in ("satellite", "signal", "clock")}
        epochs = replace(epochs, **names, **values)
    elif garbage == "nothing measured":
        epochs = without_epochs(epochs, np.ones(40, dtype=bool))
    elif garbage == "wild codes":
        epochs = replace(epochs, code_m=epochs.code_m + 1e5 * random.normal(size=epochs.code_m.shape))
    elif garbage == "one satellite":
        epochs = replace(epochs, code_m=np.where(np.arange(10) > 0, np.nan, epochs.code_m))
    elif garbage == "same instant":
        epochs = replace(epochs, time=np.repeat(epochs.time[::2], 2))
    else:
        epochs = replace(epochs, rate_mps=1e9 * epochs.rate_mps, phase_m=-1e6 * epochs.phase_m)
    result, _ = track(epochs, case.line, limits=TrackingLimits.model_validate({"level": level}))
    assert len(result) == 40


@pytest.mark.requirement("E5")
def test_codes_count_once_a_second_where_phases_or_dopplers_carry_the_place() -> None:
    case = ride(40, rate_hz=10.0, noise=1.0)
    result, _ = track(case.epochs, case.line)
    coded = np.isfinite(result.innovation[:, Kind.CODE]).any(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(coded), np.arange(0, 400, 10))
    assert (result.status == TrackStatus.TRACKING)[20:].all()
    # the same information as the codes of all epochs, whose white error is that of a second
    every, _ = track(case.epochs, case.line, limits=TrackingLimits(code_period_s=0.0))
    assert np.isfinite(every.innovation[:, Kind.CODE]).any(axis=1).all()
    np.testing.assert_allclose(result.sigma_m[50:], every.sigma_m[50:], rtol=0.05)
    assert (np.abs(result.arc_m - every.arc_m) < every.sigma_m)[50:].all()
    # a log of codes alone has nothing else to go by
    alone = replace(case.epochs, phase_m=case.epochs.phase_m * np.nan, rate_mps=case.epochs.rate_mps * np.nan)
    assert np.isfinite(track(alone, case.line)[0].innovation[:, Kind.CODE]).any(axis=1).all()


@pytest.mark.requirement("E5")
def test_codes_count_at_once_when_they_come_back() -> None:
    case = ride(40, rate_hz=10.0, noise=1.0)
    code = case.epochs.code_m.copy()
    code[205:254] = np.nan
    result, _ = track(replace(case.epochs, code_m=code), case.line)
    coded = np.flatnonzero(np.isfinite(result.innovation[:, Kind.CODE]).any(axis=1))
    np.testing.assert_array_equal(coded, [*range(0, 201, 10), *range(254, 400, 10)])
    # a second of codes that contradict the place counts as a second, not as one epoch of it
    late = case.epochs.code_m + np.where(np.arange(400) >= 200, 300.0, 0.0)[:, None] * np.linspace(-1, 1, 10)
    _, state = track(part(replace(case.epochs, code_m=late), slice(0, 225)), case.line)
    assert state.monitors.weak_code_s == pytest.approx(3.0)


@pytest.mark.requirement("E5")
def test_nothing_learnt_outlives_a_reset() -> None:
    """Every field of the state but the times, the satellites and what withholds a level is that of an empty one."""
    kept = {"time", "origin", "satellite", "seen", "previous"}
    case = ride(60)
    _, state = track(case.epochs, case.line, levels=True)
    learnt = [item.name for item in fields(TrackState) if item.name not in kept]
    state.monitors = Monitors(**dict.fromkeys((item.name for item in fields(Monitors)), 1.5))
    state.reset()
    empty = TrackState()
    assert state.monitors == Monitors(level_hold_s=1.5, ambiguity_hold_s=1.5, measured_s=1.5)
    for name in learnt:
        value, begun = getattr(state, name), getattr(empty, name)
        if isinstance(value, np.ndarray):
            assert not len(value) or not value.any(), name
        elif name != "monitors":
            assert value == begun or str(value) == str(begun) == "NaT", name
    assert state.time == case.epochs.time[-1]


@pytest.mark.requirement("C6")
def test_an_improbable_place_hides_no_other() -> None:
    """Places near a hypothesis are not restarted, unless it has drifted off them and is as good as excluded."""
    case = ride(40, noise=0.5)
    _, state = track(case.epochs.take(slice(0, 30)), case.line)
    for name in ("mean", "covariance", "hypothesis"):
        setattr(state, name, np.repeat(getattr(state, name)[:1], 2, axis=0))
    for arc in (ix.ARC, ix.PREVIOUS_ARC):
        state.mean[:, arc] += [600.0, 50.0]
    state.hypothesis["log_probability"], state.hypothesis["origin_m"] = [0.0, -36.0], state.mean[:, ix.ARC]
    state.monitors = replace(state.monitors, contradiction=CONTRADICTION_LOST)
    result, _ = track(case.epochs.take(slice(30, None)), case.line, state)
    assert result.hypotheses[0] == 3
    np.testing.assert_allclose(result.arc_m, case.arc_m[30:], atol=1.5)
