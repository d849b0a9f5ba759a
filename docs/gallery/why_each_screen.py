"""
What each screen measures and changes
=====================================

This example draws the metric of each :doc:`screen </screens>` against its limit, and compares the positioning rate and
the errors with and without each screen.
"""

# %%
# Metric and limit of each screen
# -------------------------------

import tempfile
from pathlib import Path

import polars as pl

import railfix
from railfix.evaluate.ablation import ablate_files
from railfix.report import plots
from railfix.simulate.demonstration import demo_inputs, demo_truth

files = railfix.demo_files()
track, vehicle = railfix.read_track(files["track"]), railfix.read_vehicle(files["vehicle"])
logs = {name: railfix.read_observations(files[name]) for name in ("front", "rear")}
trajectories = {name: railfix.antenna_trajectory(track, vehicle, name) for name in logs}
config = railfix.Config()
processor = railfix.EpochProcessor(config, trajectories, navigation=railfix.read_navigation(files["nav"]))
result, _ = processor.process(logs)
positions, observations = railfix.positions_table(result), railfix.observations_table(result)
shown = plots.list_screens(config, positions, observations.lazy())
screens = {screen.name: screen for screen in shown if screen.antenna == "front"}
list(screens)


# %%
# **Elevation.** Satellites below the mask of 20 degrees are rejected.

plots.plot_screen_over_time(screens["elevation"].picture, screens["elevation"].time)


# %%
# **Doppler.** The change of a pseudorange between epochs is compared with the Doppler of the same signal, on which
# multipath has much less effect than on the pseudorange.

plots.plot_screen_over_time(screens["doppler"].picture, screens["doppler"].time)


# %%
# **Antenna pair.** The difference between the pseudoranges of two antennas on one roof follows from the antennas'
# spacing. A different value indicates multipath at one of the antennas.

plots.plot_screen_over_chainage(screens["antenna_pair"].picture, screens["antenna_pair"].chainage_m)


# %%
# By default, the screens Doppler and antenna pair do not reject (``verdict = "weigh"``): they increase the standard
# deviation of a suspected observation by the measured error. The geometry therefore does not become weaker where few
# satellites are left.
#
# **RAIM.** Up to two satellites are excluded where the sum of squared residuals exceeds a threshold. The threshold
# follows from the distribution of this sum in the absence of faults.

plots.plot_screen_over_chainage(screens["raim"].picture, screens["raim"].chainage_m)


# %%
# **Antenna spacing.** The distance between the two positions along the line must equal the spacing of the antennas.
# The **C/N0** screen requires the open-sky curve of antenna and receiver (``railfix cn0-curve``); it is not run here.
#
# Rejected observations
# ---------------------

(
    observations.filter(pl.col("reason") != 0)
    .group_by("antenna", "reason_text")
    .agg(pl.len().alias("pseudoranges"), pl.col("satellite").n_unique().alias("satellites"))
    .sort("antenna", "pseudoranges", descending=[False, True])
)


# %%
# Effect on rate and errors
# -------------------------
#
# ``ablate_files`` reads the log once, and computes positions with all screens, with no screen, with each single screen,
# and with all screens but one.

inputs = demo_inputs().replaced(truth=demo_truth())
ablation = ablate_files(inputs, config, out=Path(tempfile.mkdtemp()) / "effects")
effects = pl.DataFrame([effect.as_row() for effect in ablation.effects], infer_schema_length=None)
columns = ["choice", "rate", "ok_rate", "n_used", "coordinates_p95_m", "coordinates_max_m", "ok_p95_m", "ok_max_m"]
effects.filter(pl.col("antenna") == "front").select(columns)


# %%
# The columns ``coordinates_*`` have the errors of all positions, the columns ``ok_*`` have the errors of positions
# that passed every check.
