"""What line is simulated: the settings of its four kinds and of the map's error."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final, Literal

from railfix.core.errors import SettingsError
from railfix.simulate.setting_checks import require_not_negative, require_one_of, require_positive

#: Length of the pattern of P1's test line [m], and of a generated line, where none is given.
PATTERN_LENGTH_M: Final = 756.0
GENERATED_LENGTH_M: Final = 36_000.0


def _range(table: Any, name: str) -> None:
    value = getattr(table, name)
    if not 0.0 < value[0] <= value[1] < math.inf:
        raise SettingsError(f"{type(table).__name__}.{name} must be two positive rising numbers, got {value!r}")


@dataclass(frozen=True, kw_only=True)
class Element:
    """A piece of the line in plan.

    Attributes
    ----------
    kind : {"straight", "transition", "curve"}
        A transition is a clothoid from the element before to the one after; cant rises with its curvature.
    length_m : float
    radius_m : float
        Of a curve, positive to the right; infinite for the others.
    cant_m : float
        Of a curve: outer rail above inner rail.
    """

    kind: Literal["straight", "transition", "curve"]
    length_m: float
    radius_m: float = math.inf
    cant_m: float = 0.0

    def __post_init__(self) -> None:
        require_one_of(self, "kind", ("straight", "transition", "curve"))
        require_positive(self, "length_m")
        require_not_negative(self, "cant_m")
        curved = self.kind == "curve"
        if curved != math.isfinite(self.radius_m) or (curved and abs(self.radius_m) < 30.0):
            raise SettingsError(
                f"Element.radius_m of a {self.kind} is {self.radius_m}; a curve has one of at least 30 m "
                "(negative to the left), the others none"
            )
        if self.cant_m > 0.0 and not curved:
            raise SettingsError(f"Element.cant_m of a {self.kind} is {self.cant_m}; give it to the curve")
        if self.cant_m > 0.3:
            raise SettingsError(f"Element.cant_m is {self.cant_m} m, expected at most 0.3")


@dataclass(frozen=True, kw_only=True)
class Gradient:
    """The gradient from a place on.

    Attributes
    ----------
    from_m : float
        Chainage of the change, the middle of its vertical curve.
    permille : float
        Positive where the line rises with chainage.
    vertical_radius_m : float
        Of the vertical curve that joins it to the gradient before.
    """

    from_m: float
    permille: float
    vertical_radius_m: float = 4000.0

    def __post_init__(self) -> None:
        require_not_negative(self, "from_m")
        require_positive(self, "vertical_radius_m")
        if not abs(self.permille) <= 100.0:
            raise SettingsError(f"Gradient.permille must lie within 100, got {self.permille}")


@dataclass(frozen=True, kw_only=True)
class Terrain:
    """What a generated line is made of from a place on; lengths and radii are drawn evenly from ranges.

    Attributes
    ----------
    from_m : float
    straight_m, curve_m, radius_m : tuple of float
        Least and most of the straights' and curves' lengths, transitions not counted, and of the radii.
    permille : float
        Steepest gradient.
    gradient_m : tuple of float
        Least and most of the distance between two changes of the gradient.
    """

    from_m: float = 0.0
    straight_m: tuple[float, float] = (200.0, 1500.0)
    curve_m: tuple[float, float] = (100.0, 500.0)
    radius_m: tuple[float, float] = (400.0, 1600.0)
    permille: float = 10.0
    gradient_m: tuple[float, float] = (400.0, 1500.0)

    def __post_init__(self) -> None:
        require_not_negative(self, "from_m", "permille")
        for name in ("straight_m", "curve_m", "radius_m", "gradient_m"):
            _range(self, name)
        if self.radius_m[0] < 100.0:
            raise SettingsError(f"Terrain.radius_m begins at {self.radius_m[0]} m, expected at least 100")
        if self.gradient_m[0] < 200.0:
            raise SettingsError(f"Terrain.gradient_m begins at {self.gradient_m[0]} m, expected at least 200")
        if self.permille > 35.0:
            raise SettingsError(f"Terrain.permille must be at most 35, got {self.permille}")


@dataclass(frozen=True, kw_only=True)
class GeneratedLine:
    """How a commercial line is made up.

    Attributes
    ----------
    seed : int
        Of the line alone, so that many runs share it.
    speed_mps : float
        The cant is the equilibrium cant of this speed, up to `largest_cant_m`, in steps of 5 mm.
    largest_cant_m : float
    vertical_radius_m : float
    terrain : tuple of Terrain
        By rising `from_m`, the first from 0.
    """

    seed: int = 1
    speed_mps: float = 110.0 / 3.6
    largest_cant_m: float = 0.105
    vertical_radius_m: float = 4000.0
    terrain: tuple[Terrain, ...] = (Terrain(),)

    def __post_init__(self) -> None:
        require_positive(self, "speed_mps", "vertical_radius_m")
        require_not_negative(self, "seed", "largest_cant_m")
        starts = [part.from_m for part in self.terrain]
        if not starts or starts[0] != 0.0 or any(a >= b for a, b in pairwise(starts)):
            raise SettingsError(f"GeneratedLine.terrain must begin at 0 and rise, got from_m of {starts}")


@dataclass(frozen=True, kw_only=True)
class LineFile:
    """A track file as the line.

    Attributes
    ----------
    path : str
        As `railfix.track.read_track` reads it; in a scenario file relative to that file.
    from_m, to_m : float
        Part of the file's chainage that is used.
    crs, height_datum, geoid : str
        As the options of `read_track`; empty where the file says it itself.
    """

    path: str
    from_m: float = 0.0
    to_m: float = math.inf
    crs: str = ""
    height_datum: str = ""
    geoid: str = ""

    def __post_init__(self) -> None:
        require_not_negative(self, "from_m")
        if not self.to_m > self.from_m:
            raise SettingsError(f"LineFile.to_m must lie beyond from_m of {self.from_m}, got {self.to_m}")


@dataclass(frozen=True, kw_only=True)
class MapError:
    """How far the map lies from the true line: smooth along it, Gaussian.

    Attributes
    ----------
    plan_sigma_m : float
        Standard deviation to the east and to the north, each.
    height_sigma_m : float
    correlation_m : float
        Distance along the line over which the correlation falls to exp(-1/2).
    seed : int
    """

    plan_sigma_m: float = 0.0
    height_sigma_m: float = 0.0
    correlation_m: float = 500.0
    seed: int = 1

    def __post_init__(self) -> None:
        require_not_negative(self, "plan_sigma_m", "height_sigma_m", "seed")
        require_positive(self, "correlation_m")


@dataclass(frozen=True, kw_only=True)
class LineSettings:
    """The line and how its map is sampled.

    Attributes
    ----------
    name : str
    kind : {"pattern", "elements", "generated", "file"}
        The pattern of P1's test line; `elements` and `gradients`; `generated`; or `file`.
    length_m : float
        The pattern, 756 m long, is repeated (every second time mirrored) and cut off here; a generated
        line ends here. Elements have their own sum, and a file its own length (NaN here).
    latitude_deg, longitude_deg, height_m : float
        First point; ellipsoidal height. An invented place. Not used for a file.
    azimuth_deg : float
        Direction of the line at its first point. Not used for a file.
    kilometrage_start_m : float
        The line's own marking at its first point; it rises with the length. A file brings its own.
    straight_spacing_m, curve_spacing_m : float
        Largest spacing of the map's points; curves include their transitions. A file brings its points.
    elements : tuple of Element
    gradients : tuple of Gradient
        Level where there is none.
    generated : GeneratedLine
    file : LineFile or None
    map_error : MapError
    """

    name: str = "made test line"
    kind: Literal["pattern", "elements", "generated", "file"] = "pattern"
    length_m: float = math.nan
    latitude_deg: float = 35.05
    longitude_deg: float = 135.45
    height_m: float = 162.0
    azimuth_deg: float = 63.0
    kilometrage_start_m: float = 12_340.0
    straight_spacing_m: float = 20.0
    curve_spacing_m: float = 2.32
    elements: tuple[Element, ...] = ()
    gradients: tuple[Gradient, ...] = ()
    generated: GeneratedLine = field(default_factory=GeneratedLine)
    file: LineFile | None = None
    map_error: MapError = field(default_factory=MapError)

    def __post_init__(self) -> None:
        require_one_of(self, "kind", ("pattern", "elements", "generated", "file"))
        self._of_one_kind()
        if math.isnan(self.length_m) and self.kind != "file":
            by_kind = {"pattern": PATTERN_LENGTH_M, "generated": GENERATED_LENGTH_M, "elements": self._sum_m}
            object.__setattr__(self, "length_m", by_kind[self.kind])
        require_positive(self, "straight_spacing_m", "curve_spacing_m")
        if self.kind != "file" and not self.length_m >= 100.0:
            raise SettingsError(f"LineSettings.length_m must be at least 100 m for a train to run, got {self.length_m}")
        if not abs(self.latitude_deg) < 80.0:
            raise SettingsError(f"LineSettings.latitude_deg must lie within 80 degrees, got {self.latitude_deg}")

    @property
    def _sum_m(self) -> float:
        return math.fsum(item.length_m for item in self.elements)

    def _of_one_kind(self) -> None:
        """Settings of another kind than the line's are contradictions, not ignored."""
        if (self.kind == "elements") != bool(self.elements) or (self.gradients and not self.elements):
            raise SettingsError(f"LineSettings.elements (and gradients) go with kind 'elements', got {self.kind!r}")
        if (self.kind == "file") != (self.file is not None):
            raise SettingsError(f"LineSettings.file goes with kind 'file', got kind {self.kind!r}")
        if self.kind != "generated" and self.generated != GeneratedLine():
            raise SettingsError(f"LineSettings.generated goes with kind 'generated', got {self.kind!r}")
        if self.kind == "file" and not math.isnan(self.length_m):
            raise SettingsError("LineSettings.length_m is the file's own; use from_m and to_m of the file for a part")
        if self.kind == "elements" and abs(self.length_m - self._sum_m) > 1e-6:
            raise SettingsError(f"LineSettings.length_m is {self.length_m}, but the elements are {self._sum_m} m long")
