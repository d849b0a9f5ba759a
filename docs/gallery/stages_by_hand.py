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

# Stages by hand

`EpochProcessor` calls public functions of arrays, in the order of P1's figure 1: satellite states, corrected ranges, screens, 3-D position and
inter-system biases, section search, constrained position, fault exclusion, protection level. Here they are called by hand for one antenna, so that
one of your own can take the place of any. NaN stands for what is absent.

## From a log to positions on the line

```{code-cell} ipython3
import dataclasses
import numpy as np
import railfix
from railfix import integrity, positioning, ranges, screens

def positions_by_hand(log, navigation, line, systems):
    channels = ranges.select_channels(log.satellite, log.signal, systems=systems)
    source = ranges.BroadcastSource.of(navigation)
    satellites = ranges.find_satellites(log, channels, source)
    raw = np.where(satellites.reason == 0, log.code_m[:, channels.columns] + satellites.correction_m, np.nan)
    equal = positioning.weighted_ranges(satellites.states.position_ecef_m, raw, np.full(raw.shape, 10.0), channels.clock)
    near = positioning.approximate_position(equal, line)
    codes = ranges.corrected_ranges(log, channels, satellites, near.ecef_m, source, gross=near.gross)
    low = screens.elevation_screen(codes.elevation_deg).reject
    code = np.where(low, np.nan, codes.used_code_m)
    used = positioning.weighted_ranges(codes.satellites.position_ecef_m, code, codes.sigma_m, channels.clock)
    tied, state = positioning.tie_constellations(log.time, channels.clocks, used, near.ecef_m)
    return tied.ranges, positioning.fix_on_line(tied.ranges, line, tied.tied)
```

A screen of your own is one more line that puts NaN into the codes. `BroadcastSource` can be replaced by `SbasSource`, `DfmcSource` or
`BaseStationSource`; precise orbits are in the navigation data. `fix_on_line` calls `find_section` and `position_on_line`. What is known of the clocks of
the constellations grows from epoch to epoch: `state` goes into the next call, as in `scipy.signal.lfilter`.

## Faults and protection level

```{code-cell} ipython3
files = railfix.demo_files()
log, navigation = railfix.read_observations(files["front"]), railfix.read_navigation(files["nav"])
line = railfix.antenna_trajectory(railfix.read_track(files["track"]), railfix.read_vehicle(files["vehicle"]), "front")
used, fix = positions_by_hand(log, navigation, line, ("G", "J"))
used, fix, raim = integrity.exclude_faults(used, line, fix)
model = integrity.linear_model(used, line, fix.constrained.arc_m, section=fix.constrained.section)
```

`exclude_faults` returns ranges and positions without the satellites that it excludes. The level is that of these ranges:

```{code-cell} ipython3
channels = ranges.select_channels(log.satellite, log.signal, systems=("G", "J"))
level = integrity.protection_level(model, [name[0] for name in channels.satellite], n_excluded=raim.excluded)
int(raim.excluded.any(axis=1).sum()), float(np.nanmedian(level.level_m))
```

## The same by the pipeline

On the demonstration, with two and with four constellations, and with a navigation file that has no ionospheric coefficients: typical ones are used then, with
2 m more of standard deviation. A recording is compared as well where one is at hand (`RECORDING`: folder with RINEX files, or nothing).

```{code-cell} ipython3
silent = dataclasses.replace(navigation, klobuchar={})
cases = {
    "GPS and QZSS": (log, navigation, line, ("G", "J")),
    "four constellations": (log, navigation, line, ("G", "J", "E", "C")),
    "without ionosphere": (log, silent, line, ("G", "J", "E", "C")),
}
compared = {}
for name, (own_log, own_navigation, own_line, systems) in cases.items():
    config = railfix.Config(systems=systems, screens=("elevation",), filter="off")
    processor = railfix.EpochProcessor(config, {"front": own_line}, navigation=own_navigation)
    result, _ = processor.process({"front": own_log})
    compared[name] = positions_by_hand(own_log, own_navigation, own_line, systems)[1], result["front"]
{name: float(np.nanmax(np.abs(fix.constrained.arc_m - found.constrained.arc_m))) for name, (fix, found) in compared.items()}
```

The pipeline adds what needs more than one stage here: the receiver's noise scale and satellites that are wrong for long, both from earlier epochs, the test of
the map, whose result is in its levels, and the [filter](../filter.md) (`railfix.tracking.track`).
