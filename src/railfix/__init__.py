"""railfix: satellite train positioning on a 3-D track map.

A train runs on a known line, so its antenna lies on a known 3-D curve and its position is one
number along it. railfix turns raw receiver logs (RINEX) and a track map into positions along the
line, with the reason for everything it refused.

Vocabulary
----------
epoch
    One instant at which a receiver reports. Axis 0 of every array, length T.
channel
    One satellite on one signal. Axis 1 of every array, length M.
ECEF
    Earth-centred Earth-fixed frame, WGS 84 [m]; the last axis of length 3 is x, y, z.
chainage
    Distance along the antenna's trajectory or the track from its first point [m].
kilometrage
    The line's own marking [m]; it may jump or run backwards.
GPS time
    The only time scale inside: ``datetime64[ns]``.

Names carry the unit at public edges: ``_m``, ``_deg``, ``_s``, ``_hz``, ``_dbhz``, ``_ecef_m``.
Absent is NaN (NaT for times); 0 is a value. A rejected observation is True in a mask everywhere.
"""

__version__ = "0.1.0"
