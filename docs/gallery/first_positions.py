---
jupytext:
  text_representation:
    extension: .md
    format_name: myst
kernelspec:
  display_name: Python 3
  language: python
  name: python3
---

# First positions

From a receiver log, navigation records and a track map to positions along the line, on the demonstration that comes with railfix: a simulated train with two antennas that runs through a town and a tunnel.

## Read the files

```{code-cell} ipython3
%matplotlib inline
import polars as pl

import railfix
from railfix.report import plots

files = railfix.demo_files()
navigation = railfix.read_navigation(files["nav"])
observations = {name: railfix.read_observations(files[name]) for name in ("front", "rear")}
track = railfix.read_track(files["track"])
vehicle = railfix.read_vehicle(files["vehicle"])
observations["front"]
```

The log is a set of arrays: axis 0 is time, axis 1 the channel, one satellite on one signal. Map and vehicle give the curve in space on which each antenna moves:

```{code-cell} ipython3
trajectories = {name: railfix.antenna_trajectory(track, vehicle, name) for name in observations}
track, navigation
```

## Position them

```{code-cell} ipython3
processor = railfix.EpochProcessor(railfix.Config(), trajectories, navigation=navigation)
result, state = processor.process(observations)
result
```

The filter along the track takes all epochs so far, and rides through the tunnel. Every epoch has a row with a status; `tracking` and `coasting` have a bound on the error.

```{code-cell} ipython3
train = railfix.train_table(result)
front = train.filter(pl.col("antenna") == "front")
columns = ["time_gpst", "status", "chainage_m", "along_sigma_m", "protection_level_m", "speed_mps", "branch_probability"]
front.select(columns)[300:305]
```

## Compare with the ground truth

Beside it each epoch by itself, and the conventional 3-D position moved to the nearest point of the line:

```{code-cell} ipython3
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
        ("filter", "error_m"), ("single epochs", "single_error_m"), ("conventional", "conventional_error_m")
    )
)
```

```{code-cell} ipython3
plots.plot_plan(front, level_m=front["protection_level_m"].to_numpy(), track=track)
```

```{code-cell} ipython3
chart = errors.select("time_gpst", "error_m", "conventional_error_m", "along_sigma_m", chainage_m="true_m")
plots.plot_error_over_chainage(chart)
```

The same in files, with one command: `railfix demo`. Own data: [how to](../how-to.md).
