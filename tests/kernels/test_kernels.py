"""Compiled kernels give what plain Python gives; the code on disk is that of the source."""

from __future__ import annotations

import copy
import operator
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba.core.types.functions import BaseFunction

import raim_oracle
import separation_oracle
from plain_kernels import plain
from railfix import kernels
from railfix.core.arrays import read_only
from railfix.integrity.protection import RiskBudget, along_track_level
from railfix.integrity.protection.level import MapDeviation, RangeBounds
from railfix.integrity.raim import constrained_model
from railfix.io import read_navigation, read_observations
from railfix.kernels import compiling
from railfix.kernels.compiling import by_reference
from railfix.kernels.tracking.recursion import advance
from railfix.kernels.tracking.velocity import fitted_velocities
from railfix.pipeline.config import Config
from railfix.pipeline.results import Result
from railfix.positioning.noise_scale import robust_fit
from railfix.positioning.normal_equations import constrained_position, fit, normal_equations, single_point
from railfix.run.processor import make_processor
from railfix.simulate.demonstration import demo_inputs
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle

#: Positions and levels may differ by this much [m].
TOLERANCE_M = 1e-6


def result_of(epochs: int, **settings: Any) -> Result:
    """Positions of the first epochs of the demonstration."""
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    track, vehicle = read_track(inputs.track), read_vehicle(inputs.vehicle)
    logs = {"front": read_observations(inputs.front)[:epochs], "rear": read_observations(inputs.rear)[:epochs]}
    paths = {name: antenna_trajectory(track, vehicle, name) for name in logs}
    return make_processor(Config(**settings), read_navigation(inputs.nav), paths).process(logs)[0]


