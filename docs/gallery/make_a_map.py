"""
Make a track map from positions
===============================

One run with accurate positions (RTK) is enough for a map. Here the ground truth of the demonstration, with noise of
two centimetres, replaces RTK positions. The commands ``railfix map from-positions`` and ``railfix map check`` do the
same with files.
"""

# %%
# From positions to a map
# -----------------------

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

# %%
# The train runs along the line and back, and stops at both ends. The map is made from the outward run, without the
# positions at standstill. The map is the path of the antenna, not the centreline of the track.
#
# Check the map
# -------------

for finding in railfix.check_track(made).findings:
    print(finding)

# %%
# The printed numbers are the distances between the points of the new map and the antenna's path, which is computed
# from the map of the demonstration.

vehicle = railfix.read_vehicle(files["vehicle"])
shipped = railfix.antenna_trajectory(railfix.read_track(files["track"]), vehicle, "front")
_, offset_m = shipped.nearest(made.ecef_m)
print(f"median {np.median(offset_m):.3f} m, largest {np.max(offset_m):.3f} m")

# %%
# Compute positions on the map
# ----------------------------
#
# The map is the path of the antenna, so no vehicle file is required.

trajectory = railfix.Trajectory.from_antenna_path(made)
navigation = railfix.read_navigation(files["nav"])
processor = railfix.EpochProcessor(railfix.Config(), {"front": trajectory}, navigation=navigation)
result, _ = processor.process({"front": railfix.read_observations(files["front"])})
true_arc_m, _ = trajectory.nearest(true_ecef_m)
passed = railfix.positions_table(result)["status"].to_numpy() == "ok"
error_m = np.abs(result.antennas["front"].arc_m - true_arc_m)[passed]
print(f"{len(error_m)} epochs ok; error along the line: median {np.median(error_m):.2f} m, max {np.max(error_m):.2f} m")

# %%
# The points of a map are chosen so that the chords between them stay within 0.3 m of the path.
