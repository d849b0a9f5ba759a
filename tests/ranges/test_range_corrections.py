"""Corrections and sigmas of pseudoranges: hand-worked cases of each term, and that the positioning uses every one."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import pipeline_cases as cases
from railfix.core.constants import FREQUENCY_L1
from railfix.core.errors import SettingsError
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, range_with_rotation
from railfix.core.reasons import Reason
from railfix.gnss.orbits import SatelliteStates
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.range_stage import Models
from railfix.ranges.atmosphere import SeenFrom, model_delays
from railfix.ranges.channels import channel_order, first_available
from railfix.ranges.error_model import BinStatistics, ErrorBins, ErrorModel, FaultRate
from railfix.ranges.range_sigma import CodeNoise, NominalErrors, code_sigma_m
from railfix.ranges.sbas import (
    IonosphereDelays,
    IonosphereState,
    SatelliteCorrections,
    SatelliteState,
    SbasCorrections,
    read_sbas,
)
from railfix.ranges.sbas.sbas_sources import apply_long_term, sbas_delays
from railfix.run.processor_setup import make_processor
from recordings_score import straight_line

pytestmark = pytest.mark.requirement("A4")
L5_HZ = 1176.45e6
TIME = np.array(["2024-03-05T03:10:00"], dtype="datetime64[ns]")


@dataclass
class _States:
    """The fields of `SatelliteStates` that long-term corrections change."""

    position_ecef_m: np.ndarray
    clock_m: np.ndarray


def one_satellite(elevation_deg: float, channels: int) -> SeenFrom:
    """A receiver at 36 N, 138 E, and the same satellite east of it on every channel."""
    place = ecef_from_geodetic(np.array([36.0]), np.array([138.0]), np.array([100.0]))
    row = np.full((1, channels), elevation_deg)
    return SeenFrom(
        receiver_ecef_m=place,
        latitude_deg=np.array([36.0]),
        longitude_deg=np.array([138.0]),
        height_m=np.array([100.0]),
        satellite_ecef_m=np.repeat(place[:, None, :] * 4.0, channels, axis=1),
        elevation_deg=row,
        azimuth_deg=np.full_like(row, 90.0),
    )


def fixes_of(channels: int, **values: float) -> SatelliteCorrections:
    """Corrections of one epoch, every channel corrected, 0 but for the values given."""
    shape = (1, channels)
    arrays: dict[str, Any] = {item.name: np.zeros(shape) for item in fields(SatelliteCorrections)}
    for name in ("state", "iode", "record", "udrei", "covariance"):
        arrays[name] = np.zeros(shape, dtype=np.int64)
    for name in ("inflated", "rss"):
        arrays[name] = np.zeros(shape, dtype=bool)
    arrays["position_m"] = np.zeros((*shape, 3))
    return SatelliteCorrections(**arrays | {name: np.full(shape, value) for name, value in values.items()})


def engine_of(delay_m: float, sigma_uire_m: float, factor: float, state: int = IonosphereState.OK) -> SbasCorrections:
    """Corrections whose grid has one delay and sigma everywhere, and one factor on sigma UDRE."""

    def ionosphere(*arguments: np.ndarray) -> IonosphereDelays:
        shape = arguments[-1].shape
        return IonosphereDelays(
            state=np.full(shape, state, dtype=np.int64),
            delay_m=np.full(shape, delay_m),
            sigma_uire_m=np.full(shape, sigma_uire_m),
            latitude_deg=np.zeros(shape),
            longitude_deg=np.zeros(shape),
            points=np.full(shape, 4, dtype=np.int64),
        )

    def delta_udre(_: np.ndarray, fixes: SatelliteCorrections, *__: np.ndarray) -> np.ndarray:
        return np.full(fixes.state.shape, factor)

    return cast("SbasCorrections", SimpleNamespace(ionosphere=ionosphere, delta_udre=delta_udre))


def test_sbas_sigma_by_hand_on_two_frequencies() -> None:
    """At 30 degrees: flt = 1.5 x 2 + 0.3 + 0.4 + 0.1 = 3.8 m; UIRE 0.9 m on L1, (1575.42/1176.45)^2 of it on L5."""
    fixes = fixes_of(2, sigma_udre_m=1.5, fast_growth_m=0.3, rate_growth_m=0.4, long_term_growth_m=0.1)
    frequency = np.array([FREQUENCY_L1, L5_HZ])
    found = sbas_delays(engine_of(4.0, 0.9, 2.0), fixes, TIME, one_satellite(30.0, 2), frequency)
    ratio = 1.793_270
    assert found.ionosphere_m[0] == pytest.approx([4.0, 4.0 * ratio], rel=1e-6)
    troposphere = 0.12 * 1.001 / np.sqrt(0.002001 + 0.25)
    for k, uire in enumerate((0.9, 0.9 * ratio)):
        assert found.sigma_m[0, k] ** 2 == pytest.approx(3.8**2 + uire**2 + troposphere**2, rel=1e-6)
    assert (found.reason == 0).all()


def test_the_troposphere_of_sbas_grows_with_its_mapping() -> None:
    """2.4 m in the zenith of 36 N at 100 m, 1.001/sqrt(0.002001 + sin^2) of it at 30 degrees."""
    l1 = np.array([FREQUENCY_L1])
    zenith, low = (
        sbas_delays(engine_of(1.0, 1.0, 1.0), fixes_of(1), TIME, one_satellite(angle, 1), l1).troposphere_m[0, 0]
        for angle in (90.0, 30.0)
    )
    assert zenith == pytest.approx(2.4, abs=0.1)
    assert low / zenith == pytest.approx(np.sqrt(1.002001 / 0.252001))


def test_every_sbas_term_widens_sigma_and_rss_adds_squares() -> None:
    names = ("sigma_udre_m", "fast_growth_m", "rate_growth_m", "long_term_growth_m", "en_route_m")
    seen, l1 = one_satellite(45.0, 1), np.array([FREQUENCY_L1])
    values = dict(zip(names, (1.0, 0.5, 0.25, 0.125, 2.0), strict=True))

    def variance(fixes: SatelliteCorrections) -> float:
        rest = sbas_delays(engine_of(1.0, 0.0, 1.0), fixes_of(1), TIME, seen, l1).sigma_m[0, 0] ** 2
        return float(sbas_delays(engine_of(1.0, 0.0, 1.0), fixes, TIME, seen, l1).sigma_m[0, 0] ** 2 - rest)

    assert variance(fixes_of(1, **values)) == pytest.approx(3.875**2)
    assert variance(fixes_of(1, **values, rss=True)) == pytest.approx(1.0 + 0.25 + 0.0625 + 0.015625 + 4.0)
    assert variance(fixes_of(1, **values, rss=True, inflated=True)) == pytest.approx(3.875**2)


def test_an_unknown_grid_delay_leaves_the_channel_without_ionosphere() -> None:
    seen, l1 = one_satellite(45.0, 2), np.full(2, FREQUENCY_L1)
    fixes = fixes_of(2, sigma_udre_m=1.0)
    for engine in (engine_of(1.0, 0.5, 1.0, IonosphereState.NO_GRID), engine_of(1.0, np.nan, 1.0)):
        found = sbas_delays(engine, fixes, TIME, seen, l1)
        assert np.isnan(found.ionosphere_m).all()
        assert (found.reason == int(Reason.SBAS_NO_IONOSPHERE)).all()
    state = np.array([[SatelliteState.OK, SatelliteState.TIMED_OUT]], dtype=np.int64)
    found = sbas_delays(engine_of(1.0, 0.5, 1.0), replace(fixes, state=state), TIME, seen, l1)
    assert np.isfinite(found.sigma_m).tolist() == np.isfinite(found.troposphere_m).tolist() == [[True, False]]
    assert found.reason.tolist() == [[0, 0]]
    nothing = sbas_delays(engine_of(1.0, 0.5, 1.0), replace(fixes, state=state * 0 + 7), TIME, seen, l1)
    assert np.isnan(nothing.sigma_m).all()


def test_long_term_corrections_move_satellites_and_their_clocks() -> None:
    states = cast("SatelliteStates", _States(np.zeros((1, 2, 3)), np.array([[10.0, 20.0]])))
    state = np.array([[SatelliteState.OK, SatelliteState.DO_NOT_USE]], dtype=np.int64)
    fixes = replace(fixes_of(2, clock_s=1e-9, position_m=0.0), state=state, position_m=np.full((1, 2, 3), 3.0))
    fixes = replace(fixes, clock_s=np.array([[1e-9, np.nan]]))
    moved, reason = apply_long_term(states, fixes)
    assert moved.position_ecef_m == pytest.approx(np.full((1, 2, 3), 3.0))
    assert moved.clock_m == pytest.approx(np.array([[10.299792458, 20.0]]))
    assert reason.tolist() == [[0, int(Reason.SBAS_DO_NOT_USE)]]


def test_code_sigma_by_hand() -> None:
    """At 30 degrees and 39 dB-Hz: zenith 1 m x 2 x 10^(6/20) = 3.9905 m, with the floor of 1 m 4.1139 m."""
    cn0, elevation = np.array([39.0, np.nan, 60.0, 39.0]), np.array([30.0, 30.0, 90.0, 0.0])
    found = code_sigma_m(cn0, elevation)
    assert found[:3] == pytest.approx([4.11389, np.sqrt(5.0), np.hypot(10.0**-0.25, 1.0)], rel=1e-5)
    assert np.isnan(found[3])
    noise = CodeNoise(model="elevation", zenith_sigma_m=2.0, floor_sigma_m=0.0)
    assert code_sigma_m(cn0, elevation, noise=noise)[:3] == pytest.approx([4.0, 4.0, 2.0])


def test_nominal_sigma_by_hand() -> None:
    """At the zenith the root of the summed squares; at 30 degrees each term with its own mapping."""
    nominal = NominalErrors(satellite_sigma_m=0.8, ionosphere_sigma_m=1.0, troposphere_sigma_m=0.12)
    wet = 1.001 / np.sqrt(1.002001)
    assert nominal.sigma_m(np.array([90.0]), np.zeros(1))[0] == pytest.approx(np.sqrt(0.64 + 1.0 + (0.12 * wet) ** 2))
    # Elevation 30 degrees: cosine at the shell 6378.1363/6728.1363 x 0.8660 = 0.82097, obliquity 1.75143.
    only = {"satellite_sigma_m": 0.0, "ionosphere_sigma_m": 0.0, "troposphere_sigma_m": 0.0}
    assert NominalErrors(**only | {"ionosphere_sigma_m": 2.0}).sigma_m(np.array([30.0]), np.full(1, np.nan))[
        0
    ] == pytest.approx(2.0 * 1.75143, rel=1e-4)
    assert NominalErrors(**only | {"troposphere_sigma_m": 1.0}).sigma_m(np.array([30.0]), np.full(1, np.nan))[
        0
    ] == pytest.approx(1.99404, rel=1e-4)
    assert np.isnan(nominal.sigma_m(np.array([0.0]), np.array([40.0]))[0])
    # A fifth of the slant delay (DO-229D J.2.3): 1.7 m of 8.5 m is less than 1.75143 m, 1.8 m of 9 m is more.
    for slant, ionosphere in ((8.5, 1.75143), (9.0, 1.8), (90.0, 18.0)):
        found = NominalErrors(**only | {"ionosphere_sigma_m": 1.0}).sigma_m(np.array([30.0]), np.array([slant]))[0]
        assert found == pytest.approx(ionosphere, rel=1e-4)
    assert NominalErrors(**only, ionosphere_share=0.0).sigma_m(np.array([30.0]), np.array([90.0]))[0] == 0.0
    np.testing.assert_allclose(nominal.vertical_ionosphere_m(np.array([0.0, 4.9, 6.0, 20.0])), [1.0, 1.0, 1.2, 4.0])
    np.testing.assert_array_equal(nominal.unusual_sigma_m(np.array([2.0, 5.0, 6.85, np.nan])), [0.0, 0.0, 6.85, 0.0])


@pytest.mark.parametrize("settings", [{"zenith_sigma_m": 0.0}, {"floor_sigma_m": -0.1}, {"model": "cn0"}])
def test_impossible_noise_is_rejected(settings: dict[str, Any]) -> None:
    with pytest.raises(SettingsError):
        CodeNoise(**settings)
    with pytest.raises(SettingsError):
        NominalErrors(satellite_sigma_m=-1.0)


def test_models_that_are_off_give_no_delay() -> None:
    seen, l1 = one_satellite(30.0, 1), np.array([FREQUENCY_L1])
    coefficients = np.array([1e-8, 0.0, 0.0, 0.0, 9e4, 0.0, 0.0, 0.0])
    off = model_delays(TIME, seen, l1, klobuchar=None, troposphere="off")
    assert (off.ionosphere_m[0, 0], off.troposphere_m[0, 0], off.sigma_m[0, 0]) == (0.0, 0.0, 0.0)
    on = model_delays(TIME, seen, l1, klobuchar=coefficients, troposphere="saastamoinen")
    zenith = model_delays(TIME, one_satellite(90.0, 1), l1, klobuchar=coefficients, troposphere="saastamoinen")
    assert on.troposphere_m[0, 0] == pytest.approx(2.0 * zenith.troposphere_m[0, 0])
    assert on.ionosphere_m[0, 0] > zenith.ionosphere_m[0, 0] > 1.0


def test_coefficients_that_were_not_received_widen_sigma() -> None:
    """2 m at the zenith, times the obliquity of `test_nominal_sigma_by_hand` at 30 degrees, and the carrier."""
    coefficients = np.array([1e-8, 0.0, 0.0, 0.0, 9e4, 0.0, 0.0, 0.0])
    carriers, models = np.array([FREQUENCY_L1, 1_207.14e6]), {"klobuchar": coefficients, "troposphere": "off"}
    found = [
        model_delays(TIME, one_satellite(angle, 2), carriers, ionosphere_sigma_m=2.0, **models).sigma_m[0]
        for angle in (90.0, 30.0)
    ]
    np.testing.assert_allclose(found[0], [2.0, 2.0 * 1.70328], rtol=1e-4)
    np.testing.assert_allclose(found[1], 1.75143 * found[0], rtol=1e-4)
    assert not model_delays(TIME, one_satellite(30.0, 2), carriers, **models).sigma_m.any()


def test_channels_of_one_clock_stand_together_and_the_best_signal_first() -> None:
    satellite = np.array(["E01", "G02", "J01", "G01", "G01", "C05"])
    signal = np.array(["1C", "1C", "1C", "1X", "1C", "2I"])
    order = channel_order(
        satellite, signal, systems=("G", "J", "E"), signals={"G": ("1C", "1X"), "E": ("1C",), "J": ("1C",)}
    )
    names = [f"{satellite[i]} {signal[i]}" for i in order]
    assert names == ["E01 1C", "G01 1C", "G01 1X", "G02 1C", "J01 1C"]
    available = np.array([[False, True, True, True, True], [True, False, True, False, True]])
    taken = first_available(satellite[order], available)
    assert taken.tolist() == [[False, True, False, True, True], [True, False, True, False, True]]
    alone = np.array(["G01", "G02"])
    assert first_available(alone, available[:, :2]).tolist() == available[:, :2].tolist()


def test_sigmas_of_a_run_are_those_of_its_noise_model_and_weights_their_inverse_squares() -> None:
    """Position of an epoch by textbook least squares with 1/sigma^2 is that of the pipeline; with 1/sigma it is not."""
    settings = {"screens": [], "systems": ["G"], "protection": "off", "ionosphere": "off"}
    observations = cases.clean_observations()["front"][:40]
    result = cases.front_alone(observations, settings)
    columns = result.columns
    expected = code_sigma_m(result.cn0_dbhz[:, columns], result.elevation_deg[:, columns])
    used = result.reason[:, columns] == 0
    np.testing.assert_allclose(result.sigma_m[:, columns][used], expected[used], rtol=1e-12)
    satellites, code = result.corrected.satellites.position_ecef_m, result.corrected_code_m[:, columns]
    differences = dict.fromkeys((1, 2), 0.0)
    for t in range(len(result)):
        at = np.flatnonzero(used[t])
        for power in differences:
            place, clock = result.point.ecef_m[t].copy(), 0.0
            for _ in range(4):
                distance, sight = range_with_rotation(satellites[t, at], place)
                design = np.column_stack([-sight, np.ones(len(at))])
                root = expected[t, at] ** (-power / 2.0)
                step, *_ = np.linalg.lstsq(design * root[:, None], (code[t, at] - distance - clock) * root, rcond=None)
                place, clock = place + step[:3], clock + step[3]
            difference = float(np.linalg.norm(place - result.point.ecef_m[t]))
            differences[power] = max(differences[power], difference)
    assert differences[2] < 1e-3 < 0.05 < differences[1]


def uniform_model(sigma_m: float, bias_m: float) -> ErrorModel:
    """Model of one bin."""
    bins = ErrorBins(elevation_deg=(0.0, 90.0), sectors=1, cn0_dbhz=(0.0, 60.0))
    number = np.full(bins.shape, 100)
    figures = {"bias_m": 0.0, "sigma_m": sigma_m, "bound_bias_m": bias_m, "bound_sigma_m": sigma_m}
    statistics = BinStatistics(
        count=number,
        blocks=number,
        pooled=number * 0,
        **{name: np.full(bins.shape, value) for name, value in figures.items()},
    )
    return ErrorModel(bins=bins, before=statistics, after=statistics, covers="satellite_and_atmosphere")


def test_a_model_of_local_errors_is_widened_by_the_nominal_errors_and_another_is_not() -> None:
    observations = {"front": cases.clean_observations()["front"][:5]}
    model = uniform_model(3.0, 0.0)
    for covers, extra in (("local", 1.0), ("satellite_and_atmosphere", 0.0)):
        processor = EpochProcessor(
            parse_config({"filter": "off", "error_model": "line.toml", "screens": []}),
            cases.clean_trajectories(),
            navigation=cases.clean_navigation(),
            models=Models(error_model=replace(model, covers=cast("Any", covers))),
        )
        result = processor.process(observations)[0].antennas["front"]
        used = result.reason == 0
        nominal = NominalErrors().sigma_m(result.elevation_deg, result.corrected.ionosphere_m)
        assert result.bound_sigma_m[used] == pytest.approx(np.sqrt(9.0 + extra * nominal[used] ** 2))


def test_sigmas_of_the_error_model_are_by_the_direction_from_the_front_of_the_car() -> None:
    """Sectors of 90 degrees with sigmas of their own; the heading is that of the line's points on the map."""
    bins = ErrorBins(elevation_deg=(0.0, 90.0), sectors=4, cn0_dbhz=(0.0, 60.0))
    number, zero = np.full(bins.shape, 100), np.zeros(bins.shape)
    sigma = np.array([10.0, 20.0, 30.0, 40.0]).reshape(bins.shape)
    statistics = BinStatistics(
        count=number, blocks=number, pooled=number * 0, bias_m=zero, sigma_m=sigma, bound_bias_m=zero,
        bound_sigma_m=sigma,
    )  # fmt: skip
    model = ErrorModel(bins=bins, before=statistics, after=statistics, covers="satellite_and_atmosphere")
    trajectory = cases.clean_trajectories()["front"]
    processor = EpochProcessor(
        parse_config({"filter": "off", "error_model": "line.toml", "screens": []}),
        cases.clean_trajectories(),
        navigation=cases.clean_navigation(),
        models=Models(error_model=model),
    )
    result = processor.process({"front": cases.clean_observations()["front"][::100]})[0].antennas["front"]
    vertex = np.clip(np.searchsorted(trajectory.arc_m, result.arc_m), 1, len(trajectory.arc_m) - 1)
    step = trajectory.ecef_m[vertex] - trajectory.ecef_m[vertex - 1]
    east, north = np.einsum("tij,tj->it", enu_axes(result.latitude_deg, result.longitude_deg)[:, :2], step)
    turned = (result.azimuth_deg - np.degrees(np.arctan2(east, north))[:, None]) % 360.0
    clear = (result.reason == 0) & (np.abs(turned % 90.0 - 45.0) > 5.0)
    assert clear.sum() > 100
    expected = 10.0 * (1.0 + np.round(turned / 90.0) % 4.0)
    np.testing.assert_allclose(result.bound_sigma_m[clear], expected[clear])
    assert set(expected[clear]) == {10.0, 20.0, 30.0, 40.0}


