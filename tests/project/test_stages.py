"""Public stages: composed by hand they are the pipeline; arguments that cannot be right are named."""

from __future__ import annotations

import ast
import inspect
import re
import runpy
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

import recordings_truth
import synthetic
from conftest import ROOT
from railfix import (
    Config,
    EpochProcessor,
    Trajectory,
    integrity,
    positioning,
    ranges,
    read_navigation,
    read_observations,
    screens,
)
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.persistent_biases import LastingErrorLimits
from railfix.track import Track, from_positions
from railfix.track.point_files import write_track_csv

#: The example that calls the stages one by one.
EXAMPLE = ROOT / "docs" / "gallery" / "stages_by_hand.py"
#: Has a table of arguments that cannot be right, each with its sentence.
PAGE = (ROOT / "docs" / "researcher.md").read_text(encoding="utf-8")
#: Stages of P1's figure 1, in their order, by room.
STAGES = {
    "ranges": ("select_channels", "find_satellites", "corrected_ranges"),
    "positioning": (
        "approximate_position", "weighted_ranges", "point_position", "tie_clocks", "find_section", "position_on_line",
        "fix_on_line", "robust_fit", "robust_on_line", "noise_scale",
    ),
    "integrity": (
        "linear_model", "reject_persistent_biases", "exclude_faults", "protection_level", "validate_point",
        "availability",
    ),
    "tracking": ("track",),
}  # fmt: skip


