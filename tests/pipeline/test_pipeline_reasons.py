"""A simulated case for every status and every reason of the pipeline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import polars as pl
import pytest

from pipeline_cases import (
    channel,
    clean_navigation,
    clean_observations,
    clean_trajectories,
    front_alone,
    only,
    processor,
    with_code,
)
from railfix.core.reasons import CHECK_FAILED, POSITIONED, Reason, Status
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.protection import LevelStatus
from railfix.pipeline.result_tables import observations_table
from railfix.pipeline.results import AntennaResult
from railfix.track import Track
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("B7")

MASK_ONLY = {"screens": ["elevation"]}


@cache
def front() -> Observations:
    """Epochs of the simulated cases: the train runs, all satellites are there."""
    return clean_observations()["front"][400:440]


@cache
def whole() -> AntennaResult:
    return front_alone(front(), MASK_ONLY)


def highest(system: str, count: int) -> list[str]:
    order = np.argsort(-whole().elevation_deg[0])
    return [s for s in whole().satellite[order].tolist() if s[0] == system][:count]


def all_are(found: AntennaResult, status: Status) -> None:
    assert [Status(s).name for s in np.unique(found.status)] == [status.name]


def line(points_ecef_m: np.ndarray) -> dict[str, Trajectory]:
    return {"front": Trajectory.from_antenna_path(Track.from_ecef(points_ecef_m))}


@pytest.mark.requirement("A3")
def test_everything_there_is_ok():
    all_are(whole(), Status.OK)


def test_nominal_errors_add_to_the_variance_along_the_line():
    """Without an error model the variance grows with the square of the nominal sigma, from that of the noise alone."""
    none = {"satellite_sigma_m": 0.0, "ionosphere_sigma_m": 0.0, "ionosphere_share": 0.0, "troposphere_sigma_m": 0.0}
    variance = [
        front_alone(front(), MASK_ONLY | {"nominal": none | {"satellite_sigma_m": sigma}}).along_sigma_m ** 2
        for sigma in (0.0, 1.0, 3.0)
    ]
    assert (variance[1] - variance[0] > 0.01).all()
    np.testing.assert_allclose(variance[2] - variance[0], 9.0 * (variance[1] - variance[0]), rtol=1e-9)


def test_no_observation():
    gone = with_code(front(), np.where(np.arange(40)[:, None] == 7, np.nan, 0.0))
    found = front_alone(gone, MASK_ONLY)
    assert np.flatnonzero(found.status == Status.NO_OBSERVATION).tolist() == [7]
    assert np.isnan(found.arc_m[7])
    assert found.n_used[7] == found.n_rejected[7] == 0


def test_too_few_satellites():
    found = front_alone(only(front(), highest("G", 2)), MASK_ONLY)
    all_are(found, Status.TOO_FEW_SATELLITES)
    assert np.isnan(found.arc_m).all()
    assert np.isnan(found.ecef_m).all()


@pytest.mark.requirement("A4")
def test_two_satellites_are_enough_when_allowed():
    """Fewer redundant ranges than a sure section asks for, so the position is there and no status says "ok"."""
    found = front_alone(only(front(), highest("G", 2)), MASK_ONLY | {"min_satellites": 2})
    positioned = np.isfinite(found.arc_m)
    assert np.isin(found.status[positioned], sorted(set(POSITIONED) - {Status.OK})).all()
    assert positioned.mean() > 0.9
    assert np.all(found.n_used == 2)
    # On the true section two ranges give the place: the residuals vanish.
    assert np.nanmax(np.abs(found.residual_m[found.fix.constrained.overshoot_m == 0])) < 1e-3


@pytest.mark.requirement("A3")
def test_ambiguous_with_one_redundant_range():
    found = front_alone(only(front(), highest("G", 3)), MASK_ONLY)
    all_are(found, Status.AMBIGUOUS)
    assert np.isfinite(found.arc_m).all()
    sure = front_alone(only(front(), highest("G", 3)), MASK_ONLY | {"section": {"redundancy": 1}})
    assert (sure.status == Status.OK).any()


@pytest.mark.requirement("A3")
def test_ambiguous_where_the_line_comes_by_twice():
    """The line and the same line beside it, 3 m away: no range can tell."""
    there = clean_trajectories()["front"].ecef_m
    aside = there + 3.0 * np.r_[clean_trajectories()["front"].up[:1], clean_trajectories()["front"].up]
    found = front_alone(front(), MASK_ONLY, trajectories=line(np.concatenate([there, aside[::-1]])))
    one = front_alone(front(), MASK_ONLY, trajectories=line(there))
    assert (found.status == Status.AMBIGUOUS).mean() > 0.5
    all_are(one, Status.OK)


def test_off_map_beyond_the_end():
    here = int(np.searchsorted(clean_trajectories()["front"].arc_m, whole().arc_m.min()))
    found = front_alone(front(), MASK_ONLY, trajectories=line(clean_trajectories()["front"].ecef_m[: here - 8]))
    all_are(found, Status.OFF_MAP)
    assert (found.fix.constrained.overshoot_m > 5.0).all()
    assert np.all(found.arc_m == found.arc_m.max())


def test_a_position_clamped_to_an_end_within_the_noise_is_not_ok():
    """The line ends 1 m before the train: within four sigmas of the position, which is the end of the line."""
    there, at = clean_trajectories()["front"], whole()
    kept = there.arc_m < at.arc_m[0] - 1.0
    end = there.at_arc(at.arc_m[:1] - 1.0)
    found = front_alone(front()[:1], MASK_ONLY, trajectories=line(np.concatenate([there.ecef_m[kept], end])))
    all_are(found, Status.MAP_END)
    assert found.fix.constrained.overshoot_m[0] == pytest.approx(1.0, abs=0.1)
    assert found.protection.status[0] == LevelStatus.UNAVAILABLE


def test_off_map_far_to_the_side():
    trajectory = clean_trajectories()["front"]
    aside = trajectory.ecef_m + 5000.0 * trajectory.across[len(trajectory) // 2]
    all_are(front_alone(front(), MASK_ONLY, trajectories=line(aside)), Status.OFF_MAP)


def test_unobservable():
    """A limit that the satellites cannot reach."""
    found = front_alone(front(), MASK_ONLY | {"dilution_limit": 0.2})
    all_are(found, Status.UNOBSERVABLE)
    assert np.isnan(found.arc_m).all()


def test_no_convergence():
    """One step allowed: epochs whose nearest point lies ahead of them would have had to walk into its section."""
    found = front_alone(front(), MASK_ONLY | {"constrained": {"max_iterations": 1}})
    walked = whole().fix.constrained.iterations > 1
    assert 0 < walked.sum() < len(walked)
    assert np.array_equal(found.status == Status.NO_CONVERGENCE, walked)
    assert np.array_equal(np.isnan(found.arc_m), walked)


def test_inconsistent():
    """Half of the satellites are wrong, each otherwise: no exclusion of two mends that."""
    wrong = np.zeros(len(front().satellite))
    for i, name in enumerate(highest("G", 4) + highest("E", 2)):
        wrong[channel(front(), name)] = (40.0 + 9.0 * i) * (-1) ** i
    found = front_alone(with_code(front(), wrong), {"screens": ["elevation", "raim"]})
    refused = found.status == Status.INCONSISTENT
    assert refused.mean() > 0.8
    assert np.isfinite(found.arc_m).all()
    dropped = front_alone(with_code(front(), wrong), {"screens": ["elevation", "raim"], "failed_checks": "drop"})
    assert np.array_equal(dropped.status, found.status)
    assert np.array_equal(np.isnan(dropped.arc_m), np.isin(found.status, CHECK_FAILED))


def test_antennas_disagree():
    """Each antenna's log given as the other's: 36 m from where they should be."""
    parts = {name: whole[400:440] for name, whole in clean_observations().items()}
    swapped = {"front": parts["rear"], "rear": parts["front"]}
    result, _ = processor({"screens": ["elevation", "antenna_spacing"]}).process(swapped)
    for found in result.antennas.values():
        all_are(found, Status.ANTENNAS_DISAGREE)


# --- reasons -----------------------------------------------------------------


def changed_records(name: str, **values: Any) -> Navigation:
    """The run's records, some fields of one satellite's changed."""
    navigation = clean_navigation()
    mine = navigation.kepler.satellite == name
    fields = {key: np.where(mine, value, getattr(navigation.kepler, key)) for key, value in values.items()}
    return replace(navigation, kepler=replace(navigation.kepler, **fields))


def second_signal() -> Observations:
    """The first GPS satellite once more, on P(Y) as received by semi-codeless tracking."""
    at = channel(front(), highest("G", 1)[0])
    names = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
    twice = {name: np.concatenate([getattr(front(), name), getattr(front(), name)[:, [at]]], axis=1) for name in names}
    satellite = np.append(front().satellite, front().satellite[at])
    return replace(front(), satellite=satellite, signal=np.append(front().signal, "1W"), **twice)


def top() -> str:
    return highest("G", 1)[0]


def top_channel() -> int:
    return channel(front(), top())


def one_wrong(change_m: float, *, from_epoch: int = 0) -> Observations:
    add = np.zeros(front().code_m.shape)
    add[from_epoch:, top_channel()] = change_m
    return with_code(front(), add)


def weak() -> Observations:
    return replace(
        front(), cn0_dbhz=np.where(np.arange(len(front().satellite)) == top_channel(), 10.0, front().cn0_dbhz)
    )


def other_signals() -> dict[str, Any]:
    """Galileo asked for on E6 only, whose group delay is not broadcast."""
    return MASK_ONLY | {"signals": {"G": ["1C"], "J": ["1C"], "E": ["6C"]}}


def on_e6() -> Observations:
    return replace(front(), signal=np.where(front().system == "E", "6C", front().signal))


def lone() -> str:
    return highest("E", 1)[0]


CASES: dict[Reason, Callable[[], tuple[AntennaResult, int, int]]] = {
    # Reason: result, channel, epoch at which it must stand alone.
    Reason.NOT_OBSERVED: lambda: (front_alone(one_wrong(np.nan), MASK_ONLY), top_channel(), 0),
    Reason.IMPLAUSIBLE_CODE: lambda: (front_alone(one_wrong(-1.8e7), MASK_ONLY), top_channel(), 0),
    Reason.SYSTEM_NOT_SELECTED: lambda: (front_alone(front(), MASK_ONLY | {"systems": ["E"]}), top_channel(), 0),
    Reason.EXCLUDED_BY_SETTING: lambda: (front_alone(front(), MASK_ONLY | {"exclude": [top()]}), top_channel(), 0),
    Reason.OTHER_SIGNAL_TAKEN: lambda: (front_alone(second_signal(), MASK_ONLY), len(front().satellite), 0),
    Reason.NO_EPHEMERIS: lambda: (
        front_alone(front(), MASK_ONLY, navigation=changed_records(top(), satellite="G31")),
        top_channel(),
        0,
    ),
    Reason.EPHEMERIS_TOO_OLD: lambda: (
        front_alone(front(), MASK_ONLY | {"max_ephemeris_age_s": 1.0}),
        top_channel(),
        0,
    ),
    Reason.UNHEALTHY: lambda: (
        front_alone(front(), MASK_ONLY, navigation=changed_records(top(), health=1)),
        top_channel(),
        0,
    ),
    Reason.ELEVATION_MASK: lambda: (
        front_alone(front(), MASK_ONLY | {"elevation": {"mask_deg": 89.0}}),
        top_channel(),
        0,
    ),
    Reason.ALONE_ON_ITS_CLOCK: lambda: (
        front_alone(only(front(), [*highest("G", 5), lone()]), MASK_ONLY),
        channel(front(), lone()),
        0,
    ),
    Reason.NO_CORRECTION: lambda: (front_alone(on_e6(), other_signals()), channel(front(), lone()), 0),
    Reason.CN0_FLOOR: lambda: (
        front_alone(weak(), {"screens": ["cn0"], "cn0": {"floor_dbhz": 30.0}}),
        top_channel(),
        0,
    ),
    Reason.DOPPLER: lambda: (
        front_alone(one_wrong(60.0, from_epoch=20), {"screens": ["doppler"], "doppler": {"verdict": "reject"}}),
        top_channel(),
        20,
    ),
    Reason.GROSS_ERROR: lambda: (front_alone(one_wrong(1e3), MASK_ONLY), top_channel(), 0),
    Reason.FAULT_EXCLUDED: lambda: (front_alone(one_wrong(80.0), {"screens": ["elevation", "raim"]}), top_channel(), 0),
}
#: Reasons of screens that need more than one log and the settings; tested beside those screens, or below.
ELSEWHERE = {Reason.CN0_CURVE, Reason.ANTENNA_PAIR, Reason.LASTING_ERROR, Reason.USED} | {
    r for r in Reason if r.name.startswith("SBAS_")
}


def test_every_reason_has_a_case():
    assert set(CASES) | ELSEWHERE == {Reason.USED, *Reason}


@pytest.mark.requirement("B0")
@pytest.mark.parametrize("reason", CASES, ids=lambda r: r.name.lower())
def test_reason_is_given(reason: Reason):
    found, at, epoch = CASES[reason]()
    assert Reason(int(found.reason[epoch, at])) == reason
    assert np.isnan(found.residual_m[epoch, at])


def test_antenna_pair_is_given():
    parts = {name: whole[400:440] for name, whole in clean_observations().items()}
    parts["front"] = one_wrong(40.0)
    pair = {"screens": ["elevation", "antenna_pair"], "antenna_pair": {"verdict": "reject"}}
    result, _ = processor(pair).process(parts)
    for found in result.antennas.values():
        assert np.all(found.reason[:, top_channel()] == Reason.ANTENNA_PAIR)


@pytest.mark.requirement("B0")
@pytest.mark.parametrize("screen", ["doppler", "antenna_pair"])
def test_a_suspicion_weighs_and_takes_nothing_away(screen: str):
    """The sigma of a suspected satellite grows by what the screen measured; that of the others stays."""
    parts = {name: whole[400:440] for name, whole in clean_observations().items()}
    parts["front"] = one_wrong(40.0, from_epoch=20)
    result, _ = processor({"screens": ["elevation", screen]}).process(parts)
    without, _ = processor({"screens": ["elevation"]}).process(parts)
    found, plain = result.antennas["front"], without.antennas["front"]
    assert np.array_equal(found.reason, plain.reason)
    at = 21
    assert found.sigma_m[at, top_channel()] == pytest.approx(np.hypot(plain.sigma_m[at, top_channel()], 40.0), rel=0.05)
    unsuspected = ~found.screens[screen].reject[at]
    columns = found.columns
    assert np.array_equal(found.sigma_m[at, columns][unsuspected], plain.sigma_m[at, columns][unsuspected])


def test_reasons_gather():
    """A satellite can have several: unhealthy and below the mask."""
    settings = MASK_ONLY | {"elevation": {"mask_deg": 89.0}}
    found = front_alone(front(), settings, navigation=changed_records(top(), health=1))
    assert np.all(found.reason[:, top_channel()] == Reason.UNHEALTHY | Reason.ELEVATION_MASK)


@pytest.mark.requirement("B0")
@pytest.mark.requirement("E5")
def test_the_filter_uses_no_measurement_of_an_unhealthy_satellite() -> None:
    """Screens that judge single codes leave the filter its say; health does not."""
    broken, low = highest("G", 2)
    records = clean_navigation()
    sick = np.where(records.kepler.satellite == broken, 63, records.kepler.health)
    navigation = replace(records, kepler=replace(records.kepler, health=sick))
    weak = np.where(front().satellite == low, 20.0, front().cn0_dbhz)
    observations = replace(front(), cn0_dbhz=weak)
    settings = {"filter": "track", "screens": ["elevation", "cn0"], "cn0": {"floor_dbhz": 30.0}}
    result, _ = processor(settings, navigation=navigation).process({"front": observations})
    table = observations_table(result)
    measured = ("innovation_code_m", "innovation_phase_m", "innovation_doppler_mps", "weight_code")
    unhealthy = table.filter(satellite=broken)
    assert unhealthy["reason_text"].str.contains("unhealthy").all()
    assert len(unhealthy) == 40
    assert all(unhealthy[name].null_count() == 40 for name in measured)
    others = table.filter(pl.col("satellite") != broken, pl.col("reason") == 0)
    assert all(others[name].null_count() < len(others) for name in measured)
    refused = table.filter(pl.col("satellite") == low)
    assert (refused["reason_text"] == "cn0_floor").all()
    assert refused["weight_code"].null_count() < 40