def test_the_accuracy_that_records_state_is_in_the_sigmas() -> None:
    """20 m of GPS, 3 m of the others (no worse than usual): sigmas and bounds grow by the former alone."""
    observations, navigation = {"front": cases.clean_observations()["front"][:5]}, cases.clean_navigation()
    gps = np.char.startswith(navigation.kepler.satellite, "G")
    stated = replace(navigation, kepler=replace(navigation.kepler, accuracy_m=np.where(gps, 20.0, 3.0)))
    usual = replace(navigation, kepler=replace(navigation.kepler, accuracy_m=np.full(len(gps), 2.0)))
    found = [
        cases.processor({"screens": []}, navigation=records).process(observations)[0].antennas["front"]
        for records in (usual, stated)
    ]
    before, after = (result.sigma_m for result in found)
    known = np.isfinite(before)
    of_gps = known & np.char.startswith(found[0].satellite, "G")
    assert of_gps.any()
    assert (known & ~of_gps).any()
    np.testing.assert_allclose(after[of_gps], np.hypot(before[of_gps], 20.0))
    np.testing.assert_array_equal(after[known & ~of_gps], before[known & ~of_gps])


def test_a_corrected_code_is_without_clock_ionosphere_and_troposphere() -> None:
    """Code + satellite clock - group delay - Klobuchar - Saastamoinen, each from the place of the solution."""
    observations, navigation = cases.clean_observations()["front"][:10], cases.clean_navigation()
    result = cases.front_alone(observations, {"screens": [], "systems": ["G"]})
    columns, used = result.columns, result.reason[:, result.columns] == 0
    seen = SeenFrom.of(result.point.ecef_m, result.corrected.satellites.position_ecef_m)
    frequency = np.full(len(columns), FREQUENCY_L1)
    delays = model_delays(result.time, seen, frequency, klobuchar=navigation.klobuchar["G"], troposphere="saastamoinen")
    states = result.corrected.satellites
    code = observations.code_m[:, columns] + states.clock_m - states.group_delay_m
    expected = code - delays.ionosphere_m - delays.troposphere_m
    assert (delays.troposphere_m[used] > 2.0).all()
    assert (delays.ionosphere_m[used] > 1.0).all()
    np.testing.assert_allclose(result.corrected_code_m[:, columns][used], expected[used], atol=0.02)