def _called_in(folder: Path) -> set[str]:
    """Return the names of functions that the files of a folder call."""
    names: set[str] = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                names.add(node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", ""))
    return names


@pytest.mark.requirement("S1")
def test_every_public_stage_has_a_caller_in_the_pipeline() -> None:
    """Called by a file of the pipeline, or by a stage that one calls."""
    source = ROOT / "src" / "railfix"
    called = _called_in(source / "pipeline") | _called_in(source / "positioning") | _called_in(source / "integrity")
    in_pipeline = _called_in(source / "pipeline")
    for room, names in STAGES.items():
        face = (source / room / "__init__.pyi").read_text(encoding="utf-8")
        for name in names:
            assert f'"{name}"' in face, f"{room} does not export {name}"
            assert name in called, f"nothing calls {room}.{name}"
    inside = {"find_section", "position_on_line", "robust_fit", "tie_clocks"}
    assert {name for names in STAGES.values() for name in names} - in_pipeline <= inside


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Names of the example after it has run, with a recording where the recordings are present."""
    data = ROOT.parent / "shared" / "data"
    with pytest.MonkeyPatch.context() as patch:
        if data.is_dir():
            folder = tmp_path_factory.mktemp("recording")
            for own, recorded in zip(("log.obs", "log.nav"), _files(data, "m8t"), strict=True):
                (folder / own).symlink_to(recorded)
            write_track_csv(_path(data, "m8t"), folder / "path.csv")
            patch.setenv("RECORDING", str(folder))
        return runpy.run_path(str(EXAMPLE))


def assert_same_positions(fix: Any, result: Any, *, least: float) -> None:
    """Assert that positions by hand and by the pipeline are equal to a millimetre at every epoch, gaps included."""
    assert np.isfinite(result.fix.constrained.arc_m).mean() > least
    np.testing.assert_allclose(fix.constrained.arc_m, result.fix.constrained.arc_m, rtol=0.0, atol=1e-3)
    np.testing.assert_array_equal(fix.section.vertex, result.fix.section.vertex)


@pytest.mark.requirement("S1")
@pytest.mark.requirement("G2")
def test_the_stages_of_the_example_are_the_pipeline_to_a_millimetre(names: dict[str, Any]) -> None:
    text = EXAMPLE.read_text(encoding="utf-8").split('"""', 2)[2].split("# Comparison with the pipeline")[0]
    by_hand = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    assert len(by_hand) <= 30
    for case, (fix, result) in names["compared"].items():
        assert_same_positions(fix, result, least=0.3 if case == "recording" else 0.8)


@cache
def _recording(folder: Path, name: str) -> tuple[Observations, Navigation, Trajectory]:
    """Return a recording, its navigation data, and a line by its reference positions."""
    if name == "esbc":
        place = folder / "static" / "ESBC_2020177"
        log = read_observations(next(place.glob("*.crx.gz")))[:600]
        along = log.header.approximate_ecef_m + np.linspace(-400.0, 400.0, 81)[:, None] * np.array([-0.2, 0.98, 0.0])
        return (
            log,
            read_navigation(next(place.glob("*_MN.rnx.gz"))),
            Trajectory.from_antenna_path(Track.from_ecef(along)),
        )
    files = _files(folder, name)
    line = Trajectory.from_antenna_path(_path(folder, name))
    return read_observations(files[0]), read_navigation(files[1]), line


def _files(folder: Path, name: str) -> tuple[Path, Path]:
    """Return the observation and navigation files of a drive."""
    town, japan = (next((folder / "kinematic").glob(f"{begin}*")) for begin in ("urbannav_tst", "japan"))
    return {
        "f9p": (town / "20210517.light-urban.tste.ublox.f9p.obs", town / "hksc137c.nav"),
        "m8t": (town / "20210517.light-urban.tste.ublox.m8t.GC.obs", town / "hksc137c.nav"),
        "japan": (japan / "SEPT265G.21O", japan / "SEPT2650.21P"),
    }[name]


def _path(folder: Path, name: str) -> Track:
    """Return the path of the antenna by the reference positions of a drive."""
    time, place_ecef_m = recordings_truth.TRUTHS["japan" if name == "japan" else "urbannav"](folder)
    known = np.isfinite(place_ecef_m).all(axis=1)
    return from_positions(time[known], place_ecef_m[known])


@pytest.mark.requirement("S1")
@pytest.mark.usefixtures("recordings")
def test_the_notebook_runs_on_a_recording(names: dict[str, Any]) -> None:
    assert "recording" in names["compared"]  # compared with the others


@pytest.mark.requirement("S1")
@pytest.mark.parametrize("name", ["japan", "f9p", "m8t", "esbc"])
@pytest.mark.parametrize("systems", [("G",), ("G", "J", "E", "C")], ids=["one", "four"])
@pytest.mark.parametrize("ionosphere", ["received", "absent"])
def test_stages_by_hand_are_the_pipeline_on_recordings(
    recordings: Path, names: dict[str, Any], name: str, systems: tuple[str, ...], ionosphere: str
) -> None:
    log, navigation, line = _recording(recordings, name)
    if ionosphere == "absent":
        navigation = replace(navigation, klobuchar={})
    _, fix = names["positions_by_hand"](log, navigation, line, systems)
    config = Config(systems=systems, screens=("elevation",), filter="off")
    result, _ = EpochProcessor(config, {"front": line}, navigation=navigation).process({"front": log})
    assert_same_positions(fix, result["front"], least=0.3)


@pytest.mark.requirement("B4")
def test_faults_excluded_by_hand_are_those_of_the_pipeline(names: dict[str, Any]) -> None:
    """With the noise scale held at 1 and no memory of biases, RAIM needs the epoch alone."""
    log, navigation, line = names["log"], names["navigation"], names["line"]
    code = log.code_m.copy()
    code[200:400:3, :4] += 60.0
    log = replace(log, code_m=code)
    config = Config(
        screens=("elevation", "raim"), filter="off", noise_scale={"prior": 1e15},
        lasting_errors=LastingErrorLimits(most_satellites=0),
    )  # fmt: skip
    result, _ = EpochProcessor(config, {"front": line}, navigation=navigation).process({"front": log})
    used, fix = names["positions_by_hand"](log, navigation, line, config.systems)
    _, fix, raim = integrity.exclude_faults(used, line, fix)
    assert (raim.outcome == integrity.Outcome.EXCLUDED_ONE).sum() > 50
    np.testing.assert_array_equal(raim.outcome, result["front"].raim.outcome)
    np.testing.assert_array_equal(raim.excluded, result["front"].raim.excluded)
    assert_same_positions(fix, result["front"], least=0.8)


def _nine() -> tuple[Any, Any, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Nine satellites of two constellations: line, arc lengths, satellites, codes, sigmas, clocks."""
    line, arc = synthetic.line(), np.linspace(200.0, 800.0, 20)
    made = synthetic.ranges(line, arc, systems="GGGGGEEEE", sigma_m=0.5)
    return line, arc, made.sat_ecef_m, made.code_m, np.full(made.code_m.shape, 0.5), np.array(list("GGGGGEEEE"))


@pytest.mark.requirement("A3")
@pytest.mark.requirement("A4")
def test_a_range_that_is_nan_is_not_used_and_a_faulty_one_is_excluded() -> None:
    """One satellite 60 m too long at half of the epochs."""
    line, arc, satellites, code, sigma, clock = _nine()
    faulty = code + np.where((np.arange(9) == 2) & (np.arange(20) % 2 == 0)[:, None], 60.0, 0.0)
    used = positioning.weighted_ranges(satellites, faulty, sigma, clock)
    fix = positioning.fix_on_line(used, line, positioning.point_position(used, line.ecef_m[0]))
    rest, clean, found = integrity.exclude_faults(used, line, fix)
    assert found.excluded[::2, 2].all()
    assert found.excluded.sum() == 10
    assert np.abs(clean.constrained.arc_m - arc).max() < 3.0
    absent = positioning.weighted_ranges(satellites, np.where(found.excluded, np.nan, faulty), sigma, clock)
    np.testing.assert_array_equal(absent.weight, rest.weight)
    by_nan = positioning.fix_on_line(absent, line, positioning.point_position(absent, line.ecef_m[0]))
    np.testing.assert_allclose(by_nan.constrained.arc_m, clean.constrained.arc_m, atol=1e-3)
    model = integrity.linear_model(rest, line, clean.constrained.arc_m, section=clean.constrained.section)
    level = integrity.protection_level(model, clock.tolist(), n_excluded=found.excluded)
    assert (level.level_m > np.abs(clean.constrained.arc_m - arc)).all()
    before = integrity.linear_model(used, line, fix.constrained.arc_m, section=fix.constrained.section)
    with pytest.raises(ValueError, match="uses excluded satellites; build it from the") as solved:
        integrity.protection_level(before, clock.tolist(), n_excluded=found.excluded)
    with pytest.raises(ValueError, match="scale must be positive") as scaled:
        integrity.exclude_faults(used, line, fix, scale=0.0)
    assert all(f"`{error.value}`" in PAGE for error in (solved, scaled))


#: Arguments of `weighted_ranges` (satellites, codes, sigmas, clocks) that cannot be right: which, how, the sentence.
NONSENSE: dict[str, tuple[int, Callable[[Any], Any], str]] = {
    "sigma -1": (2, lambda g: _first(g, -1.0), "sigma_m has -1 m; a standard deviation is positive"),
    "sigma 0": (2, lambda g: _first(g, 0.0), "sigma_m has 0 m; a standard deviation is positive"),
    "satellites in km": (0, lambda s: s / 1e3, "from the centre of the Earth, expected 20000000 to 60000000 m"),
    "codes in km": (1, lambda c: c / 1e3, "a pseudorange lies between 10000000 and 100000000 m"),
    "system X": (3, lambda _: ["X"] * 9, "clock names 'X', which is not a constellation; known are G"),
    "system g": (3, lambda _: ["g"] * 9, "clock names 'g', which is not a constellation"),
    "mixed clocks": (3, lambda _: list("GEGGGEEEE"), "must be adjacent"),
    "clock too short": (3, lambda k: k[:5], "clock names 5 channels, code_m has 9"),
    "one epoch": (1, lambda c: c[0], r"code_m has shape \(9,\), expected \(T, M\)"),
    "objects": (1, lambda c: c.astype(object), "code_m has elements of type object, expected float64"),
    "texts": (1, lambda c: c.astype(str), "code_m has elements of type <U32, expected float64"),
    "float32": (1, lambda c: c.astype(np.float32), "code_m has elements of type float32, expected float64"),
    "other sigma": (2, lambda g: g[:, :4], "sigma_m has shape"),
    "other satellites": (0, lambda s: s[:, :4], "sat_ecef_m has shape"),
}


def _first(sigma: np.ndarray, value: float) -> np.ndarray:
    changed = sigma.copy()
    changed[0, 0] = value
    return changed


@pytest.mark.requirement("S1")
@pytest.mark.parametrize("case", NONSENSE)
def test_nonsense_is_one_sentence(case: str) -> None:
    which, change, sentence = NONSENSE[case]
    given: list[Any] = list(_nine()[2:])
    given[which] = change(given[which])
    with pytest.raises(ValueError, match=sentence) as error:
        positioning.weighted_ranges(*given)
    assert "\n" not in str(error.value)
    assert f"`{error.value}`" in PAGE


@pytest.mark.requirement("S1")
def test_lists_are_arrays_and_systems_are_known() -> None:
    line, arc, satellites, code, sigma, clock = _nine()
    used = positioning.weighted_ranges(satellites.tolist(), code.tolist(), sigma.tolist(), clock.tolist())
    fix = positioning.fix_on_line(used, line, positioning.point_position(used, line.ecef_m[0]))
    assert np.abs(fix.constrained.arc_m - arc).max() < 3.0
    channels = np.array(["G01", "E05"]), np.array(["1C", "1C"])
    for letter in ("X", "g"):
        with pytest.raises(
            ValueError, match=f"systems names '{letter}', which is not a constellation; known are G"
        ) as e:
            ranges.select_channels(*channels, systems=(letter,))
        assert f"`{e.value}`".replace("'g'", "'X'") in PAGE


@pytest.mark.requirement("S1")
def test_every_screen_has_metric_limit_and_reject() -> None:
    """What is beyond the limit, on the side that the screen names, is rejected."""
    elevation = np.array([[10.0, 30.0, np.nan]])
    low = screens.elevation_screen(elevation)
    np.testing.assert_array_equal(low.reject, low.metric < low.limit)
    weak = screens.cn0_screen(
        np.array([[25.0, 45.0, np.nan]]), elevation, satellite=np.array(["G01", "G02", "G03"]),
        signal=np.array(["1C"] * 3), limits=screens.Cn0Limits(floor_dbhz=30.0),
    )  # fmt: skip
    assert weak.reject.tolist() == [[True, False, False]]
    np.testing.assert_array_equal(weak.floor.reject, weak.floor.metric < weak.floor.limit)
    for name in screens.__all__:
        if name.endswith("_screen"):
            returned = _own_types(get_type_hints(getattr(screens, name))["return"])
            assert any(issubclass(own, screens.Screened) for own in returned), name
    apart = screens.antenna_spacing_screen(np.array([100.0, 120.0]), np.array([80.0, 80.0]), 20.0)
    np.testing.assert_array_equal(apart.reject, np.abs(apart.metric) > apart.limit)


#: Sources of stages: a paper with its section, another publication with its year, a program with its function.
SOURCE = re.compile(r"P[1-5]\b|\b(19|20)\d\d\b|RTKLIB: `\w+`")


@pytest.mark.requirement("S1")
@pytest.mark.parametrize("room", STAGES)
def test_a_public_stage_names_its_source_first(room: str) -> None:
    package = import_module(f"railfix.{room}")
    for name in STAGES[room]:
        first = " ".join(inspect.getdoc(getattr(package, name)).split("\n\n")[:2])
        assert SOURCE.search(first), name


def _own_types(annotation: Any) -> Iterator[type]:
    """Yield the classes of the package that an annotation names."""
    if isinstance(annotation, type) and annotation.__module__.startswith("railfix"):
        yield annotation
    for part in get_args(annotation):
        yield from _own_types(part)


@pytest.mark.requirement("S1")
def test_types_that_a_call_of_a_stage_needs_are_exported() -> None:
    faces = [
        import_module(f"railfix.{room}") for room in (*STAGES, "core", "gnss", "screens", "track", "integrity.raim")
    ]
    exported = {getattr(face, name) for face in faces for name in face.__all__ if isinstance(getattr(face, name), type)}
    functions = [getattr(import_module(f"railfix.{room}"), name) for room, names in STAGES.items() for name in names]
    functions += [getattr(screens, name) for name in screens.__all__ if name.endswith("_screen")]
    assert len(functions) > 20
    hidden = {
        f"{function.__name__}: {own.__name__}"
        for function in functions
        for annotation in get_type_hints(function).values()
        for own in set(_own_types(annotation)) - exported
    }
    assert not hidden
