"""railfix: GNSS positioning of trains on a 3-D track map.

A train runs on a known line. The train's antenna therefore lies on a known 3-D curve, and its position is one
coordinate along this curve. railfix turns raw receiver logs (RINEX) and a track map into positions along the line, and
states the reason for every rejected observation.

Where to begin
--------------
>>> import railfix
>>> files = railfix.demo_files()
>>> track, vehicle = railfix.read_track(files["track"]), railfix.read_vehicle(files["vehicle"])
>>> processor = railfix.EpochProcessor(
...     railfix.Config(),
...     {"front": railfix.antenna_trajectory(track, vehicle, "front")},
...     navigation=railfix.read_navigation(files["nav"]),
... )
>>> result, state = processor.process({"front": railfix.read_observations(files["front"])})
>>> railfix.train_table(result)  # chainage, sigma, protection level, status of every epoch

The files are from a simulated run. The median error of these positions is 0.34 m against the ground truth of the run.

============================ =========================================================================
read                         `read_observations`, `read_navigation`, `read_track`, `read_vehicle`,
                             `read_sbas`, `read_sp3`, `read_positions`, `read_reference`
compute positions in Python  `EpochProcessor` with a `Config` and `Trajectory` objects
                             (`antenna_trajectory`); returns a `Result`
compute positions from files `run_files` with `RunInputs`
single stages                `ranges.find_satellites`, `ranges.corrected_ranges`, the screens of `screens`,
                             `positioning.find_section`, `positioning.position_on_line`,
                             `integrity.exclude_faults`, `integrity.protection_level`
tables                       `train_table` (the filter), `positions_table`, `observations_table`, `to_xarray`
evaluate and report          `evaluate_runs`, `write_report`
from and to georinex         `observations_from_xarray`, `observations_to_xarray`
============================ =========================================================================

docs/example.md uses these functions to compute positions from a log; ``railfix --help`` lists the corresponding
commands. Every name is imported at its first use, so that ``import railfix`` is fast.

Vocabulary
----------
epoch
    One instant at which a receiver reports. Axis 0 of arrays has the epochs; its length is T.
channel
    One signal of one satellite. Axis 1 of arrays has the channels; its length is M.
ECEF
    Earth-centred Earth-fixed frame, WGS 84 [m]; the last axis of an array has length 3 (x, y, z).
chainage
    Distance along the track (or an antenna's trajectory) from the first point of the track (or the trajectory) [m].
kilometrage
    Distance as marked along the line [m]; it may jump or run backwards.
GPS time
    The only internal time scale, stored as ``datetime64[ns]``.

Public names end with the unit of the quantity: ``_m``, ``_deg``, ``_s``, ``_hz``, ``_dbhz``, ``_ecef_m``. Absent values
are NaN (NaT for times), never 0. In every rejection mask, True means rejected.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
