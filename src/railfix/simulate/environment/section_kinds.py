"""Structures along each kind of section, and random sections with given shares of a line."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from railfix.simulate.environment.settings import Kind, RoofSettings, RowSettings, SectionSettings
from railfix.simulate.setting_types import Between

#: A road over the tracks.
_BRIDGE: Final = RoofSettings(
    inner_m=0.0, outer_m=60.0, height_m=7.5, length_m=(8.0, 20.0), gap_m=(300.0, 700.0), loss_db=60.0
)
_HOUSES: Final = RowSettings(
    distance_m=(8.0, 25.0), height_m=(5.0, 10.0), length_m=(8.0, 15.0), gap_m=(2.0, 12.0), share=0.8
)
_BLOCKS_BEHIND: Final = RowSettings(
    distance_m=(30.0, 70.0), height_m=(10.0, 25.0), length_m=(20.0, 50.0), gap_m=(10.0, 60.0), share=0.4
)
_BLOCKS: Final = RowSettings(
    distance_m=(10.0, 30.0), height_m=(15.0, 40.0), length_m=(12.0, 40.0), gap_m=(2.0, 15.0), share=0.8
)
_TOWERS_BEHIND: Final = RowSettings(
    distance_m=(35.0, 90.0), height_m=(25.0, 60.0), length_m=(20.0, 50.0), gap_m=(10.0, 60.0), share=0.6
)
_CANYON: Final = RowSettings(
    distance_m=(9.0, 20.0), height_m=(25.0, 80.0), length_m=(20.0, 60.0), gap_m=(4.0, 25.0), share=0.9
)
_SLOPE: Final = RowSettings(
    distance_m=(7.0, 12.0),
    height_m=(5.0, 12.0),
    length_m=(30.0, 100.0),
    gap_m=(0.0, 0.0),
    reflection=(0.0, 0.1),
    roughness_m=(0.05, 0.1),
    yaw_deg=(0.0, 0.0),
)
_RIDGE: Final = RowSettings(
    distance_m=(80.0, 400.0),
    height_m=(60.0, 200.0),
    length_m=(150.0, 400.0),
    gap_m=(0.0, 0.0),
    reflection=(0.0, 0.0),
    yaw_deg=(0.0, 0.0),
)
_CONCOURSE: Final = RoofSettings(
    inner_m=0.0, outer_m=40.0, height_m=8.0, length_m=(12.0, 30.0), gap_m=(150.0, 300.0), loss_db=40.0
)

#: Rows of walls by kind of section.
ROWS: Final[Mapping[Kind, tuple[RowSettings, ...]]] = MappingProxyType(
    {
        "open": (),
        "suburban": (_HOUSES, _BLOCKS_BEHIND),
        "urban": (_BLOCKS, _TOWERS_BEHIND),
        "canyon": (_CANYON, _TOWERS_BEHIND),
        "cutting": (_SLOPE,),
        "mountain": (_RIDGE,),
        "station": (_BLOCKS, _TOWERS_BEHIND),
        "tunnel": (),
    }
)
#: Roofs by kind of section.
ROOFS: Final[Mapping[Kind, tuple[RoofSettings, ...]]] = MappingProxyType(
    {
        "open": (),
        "suburban": (_BRIDGE,),
        "urban": (_BRIDGE,),
        "canyon": (_BRIDGE,),
        "cutting": (_BRIDGE,),
        "mountain": (),
        "station": (RoofSettings(), _CONCOURSE),
        "tunnel": (),
    }
)
#: The crown of a tunnel and the ground above it, seen from outside.
TUNNEL_CROWN: Final = RoofSettings(inner_m=0.0, outer_m=200.0, height_m=6.5, loss_db=200.0)


def drawn_sections(
    shares: Mapping[Kind, float], length_m: float, *, section_length_m: Between, seed: int
) -> tuple[SectionSettings, ...]:
    """Sections with exactly the given shares of a line, which add up to 1, in random order from 0 to its end.

    `section_length_m` is the approximate range of their lengths; a small share gives one shorter section.
    """
    rng = np.random.default_rng([seed, 7101])
    low, high = section_length_m
    kinds: list[Kind] = []
    lengths: list[float] = []
    for kind, share in sorted(shares.items()):
        if share <= 0.0:
            continue
        count = max(1, round(share * length_m / (0.5 * (low + high))))
        weights = rng.uniform(low, high, count)
        kinds += [kind] * count
        lengths += (weights / weights.sum() * share * length_m).tolist()
    order = rng.permutation(len(kinds))
    ends = np.cumsum(np.array(lengths)[order])
    ends *= length_m / ends[-1]
    starts = np.concatenate([[0.0], ends[:-1]])
    return tuple(
        SectionSettings(from_m=float(a), to_m=float(b), kind=kinds[k])
        for a, b, k in zip(starts, ends, order, strict=True)
    )
