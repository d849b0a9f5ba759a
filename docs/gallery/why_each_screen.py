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

# Why each screen

What each [screen](../screens.md) measures on the demonstration, and what each changes in rate and accuracy.

## What each measures

```{code-cell} ipython3
%matplotlib inline
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
```

**Elevation.** The mask is 20 degrees.

```{code-cell} ipython3
plots.plot_screen_over_time(screens["elevation"].picture, screens["elevation"].time)
```

**Doppler.** The change of a pseudorange from epoch to epoch, against its Doppler, which multipath disturbs far less.

```{code-cell} ipython3
plots.plot_screen_over_time(screens["doppler"].picture, screens["doppler"].time)
```

**Pair of antennas.** The difference of the ranges of two antennas on one roof beyond what their spacing explains is multipath at one of them.

```{code-cell} ipython3
plots.plot_screen_over_chainage(screens["antenna_pair"].picture, screens["antenna_pair"].chainage_m)
```

By default these two do not reject: a suspected observation gets a larger standard deviation by what the screen measured (`verdict = "weigh"`), which
keeps the geometry where few satellites are left.

**RAIM.** Where the sum of squares of the residuals is beyond its distribution without a fault, up to two satellites are excluded.

```{code-cell} ipython3
plots.plot_screen_over_chainage(screens["raim"].picture, screens["raim"].chainage_m)
```

**Spacing of the antennas.** The two positions must be as far apart along the line as the antennas are. The screen of **C/N0** needs a curve of
antenna and receiver under an open sky (`railfix cn0-curve`), and is inactive here.

## Which observations were rejected

```{code-cell} ipython3
(
    observations.filter(pl.col("reason") != 0)
    .group_by("antenna", "reason_text")
    .agg(pl.len().alias("pseudoranges"), pl.col("satellite").n_unique().alias("satellites"))
    .sort("antenna", "pseudoranges", descending=[False, True])
)
```

## What each changes

All screens, none, each alone, and all but each, on one reading of the log:

```{code-cell} ipython3
inputs = demo_inputs().replaced(truth=demo_truth())
ablation = ablate_files(inputs, config, out=Path(tempfile.mkdtemp()) / "effects")
effects = pl.DataFrame([effect.as_row() for effect in ablation.effects], infer_schema_length=None)
columns = ["choice", "rate", "ok_rate", "n_used", "coordinates_p95_m", "coordinates_max_m", "ok_p95_m", "ok_max_m"]
effects.filter(pl.col("antenna") == "front").select(columns)
```

`coordinates`: all positions; `ok`: those that passed every check.
