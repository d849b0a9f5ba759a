"""
Positions as the epochs arrive
==============================

``EpochProcessor.process`` returns a state, which is passed to the next call. A log can therefore be divided at any
epoch, down to single epochs as a receiver sends them. The positions are the same as for the whole log. :doc:`Live
positions </live>` are computed in this way from the streams of receivers.
"""

from time import perf_counter

import numpy as np
from matplotlib import pyplot

import railfix

files = railfix.demo_files()
track, vehicle = railfix.read_track(files["track"]), railfix.read_vehicle(files["vehicle"])
processor = railfix.EpochProcessor(
    railfix.Config(),
    {"front": railfix.antenna_trajectory(track, vehicle, "front")},
    navigation=railfix.read_navigation(files["nav"]),
)
log = railfix.read_observations(files["front"])

# %%
# The first 600 epochs, one call per epoch:

state = None
chainage_m, level_m, processing_s = [], [], []
for epoch in range(600):
    begin = perf_counter()
    result, state = processor.process({"front": log[epoch : epoch + 1]}, state)
    processing_s.append(perf_counter() - begin)
    fix = result.fusion["front"]
    chainage_m.append(fix.chainage_m[0])
    level_m.append(railfix.train_table(result)["protection_level_m"][0])
print(f"{1000 * np.median(processing_s):.1f} ms per epoch at the median")
state

# %%
# The same epochs in one call:

whole, _ = processor.process({"front": log[:600]})
difference_m = np.abs(np.array(chainage_m) - whole.fusion["front"].chainage_m)
print(f"largest difference {np.nanmax(difference_m):.1e} m")

# %%
# The chart shows chainage and protection level as computed at each epoch. The protection level decreases as the number
# of measurements increases.

figure, (upper, lower) = pyplot.subplots(2, sharex=True, layout="constrained")
seconds = (log.time[:600] - log.time[0]) / np.timedelta64(1, "s")
upper.plot(seconds, chainage_m)
upper.set_ylabel("chainage [m]")
lower.plot(seconds, np.array(level_m, dtype=float))
lower.set(xlabel="time [s]", ylabel="protection level [m]")
figure.show()
