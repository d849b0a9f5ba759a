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

# Making a map

One run with accurate positions (RTK) makes a map; here the ground truth of the demonstration, with noise of two
centimetres, takes their place. The commands for files are `railfix map from-positions` and `railfix map check`.

## From positions to a map

```{code-cell} ipython3
import numpy as np
import polars as pl

import railfix
from railfix.track import ThinningLimits, from_positions

files = railfix.demo_files()
truth = pl.read_csv(files["truth"], schema_overrides={"time_gpst": pl.Datetime("ns")})
front = truth.filter(pl.col("antenna") == "front")
true_ecef_m = front.select("x_m", "y_m", "z_m").to_numpy()
one_way = slice(0, int(front["chainage_m"].arg_max()) + 1)
noise_m = np.random.default_rng(1).normal(scale=0.02, size=true_ecef_m[one_way].shape)
made = from_positions(
    front["time_gpst"].to_numpy()[one_way],
    true_ecef_m[one_way] + noise_m,
    limits=ThinningLimits(spacing_m=5.0),
    sigma_plan_m=0.03,
    sigma_height_m=0.03,
)
made
```

The train stands at both ends and comes back; the map is made from one way, without the positions at a stand. It is the path of the antenna, not the
centreline of the track.

## Check it

```{code-cell} ipython3
for finding in railfix.check_track(made).findings:
    print(finding)
```

The distance from its points to the path of the antenna on the map that comes with the demonstration:

```{code-cell} ipython3
vehicle = railfix.read_vehicle(files["vehicle"])
shipped = railfix.antenna_trajectory(railfix.read_track(files["track"]), vehicle, "front")
_, offset_m = shipped.nearest(made.ecef_m)
print(f"median {np.median(offset_m):.3f} m, largest {np.max(offset_m):.3f} m")
```

## Position on it

The map is the antenna's own path, so it needs no vehicle file:

```{code-cell} ipython3
trajectory = railfix.Trajectory.from_antenna_path(made)
navigation = railfix.read_navigation(files["nav"])
processor = railfix.EpochProcessor(railfix.Config(), {"front": trajectory}, navigation=navigation)
result, _ = processor.process({"front": railfix.read_observations(files["front"])})
true_arc_m, _ = trajectory.nearest(true_ecef_m)
passed = railfix.positions_table(result)["status"].to_numpy() == "ok"
error_m = np.abs(result.antennas["front"].arc_m - true_arc_m)[passed]
print(f"{len(error_m)} epochs ok, error along the line: median {np.median(error_m):.2f} m, largest {np.max(error_m):.2f} m")
```

Maps keep the chords between their points within 0.3 m of the curve.
