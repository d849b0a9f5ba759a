"""Settings of the simulated line: its four kinds and the error of its map."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator, model_validator

from railfix.simulate.setting_types import (
    Between,
    Finite,
    NotNegative,
    Positive,
    ScenarioSettings,
    Seed,
    at_least,
    beyond_start,
)

#: Length of the pattern of P1's test line [m], and of a generated line, where none is given.
PATTERN_LENGTH_M: Final = 756.0
GENERATED_LENGTH_M: Final = 36_000.0
#: Longest line, and longest element of one [m].
LONGEST_LINE_M: Final = 1e7


class Element(ScenarioSettings):
    """Horizontal alignment element."""

    #: A transition is a clothoid from the element before to the one after; cant rises with its curvature.
    kind: Literal["straight", "transition", "curve"]

    length_m: float = Field(gt=0.0, le=LONGEST_LINE_M)
    #: Of a curve, positive to the right; infinite for the others.
    radius_m: float = Field(default=math.inf, allow_inf_nan=True)
    cant_m: float = Field(default=0.0, ge=0.0, le=0.3)  #: Of a curve: outer rail above inner rail.

    @model_validator(mode="after")
    def _curves_alone_bend(self) -> Element:
        curved = self.kind == "curve"
        if curved != math.isfinite(self.radius_m) or (curved and abs(self.radius_m) < 30.0):
            raise ValueError(
                f"radius_m of a {self.kind} is {self.radius_m}; a curve has a radius of at least 30 m "
                "(negative to the left), other elements have none"
            )
        if self.cant_m > 0.0 and not curved:
            raise ValueError(f"cant_m of a {self.kind} is {self.cant_m}; give it to the curve")
        return self


class Gradient(ScenarioSettings):
    """Gradient from a chainage on."""

    from_m: NotNegative  #: Chainage of the change, the middle of its vertical curve.
    permille: float = Field(ge=-100.0, le=100.0)  #: Positive where the line rises with chainage.
    vertical_radius_m: Positive = 4000.0  #: Radius of the vertical curve that joins it to the gradient before.


class Terrain(ScenarioSettings):
    """Limits of the elements of a generated line from a chainage on; lengths and radii are uniform in their ranges."""

    from_m: NotNegative = 0.0
    #: Range of the lengths of straights and curves, transitions not counted, and of the radii.
    straight_m: Annotated[Between, at_least(1.0)] = (200.0, 1500.0)
    curve_m: Annotated[Between, at_least(1.0)] = (100.0, 500.0)
    radius_m: Annotated[Between, at_least(100.0)] = (400.0, 1600.0)
    permille: float = Field(default=10.0, ge=0.0, le=35.0)  #: Steepest gradient.
    #: Range of the distance between two changes of gradient.
    gradient_m: Annotated[Between, at_least(200.0)] = (400.0, 1500.0)


class GeneratedLine(ScenarioSettings):
    """Commercial line generated from a seed."""

    seed: Seed = 1  #: Of the line alone, so that several runs share it.
    #: The cant is the equilibrium cant at this speed, up to `largest_cant_m`, in steps of 5 mm.
    speed_mps: Positive = 110.0 / 3.6

    largest_cant_m: NotNegative = 0.105
    vertical_radius_m: Positive = 4000.0
    terrain: tuple[Terrain, ...] = (Terrain(),)  #: By rising `from_m`, the first from 0.

    @field_validator("terrain")
    @classmethod
    def _from_the_start(cls, terrain: tuple[Terrain, ...]) -> tuple[Terrain, ...]:
        starts = [part.from_m for part in terrain]
        if not starts or starts[0] != 0.0 or any(a >= b for a, b in pairwise(starts)):
            raise ValueError(f"must begin at 0 and rise; its from_m are {starts}")
        return terrain


class LineFile(ScenarioSettings):
    """Track file used as the line."""

    path: str  #: As `railfix.track.read_track` reads it; in a scenario file relative to that file.
    #: Part of the file's chainage that is used.
    from_m: NotNegative = 0.0
    to_m: float = Field(default=math.inf, allow_inf_nan=True)
    #: As the options of `read_track`; empty where the file states them itself.
    crs: str = ""
    height_datum: str = ""
    geoid: str = ""

    _forward = field_validator("to_m")(beyond_start)


class MapError(ScenarioSettings):
    """Offset of the map from the true line: a smooth Gaussian function of chainage."""

    plan_sigma_m: NotNegative = 0.0  #: Standard deviation of each of the east and north offsets.
    height_sigma_m: NotNegative = 0.0
    correlation_m: Positive = 500.0  #: Distance along the line over which the correlation falls to exp(-1/2).
    seed: Seed = 1


def _length_m(given: dict[str, Any]) -> float:
    """Length of a line whose settings do not give it."""
    total = math.fsum(item.length_m for item in given.get("elements", ()))
    by_kind = {"pattern": PATTERN_LENGTH_M, "generated": GENERATED_LENGTH_M, "elements": total}
    return by_kind.get(given.get("kind", "file"), math.nan)


class LineSettings(ScenarioSettings):
    """The line and the spacing of its map."""

    name: str = "made test line"
    #: The pattern of P1's test line; `elements` and `gradients`; `generated`; or `file`.
    kind: Literal["pattern", "elements", "generated", "file"] = "pattern"
    #: First point; ellipsoidal height. Not used for a file.
    latitude_deg: float = Field(default=35.05, gt=-80.0, lt=80.0)
    longitude_deg: Finite = 135.45
    height_m: Finite = 162.0
    azimuth_deg: Finite = 63.0  #: Direction of the line at its first point. Not used for a file.
    #: Kilometrage of the first point; it rises with chainage. A file brings its own.
    kilometrage_start_m: Finite = 12_340.0
    #: Largest spacing of the map's points; curves include their transitions. A file brings its points.
    straight_spacing_m: Positive = 20.0
    curve_spacing_m: Positive = 2.32

    elements: tuple[Element, ...] = ()
    gradients: tuple[Gradient, ...] = ()  #: Level where there is none.
    #: The pattern, 756 m long, is repeated (every second time mirrored) and cut off here; a generated line ends here.
    #: Elements have their own sum, and a file its own length (NaN here).
    length_m: float = Field(default_factory=_length_m, allow_inf_nan=True)

    generated: GeneratedLine = GeneratedLine()
    file: LineFile | None = None
    map_error: MapError = MapError()

    @model_validator(mode="after")
    def _of_one_kind(self) -> LineSettings:
        """Reject settings of another kind of line."""
        total = math.fsum(item.length_m for item in self.elements)
        if (self.kind == "elements") != bool(self.elements) or (self.gradients and not self.elements):
            raise ValueError(f"elements (and gradients) go with kind 'elements', got {self.kind!r}")
        if (self.kind == "file") != (self.file is not None):
            raise ValueError(f"file goes with kind 'file', got kind {self.kind!r}")
        if self.kind != "generated" and self.generated != GeneratedLine():
            raise ValueError(f"generated goes with kind 'generated', got {self.kind!r}")
        if self.length_m > LONGEST_LINE_M:
            raise ValueError(f"length_m is {self.length_m:g}, expected at most {LONGEST_LINE_M:g}")
        if self.kind == "file" and not math.isnan(self.length_m):
            raise ValueError("length_m is the file's own; use from_m and to_m of the file for a part")
        if self.kind == "elements" and abs(self.length_m - total) > 1e-6:
            raise ValueError(f"length_m is {self.length_m}, but the elements are {total} m long")
        if self.kind != "file" and not self.length_m >= 100.0:
            raise ValueError(f"length_m must be at least 100 m for a train to run, got {self.length_m}")
        return self
