"""Settings of the structures along a line that block, reflect and scatter signals; by default, there are no structures.

In a scenario file::

    [environment.electrification]
    spacing_m = 50.0

    [[environment.sections]]
    from_m = 0.0
    to_m = 900.0
    kind = "urban"

Instead of sections, ``[environment.shares]`` specifies the fraction of the line for each kind of section; the sections
are then drawn at random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import Field, field_validator, model_validator

from railfix.core.arrays import Datetimes, Floats, Strings
from railfix.simulate.settings import (
    AngleBetween,
    Between,
    Finite,
    NotNegative,
    Positive,
    ScenarioSettings,
    Share,
    at_least,
    beyond_start,
)

Kind = Literal["open", "suburban", "urban", "canyon", "cutting", "mountain", "station", "tunnel"]
Sides = Literal["left", "right", "both"]

KINDS: Final[tuple[str, ...]] = get_args(Kind)  #: Kinds of section.


class ElectrificationSettings(ScenarioSettings):
    """Masts, beams across the tracks, and wires above the track."""

    spacing_m: Positive = 50.0  #: Spacing of the masts.
    first_m: Finite = 10.0  #: Chainage of one mast; the other masts are at multiples of the spacing from this mast.

    sides: Sides = "both"  #: Sides of the line with masts.
    lateral_m: Positive = 3.0  #: Distance of the axis of a mast from the track axis.
    width_m: Positive = 0.35  #: Width of a mast.
    height_m: Positive = 9.0  #: Height of the top of a mast above the rails.
    beam_every: int = Field(default=1, ge=0)  #: Beams are at every mast (1), every second (2) ...; 0 for no beams.
    beam_height_m: Positive = 7.5  #: Height of the middle of a beam above the rails.
    beam_depth_m: Positive = 0.4  #: Depth of a beam.
    wire_height_m: Positive = 5.1  #: Height of the contact wire above the rails, over the track axis.
    wire_width_m: Positive = 0.012  #: Width of the contact wire and of the messenger wire.
    messenger_height_m: Positive = 6.0  #: Height of the messenger wire above the rails.


class RowSettings(ScenarioSettings):
    """Row of walls (buildings, slopes, mountains); a pair of numbers is the range of a uniform distribution."""

    sides: Sides = "both"
    distance_m: Between = (10.0, 30.0)  #: Distance of the wall from the track axis.
    height_m: Between = (6.0, 15.0)  #: Height of the top of a wall above the rails.
    length_m: Between = (10.0, 30.0)  #: Length of a wall along the line.
    gap_m: Between = (2.0, 10.0)  #: Distance from the end of a wall to the next wall.
    share: Share = 1.0  #: Fraction of the building plots that have a wall.
    #: Amplitude reflection coefficient, from 0 to 1. Without `AntennaSettings`, it includes the effect of polarisation.
    reflection: Between = (0.2, 0.7)
    roughness_m: Between = (0.0, 0.02)  #: Standard deviation of the wall's surface height.
    yaw_deg: AngleBetween = (-4.0, 4.0)  #: Yaw of the wall relative to the direction of the line.

    @field_validator("distance_m", "length_m", "reflection", "yaw_deg")
    @classmethod
    def _within(cls, pair: tuple[float, float], info: Any) -> tuple[float, float]:
        least, most = {"distance_m": (2.0, inf), "length_m": (1.0, inf), "reflection": (0.0, 1.0)}.get(
            info.field_name, (-20.0, 20.0)
        )
        if pair[0] < least or pair[1] > most:
            raise ValueError(f"must lie between {least:g} and {most:g}")
        return pair


class RoofSettings(ScenarioSettings):
    """Level roofs along the line, over platforms or across the tracks (bridges, concourses)."""

    sides: Sides = "both"
    inner_m: NotNegative = 1.8  #: Distance of the inner edge from the track axis; 0 for a roof that covers the track.
    outer_m: float = Field(default=9.0, gt=0.0, validate_default=True)  #: Outer edge's distance from the track axis.
    height_m: Positive = 6.0  #: Height of the roof above the rails.
    length_m: Annotated[Between, at_least(1.0)] = (60.0, 120.0)  #: Range of the uniformly distributed lengths of roofs.
    gap_m: Between = (10.0, 40.0)  #: Range of the uniformly distributed gaps to the next roof.
    loss_db: NotNegative = 25.0  #: Loss of signals through the roof.

    @field_validator("outer_m")
    @classmethod
    def _outside(cls, outer_m: float, info: Any) -> float:
        if outer_m <= info.data.get("inner_m", 0.0):
            raise ValueError(f"must lie beyond inner_m of {info.data['inner_m']}")
        return outer_m


class SectionSettings(ScenarioSettings):
    """Section of the line with one kind of surroundings."""

    from_m: Finite  #: Chainage at which the section begins.
    to_m: Finite  #: Chainage at which the section ends.
    kind: Kind  #: Kind of section, one of `KINDS`, which determines the usual walls and roofs.
    rows: tuple[RowSettings, ...] | None = None  #: Rows of walls; None for the usual rows of the kind.
    roofs: tuple[RoofSettings, ...] | None = None  #: Roofs; None for the usual roofs of the kind.

    _forward = field_validator("to_m")(beyond_start)


class CorrelatorSettings(ScenarioSettings):
    """Correlator and tracking loops of the receivers."""

    chip_m: Positive = 293.05  #: Length of a C/A chip; the chips of faster codes are shorter in proportion.
    spacing_chips: float = Field(default=0.1, gt=0.0, le=1.0)  #: Early-late spacing of the correlator.
    tracking_cn0_dbhz: Finite = 20.0  #: A signal is lost if its C/N0 is lower than this.
    code_loop_hz: Positive = 1.0  #: Bandwidth of the code loop; faster multipath fading is averaged.
    carrier_loop_hz: Positive = 10.0  #: Bandwidth of the carrier loop.
    backward_db: Finite = 15.0  #: Loss of the antenna for signals from below the horizon.


class AntennaSettings(ScenarioSettings):
    """Polarisation of the antenna and permittivity of walls; the resulting factor multiplies a wall's `reflection`."""

    cross_polar_zenith_db: NotNegative = 15.0  #: Loss of left-handed relative to right-handed signals at the zenith.
    cross_polar_horizon_db: NotNegative = 4.0  #: Loss of left-handed relative to right-handed signals at the horizon.
    wall_permittivity: float = Field(default=6.0, gt=1.0)  #: Relative permittivity, about 6 for concrete and glass.
    #: Standard deviation of the gain over azimuth at the horizon; at other elevations, it is proportional to the cosine
    #: of the elevation. The ripples of the two antennas are independent.
    ripple_sigma_db: NotNegative = 0.0


