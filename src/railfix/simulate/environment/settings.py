"""Settings of the structures along a line that block, reflect and scatter signals; none by default.

In a scenario file::

    [environment.electrification]
    spacing_m = 50.0

    [[environment.sections]]
    from_m = 0.0
    to_m = 900.0
    kind = "urban"

or, instead of the sections, ``[environment.shares]`` with the fraction of the line that each kind has; sections are
then drawn at random over the length of the line.
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
    """Masts, beams across the tracks, and the wires over the track."""

    #: Masts are at chainages first_m + k spacing_m.
    spacing_m: Positive = 50.0
    first_m: Finite = 10.0

    sides: Sides = "both"
    #: Mast's axis from the track's axis, its width, its top over the rails.
    lateral_m: Positive = 3.0
    width_m: Positive = 0.35
    height_m: Positive = 9.0
    beam_every: int = Field(default=1, ge=0)  #: A beam at every n-th mast, from mast line to mast line; 0 for none.
    #: Middle of the beam over the rails, and its depth as seen from below.
    beam_height_m: Positive = 7.5
    beam_depth_m: Positive = 0.4
    #: Contact wire and messenger wire over the track's axis, always there.
    wire_height_m: Positive = 5.1
    wire_width_m: Positive = 0.012
    messenger_height_m: Positive = 6.0


class RowSettings(ScenarioSettings):
    """A row of vertical walls along the line, uniform between the limits: buildings, slopes, mountains."""

    sides: Sides = "both"
    distance_m: Between = (10.0, 30.0)  #: From the track's axis to the wall.
    height_m: Between = (6.0, 15.0)  #: Top over the rails.
    #: Along the line, and to the next.
    length_m: Between = (10.0, 30.0)
    gap_m: Between = (2.0, 10.0)
    share: Share = 1.0  #: Fraction of the plots with buildings.
    #: Amplitude reflection coefficient, the antenna's polarisation included (0 nothing, 1 all).
    reflection: Between = (0.2, 0.7)
    roughness_m: Between = (0.0, 0.02)  #: Standard deviation of the surface height.
    yaw_deg: AngleBetween = (-4.0, 4.0)  #: Yaw of the wall relative to the line's direction.

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
    """Level roofs along the line: over platforms, or across the tracks (bridges, concourses)."""

    sides: Sides = "both"
    #: Distances of the edges from the track's axis; an inner edge at 0 covers the track.
    inner_m: NotNegative = 1.8
    outer_m: float = Field(default=9.0, gt=0.0, validate_default=True)
    height_m: Positive = 6.0  #: Over the rails.
    #: Along the line, and to the next; uniform.
    length_m: Annotated[Between, at_least(1.0)] = (60.0, 120.0)
    gap_m: Between = (10.0, 40.0)
    loss_db: NotNegative = 25.0  #: Loss through the roof.

    @field_validator("outer_m")
    @classmethod
    def _outside(cls, outer_m: float, info: Any) -> float:
        if outer_m <= info.data.get("inner_m", 0.0):
            raise ValueError(f"must lie beyond inner_m of {info.data['inner_m']}")
        return outer_m


class SectionSettings(ScenarioSettings):
    """One section of the line."""

    #: Chainages.
    from_m: Finite
    to_m: Finite
    kind: Kind  #: One of `KINDS`; rows and roofs are the kind's unless given here.
    rows: tuple[RowSettings, ...] | None = None
    roofs: tuple[RoofSettings, ...] | None = None

    _forward = field_validator("to_m")(beyond_start)


class CorrelatorSettings(ScenarioSettings):
    """Correlator and tracking loops of the receivers."""

    chip_m: Positive = 293.05  #: Length of a C/A chip; faster codes have theirs in proportion.
    spacing_chips: float = Field(default=0.1, gt=0.0, le=1.0)  #: Early to late.
    tracking_cn0_dbhz: Finite = 20.0  #: Signals below this C/N0 are lost.
    #: Bandwidths of the loops: faster multipath fading is averaged.
    code_loop_hz: Positive = 1.0
    carrier_loop_hz: Positive = 10.0
    backward_db: Finite = 15.0  #: Loss of the antenna below the horizon.


class AntennaSettings(ScenarioSettings):
    """Polarisation of the antenna and material of the walls, which a wall's `reflection` then multiplies."""

    #: Gain for left-handed signals below the gain for right-handed signals, at the zenith and at the horizon.
    cross_polar_zenith_db: NotNegative = 15.0
    cross_polar_horizon_db: NotNegative = 4.0
    #: Relative permittivity of the walls: about 6 for concrete and glass.
    wall_permittivity: float = Field(default=6.0, gt=1.0)
    #: Gain variation over azimuth at the horizon, reduced by the cosine of the elevation above it; independent for each
    #: antenna.
    ripple_sigma_db: NotNegative = 0.0


class SideStreetSettings(ScenarioSettings):
    """Side streets with walls square to the line, uniform between the limits."""

    #: From one street to the next, and between its walls.
    spacing_m: Between = (50.0, 150.0)
    width_m: Between = (8.0, 25.0)
    #: Distance of the mouth from the track's axis, and length of the street's walls.
    front_m: Between = (12.0, 25.0)
    depth_m: Between = (20.0, 80.0)
    #: Height of the reflecting walls, and of the walls across the street, over the rails.
    height_m: Between = (15.0, 60.0)
    opposite_m: Between = (5.0, 40.0)
    reflection: Between = (0.3, 1.0)  #: As `RowSettings`.
    roughness_m: NotNegative = 0.01
    candidates: int = Field(default=2, ge=1, le=6)  #: Number of streets that can reflect one satellite at a time.