def copied(value: Any) -> Any:
    """Deep copy of arguments, arrays as writable as they were: others would be compiled for."""
    if isinstance(value, tuple):
        parts = [copied(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    other = copy.deepcopy(value)
    if isinstance(value, np.ndarray):
        other.flags.writeable = value.flags.writeable
    return other


#: Functions of single epochs by their module.
KERNELS = {
    "hypotheses": ("tails_of_hypotheses",),
    "level": ("solve_level",),
    "model": ("linearise_ranges", "residuals"),
    "off_tangent": ("forms_of_hypotheses", "risk_beyond", "risk_off_tangent"),
    "ranges": ("reduced_equations", "misfits", "iterate_points", "dilutions", "iterate_along"),
    "reading": ("decode_fields", "place_fields", "line_ends"),
    "robust": ("reweight_ranges",),
    "screens": ("suspicions", "clock_medians", "falls_of_cn0", "clock_steps", "holds"),
    "search": ("radii_of_balls", "points_in_balls", "best_points", "clear_of_sections"),
    "windows": ("window_ages", "decayed_sums"),
}
NAMES = [(module, name) for module, names in KERNELS.items() for name in names]


@pytest.fixture(scope="module")
def calls() -> dict[str, list[tuple[Any, ...]]]:
    """Arguments of the first calls of each kernel in a run."""
    found: dict[str, list[tuple[Any, ...]]] = {}

    def recording(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def recorded(*arguments: Any) -> Any:
            if len(found.setdefault(name, [])) < 4:
                found[name].append(copied(arguments))
            return function(*arguments)

        return recorded

    with pytest.MonkeyPatch.context() as patch:
        for module, name in NAMES:
            of = getattr(kernels, module)
            patch.setattr(of, name, recording(name, getattr(of, name)))
        result_of(330, filter="off")  # until the line turns within reach of a level
        # Too few satellites for a 3-D position: coarse to fine.
        result_of(5, systems=("G",), elevation={"mask_deg": 45.0}, protection="off", filter="off")
    return found


def cut(arguments: tuple[Any, ...], name: str) -> tuple[Any, ...]:
    """A text short enough for plain Python."""
    if name == "decode_fields":
        data, start, length, *rest = arguments
        return data, start[:100], length[:100], *rest
    return (arguments[0][:20_000],) if name == "line_ends" else arguments


@pytest.mark.requirement("A8")
@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning", "ignore:divide by zero:RuntimeWarning")
@pytest.mark.parametrize(("module", "name"), NAMES)
def test_each_kernel_gives_what_it_gives_as_plain_python(
    calls: dict[str, list[tuple[Any, ...]]], module: str, name: str
) -> None:
    """The compiler adds sums in another order, and takes mathematics of its own."""
    for call in calls[name]:
        expected = getattr(plain(module), name)(*cut(copied(call), name))
        given = getattr(getattr(kernels, module), name)(*cut(copied(call), name))
        if not isinstance(expected, tuple):
            expected, given = (expected,), (given,)
        assert len(given) == len(expected), name
        for one, other in zip(given, expected, strict=True):
            assert np.shape(one) == np.shape(other), name
            if np.asarray(other).dtype.kind == "f":
                np.testing.assert_allclose(one, other, rtol=1e-7, atol=TOLERANCE_M, err_msg=name)
            else:
                np.testing.assert_array_equal(one, other, err_msg=name)


def test_every_kernel_of_single_epochs_is_compared() -> None:
    compiled = {function.py_func for function in compiling.COMPILED}
    assert compiled == {getattr(getattr(kernels, m), name).py_func for m, name in NAMES} | {
        advance.py_func, fitted_velocities.py_func,
    }  # fmt: skip


@pytest.mark.requirement("A6")
def test_velocities_are_those_of_reweighted_least_squares() -> None:
    """Epochs of 3 to 14 rows, one with a false row, against numpy's; the same as plain Python."""
    rng, epochs, channels = np.random.default_rng(5), 40, 14
    gradient = rng.normal(size=(epochs, channels, 3))
    gradient /= np.linalg.norm(gradient, axis=-1, keepdims=True)
    true, up = rng.normal(size=(epochs, 3)) * [10.0, 10.0, 0.1], np.tile([0.0, 0.0, 1.0], (epochs, 1))
    variance = rng.uniform(0.5, 2.0, (epochs, channels)) * 0.03**2
    value = (gradient * true[:, None]).sum(axis=-1) + 150.0 + rng.normal(size=variance.shape) * np.sqrt(variance)
    value[::3, 0] += 3.0
    has = np.arange(channels) < rng.integers(3, channels + 1, epochs)[:, None]
    value[~has] = variance[~has] = np.nan
    velocity, covariance = fitted_velocities(gradient, value, variance, has, up)
    for made, expected in zip(
        (velocity, covariance),
        plain("tracking.velocity").fitted_velocities(gradient, value, variance, has, up),
        strict=True,
    ):
        np.testing.assert_allclose(made, expected, rtol=1e-9, atol=1e-12)
    found = 0
    for t in range(epochs):
        design, rest = np.insert(gradient[t, has[t]], 3, 1.0, axis=1), value[t, has[t]] - np.median(value[t, has[t]])
        weight, count = np.ones(len(rest)), len(rest)
        rows = np.diag([1e-3, 1e-3, 1e-3, 1e-6])
        rows = np.vstack([rows, [0.0, 0.0, 1.0 / 0.3, 0.0]])
        for _ in range(8):
            root = np.sqrt(weight / variance[t, has[t]])
            solved = np.linalg.lstsq(np.vstack([design * root[:, None], rows]), np.append(rest * root, np.zeros(5)))[0]
            square = (rest - design @ solved) ** 2 / variance[t, has[t]]
            weight = 5.0 / (4.0 + square)
        if count < 5 or weight.sum() < 0.9 * count:
            assert np.isnan(velocity[t]).all()
            assert np.isnan(covariance[t]).all()
            continue
        found += 1
        np.testing.assert_allclose(velocity[t], solved[:3], atol=1e-8)
    assert found > 15


class Numbers(NamedTuple):
    """Arrays of several types and layouts, and numbers, as those of the filter."""

    turned: np.ndarray
    marked: np.ndarray
    degrees: tuple[float, float]
    doubled: bool
    count: int


class Given(NamedTuple):
    """A tuple within a tuple, before and behind other fields."""

    cube: np.ndarray
    numbers: Numbers
    sums: np.ndarray


@compiling.borrowing
def write_sums(numbers: Numbers, given: Given) -> int:
    for i in range(numbers.count):
        for k in range(given.cube.shape[1]):
            if numbers.marked[i, k]:
                given.sums[i] += given.cube[i, k, 0] * numbers.turned[k, i] + numbers.degrees[1]
        given.sums[i] *= 2.0 if numbers.doubled else 1.0
    return len(given.sums)


@numba.njit(**compiling._OPTIONS, **compiling._UNCOUNTED)
def compute_sums(given: Given) -> int:
    return write_sums(by_reference(given.numbers), by_reference(given))


@numba.njit(**compiling._OPTIONS, **compiling._UNCOUNTED)
def compute_nested_sums(given: Given) -> int:
    return write_nested_sums(by_reference(given))


@compiling.borrowing
def write_nested_sums(given: Given) -> int:
    return write_sums(given.numbers, given)


def test_arrays_of_any_caller_are_of_one_type_for_kernels() -> None:
    """Writable, read-only and strided arrays: nothing is compiled for them beyond what the first call compiles."""
    frozen, line = raim_oracle.made(np.full(4, 731.0), "GGGGGEEE", seed=1), raim_oracle.LINE
    vertex = np.full(4, int(np.argmin(np.abs(line.arc_m - 731.0))))
    place = line.ecef_m[vertex]
    places = [read_only(place), place, np.asfortranarray(place)]
    others = [replace(frozen, code_m=frozen.code_m.copy()), replace(frozen, weight=np.asfortranarray(frozen.weight))]
    used = (kernels.ranges.misfits, kernels.ranges.reduced_equations, kernels.ranges.iterate_points)
    used += (kernels.ranges.iterate_along, kernels.robust.reweight_ranges)
    compiled = []
    for ranges, near in zip([frozen, *others], places, strict=True):
        fit(ranges, near)
        normal_equations(ranges, near)
        single_point(ranges, near)
        constrained_position(ranges, line, vertex)
        robust_fit(ranges, near)
        compiled.append([len(kernel.signatures) for kernel in used])
    assert compiled[0] == compiled[1] == compiled[2]


@pytest.mark.requirement("A8")
@pytest.mark.parametrize("function", [compute_sums, compute_nested_sums])
def test_tuples_by_reference_have_the_fields_that_they_have(function: Callable[..., int]) -> None:
    rng = np.random.default_rng(2)
    cube, turned, marked = rng.normal(size=(4, 3, 2)), rng.normal(size=(4, 6))[:, ::2].T, rng.random((4, 3)) > 0.4
    for doubled in (False, True):
        given = Given(cube, Numbers(turned, marked, (1.0, 5.0), doubled, 3), np.zeros(4))
        assert function(given) == 4
        expected = ((cube[..., 0] * turned.T + 5.0) * marked).sum(axis=1) * (1 + doubled)
        np.testing.assert_allclose(given.sums, np.append(expected[:3], 0.0), rtol=1e-13)


@pytest.mark.requirement("C2")
@pytest.mark.parametrize("systems", ["GGGGG", "GGGEE", "GGGGGEE", "GGGGEEEECCCR", "GGGGGGGGEEEEEEECCCC"])
@pytest.mark.parametrize(
    ("by_range", "side_prior", "local_prior"),
    [(False, 1e-7, 1e-3), (True, 1e-3, 1e-3), (False, 3e-5, 4e-3), (True, 1e-3, 4e-3)],
)
def test_levels_of_every_kind_of_hypothesis_are_those_of_all_sets_side_by_side(
    systems: str, by_range: bool, side_prior: float, local_prior: float
) -> None:
    """Constellations, sides, a wrong map, these together, up to four satellites; overbounds; what nothing checks."""
    arc, n, rng = np.linspace(200.0, 1800.0, 12), len(systems), np.random.default_rng(3)
    ranges = raim_oracle.made(arc, systems, seed=8, faults_m={1: 9.0})
    weight = ranges.weight * (rng.random(ranges.weight.shape) > 0.15)
    model = constrained_model(replace(ranges, weight=weight), raim_oracle.LINE, arc)
    known = np.tile(np.diag([0.1, 0.01]), (12, 1, 1)) * (rng.random(12) > 0.3)[:, None, None]
    options: dict[str, Any] = {
        "risk": RiskBudget(
            risk_per_hour=1e-3,
            local_prior=local_prior,
            side_prior=side_prior,
            constellation_prior={"E": 1e-7, "C": 1e-6},
        ),
        "scale": np.linspace(0.6, 2.0, 12),
        "map_error": MapDeviation(rng.normal(size=(12, 2)), (rng.normal(size=(12, 2)), known)),
        "sides": rng.random((12, 2, n)) > 0.6,
        "n_excluded": np.arange(12) % 3,
    }
    if by_range:
        options["overbound"] = RangeBounds(rng.uniform(0.0, 5.0, (12, n)), rng.uniform(0.0, 1.0, (12, n)))
    both = []
    for function in (separation_oracle.tails_of_hypotheses, kernels.hypotheses.tails_of_hypotheses):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kernels.hypotheses, "tails_of_hypotheses", function)
            both.append(along_track_level(model, list(systems), **options))
    assert n < 6 or np.isfinite(both[0].level_m).any()
    for name in both[0].__dataclass_fields__:
        expected, given = getattr(both[0], name), getattr(both[1], name)
        if expected.dtype.kind == "f":
            np.testing.assert_allclose(given, expected, rtol=1e-7, atol=TOLERANCE_M, err_msg=name)
        else:
            np.testing.assert_array_equal(given, expected, err_msg=name)


@pytest.mark.requirement("A8")
def test_all_kernels_are_loaded_before_a_live_session_needs_them(calls: dict[str, list[tuple[Any, ...]]]) -> None:
    for module, name in NAMES:
        getattr(getattr(kernels, module), name)(*copied(calls[name][0]))  # on disk from here on
    program = """
from railfix import kernels
loaded = kernels.load()
from railfix.kernels.compiling import COMPILED
print(loaded, *[function.py_func.__name__ for function in COMPILED if function.signatures])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded, *names = done.stdout.split()
    assert int(loaded) >= len(names)
    assert set(names) >= {name for _, name in NAMES}


@pytest.mark.slow
@pytest.mark.requirement("A8")
def test_a_session_on_a_new_machine_compiles_all_kernels_before_it_begins(tmp_path: Path) -> None:
    """Twice in processes of their own: the second finds all of them on disk."""
    program = """
from railfix import kernels
from railfix.live.warm_up import prepare_kernels
print(prepare_kernels(), *kernels.missing())
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    for expected in ("True", "False"):
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=True
        )
        assert done.stdout.split() == [expected]


def test_code_on_disk_is_that_of_all_files_that_it_calls(tmp_path: Path) -> None:
    """numba looks at the file of the function alone; here a change of what it calls compiles again."""
    room = Path(kernels.__file__).parent
    recursion, stamp = "tracking.recursion", import_module("railfix.kernels.compiling").stamp
    advance = import_module(f"railfix.kernels.{recursion}").advance
    assert advance._cache._cache_file._source_stamp == stamp(room, recursion)
    copied = tmp_path / "railfix" / "kernels"
    shutil.copytree(room, copied, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "railfix" / "core").mkdir()
    shutil.copy(room.parent / "core" / "constants.py", tmp_path / "railfix" / "core")
    before = {name: stamp(copied, name) for name in (recursion, "search")}
    assert before == {name: stamp(room, name) for name in before}
    for changed, names in {"kernels/tracking/update": {recursion}, "core/constants": {recursion, "search"}}.items():
        with (tmp_path / "railfix" / f"{changed}.py").open("a") as file:
            file.write("# changed\n")
        stamp.cache_clear()
        after = {name: stamp(copied, name) for name in before}
        assert {name for name in before if after[name] != before[name]} == names
        before = after


@pytest.mark.requirement("A8")
def test_arrays_of_a_trajectory_and_records_stay_read_only_in_another_process() -> None:
    """The second channel of a live session gets them pickled; for writable ones each kernel was compiled again."""
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    path = antenna_trajectory(read_track(inputs.track), read_vehicle(inputs.vehicle), "front")
    assert path.length_m.size
    assert path.tangent.size  # cached with the instance
    for sent in (path, read_navigation(inputs.nav).kepler):
        got = pickle.loads(pickle.dumps(sent))
        arrays = {name: value for name, value in vars(sent).items() if isinstance(value, np.ndarray)}
        assert len(arrays) > 5
        for name, value in arrays.items():
            assert not vars(got)[name].flags.writeable, name
            np.testing.assert_array_equal(vars(got)[name], value)


def test_code_on_disk_with_types_of_an_older_version_is_compiled_anew(tmp_path: Path) -> None:
    """A table of arguments was renamed since: numba cannot read the index of the code on disk."""
    (tmp_path / "tables.py").write_text("from typing import NamedTuple\nclass Old(NamedTuple):\n    x: float\n")
    program = """
import sys
import railfix.kernels.search
from railfix.kernels import compiling
function = compiling.COMPILED[0]
index = function._cache._cache_file
if len(sys.argv) > 1:
    sys.path.insert(0, sys.argv[1])
    from tables import Old
    index._save_index({Old: "x.nbc"})
    assert index._load_index()
else:
    assert index._load_index() == {}, "an index that names what is gone"
    index.save("now", b"code")
    assert index.load("now") == b"code"
"""
    for arguments in ([str(tmp_path)], []):
        subprocess.run(
            [sys.executable, "-c", program, *arguments],
            check=True, env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        )  # fmt: skip


@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.every(2)
def test_a_terminal_is_told_of_compilation_once(terminal: bool) -> None:
    program = """
import numba
import railfix.kernels.compiling
for value in (1, 2):
    function = numba.njit(eval(f"lambda: {value}", {"__name__": "railfix.kernels.made"}))
    function()
"""
    pipe = os.openpty() if terminal else os.pipe()
    reader, writer = pipe
    subprocess.run([sys.executable, "-c", program], stderr=writer, check=True)
    os.write(writer, b"end\n")
    told = ""
    while not told.endswith("end\n"):
        told += os.read(reader, 1000).decode().replace("\r", "")
    assert told == ("compiling for this processor, once: about a minute\n" if terminal else "") + "end\n"
    for end in pipe:
        os.close(end)


@pytest.mark.requirement("A8")
def test_what_the_compiler_has_found_for_types_is_not_looked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    resolve = BaseFunction.get_call_type

    def count(self: BaseFunction, context: object, args: object, kws: object) -> object:
        asked.append((self.typing_key, args))
        return resolve(self, context, args, kws)

    def used_thrice(number: float) -> float:
        return (number + 1.5) * (number + 2.5) * (number + 3.5)

    monkeypatch.setattr(BaseFunction, "get_call_type", count)
    with compiling.keep_resolutions():
        once = numba.njit(used_thrice)
        assert once(2.0) == 3.5 * 4.5 * 5.5
    assert BaseFunction.get_call_type is count
    additions = [args for function, args in asked if function is operator.add]
    assert len(additions) == len(set(additions)) > 0


def test_plain_kernels_do_not_warn_of_integers_that_wrap_around() -> None:
    """Places of line ends and digits are found by whole words, in which a borrow or a carry beyond the end is meant."""
    text = np.frombuffer(b"> 2024 03 05\nG05  20000000.123\n" * 20, dtype=np.uint8)
    with np.errstate(all="raise"):
        found = plain("reading").line_ends(text)
    np.testing.assert_array_equal(found, np.flatnonzero(text == 10))
