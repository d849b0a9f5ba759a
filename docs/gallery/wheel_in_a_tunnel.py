"""
A tachometer in a tunnel
========================

Without satellites the filter predicts the position, and its standard deviation grows. A tachometer bounds the
standard deviation. This example simulates the demonstration run with a tachometer and compares the filter with and
without it.
"""

import tempfile
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib import pyplot

import railfix
from railfix.simulate import SensorSettings, load_scenario, write_run

folder = Path(tempfile.mkdtemp())
scenario = load_scenario("demo")
sensors = SensorSettings(inertial=None, radar=None)  # the tachometer alone
files = write_run(scenario.replaced(sensors=sensors), folder / "simulated")
sorted(files)

# %%
# Both runs read the same files; only the second run uses the tachometer.

inputs = railfix.RunInputs(
    front=(files["front"],), nav=(files["nav"],), track=(files["track"],), vehicle=files["vehicle"]
)
truth = pl.read_csv(files["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})
truth = truth.select("time_gpst", "antenna", true_m="chainage_m")
runs = {}
for name, run_inputs in (("satellites", inputs), ("with tachometer", inputs.replaced(tachometer=files["tachometer"]))):
    railfix.run_files(run_inputs, out=folder / name)
    runs[name] = pl.read_parquet(folder / name / "train.parquet").join(truth, on=["time_gpst", "antenna"])

# %%
# The tunnel is at 450 to 520 m. The band shows the standard deviation stated by the filter.

figure, axes = pyplot.subplots(2, sharex=True, sharey=True, layout="constrained")
for ax, (name, table) in zip(axes, runs.items(), strict=True):
    outward = table[: int(np.argmax(table["true_m"]))]
    error_m, sigma_m = outward["chainage_m"] - outward["true_m"], outward["along_sigma_m"]
    ax.fill_between(outward["true_m"], -sigma_m, sigma_m, alpha=0.3)
    ax.plot(outward["true_m"], error_m, linewidth=1)
    ax.axvspan(450, 520, color="0.9", zorder=0)
    ax.set(title=name, ylabel="error along the line [m]")
axes[-1].set_xlabel("chainage [m]")
figure.show()

# %%
# Largest standard deviation, protection level and error:

pl.concat(
    table.select(
        run=pl.lit(name),
        largest_sigma_m=pl.col("along_sigma_m").max(),
        largest_level_m=pl.col("protection_level_m").max(),
        largest_error_m=(pl.col("chainage_m") - pl.col("true_m")).abs().max(),
    )
    for name, table in runs.items()
)
