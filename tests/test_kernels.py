"""Compiled kernels give what the numpy functions give, one by one and in a whole run."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from railfix import kernels
from railfix.core.errors import SettingsError
from railfix.io.rinex import read_navigation, read_observations
from railfix.pipeline.config import Config
from railfix.pipeline.processor import Result
from railfix.pipeline.tables import antenna_observations, antenna_positions
from railfix.run.processor import processor_of
from railfix.simulate.demonstration import demo_inputs
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle

with_numba = pytest.mark.skipif(find_spec("numba") is None, reason="numba is not installed (railfix[fast])")
#: Positions and levels may differ by this much [m].
TOLERANCE_M = 1e-6


def result_of(epochs: int, **settings: Any) -> Result:
    """Positions of the first epochs of the demonstration."""
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    track, vehicle = read_track(inputs.track), read_vehicle(inputs.vehicle)
    logs = {"front": read_observations(inputs.front)[:epochs], "rear": read_observations(inputs.rear)[:epochs]}
    paths = {name: antenna_trajectory(track, vehicle, name) for name in logs}
    return processor_of(Config(**settings), read_navigation(inputs.nav), paths).process(logs)[0]


@pytest.fixture(scope="module")
def calls() -> dict[str, list[tuple[Any, ...]]]:
    """Arguments of the first calls of each kernel in a run."""
    found: dict[str, list[tuple[Any, ...]]] = {}

    def recording(name: str) -> Callable[..., Any]:
        def reference(*arguments: Any) -> Any:
            if len(found.setdefault(name, [])) < 4:
                found[name].append(copy.deepcopy(arguments))
            return kernels.REGISTERED[name][0](*arguments)

        return reference

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "CHOSEN", "numba")
        patch.setattr(kernels, "compiled", recording)
        result_of(60)
    return found


@with_numba
@pytest.mark.requirement("A7")
def test_each_kernel_gives_what_its_reference_gives(calls: dict[str, list[tuple[Any, ...]]]) -> None:
    assert sorted(calls) == sorted(kernels.REGISTERED), "a kernel that no run calls is not compared"
    for name, arguments in calls.items():
        for call in arguments:
            expected = kernels.REGISTERED[name][0](*copy.deepcopy(call))
            given = kernels.compiled(name)(*copy.deepcopy(call))
            if not isinstance(expected, tuple):
                expected, given = (expected,), (given,)
            assert len(given) == len(expected), name
            for one, other in zip(given, expected, strict=True):
                assert np.shape(one) == np.shape(other), name
                if np.asarray(other).dtype.kind == "f":
                    np.testing.assert_allclose(one, other, rtol=1e-7, atol=TOLERANCE_M, err_msg=name)
                else:
                    np.testing.assert_array_equal(one, other, err_msg=name)


@with_numba
@pytest.mark.requirement("A7")
def test_a_run_is_the_same_with_compiled_kernels() -> None:
    both = {}
    for chosen in ("numpy", "numba"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kernels, "CHOSEN", chosen)
            both[chosen] = result_of(400, filter="off")
    for name, reference in both["numpy"].antennas.items():
        for table in (antenna_positions, antenna_observations):
            expected, given = table(name, reference), table(name, both["numba"].antennas[name])
            assert given.columns == expected.columns
            for column, values in expected.to_dict().items():
                one, other = given[column], values
                if other.dtype.is_float():
                    np.testing.assert_allclose(
                        one.to_numpy(), other.to_numpy(), rtol=1e-9, atol=TOLERANCE_M, err_msg=column
                    )
                else:
                    assert one.equals(other, null_equal=True), column


@pytest.mark.requirement("A7")
def test_the_variable_chooses_and_what_cannot_be_is_said() -> None:
    assert kernels.choose("", installed=True) == "numba"
    assert kernels.choose("auto", installed=False) == "numpy"
    assert kernels.choose("numpy", installed=True) == "numpy"
    with pytest.raises(SettingsError, match=r"not installed; pip install 'railfix\[fast\]'"):
        kernels.choose("numba", installed=False)
    with pytest.raises(SettingsError, match="RAILFIX_KERNELS is 'fast', expected auto, numpy or numba"):
        kernels.choose("fast", installed=True)


@pytest.mark.requirement("A7")
def test_a_wrong_choice_ends_a_command_as_a_setting_does() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "railfix", "run", "--help"],
        capture_output=True, text=True, check=False, env={**os.environ, kernels.VARIABLE: "cuda"},
    )  # fmt: skip
    assert done.returncode == SettingsError.exit_code, done.stderr
    assert "RAILFIX_KERNELS is 'cuda'" in done.stderr


def test_a_name_stands_for_one_kernel() -> None:
    with pytest.raises(ValueError, match="reduced_equations is registered already"):

        @kernels.compiled_by("ranges")
        def reduced_equations() -> None: ...