class TreeSettings(ScenarioSettings):
    """A row of trees along the line, uniform between the limits."""

    sides: Sides = "both"
    distance_m: Between = (6.0, 12.0)  #: From the track's axis to the trunks.
    #: Top and lower edge of the crowns over the rails.
    height_m: Between = (8.0, 16.0)
    crown_m: Between = (2.5, 4.0)
    #: Width of a crown, and distance to the next.
    length_m: Between = (4.0, 9.0)
    gap_m: Between = (0.0, 6.0)
    share: Share = 1.0  #: Fraction of the planting positions with a tree.
    #: Specific attenuation, largest loss, and fraction of the lost amplitude that is scattered forward.
    attenuation_db_per_m: NotNegative = 1.0
    most_db: NotNegative = 12.0
    scatter: Share = 0.5


class NeighbourSettings(ScenarioSettings):
    """Vehicles on a parallel track or lane, following each other at constant speed."""

    side: Literal["left", "right"] = "right"
    #: Distance of their side from the track's axis, and their top over the rails.
    lateral_m: Positive = 2.5
    height_m: Positive = 4.3
    #: Length of a vehicle, and spacing from front to front.
    length_m: Positive = 100.0
    spacing_m: Positive = 5000.0
    speed_mps: Finite = -20.0  #: Speed toward rising chainage.
    reflection: Share = 0.8  #: Amplitude reflection coefficient of their sides.


class RoofEquipment(ScenarioSettings):
    """Equipment on the vehicle's roof near the antenna: air conditioning, pantograph well."""

    ahead_m: Finite  #: Distance of its nearest edge in front of the antenna, negative behind.
    above_antenna_m: Positive
    half_width_m: Positive = 1.0


class EnvironmentSettings(ScenarioSettings):
    """Structures along the line that block, reflect and scatter signals; by default none."""

    electrification: ElectrificationSettings | None = None
    sections: tuple[SectionSettings, ...] = ()  #: Rising, without overlap; between them the line is open.
    #: Instead of sections: fraction of the line's length by kind; the sections are drawn at random.
    shares: dict[Kind, Share] = Field(default_factory=dict)
    section_length_m: Annotated[Between, at_least(20.0)] = (150.0, 800.0)  #: Lengths of the drawn sections.
    antenna_height_m: Positive = 4.0  #: Over the rails.
    ground_reflection: Share = 0.5  #: Amplitude reflection coefficient of the ballast; 0 for none.
    ground_roughness_m: NotNegative = 0.05
    receiver: CorrelatorSettings = CorrelatorSettings()
    #: None: walls reflect with the amplitude `reflection`, whatever the polarisation.
    antenna: AntennaSettings | None = None
    #: "opposite": signals reflected by both nearest rows in sequence.
    second_reflections: Literal["none", "opposite"] = "none"
    side_streets: SideStreetSettings | None = None  #: All along the line.
    trees: tuple[TreeSettings, ...] = ()  #: All along the line.
    neighbours: tuple[NeighbourSettings, ...] = ()
    equipment: tuple[RoofEquipment, ...] = ()  #: Of both antennas.

    @field_validator("sections")
    @classmethod
    def _in_order(cls, sections: tuple[SectionSettings, ...]) -> tuple[SectionSettings, ...]:
        for before, after in pairwise(sections):
            if after.from_m < before.to_m:
                raise ValueError(
                    f"must rise without overlap: {after.kind} from {after.from_m:g} m "
                    f"begins before {before.kind} ends at {before.to_m:g} m"
                )
        return sections

    @field_validator("shares")
    @classmethod
    def _complete(cls, shares: dict[Kind, float]) -> dict[Kind, float]:
        if shares and abs(sum(shares.values()) - 1.0) > 1e-6:
            raise ValueError(f"must add up to 1; they are {sum(shares.values()):g} together")
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
    """Positions of one antenna and directions to its satellites at T epochs, M channels."""

    antenna: str  #: "front" or "rear".
    time: Datetimes  #: Shape (T,).
    #: Shape (M,).
    satellite: Strings
    signal: Strings
    chainage_m: Floats  #: Chainage of the centreline point abeam the antenna, shape (T,).
    speed_mps: Floats  #: Negative toward falling chainage, shape (T,).
    antenna_ecef_m: Floats  #: Shape (T, 3).
    heading_deg: Floats  #: Azimuth of the vehicle's forward axis, shape (T,).
    #: Shape (T, M).
    elevation_deg: Floats
    azimuth_deg: Floats


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Terms added to the observations, shapes (T, M)."""

    code_m: Floats  #: NaN where the signal is lost; all observables are then absent.
    phase_m: Floats
    doppler_hz: Floats
    cn0_db: Floats  #: Negative where the signal is attenuated.


#: A source of disturbances: a function of the geometry alone, so that results do not depend on the chunks.
Disturbances = Callable[[SightGeometry], Disturbance]


CN0_HORIZON_DBHZ: Final = 34.0
CN0_RISE_DB: Final = 16.0
CN0_SECOND_DB: Final = -3.0