def test_a_model_of_an_earlier_version_is_noted() -> None:
    """Files of an earlier version have no rate of satellites of one side that are faulty together."""
    measured = {"beyond_sigma": 5.0, "ranges": 10, "faulty": 0, "blocks": 10, "faulty_blocks": 0, "prior": 0.0}
    notes = {}
    for name, more in (("old", {}), ("new", {"side_upper": 1.0})):
        faults = FaultRate.model_validate({**measured, "upper": 0.3, "together": 0.0, **more})
        model = replace(uniform_model(3.0, 0.0), faults=faults)
        config = parse_config({"filter": "off", "error_model": "line.toml", "screens": []})
        notes[name] = EpochProcessor(config, cases.clean_trajectories(), models=Models(error_model=model)).notes
    assert [note for note in notes["old"] if note not in notes["new"]] == [
        "error model: faults.side_upper, bound of simultaneous faults of low satellites on one side, is missing; "
        "the file is of an earlier version, so fit the model again with railfix error-model"
    ]
    assert set(notes["new"]) < set(notes["old"])


def test_a_run_with_sbas_adds_the_sbas_variance_to_that_of_the_noise_model(recordings: Path) -> None:
    stem = recordings / "sbas" / "msas_20080526_crescent" / "cres_20080526.bin"
    observations, navigation = read_observations(f"{stem}.obs")[150:220], read_navigation([f"{stem}.nav"])
    line = straight_line(observations.header.approximate_ecef_m, 45.0)
    config = parse_config({"filter": "off", "sbas": [f"{stem}.sbs"], "sbas_prn": 137, "screens": []})
    result = make_processor(config, navigation, {"front": line}).process({"front": observations})[0].antennas["front"]
    columns = result.columns
    used = result.reason[:, columns] == 0
    engine = SbasCorrections.from_log(read_sbas(f"{stem}.sbs"), prn=137)
    fixes = engine.satellites(result.time, result.satellite[columns], navigation)
    elevation, azimuth = result.elevation_deg[:, columns], result.azimuth_deg[:, columns]
    middle = len(line.ecef_m) // 2
    seen = SeenFrom.of(
        np.broadcast_to(line.ecef_m[middle], (len(result), 3)), result.corrected.satellites.position_ecef_m
    )
    grid = engine.ionosphere(result.time, seen.latitude_deg, seen.longitude_deg, elevation, azimuth)
    troposphere = 0.12 * 1.001 / np.sqrt(0.002001 + np.sin(np.radians(elevation)) ** 2)
    local = code_sigma_m(result.cn0_dbhz[:, columns], elevation)
    sight = seen.satellite_ecef_m - seen.receiver_ecef_m[:, None, :]
    sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
    factor = engine.delta_udre(result.time, fixes, sight, seen.latitude_deg, seen.longitude_deg)
    expected = local**2 + fixes.sigma_flt_m(factor) ** 2 + grid.sigma_uire_m**2 + troposphere**2
    assert used.sum() > 100
    np.testing.assert_allclose(result.sigma_m[:, columns][used] ** 2, expected[used], rtol=1e-3)
