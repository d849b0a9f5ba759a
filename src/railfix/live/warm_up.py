"""Compilation of all kernels before a session begins: during a session it would delay epochs by seconds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from railfix import kernels
from railfix.gnss.observations import Observations
from railfix.io.rinex import read_navigation, read_observations
from railfix.pipeline.config import parse_config
from railfix.run.processor import processor_of
from railfix.simulate.demonstration import demo_inputs
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle

#: Settings and numbers of epochs that together call every kernel; the second run has too few satellites for 3-D.
_RUNS = (
    ({"filter": "track"}, 60),
    ({"systems": ["G"], "elevation": {"mask_deg": 45.0}, "protection": "off"}, 5),
)


def compile_kernels() -> bool:
    """Compile kernels that have never run on this machine, on epochs of the demonstration; False where there are none.

    Raises
    ------
    InputFileError
        Neither the package nor the clone has the files of the demonstration.
    """
    kernels.load()
    if not kernels.missing():
        return False
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    track, vehicle = read_track(inputs.track), read_vehicle(inputs.vehicle)
    logs = {"front": read_observations(inputs.front), "rear": read_observations(inputs.rear)}
    strongest = str(logs["front"].satellite[np.nan_to_num(logs["front"].cn0_dbhz[0]).argmax()])
    logs = {name: _faulty(log, strongest) for name, log in logs.items()}
    paths = {
        "front": antenna_trajectory(track, vehicle, "front"),
        "rear": antenna_trajectory(track, vehicle, "rear"),
    }
    navigation = read_navigation(inputs.nav)
    for settings, epochs in _RUNS:
        processor, state = processor_of(parse_config(settings), navigation, paths), None
        processor.process({name: log[:epochs] for name, log in logs.items()})
        for epoch in range(epochs):
            _, state = processor.process({name: log[epoch : epoch + 1] for name, log in logs.items()}, state)
    return True


def _faulty(log: Observations, satellite: str) -> Observations:
    """The log with the codes of a satellite 300 m too long: RAIM looks for it."""
    return replace(log, code_m=log.code_m + np.where(log.satellite == satellite, 300.0, 0.0))
