"""
Stages of the pipeline, called one by one
=========================================

``EpochProcessor`` calls public functions on arrays, in the order of P1's figure 1: satellite states, corrected ranges,
screens, 3-D position and inter-system biases, section search, constrained position, fault exclusion, protection level.
This example calls them one by one for one antenna, so that you can replace any of them. Absent values are NaN.
"""

# %%
# From a log to positions on the line
# -----------------------------------

import dataclasses
import os
import pathlib

import numpy as np

import railfix
from railfix import integrity, positioning, ranges, screens


def positions_by_hand(log, navigation, line, systems):
    channels = ranges.select_channels(log.satellite, log.signal, systems=systems)
    source = ranges.BroadcastSource.of(navigation)
    satellites = ranges.find_satellites(log, channels, source)
    raw = np.where(satellites.reason == 0, log.code_m[:, channels.columns] + satellites.correction_m, np.nan)
    equal = positioning.weighted_ranges(
        satellites.states.position_ecef_m, raw, np.full(raw.shape, 10.0), channels.clock
    )
    near = positioning.approximate_position(equal, line)
    codes = ranges.corrected_ranges(log, channels, satellites, near.ecef_m, source, gross=near.gross)
    low = screens.elevation_screen(codes.elevation_deg).reject
    code = np.where(low, np.nan, codes.used_code_m)
    used = positioning.weighted_ranges(codes.satellites.position_ecef_m, code, codes.sigma_m, channels.clock)
    tied, points, state = positioning.tie_constellations(log.time, channels.clocks, used, near.ecef_m)
    return tied, positioning.fix_on_line(tied, line, points.tied)


# %%
# To add your own screen, insert a line that sets the rejected codes to NaN. ``SbasSource``, ``DfmcSource`` or
# ``BaseStationSource`` can replace ``BroadcastSource``; precise orbits are part of the navigation data. ``fix_on_line``
# calls ``find_section`` and ``position_on_line``. Inter-system biases are estimated over all epochs so far. To process
# a log in several calls, pass ``state`` to the next call, as with ``zi`` of ``scipy.signal.lfilter``.
#
# Faults and protection level
# ---------------------------

files = railfix.demo_files()
log, navigation = railfix.read_observations(files["front"]), railfix.read_navigation(files["nav"])
line = railfix.antenna_trajectory(railfix.read_track(files["track"]), railfix.read_vehicle(files["vehicle"]), "front")
used, fix = positions_by_hand(log, navigation, line, ("G", "J"))
used, fix, raim = integrity.exclude_faults(used, line, fix)
model = integrity.linear_model(used, line, fix.constrained.arc_m, section=fix.constrained.section)

# %%
# ``exclude_faults`` returns ranges and positions without the satellites that it excludes. The protection level is
# computed from these ranges.

channels = ranges.select_channels(log.satellite, log.signal, systems=("G", "J"))
level = integrity.protection_level(model, [name[0] for name in channels.satellite], n_excluded=raim.excluded)
int(raim.excluded.any(axis=1).sum()), float(np.nanmedian(level.level_m))

# %%
# Comparison with the pipeline
# ----------------------------
#
# The stages are compared with the pipeline for two and for four constellations, and for a navigation file without
# ionospheric coefficients. In the last case, typical coefficients are used, and 2 m is added to the standard
# deviation of the vertical delay.

# If the environment variable ``RECORDING`` names a folder with ``log.obs``, ``log.nav`` and the antenna's path as
# ``path.csv``, this recording is also compared.

silent = dataclasses.replace(navigation, klobuchar={})
cases = {
    "GPS and QZSS": (log, navigation, line, ("G", "J")),
    "four constellations": (log, navigation, line, ("G", "J", "E", "C")),
    "without ionosphere": (log, silent, line, ("G", "J", "E", "C")),
}
if "RECORDING" in os.environ:
    folder = pathlib.Path(os.environ["RECORDING"])
    path = railfix.Trajectory.from_antenna_path(railfix.read_track(folder / "path.csv"))
    recorded = railfix.read_observations(folder / "log.obs"), railfix.read_navigation(folder / "log.nav")
    cases["recording"] = (*recorded, path, ("G", "J", "E", "C"))
compared = {}
for name, (own_log, own_navigation, own_line, systems) in cases.items():
    config = railfix.Config(systems=systems, screens=("elevation",), filter="off")
    processor = railfix.EpochProcessor(config, {"front": own_line}, navigation=own_navigation)
    result, _ = processor.process({"front": own_log})
    compared[name] = positions_by_hand(own_log, own_navigation, own_line, systems)[1], result["front"]
{
    name: float(np.nanmax(np.abs(fix.constrained.arc_m - found.fix.constrained.arc_m)))
    for name, (fix, found) in compared.items()
}

# %%
# The pipeline adds the tests and estimates that require earlier epochs: the receiver's noise scale, the test for
# persistent range errors, and the test of the map, whose result affects the protection levels. The
# :doc:`filter </filter>` is ``railfix.tracking.track``.
