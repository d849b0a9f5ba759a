"""What callers of kernels share with them: numbers that both sides must have alike."""

from __future__ import annotations

from typing import Final

#: Gradient of the Earth-rotation term of a range over the receiver's place, rounded up (see `geodesy`).
ROTATION_GRADIENT: Final = 1.1e-5
#: Children of a stretch of line in the search.
FAN_OUT: Final = 8
#: Least redundancy number of a range whose error can be estimated.
LEAST_REDUNDANCY: Final = 1e-9
#: Cosine of the angle off the tangent (6 deg) within which the linear model of the level holds.
ALONG: Final = 0.9945
#: Distance up to which the line is looked over for parts off the tangent before anything else [m].
CLEAR_M: Final = 200.0
#: Points this near to a tangent are not off it beyond any level [m].
ON_TANGENT_M: Final = 1e-3
