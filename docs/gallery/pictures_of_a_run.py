"""
Charts of a run
===============

``railfix.report.plots`` draws tables of a run with matplotlib. Each ``plot_*`` function draws into the axes ``ax``, or
into a new figure, and returns the axes. The :doc:`report </report>` shows the same charts in an interactive page.
"""

import tempfile
from pathlib import Path

import polars as pl

import railfix
from railfix.evaluate import evaluate_run
from railfix.report import plots
from railfix.run import RunOptions
from railfix.simulate.demonstration import demo_inputs, demo_truth

out = Path(tempfile.mkdtemp()) / "results"
railfix.run_files(demo_inputs(), railfix.Config(), out=out, options=RunOptions(observations="write"))
is_front = pl.col("antenna") == "front"
evaluation = evaluate_run(out, demo_truth())
errors = evaluation.epochs.filter(is_front)
positions = pl.read_parquet(out / "positions.parquet").filter(is_front)
observations = pl.scan_parquet(out / "observations.parquet").filter(is_front)


# %%
# The plan of the line shows positions coloured by their protection level.

plots.plot_plan(positions, level_m=positions["protection_level_m"].to_numpy())


# %%
# The chart shows the errors of positions on the line and of conventional positions over time.

plots.plot_error_over_time(errors)


# %%
# The chart shows the protection level over chainage, with the alarm limit.

plots.plot_levels_over_chainage(positions, railfix.Config().alarm_limit_m)


# %%
# The chart shows the numbers of used and rejected satellites over time.

plots.plot_satellites_over_time(positions)


# %%
# The chart shows the C/N0 of one signal over elevation, with the mean C/N0.

plots.draw_chart(plots.cn0_over_elevation(observations)[0])


# %%
# The chart shows the smallest, mean and largest error.

plots.plot_error_ranges({"front": errors})
