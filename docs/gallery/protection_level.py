"""
Protection level with a faulty satellite
========================================

A protection level bounds the error of a position at a stated risk, including satellite faults. This example
compares the protection levels of the demonstration with its errors, with and without a fault.
"""

# %%
# Levels and errors
# -----------------

import dataclasses

import numpy as np
import polars as pl

import railfix
from railfix.report import plots

files = railfix.demo_files()
navigation = railfix.read_navigation(files["nav"])
track, vehicle = railfix.read_track(files["track"]), railfix.read_vehicle(files["vehicle"])
log = railfix.read_observations(files["front"])
trajectory = {"front": railfix.antenna_trajectory(track, vehicle, "front")}
truth = pl.read_csv(files["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})
truth = truth.select("time_gpst", "antenna", true_m="chainage_m")
alarm_limit_m = railfix.Config().alarm_limit_m


def run_with_errors(log):
    """Return the result of a log, and its positions with their errors along the line."""
    processor = railfix.EpochProcessor(railfix.Config(), trajectory, navigation=navigation)
    result, _ = processor.process({"front": log})
    table = railfix.positions_table(result).join(truth, on=["time_gpst", "antenna"], maintain_order="left")
    return result.antennas["front"], table.with_columns(error_m=pl.col("chainage_m") - pl.col("true_m"))


result, errors = run_with_errors(log)
plots.plot_levels_over_time(errors, alarm_limit_m)


# %%
def counts(table):
    """Count epochs with a finite level, those within the alarm limit, and those whose error exceeds the level."""
    error, level = pl.col("error_m").abs(), pl.col("protection_level_m")
    return table.filter(level.is_finite() & error.is_finite()).select(
        epochs=pl.len(),
        median_level_m=level.median(),
        within_alarm_limit=(level <= alarm_limit_m).mean(),
        largest_error_m=error.max(),
        errors_over_the_level=(error > level).sum(),
    )


counts(errors)

# %%
# With a fault
# ------------
#
# For 20 seconds, 40 m is added to the pseudoranges of the satellite that is used most often in this interval.

stretch = slice(200, 400)
used = (result.reason[stretch] == 0).sum(axis=0)
channel = int(np.argmax(used))
fault_m = np.zeros(log.code_m.shape)
fault_m[stretch, channel] = 40.0
str(log.satellite[channel]), int(used[channel])

# %%
faulty, faulty_errors = run_with_errors(dataclasses.replace(log, code_m=log.code_m + fault_m))
rejected = int((faulty.reason[stretch, channel] != 0).sum())
table = pl.concat([counts(errors[stretch]), counts(faulty_errors[stretch])])
print(f"{rejected} of 200 faulty ranges rejected")
table.insert_column(0, pl.Series("fault", ["none", "40 m"]))

# %%
# Assumed probabilities
# ---------------------
#
# The protection levels of this run are *indicative*: fault probabilities are assumed, not measured on this line.

railfix.Config().risk

# %%
# ``railfix error-model`` fits a model of the pseudorange errors of a line, with measured probabilities that replace
# the assumed ones. See :doc:`protection level </protection-level>` and the
# :doc:`levels on recordings </level-results>`.