class SideStreetSettings(ScenarioSettings):
    """Side streets with walls perpendicular to the line; a pair of numbers is the range of a uniform distribution."""

    spacing_m: Between = (50.0, 150.0)  #: Distance from the end of a street to the next street.
    width_m: Between = (8.0, 25.0)  #: Distance between the walls of a street.
    front_m: Between = (12.0, 25.0)  #: Distance of the mouth of the street from the track axis.
    depth_m: Between = (20.0, 80.0)  #: Length of the walls of the street.
    height_m: Between = (15.0, 60.0)  #: Height of the reflecting wall above the rails.
    opposite_m: Between = (5.0, 40.0)  #: Height of the opposite wall of the street above the rails.
    reflection: Between = (0.3, 1.0)  #: Amplitude reflection coefficient, as in `RowSettings`.
    roughness_m: NotNegative = 0.01  #: Standard deviation of the walls' surface height.
    candidates: int = Field(default=2, ge=1, le=6)  #: Number of streets, nearest first, whose reflections are computed.


class TreeSettings(ScenarioSettings):
    """Row of trees along the line; a pair of numbers is the range of a uniform distribution."""

    sides: Sides = "both"
    distance_m: Between = (6.0, 12.0)  #: Distance of the trunks from the track axis.
    height_m: Between = (8.0, 16.0)  #: Height of the top of a crown above the rails.
    crown_m: Between = (2.5, 4.0)  #: Height of the lower edge of a crown above the rails.
    length_m: Between = (4.0, 9.0)  #: Width of a crown.
    gap_m: Between = (0.0, 6.0)  #: Distance from the edge of a crown to the next crown.
    share: Share = 1.0  #: Fraction of the planting positions that have a tree.
    attenuation_db_per_m: NotNegative = 1.0  #: Specific attenuation of a crown.
    most_db: NotNegative = 12.0  #: Largest loss by a crown.
    scatter: Share = 0.5  #: Ratio of the amplitude scattered to the antenna to the amplitude lost in a crown.


class NeighbourSettings(ScenarioSettings):
    """Vehicles on a parallel track or lane that follow each other at constant speed."""

    side: Literal["left", "right"] = "right"
    lateral_m: Positive = 2.5  #: Distance of the near side of the vehicles from the track axis.
    height_m: Positive = 4.3  #: Height of the top of the vehicles above the rails.
    length_m: Positive = 100.0  #: Length of a vehicle.
    spacing_m: Positive = 5000.0  #: Distance from the start of a vehicle to the start of the next vehicle.
    speed_mps: Finite = -20.0  #: Speed of the vehicles, positive toward rising chainage.
    reflection: Share = 0.8  #: Amplitude reflection coefficient of the sides of the vehicles.


