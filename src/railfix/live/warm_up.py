"""Compilation of all kernels at the first command on a machine; later commands load them from disk.

Without this step, compilation would delay epochs of a live session by seconds, and a run would pause without a message.
"""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import hatanaka
import numpy as np

from railfix import kernels
from railfix.gnss.observations import Observations
from railfix.integrity.protection.open_places import Forms
from railfix.integrity.raim.position_model import ModelArrays
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import parse_config
from railfix.run.processor_setup import make_processor
from railfix.simulate.demonstration import demo_inputs
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from railfix.tracking.chunk import prepare_chunk
from railfix.tracking.epochs import GnssEpochs, SensorEpochs
from railfix.tracking.filter import Recursion
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.state import TrackState

#: Groups of settings, each with the number of epochs to process. Together, the groups call all single-epoch kernels
#: except the kernels in `_look_beyond`. The second group leaves too few satellites for 3-D positions.
_SINGLE_EPOCHS: Final[tuple[tuple[dict[str, Any], int], ...]] = (
    ({"filter": "off"}, 60),
    ({"filter": "off", "systems": ["G"], "elevation": {"mask_deg": 45.0}, "protection": "off"}, 5),
)
_WITH_FILTER: Final[tuple[dict[str, Any], int]] = ({"filter": "track", "protection": "off"}, 8)


def prepare_kernels() -> bool:
    """Compile the kernels that have no cached machine code; return whether any were compiled.

    Epochs of the demonstration are processed in one call and then one by one, so that kernels are compiled for the
    array types of both cases. If the standard error output is a terminal, the duration is printed. Raise InputFileError
    if the files of the demonstration are missing.
    """
    if kernels.is_compiled():
        return False
    begin = time.monotonic()
    # numba compiles only one function at a time in a process. The functions of the filter, about half of all functions,
    # are therefore compiled in a second process.
    filter_process = subprocess.Popen(
        [sys.executable, "-c", f"from {__name__} import compile_filter; compile_filter()"]
    )
    try:
        logs = _read_logs()
        for chosen, epochs in _SINGLE_EPOCHS:
            _process(chosen, epochs, logs)
        _look_beyond()
    finally:
        filter_process.wait()
    _process(*_WITH_FILTER, logs)
    kernels.record_compiled()
    if sys.stderr.isatty():
        sys.stderr.write(f"kernels compiled in {time.monotonic() - begin:.0f} s; later commands load them\n")
    return True


def compile_filter() -> None:
    """Compile the recursion of the filter along the track; the machine code is cached on disk for other processes."""
    nothing = np.full((1, 1), np.nan)
    epochs = GnssEpochs(
        time=np.array(["2024-01-01"], dtype="datetime64[ns]"), satellite=np.array(["G01"]),
        signal=np.array(["1C"]), clock=np.array(["G"]),
        sat_ecef_m=np.full((1, 1, 3), np.nan), sat_velocity_mps=np.full((1, 1, 3), np.nan), code_m=nothing,
        code_sigma_m=nothing, phase_m=nothing, phase_joined=np.zeros((1, 1), dtype=np.bool_), rate_mps=nothing,
        cn0_dbhz=nothing, off_map=np.zeros(1, dtype=np.bool_),
    )  # fmt: skip
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    line = Line(antenna_trajectory(read_track(inputs.track), read_vehicle(inputs.vehicle), "front"))
    state, limits = TrackState(), TrackingLimits()
    chunk = prepare_chunk(epochs, state, limits)
    recursion = Recursion(chunk, line, SensorEpochs(), limits, state, levels=True)
    recursion.run(state, len(epochs), found=None, trace=None)  # a call without epochs compiles the recursion


def _read_logs() -> dict[str, Observations]:
    """Read the first epochs of the demonstration's logs, and add a simulated fault that RAIM detects."""
    inputs, longest = demo_inputs(), max(epochs for _, epochs in (*_SINGLE_EPOCHS, _WITH_FILTER))
    logs = {"front": _first_epochs(inputs.front[0], longest), "rear": _first_epochs(inputs.rear[0], longest)}
    strongest = str(logs["front"].satellite[np.nan_to_num(logs["front"].cn0_dbhz[0]).argmax()])
    return {name: _faulty(log, strongest) for name, log in logs.items()}


def _process(chosen: dict[str, Any], epochs: int, logs: dict[str, Observations]) -> None:
    """Process the first epochs of the logs with the settings `chosen`, first in one call and then one by one."""
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    track, vehicle = read_track(inputs.track), read_vehicle(inputs.vehicle)
    paths = {name: antenna_trajectory(track, vehicle, name) for name in ("front", "rear")}
    processor, state = make_processor(parse_config(chosen), read_navigation(inputs.nav), paths), None
    processor.process({name: log[:epochs] for name, log in logs.items()})
    for epoch in range(epochs):
        _, state = processor.process({name: log[epoch : epoch + 1] for name, log in logs.items()}, state)


def _look_beyond() -> None:
    """Call the kernels that compute the risk of positions beyond a protection level.

    The straight line of the demonstration does not require these kernels.
    """
    nothing, clock = np.zeros((1, 1)), np.zeros(1, dtype=np.intp)
    model = ModelArrays(
        nothing, clock, np.zeros((1, 1, 1)), np.zeros((1, 1, 3)), np.zeros((1, 3, 3)), np.zeros((3, 3)), nothing
    )
    one, sides = np.ones(1), np.zeros((1, 2, 1), dtype=np.bool_)
    forms = Forms(*kernels.off_tangent.forms_of_hypotheses(model, one, one, sides, 0.0, (1.0, 1.0)))
    sections = np.zeros(2, dtype=np.intp), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1), np.zeros(1)
    kernels.off_tangent.risk_beyond(forms.prior, forms.form, np.zeros(forms.prior.shape), *sections)


def _first_epochs(log: Path, count: int) -> Observations:
    """Read the first epochs of a compact RINEX 3 log; without compiled kernels, the whole file would take too long."""
    lines = hatanaka.decompress(log).decode("ascii").splitlines(keepends=True)
    begins = [number for number, line in enumerate(lines) if line.startswith(">")]
    with TemporaryDirectory() as folder:
        short = Path(folder) / "log.rnx"
        short.write_text("".join(lines[: begins[count]]), encoding="ascii")
        return read_observations(short)


def _faulty(log: Observations, satellite: str) -> Observations:
    """Return the log with 300 m added to one satellite's codes, so that RAIM detects a fault."""
    return replace(log, code_m=log.code_m + np.where(log.satellite == satellite, 300.0, 0.0))
