"""What stands along a line: every choice with its default, as plain values that TOML can hold.

By default nothing stands there. In a scenario file::

    [environment]
    antenna_height_m = 4.0

    [environment.electrification]
    spacing_m = 50.0
    sides = "both"
    beam_every = 1

    [[environment.sections]]
    from_m = 0.0
    to_m = 900.0
    kind = "urban"

    [[environment.sections]]
    from_m = 900.0
    to_m = 1300.0
    kind = "tunnel"

or, instead of the sections, shares from which they are drawn for the line's length::

    [environment.shares]
    open = 0.2
    suburban = 0.5
    urban = 0.2
    tunnel = 0.1
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, Final, Literal, get_args

from railfix.core.errors import SettingsError

Kind = Literal["open", "suburban", "urban", "canyon", "cutting", "mountain", "station", "tunnel"]
Sides = Literal["left", "right", "both"]
#: Least and greatest of what is drawn evenly.
Between = tuple[float, float]

#: Kinds of section.
KINDS: Final[tuple[str, ...]] = get_args(Kind)
#: Misspelt keys are refused where pydantic reads these from a file.
_STRICT: Final = {"extra": "forbid"}


def _refuse(table: Any, name: str, wanted: str) -> None:
    raise SettingsError(f"{type(table).__name__}.{name} must {wanted}, got {getattr(table, name)!r}")


def _positive(table: Any, *names: str) -> None:
    for name in names:
        if not 0.0 < getattr(table, name) < float("inf"):
            _refuse(table, name, "be positive")


def _between(table: Any, *names: str, least: float = 0.0, most: float = float("inf")) -> None:
    for name in names:
        pair = getattr(table, name)
        if len(pair) != 2 or not least <= pair[0] <= pair[1] <= most:
            _refuse(table, name, f"be two rising numbers between {least:g} and {most:g}")


@dataclass(frozen=True, kw_only=True)
class ElectrificationSettings:
    """Masts, beams across the tracks, and the wires over the track.

    Attributes
    ----------
    spacing_m, first_m : float
        Masts stand at chainages first_m + k spacing_m.
    sides : {"left", "right", "both"}
    lateral_m, width_m, height_m : float
        Mast's axis from the track's axis, its width, its top over the rails.
    beam_every : int
        A beam at every so-manieth mast; 0 for none. It reaches from mast line to mast line.
    beam_height_m, beam_depth_m : float
        Middle of the beam over the rails, and its depth as seen from below.
    wire_height_m, wire_width_m, messenger_height_m : float
        Contact wire and messenger wire over the track's axis, always there.
    """

    spacing_m: float = 50.0
    first_m: float = 10.0
    sides: Sides = "both"
    lateral_m: float = 3.0
    width_m: float = 0.35
    height_m: float = 9.0
    beam_every: int = 1
    beam_height_m: float = 7.5
    beam_depth_m: float = 0.4
    wire_height_m: float = 5.1
    wire_width_m: float = 0.012
    messenger_height_m: float = 6.0
    __pydantic_config__: ClassVar[Any] = _STRICT

    def __post_init__(self) -> None:
        _positive(self, "spacing_m", "lateral_m", "width_m", "height_m", "beam_height_m", "beam_depth_m")
        _positive(self, "wire_height_m", "wire_width_m", "messenger_height_m")
        if self.beam_every < 0:
            _refuse(self, "beam_every", "not be negative")
        if self.sides not in get_args(Sides):
            _refuse(self, "sides", f"be one of {get_args(Sides)}")


@dataclass(frozen=True, kw_only=True)
class RowSettings:
    """A row of upright faces along the line, each drawn evenly between the limits: buildings, slopes, mountains.

    Attributes
    ----------
    sides : {"left", "right", "both"}
    distance_m : tuple of float
        From the track's axis to the face.
    height_m : tuple of float
        Top over the rails.
    length_m, gap_m : tuple of float
        Along the line, and to the next.
    share : float
        Of the lots that are built upon.
    reflection : tuple of float
        Amplitude of what the face throws back, as the antenna receives it (0 nothing, 1 all).
    roughness_m : tuple of float
        Standard deviation of the face's unevenness.
    yaw_deg : tuple of float
        Turn of the face out of the line's direction.
    """

    sides: Sides = "both"
    distance_m: Between = (10.0, 30.0)
    height_m: Between = (6.0, 15.0)
    length_m: Between = (10.0, 30.0)
    gap_m: Between = (2.0, 10.0)
    share: float = 1.0
    reflection: Between = (0.2, 0.7)
    roughness_m: Between = (0.0, 0.02)
    yaw_deg: Between = (-4.0, 4.0)
    __pydantic_config__: ClassVar[Any] = _STRICT

    def __post_init__(self) -> None:
        if self.sides not in get_args(Sides):
            _refuse(self, "sides", f"be one of {get_args(Sides)}")
        _between(self, "distance_m", least=2.0)
        _between(self, "length_m", least=1.0)
        _between(self, "height_m", "gap_m", "roughness_m")
        _between(self, "reflection", most=1.0)
        _between(self, "yaw_deg", least=-20.0, most=20.0)
        if not 0.0 <= self.share <= 1.0:
            _refuse(self, "share", "lie in [0, 1]")


@dataclass(frozen=True, kw_only=True)
class RoofSettings:
    """Level roofs along the line: over platforms, or across the tracks (bridges, concourses).

    Attributes
    ----------
    sides : {"left", "right", "both"}
    inner_m, outer_m : float
        From the track's axis; 0 covers the track.
    height_m : float
        Over the rails.
    length_m, gap_m : tuple of float
        Along the line, and to the next; drawn.
    loss_db : float
        What goes through the roof is weaker by this.
    """

    sides: Sides = "both"
    inner_m: float = 1.8
    outer_m: float = 9.0
    height_m: float = 6.0
    length_m: Between = (60.0, 120.0)
    gap_m: Between = (10.0, 40.0)
    loss_db: float = 25.0
    __pydantic_config__: ClassVar[Any] = _STRICT

    def __post_init__(self) -> None:
        if self.sides not in get_args(Sides):
            _refuse(self, "sides", f"be one of {get_args(Sides)}")
        if not 0.0 <= self.inner_m < self.outer_m:
            _refuse(self, "inner_m", "lie between 0 and outer_m")
        _positive(self, "height_m")
        _between(self, "length_m", least=1.0)
        _between(self, "gap_m")
        if not self.loss_db >= 0.0:
            _refuse(self, "loss_db", "not be negative")


@dataclass(frozen=True, kw_only=True)
class SectionSettings:
    """One section of the line.

    Attributes
    ----------
    from_m, to_m : float
        Chainages.
    kind : str
        One of `KINDS`; gives the rows and roofs where none are given here.
    rows : tuple of RowSettings, optional
    roofs : tuple of RoofSettings, optional
    """

    from_m: float
    to_m: float
    kind: Kind
    rows: tuple[RowSettings, ...] | None = None
    roofs: tuple[RoofSettings, ...] | None = None
    __pydantic_config__: ClassVar[Any] = _STRICT

    def __post_init__(self) -> None:
        if not self.from_m < self.to_m:
            _refuse(self, "to_m", f"lie beyond from_m, {self.from_m!r}")
        if self.kind not in KINDS:
            _refuse(self, "kind", f"be one of {KINDS}")


@dataclass(frozen=True, kw_only=True)
class CorrelatorSettings:
    """The receiver, as far as it decides what multipath does.

    Attributes
    ----------
    chip_m : float
        Length of a C/A chip; faster codes have theirs in proportion.
    spacing_chips : float
        Early to late.
    tracking_cn0_dbhz : float
        Weaker signals are lost.
    code_loop_hz, carrier_loop_hz : float
        Bandwidths of the loops: multipath that turns faster is averaged.
    backward_db : float
        By which the antenna on its roof receives from below the horizon weaker.
    """

    chip_m: float = 293.05
    spacing_chips: float = 0.1
    tracking_cn0_dbhz: float = 20.0
    code_loop_hz: float = 1.0
    carrier_loop_hz: float = 10.0
    backward_db: float = 15.0
    __pydantic_config__: ClassVar[Any] = _STRICT

    def __post_init__(self) -> None:
        _positive(self, "chip_m", "spacing_chips", "code_loop_hz", "carrier_loop_hz")
        if self.spacing_chips > 1.0:
            _refuse(self, "spacing_chips", "be at most 1")


@dataclass(frozen=True, kw_only=True)
class EnvironmentSettings:
    """Everything along the line that disturbs signals; by default nothing.

    Attributes
    ----------
    electrification : ElectrificationSettings, optional
    sections : tuple of SectionSettings
        Rising, without overlap; between them the line is open.
    shares : dict of str to float
        Instead of sections: share of the line's length by kind, from which sections are drawn.
    section_length_m : tuple of float
        Lengths of the drawn sections.
    antenna_height_m : float
        Over the rails.
    ground_reflection : float
        Amplitude that ballast throws back; 0 for none.
    ground_roughness_m : float
    receiver : CorrelatorSettings
    """

    electrification: ElectrificationSettings | None = None
    sections: tuple[SectionSettings, ...] = ()
    shares: dict[Kind, float] = field(default_factory=dict)
    section_length_m: Between = (150.0, 800.0)
    antenna_height_m: float = 4.0
    ground_reflection: float = 0.5
    ground_roughness_m: float = 0.05
    receiver: CorrelatorSettings = field(default_factory=CorrelatorSettings)
    __pydantic_config__: ClassVar[Any] = _STRICT

    def __post_init__(self) -> None:
        ordered(self.sections)
        if self.sections and self.shares:
            raise SettingsError("EnvironmentSettings takes either sections or shares, not both")
        wrong = set(self.shares) - set(KINDS)
        if wrong or any(not 0.0 <= share <= 1.0 for share in self.shares.values()):
            _refuse(self, "shares", f"give numbers in [0, 1] to kinds out of {KINDS}")
        if self.shares and abs(sum(self.shares.values()) - 1.0) > 1e-6:
            _refuse(self, "shares", "add up to 1")
        _between(self, "section_length_m", least=20.0)
        _positive(self, "antenna_height_m")
        if not 0.0 <= self.ground_reflection <= 1.0:
            _refuse(self, "ground_reflection", "lie in [0, 1]")
        if not self.ground_roughness_m >= 0.0:
            _refuse(self, "ground_roughness_m", "not be negative")

    @property
    def empty(self) -> bool:
        """Whether nothing at all stands along the line, so that the environment can be left out."""
        return self.electrification is None and not self.sections and not self.shares


def ordered(sections: Sequence[SectionSettings]) -> None:
    """Refuse sections that overlap or fall.

    Raises
    ------
    SettingsError
    """
    for one, other in pairwise(sections):
        if other.from_m < one.to_m:
            raise SettingsError(
                f"EnvironmentSettings.sections must rise without overlap: {other.kind} from {other.from_m:g} m "
                f"begins before {one.kind} ends at {one.to_m:g} m"
            )
