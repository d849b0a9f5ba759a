"""Compiled kernels give what plain Python gives; the code on disk is that of the source."""

from __future__ import annotations

import copy
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import raim_cases
from plain_kernels import plain
from railfix import kernels
from railfix.core.arrays import read_only
from railfix.io import read_navigation, read_observations
from railfix.kernels import compiling
from railfix.kernels.compiling import compute_stamp
from railfix.kernels.tracking.recursion import advance
from railfix.kernels.tracking.velocity import write_velocities
from railfix.live.warm_up import compile_filter
from railfix.pipeline.config import Config
from railfix.pipeline.results import Result
from railfix.positioning.igg3_fit import robust_fit
from railfix.positioning.normal_equations import misfit, normal_equations, point_position, position_on_line
from railfix.run.processor_setup import make_processor
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
    kernels.load()
    compiled = {function.py_func for function in compiling.COMPILED}
    assert compiled == {getattr(getattr(kernels, m), name).py_func for m, name in NAMES} | {
        advance.py_func, write_velocities.py_func,
    }  # fmt: skip


@pytest.mark.requirement("A6")
def test_velocities_are_those_of_reweighted_least_squares() -> None:
    """Epochs of 3 to 14 rows, some with a false row, against numpy's."""
    rng, epochs, channels = np.random.default_rng(5), 40, 14
    gradient = rng.normal(size=(epochs, channels, 3))
    gradient /= np.linalg.norm(gradient, axis=-1, keepdims=True)
    true, up = rng.normal(size=(epochs, 3)) * [10.0, 10.0, 0.1], np.array([0.0, 0.0, 1.0])
    variance = rng.uniform(0.5, 2.0, (epochs, channels)) * 0.03**2
    value = (gradient * true[:, None]).sum(axis=-1) + 150.0 + rng.normal(size=variance.shape) * np.sqrt(variance)
    value[::3, 0] += 3.0
    has = np.arange(channels) < rng.integers(3, channels + 1, epochs)[:, None]
    velocity, covariance = np.full((epochs, 3), np.nan), np.full((epochs, 3, 3), np.nan)
    for t in range(epochs):
        h, y, r = np.zeros((channels + 1, 4)), np.zeros(channels + 1), np.zeros(channels + 1)
        h[:-1, :3], y[:-1], r[:-1], count = gradient[t], value[t], variance[t], int(has[t].sum())
        plain("tracking.velocity").fit_velocity(h, y, r, count, up, velocity[t], covariance[t])
    found = 0
    for t in range(epochs):
        design, rest = np.insert(gradient[t, has[t]], 3, 1.0, axis=1), value[t, has[t]] - np.median(value[t, has[t]])
        weight, count = np.ones(len(rest)), len(rest)
        rows = np.diag([1e-3, 1e-3, 1e-3, 1e-3])
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


def test_arrays_of_any_caller_are_of_one_type_for_kernels() -> None:
    """Writable, read-only and strided arrays: nothing is compiled for them beyond what the first call compiles."""
    frozen, line = raim_cases.made(np.full(4, 731.0), "GGGGGEEE", seed=1), raim_cases.LINE
    vertex = np.full(4, int(np.argmin(np.abs(line.arc_m - 731.0))))
    place = line.ecef_m[vertex]
    places = [read_only(place), place, np.asfortranarray(place)]
    others = [replace(frozen, code_m=frozen.code_m.copy()), replace(frozen, weight=np.asfortranarray(frozen.weight))]
    used = (kernels.ranges.misfits, kernels.ranges.reduced_equations, kernels.ranges.iterate_points)
    used += (kernels.ranges.iterate_along, kernels.robust.reweight_ranges)
    compiled = []
    for ranges, near in zip([frozen, *others], places, strict=True):
        misfit(ranges, near)
        normal_equations(ranges, near)
        point_position(ranges, near)
        position_on_line(ranges, line, vertex)
        robust_fit(ranges, near)
        compiled.append([len(kernel.signatures) for kernel in used])
    assert compiled[0] == compiled[1] == compiled[2]


@pytest.mark.requirement("A8")
def test_the_recursion_is_compiled_by_itself_for_the_arrays_of_a_run() -> None:
    """It is called in a process of its own, whose failure would only make the first run slower."""
    before = len(advance.signatures)
    compile_filter()
    assert len(advance.signatures) == max(before, 1)


