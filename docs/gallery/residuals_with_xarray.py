"""
Multipath in the residuals
==========================

``to_xarray`` returns the results of an antenna with named axes. This example draws the residuals of all pseudoranges
over elevation, and the multipath of one satellite over chainage.
"""

import numpy as np
from matplotlib import pyplot

import railfix

result = railfix.demo()
data = railfix.to_xarray(result["front"], result.fusion["front"])
data

# %%
# The residual is the corrected pseudorange minus the range computed from the position on the line and the receiver
# clock. Reflected signals arrive late, so the residuals of low satellites have a larger spread, and are mostly
# positive.

used = data.reason == 0
figure, ax = pyplot.subplots(layout="constrained")
ax.plot(data.elevation_deg.where(used).values.ravel(), data.residual_m.where(used).values.ravel(), ".", markersize=1)
ax.set(xlabel="elevation [deg]", ylabel="residual [m]", ylim=(-15, 25))
figure.show()

# %%
# Root mean square of the residuals by satellite and signal:

rms_m = np.sqrt((data.residual_m.where(used) ** 2).mean("time"))
table = rms_m.to_series().set_axis(data.satellite.values + " " + data.signal.values).dropna()
table.sort_values(ascending=False).head(8).round(2)

# %%
# This chart shows the residuals of the satellite with the largest spread over chainage, on the outward run:

channel = int(np.nanargmax(rms_m.values))
outward = slice(0, int(np.nanargmax(data.filter_chainage_m.values)))
figure, ax = pyplot.subplots(layout="constrained")
ax.plot(data.filter_chainage_m[outward], data.residual_m.where(used)[outward, channel], ".", markersize=2)
ax.set(xlabel="chainage [m]", ylabel="residual [m]", title=str(data.satellite.values[channel]))
figure.show()
