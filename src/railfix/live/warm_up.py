"""Compilation of all kernels at the first command on a machine: later ones load them from disk.

Two processes share it: the recursion of the filter takes as long as all kernels of single epochs together. During a
live session it would delay epochs by seconds, in a run nobody would know why nothing happens.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, TypeAlias

import hatanaka
import numpy as np

from railfix import kernels
from railfix.gnss.observations import Observations
from railfix.integrity.protection.open_places import Forms
from railfix.integrity.raim.model import ModelArrays
from railfix.io import read_navigation, read_observations
from railfix.kernels.compiling import keep_resolutions
from railfix.pipeline.config import parse_config
from railfix.run.processor import make_processor
from railfix.simulate.demonstration import demo_inputs
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle

_Settings: TypeAlias = tuple[tuple[dict[str, Any], int], ...]
#: Settings and numbers of epochs that together call every kernel of single epochs but those of `_look_beyond`; the
#: second has too few satellites for 3-D positions.
_STAGES: Final[_Settings] = (
    ({"filter": "off"}, 60),
    ({"filter": "off", "systems": ["G"], "elevation": {"mask_deg": 45.0}, "protection": "off"}, 5),
)
_FILTER: Final[_Settings] = (({"filter": "track", "protection": "off"}, 8),)
#: Runs the filter with the stages as plain Python: another process compiles those.
_PROGRAM = "from railfix.live.warm_up import compile_filter; compile_filter()"


def prepare_kernels() -> bool:
    """Compile the kernels that this machine has no code of, and say so on a terminal; return whether there were any.

    InputFileError: neither the package nor the clone has the files of the demonstration, on which they are compiled.
    """
    missing = kernels.missing()
    if not missing:
        return False
    begin = time.monotonic()
    kernels.suppress_announcement()
    _say("compiling for this processor, once: about forty seconds on two cores")
    environment = {**os.environ, kernels.FILTER_ALONE: "1"}
    if kernels.FILTER in missing:
        with subprocess.Popen([sys.executable, "-c", _PROGRAM], env=environment, stderr=subprocess.PIPE) as other:
            try:
                _run(_STAGES)
                _say(f"single epochs compiled after {time.monotonic() - begin:.0f} s; the filter still is")
                _, error = other.communicate()
            except BaseException:  # as the end by a signal, which would wait for it
                other.kill()
                raise
        if other.returncode:
            raise RuntimeError(f"the filter cannot be compiled: {error.decode(errors='replace').strip()}")
    else:
        _run(_STAGES)
    _say(f"compiled in {time.monotonic() - begin:.0f} s; later commands load it")
    return True


def compile_filter() -> None:
    """Compile the recursion of the filter."""
    _run(_FILTER)


def _say(text: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(text + "\n")


def _run(settings: _Settings) -> None:
    """Process epochs of the demonstration at once and one by one: kernels are compiled for the arrays of both."""
    with keep_resolutions():
        _process(settings)
        if settings is _STAGES:
            _look_beyond()


def _process(settings: _Settings) -> None:
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    track, vehicle = read_track(inputs.track), read_vehicle(inputs.vehicle)
    longest = max(epochs for _, epochs in settings)
    logs = {"front": _first_epochs(inputs.front[0], longest), "rear": _first_epochs(inputs.rear[0], longest)}
    strongest = str(logs["front"].satellite[np.nan_to_num(logs["front"].cn0_dbhz[0]).argmax()])
    logs = {name: _faulty(log, strongest) for name, log in logs.items()}
    paths = {name: antenna_trajectory(track, vehicle, name) for name in ("front", "rear")}
    navigation = read_navigation(inputs.nav)
    for chosen, epochs in settings:
        processor, state = make_processor(parse_config(chosen), navigation, paths), None
        processor.process({name: log[:epochs] for name, log in logs.items()})
        for epoch in range(epochs):
            _, state = processor.process({name: log[epoch : epoch + 1] for name, log in logs.items()}, state)


def _look_beyond() -> None:
    """Look for places beyond a level: the line does not turn where these epochs are."""
    nothing, clock = np.zeros((1, 1)), np.zeros(1, dtype=np.intp)
    model = ModelArrays(
        nothing, clock, np.zeros((1, 1, 1)), np.zeros((1, 1, 3)), np.zeros((1, 3, 3)), np.zeros((3, 3)), nothing
    )
    one, sides = np.ones(1), np.zeros((1, 2, 1), dtype=np.bool_)
    forms = Forms(*kernels.off_tangent.forms_of_hypotheses(model, one, one, sides, 0.0, (1.0, 1.0)))
    sections = np.zeros(2, dtype=np.intp), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1), np.zeros(1)
    kernels.off_tangent.risk_beyond(forms.prior, forms.form, np.zeros(forms.prior.shape), *sections)


def _first_epochs(log: Path, count: int) -> Observations:
    """Read the first epochs of a compact RINEX 3 log: plain Python would read the whole of it for long."""
    lines = hatanaka.decompress(log).decode("ascii").splitlines(keepends=True)
    begins = [number for number, line in enumerate(lines) if line.startswith(">")]
    with TemporaryDirectory() as folder:
        short = Path(folder) / "log.rnx"
        short.write_text("".join(lines[: begins[count]]), encoding="ascii")
        return read_observations(short)


def _faulty(log: Observations, satellite: str) -> Observations:
    """Return the log with the codes of a satellite 300 m too long: RAIM looks for it."""
    return replace(log, code_m=log.code_m + np.where(log.satellite == satellite, 300.0, 0.0))