@pytest.mark.slow
@pytest.mark.requirement("A8")
def test_a_new_machine_compiles_all_kernels_once_and_loads_them_from_then_on(tmp_path: Path) -> None:
    """A live session loads them before it begins; nothing is compiled then."""
    program = """
from railfix import kernels
from railfix.live.warm_up import prepare_kernels
prepared = prepare_kernels()
kernels.load()
from railfix.kernels.compiling import COMPILED
loaded = sum(len(f.signatures) for f in COMPILED)
compiled = sum(sum(function.stats.cache_misses.values()) for function in COMPILED)
print(prepared, compiled, loaded, *[f.py_func.__name__ for f in COMPILED if f.signatures])
"""
    environment, before = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}, 0
    for expected in ("True", "False"):
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
        prepared, compiled, loaded, *names = done.stdout.split()
        assert prepared == expected
        assert set(names) >= {name for _, name in NAMES}
        assert int(loaded) >= len(names)
        # the recursion of the filter is compiled in another process meanwhile
        assert int(compiled) == 0 if before else 0 < int(compiled) < int(loaded)
        before = int(loaded)


def test_code_on_disk_is_that_of_all_files_that_it_calls(tmp_path: Path) -> None:
    """numba looks at the file of the function alone; here a change of what it calls compiles again.

    So does a named tuple that has moved to another file: numba could not even read the types of its arguments.
    """
    room, names = Path(kernels.__file__).parent, ("tracking.recursion", "search")
    copied = tmp_path / "railfix" / "kernels"
    shutil.copytree(room, copied, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "railfix" / "core").mkdir()
    shutil.copy(room.parent / "core" / "constants.py", tmp_path / "railfix" / "core")
    before = {name: compute_stamp(copied, name) for name in names}
    changes = {
        "kernels/tracking/constants": ("# changed", {"tracking.recursion"}),
        "core/constants": ("# changed", set(names)),
        "arrays": ("class RangeArrays(NamedTuple): ...", set(names)),
        "plain": ("x = 1", set()),
    }
    for changed, (text, of) in changes.items():
        with (tmp_path / "railfix" / f"{changed}.py").open("a") as file:
            file.write(f"{text}\n")
        for function in (compute_stamp, compiling._tuples):
            function.cache_clear()
        after = {name: compute_stamp(copied, name) for name in names}
        assert {name for name in names if after[name] != before[name]} == of, changed
        before = after


def test_code_of_other_sources_is_removed_from_disk(tmp_path: Path) -> None:
    """What was compiled before a function changed that it calls; the code of other modules stays."""
    program = """
import numpy as np
from railfix import kernels
from railfix.kernels.compiling import COMPILED
kernels.windows.decayed_sums(np.ones((1, 1)), np.ones(1), np.ones(1), np.ones((1, 1)), np.ones(1, dtype=np.intp))
print(*[sum(f.stats.cache_misses.values()) for f in COMPILED if f.signatures])
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def misses() -> str:
        command = [sys.executable, "-c", program]
        return subprocess.run(command, capture_output=True, text=True, env=environment, check=True).stdout.strip()

    assert [misses(), misses()] == ["1", "0"]
    (stamp,) = tmp_path.rglob("windows.sha256")
    others = stamp.with_name("search.points.py311.nbi")
    others.touch()
    stamp.write_text("of other sources")
    assert [misses(), misses()] == ["1", "0"]
    assert others.exists()


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


@pytest.mark.parametrize("terminal", [True, False])
@pytest.mark.every(4)
def test_a_terminal_is_told_of_compilation_once(tmp_path: Path, terminal: bool) -> None:
    program = "import railfix.kernels.windows, railfix.kernels.search"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    pipe = os.openpty() if terminal else os.pipe()
    reader, writer = pipe
    subprocess.run([sys.executable, "-c", program], stderr=writer, check=True, env=environment)
    os.write(writer, b"end\n")
    told = ""
    while not told.endswith("end\n"):
        told += os.read(reader, 1000).decode().replace("\r", "")
    assert told == ("compiling kernels for this processor once: about a minute\n" if terminal else "") + "end\n"
    for end in pipe:
        os.close(end)


def test_plain_kernels_do_not_warn_of_integers_that_wrap_around() -> None:
    """Places of line ends and digits are found by whole words, in which a borrow or a carry beyond the end is meant."""
    text = np.frombuffer(b"> 2024 03 05\nG05  20000000.123\n" * 20, dtype=np.uint8)
    with np.errstate(all="raise"):
        found = plain("reading").line_ends(text)
    np.testing.assert_array_equal(found, np.flatnonzero(text == 10))
