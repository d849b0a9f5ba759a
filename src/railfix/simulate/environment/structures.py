"""Walls and roofs along a line, drawn from settings and a seed, in arrays sorted by side and chainage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Strings
from railfix.simulate.environment.settings import Kind, RoofSettings, RowSettings, SectionSettings, TreeSettings
from railfix.simulate.settings import Between

#: Road bridges over the tracks.
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

#: Rows of walls by kind of section; kinds that are not listed have no walls.
ROWS: Final[Mapping[Kind, tuple[RowSettings, ...]]] = {
    "suburban": (_HOUSES, _BLOCKS_BEHIND),
    "urban": (_BLOCKS, _TOWERS_BEHIND),
    "canyon": (_CANYON, _TOWERS_BEHIND),
    "cutting": (_SLOPE,),
    "mountain": (_RIDGE,),
    "station": (_BLOCKS, _TOWERS_BEHIND),
}
#: Roofs by kind of section; kinds that are not listed have no roofs.
ROOFS: Final[Mapping[Kind, tuple[RoofSettings, ...]]] = {
    **dict.fromkeys(("suburban", "urban", "canyon", "cutting"), (_BRIDGE,)),
    "station": (RoofSettings(), _CONCOURSE),
}
#: Roof that represents the crown of a tunnel and the ground above it, for antennas outside the tunnel.
TUNNEL_CROWN: Final = RoofSettings(inner_m=0.0, outer_m=200.0, height_m=6.5, loss_db=200.0)


def draw_sections(
    shares: Mapping[Kind, float], length_m: float, *, section_length_m: Between, seed: int
) -> tuple[SectionSettings, ...]:
    """Return sections in random order that cover a line from 0 to its end, with exactly the given fractions by kind.

    The fractions `shares` must add up to 1. `section_length_m` is the approximate range of the lengths of sections; a
    kind with a small fraction has a single shorter section.
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


BEYOND_M: Final = 500.0  #: The first and the last section extend this far beyond the line [m].
SIDES: Final = ("left", "right")  #: Sides of the line, in the order of the arrays.


@dataclass(frozen=True, kw_only=True)
class Strips:
    """Structures of the left, then of the right side, n in total; each side in order of chainage, without overlap."""

    start_m: Floats  #: Chainage of the start of each structure, shape (n,).
    end_m: Floats  #: Chainage of the end of each structure, shape (n,).
    #: Chainage from which on the structure is the nearest of its side, plus `reach_m` on the right side, shape (n,).
    border_m: Floats
    reach_m: float  #: Length larger than all chainages.
    value: dict[str, Floats]  #: Properties by name, each of shape (n,).

    def nearest(self, side: Indices, chainage_m: Floats) -> Indices:
        """Return the index of the nearest structure on a side (0 left, 1 right). Both sides must have structures."""
        low = np.clip(chainage_m, -0.25 * self.reach_m, 0.5 * self.reach_m)
        return np.searchsorted(self.border_m, side * self.reach_m + low, side="right") - 1


@dataclass(frozen=True, kw_only=True)
class Structures:
    """Walls, roofs and sections of a line."""

    #: Rows of vertical walls with `distance_m` (to the middle of the wall), `height_m`, `reflection`, `roughness_m` and
    #: `slope` (tangent of the yaw).
    walls: tuple[Strips, ...]
    #: Rows of roofs with `inner_m`, `outer_m`, `height_m` and `through` (amplitude factor of signals through the roof).
    roofs: tuple[Strips, ...]
    borders_m: Floats  #: Start and end chainage of each section, shape (2 S,).
    kinds: Strings  #: Kind of section before, between and after the borders, shape (2 S + 1,).