class RoofEquipment(ScenarioSettings):
    """Equipment on the roof of the vehicle near the antenna, such as air conditioning or a pantograph."""

    ahead_m: Finite  #: Distance forward from the antenna to the nearest edge; negative if the edge is behind.
    above_antenna_m: Positive  #: Height of the top above the antenna.
    half_width_m: Positive = 1.0  #: Half the width of the equipment, across the vehicle.


class EnvironmentSettings(ScenarioSettings):
    """Structures along the line that block, reflect and scatter signals; there are none by default."""

    electrification: ElectrificationSettings | None = None
    sections: tuple[SectionSettings, ...] = ()  #: Sections in order of chainage; between sections, the line is open.
    #: Fraction of the line length by kind of section, instead of `sections`; the sections are then drawn at random.
    shares: dict[Kind, Share] = Field(default_factory=dict)
    section_length_m: Annotated[Between, at_least(20.0)] = (150.0, 800.0)  #: Range of the lengths of drawn sections.
    antenna_height_m: Positive = 4.0  #: Height of the antennas above the rails.
    ground_reflection: Share = 0.5  #: Amplitude reflection coefficient of the ballast; 0 for no reflection.
    ground_roughness_m: NotNegative = 0.05  #: Standard deviation of the height of the ballast.
    receiver: CorrelatorSettings = CorrelatorSettings()
    #: Effect of polarisation on reflections; if None, a wall's `reflection` applies to any polarisation.
    antenna: AntennaSettings | None = None
    #: "opposite" adds signals reflected twice, by the first rows of walls on opposite sides of the line.
    second_reflections: Literal["none", "opposite"] = "none"
    side_streets: SideStreetSettings | None = None  #: Side streets along the whole line.
    trees: tuple[TreeSettings, ...] = ()  #: Rows of trees along the whole line.
    neighbours: tuple[NeighbourSettings, ...] = ()  #: Vehicles on parallel tracks.
    equipment: tuple[RoofEquipment, ...] = ()  #: Roof equipment; its position relative to each antenna is the same.

    @field_validator("sections")
    @classmethod
    def _in_order(cls, sections: tuple[SectionSettings, ...]) -> tuple[SectionSettings, ...]:
        for before, after in pairwise(sections):
            if after.from_m < before.to_m:
                raise ValueError(
                    f"must be in ascending order without overlap: {after.kind} from {after.from_m:g} m "
                    f"begins before {before.kind} ends at {before.to_m:g} m"
                )
        return sections

    @field_validator("shares")
    @classmethod
    def _complete(cls, shares: dict[Kind, float]) -> dict[Kind, float]:
        if shares and abs(sum(shares.values()) - 1.0) > 1e-6:
            raise ValueError(f"must add up to 1, got {sum(shares.values()):g} in total")
        return shares

    @model_validator(mode="after")
    def _one_way(self) -> EnvironmentSettings:
        if self.sections and self.shares:
            raise ValueError("give either sections or shares, not both")
        return self

    @property
    def empty(self) -> bool:
        """Whether the line has no structures."""
        parts = (self.electrification, self.side_streets)
        lists = (self.sections, self.shares, self.trees, self.neighbours, self.equipment)
        return all(part is None for part in parts) and not any(lists)


@dataclass(frozen=True, kw_only=True)
class SightGeometry:
    """Positions of one antenna, and directions to satellites, at T epochs for M channels."""

    antenna: str  #: "front" or "rear".
    time: Datetimes  #: Time tags, shape (T,).
    satellite: Strings  #: Satellite of each channel, shape (M,).
    signal: Strings  #: Signal of each channel, shape (M,).
    chainage_m: Floats  #: Chainage of the centreline point abeam the antenna, shape (T,).
    speed_mps: Floats  #: Speed, negative toward falling chainage, shape (T,).
    antenna_ecef_m: Floats  #: Position of the antenna, shape (T, 3).
    heading_deg: Floats  #: Azimuth of the forward axis of the vehicle, shape (T,).
    elevation_deg: Floats  #: Elevation of the satellites, shape (T, M).
    azimuth_deg: Floats  #: Azimuth of the satellites, shape (T, M).


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Terms that are added to the observations of T epochs and M channels, shapes (T, M)."""

    code_m: Floats  #: Code error; where it is NaN, the signal is lost and has no observables.
    phase_m: Floats
    doppler_hz: Floats
    cn0_db: Floats  #: Change of C/N0, negative where the signal is attenuated.


#: Function that computes disturbances from the geometry only; results therefore do not depend on the chunks.
Disturbances = Callable[[SightGeometry], Disturbance]


CN0_HORIZON_DBHZ: Final = 34.0
CN0_RISE_DB: Final = 16.0
CN0_SECOND_DB: Final = -3.0
