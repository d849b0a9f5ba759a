"""
First positions
===============

Positions along the line are computed from a receiver log, navigation records and a track map. The files are those of
the demonstration that comes with railfix: a simulated train with two antennas runs through a town and a tunnel.
"""

# %%
# Read the files
# --------------

import polars as pl

import railfix
from railfix.report import plots

files = railfix.demo_files()
navigation = railfix.read_navigation(files["nav"])
observations = {name: railfix.read_observations(files[name]) for name in ("front", "rear")}
track = railfix.read_track(files["track"])
vehicle = railfix.read_vehicle(files["vehicle"])
observations["front"]

# %%
# The log is a set of arrays. Axis 0 is time, and axis 1 is the channel (one satellite on one signal). The map and the
# vehicle file determine the curve in space on which each antenna moves.

trajectories = {name: railfix.antenna_trajectory(track, vehicle, name) for name in observations}
track, navigation

# %%
# Compute positions
# -----------------

processor = railfix.EpochProcessor(railfix.Config(), trajectories, navigation=navigation)
result, state = processor.process(observations)
result

# %%
# The filter along the track uses all epochs so far, and predicts the position in the tunnel. Every epoch has a row
# with a status. Positions of status ``tracking`` and ``coasting`` have a bound on their error.

train = railfix.train_table(result)
front = train.filter(pl.col("antenna") == "front")
columns = [
    "time_gpst",
    "status",
    "chainage_m",
    "along_sigma_m",
    "protection_level_m",
    "speed_mps",
    "branch_probability",
]
front.select(columns)[300:305]

# %%
# Compare with the ground truth
# -----------------------------
#
# The errors of the filter are compared with the errors of single-epoch positions, and of conventional 3-D positions
# moved to the nearest point of the line.

truth = pl.read_csv(files["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})
truth = truth.select("time_gpst", "antenna", true_m="chainage_m")
single = railfix.positions_table(result).select(
    "time_gpst", "antenna", "conventional_chainage_m", single_status="status", single_m="chainage_m"
)
errors = front.join(truth, on=["time_gpst", "antenna"]).join(single, on=["time_gpst", "antenna"], how="left")
errors = errors.with_columns(
    error_m=pl.col("chainage_m") - pl.col("true_m"),
    single_error_m=pl.col("single_m") - pl.col("true_m"),
    conventional_error_m=pl.col("conventional_chainage_m") - pl.col("true_m"),
)
pl.concat(
    errors.select(
        position=pl.lit(name),
        epochs=pl.col(column).count(),
        median_m=pl.col(column).abs().median(),
        p95_m=pl.col(column).abs().quantile(0.95),
        largest_m=pl.col(column).abs().max(),
    )
    for name, column in (
        ("filter", "error_m"),
        ("single epochs", "single_error_m"),
        ("conventional", "conventional_error_m"),
    )
)

# %%
plots.plot_plan(front, level_m=front["protection_level_m"].to_numpy(), track=track)

# %%
chart = errors.select("time_gpst", "error_m", "conventional_error_m", "along_sigma_m", chainage_m="true_m")
plots.plot_error_over_chainage(chart)

# %%
# ``railfix demo`` computes the same positions and writes files. For your own data, see :doc:`how to </how-to>`.