def build_structures(sections: Sequence[SectionSettings], line_length_m: float, seed: int) -> Structures:
    """Return the walls and roofs of sections, in order of chainage; equal seeds yield equal structures."""
    ends = np.array([section.to_m for section in sections])
    reach = 4.0 * (max(line_length_m, ends.max(initial=0.0)) + 2.0 * BEYOND_M)
    walls: dict[int, list[list[list[float]]]] = {}
    roofs: dict[int, list[list[list[float]]]] = {}
    for i, section in enumerate(sections):
        low = section.from_m - (BEYOND_M if i == 0 and section.kind != "tunnel" else 0.0)
        high = section.to_m + (BEYOND_M if i == len(sections) - 1 and section.kind != "tunnel" else 0.0)
        rows = ROWS.get(section.kind, ()) if section.rows is None else section.rows
        over = ROOFS.get(section.kind, ()) if section.roofs is None else section.roofs
        for r, row in enumerate(rows):
            for s, side in enumerate(SIDES):
                if row.sides in (side, "both"):
                    rng = np.random.default_rng([seed, 7102, i, r, s])
                    walls.setdefault(r, [[], []])[s] += _row(row, low, high, rng)
        if section.kind == "tunnel":
            over = (TUNNEL_CROWN,)
        for r, roof in enumerate(over):
            for s, side in enumerate(SIDES):
                # A roof over the track has the same seed on both sides, because it is one structure.
                rng = np.random.default_rng([seed, 7103, i, r, 0 if roof.inner_m == 0.0 else s])
                tunnel = [(low, high)] if section.kind == "tunnel" else None
                if roof.sides in (side, "both"):
                    spans = tunnel or _spans(roof.length_m, roof.gap_m, low, high, rng)
                    form = (roof.inner_m, roof.outer_m, roof.height_m, 10.0 ** (-roof.loss_db / 20.0))
                    roofs.setdefault(r, [[], []])[s] += [[*span, *form] for span in spans]
    names = ("distance_m", "height_m", "reflection", "roughness_m", "slope")
    over_names = ("inner_m", "outer_m", "height_m", "through")
    kinds = [kind for section in sections for kind in ("open", section.kind)]
    return Structures(
        walls=tuple(_strips(sides, names, reach) for _, sides in sorted(walls.items())),
        roofs=tuple(_strips(sides, over_names, reach) for _, sides in sorted(roofs.items())),
        borders_m=np.array([x for section in sections for x in (section.from_m, section.to_m)]),
        kinds=np.array([*kinds, "open"]),
    )


def tree_rows(settings: Sequence[TreeSettings], line_length_m: float, seed: int) -> tuple[Strips, ...]:
    """Return rows of trees along the whole line, one per element of `settings`.

    The properties of the trees are `distance_m`, `height_m`, `crown_m`, `attenuation_db_per_m`, `most_db` and
    `scatter`.
    """
    reach = 4.0 * (line_length_m + 2.0 * BEYOND_M)
    names = ("distance_m", "height_m", "crown_m", "attenuation_db_per_m", "most_db", "scatter")
    rows = []
    for number, row in enumerate(settings):
        sides: list[list[list[float]]] = [[], []]
        for s, side in enumerate(SIDES):
            rng = np.random.default_rng([seed, 7105, number, s])
            for start, end in _spans(row.length_m, row.gap_m, -BEYOND_M, line_length_m + BEYOND_M, rng):
                drawn = [rng.uniform(*pair) for pair in (row.distance_m, row.height_m, row.crown_m)]
                if rng.uniform() < row.share and row.sides in (side, "both"):
                    sides[s].append([start, end, *drawn, row.attenuation_db_per_m, row.most_db, row.scatter])
        rows.append(_strips(sides, names, reach))
    return tuple(rows)


def _spans(
    length_m: Between, gap_m: Between, low: float, high: float, rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Return the start and the end of consecutive structures between two chainages, with random lengths and gaps."""
    spans = []
    at = low + rng.uniform(0.0, 1.0) * gap_m[1]
    while at < high:
        end = at + rng.uniform(*length_m)
        spans.append((at, min(end, high)))
        at = end + rng.uniform(*gap_m)
    return spans


def _row(row: RowSettings, low: float, high: float, rng: np.random.Generator) -> list[list[float]]:
    walls = []
    for start, end in _spans(row.length_m, row.gap_m, low, high, rng):
        drawn = [rng.uniform(*pair) for pair in (row.distance_m, row.height_m, row.reflection, row.roughness_m)]
        slope = float(np.tan(np.radians(rng.uniform(*row.yaw_deg))))
        if rng.uniform() < row.share:
            walls.append([start, end, *drawn, slope])
    return walls


def _strips(sides: list[list[list[float]]], names: tuple[str, ...], reach: float) -> Strips:
    """Return the arrays of both sides; each side begins with a structure of zero length far before the line.

    This structure ensures that `Strips.nearest` finds a structure on an empty side.
    """
    absent = [-0.3 * reach, -0.3 * reach, *([1.0] * (len(names) - 1)), 0.0]
    tables = [np.array([absent, *side]) for side in sides]
    borders = []
    for s, table in enumerate(tables):
        middle = 0.5 * (table[:-1, 1] + table[1:, 0])
        borders.append(s * reach + np.concatenate([[-0.3 * reach], middle]))
    both = np.concatenate(tables)
    return Strips(
        start_m=both[:, 0],
        end_m=both[:, 1],
        border_m=np.concatenate(borders),
        reach_m=reach,
        value={name: both[:, 2 + k] for k, name in enumerate(names)},
    )
