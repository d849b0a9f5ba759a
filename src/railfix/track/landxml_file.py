"""Reader of LandXML 1.2 alignments; plan, profile and cant become elements of `railfix.track.elements`."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.track.crs import choose_crs
from railfix.track.elements import (
    CantElement,
    Design,
    Plan,
    PlanElement,
    ProfileElement,
    Stations,
    is_within,
    segment_of_design,
)
from railfix.track.route import MapReading, Segment
from railfix.track.transitions import OrdinateElement, Shape

_METRIC: Final = (1.0, 1e-3, 1e-2, 1e3)
_UNITS: Final = {
    **dict(zip(("meter", "millimeter", "centimeter", "kilometer"), _METRIC, strict=True)),
    "foot": 0.3048,
    "USSurveyFoot": 1200.0 / 3937.0,
    "inch": 0.0254,
    "mile": 1609.344,
}
#: Transition curves defined by offsets from the tangent (`railfix.track.transitions`). Cubic types with and without the
#: Japanese correction are read alike, because the `End` point of a spiral determines the offset.
_ORDINATES: Final[dict[str, Shape]] = {
    "cubic": "cubic", "cubicParabola": "cubic", "japaneseCubic": "cubic", "sineHalfWave": "half-sine",
}  # fmt: skip
#: Curvature laws of spirals that are not in `_ORDINATES`. The biquadratic parabola (InfraModel, Finland) is Helmert's
#: curve, whose curvature consists of two parabolas.
_SPIRALS: Final = {
    "clothoid": "linear",
    "bloss": "bloss",
    "cosine": "cosine",
    "sinusoid": "sine",
    "biquadraticParabola": "helmert",
}
_CANT_LAWS: Final = {**_SPIRALS, **dict.fromkeys(_ORDINATES, "linear"), "sineHalfWave": "cosine"}
_SAME_M: Final = 1e-6  #: Elements shorter than this are left out, because they have no direction [m].
#: A jump of the kilometrage is spread over this distance before and after the station equation [m].
_JUMP_M: Final = 0.05
#: A transition is rejected if the curvature at its curved end, times the stated radius, is outside these limits.
_ORDINATE_SHARE: Final = (0.9, 1.25)
_BROKEN_RAD: Final = 0.1  #: Larger changes of direction at a joint suggest a wrong order of coordinates [rad].


def finite_number(text: Any) -> float:
    """Convert a text to a number; raise ValueError if the text is not a finite number."""
    value = float(text)
    if not np.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def read_landxml_segments(path: str, root: Any, reading: MapReading) -> list[Segment]:
    """Read the alignments of a LandXML file as segments; `root` is the root element of the file.

    Raise InputFileError if there is no alignment, or an element is not valid or not supported.
    """
    unit = root.find(".//{*}Metric")
    unit = root.find(".//{*}Imperial") if unit is None else unit
    of_length = "meter" if unit is None else unit.get("linearUnit", "meter")
    if of_length not in _UNITS:
        raise InputFileError(path, f"linearUnit is {of_length!r}; one of {', '.join(_UNITS)} was expected")
    scale = _UNITS[of_length]
    system = root.find(".//{*}CoordinateSystem")
    named = f"EPSG:{system.get('epsgCode')}" if system is not None and system.get("epsgCode") else None
    segments = []
    for number, alignment in enumerate(root.iterfind(".//{*}Alignment"), start=1):
        name = alignment.get("name") or f"alignment {number}"
        start = finite_number(alignment.get("staStart") or 0.0) * scale
        geometry = alignment.find("{*}CoordGeom")
        if geometry is None:
            continue
        try:
            crs = choose_crs(path, reading.crs, named)
            plan, order_notes = _read_plans(path, _elements(geometry), scale, crs)
            profile = _read_profile(path, alignment.find(".//{*}ProfAlign"), scale, start)
            cant, notes = _read_cant(alignment.find(".//{*}Cant"), scale, start)
            notes += (*_notes(alignment, name), *order_notes)
            stations = _read_stations(path, alignment, scale, start)
        except KeyError as error:
            raise InputFileError(
                path,
                f"alignment {name!r}: cant of transition type {error} is not supported; only {', '.join(_CANT_LAWS)} "
                "are supported",
            ) from None
        except (TypeError, ValueError, AttributeError):
            raise InputFileError(
                path,
                f"alignment {name!r}: a number that LandXML 1.2 requires in an element is missing or invalid",
            ) from None
        segments.append(
            segment_of_design(
                path=path,
                name=name,
                design=Design(plan=plan, profile=profile, cant=cant, stations=stations),
                reading=replace(reading, crs=crs),
                notes=notes,
            )
        )
    if not segments:
        raise InputFileError(path, "there is no Alignment with CoordGeom in this LandXML file")
    return segments


def _notes(alignment: Any, name: str) -> tuple[str, ...]:
    """Return notes on the parts of an alignment that are not used."""
    notes = []
    if (count := len(alignment.findall(".//{*}ProfAlign"))) > 1:
        notes.append(f"{name}: the first of {count} profiles is used")
    return tuple(notes)


def _elements(parent: Any) -> list[Any]:
    """Return the child elements, without comments and without national or program extensions (`Feature`)."""
    return [e for e in parent if isinstance(e.tag, str) and e.tag.rsplit("}", 1)[-1] != "Feature"]


def _read_stations(path: str, alignment: Any, scale: float, start: float) -> Stations:
    """Return the stations of an alignment; `start` is the station of its first point [m].

    Raise InputFileError if the station equations are not in the order of the line.
    """
    rows, before, sign = [(0.0, start, start)], (0.0, start), 1.0
    for equation in alignment.iterfind("{*}StaEquation"):
        ahead = finite_number(equation.get("staAhead")) * scale
        if equation.get("staInternal") is not None:
            place = finite_number(equation.get("staInternal")) * scale - start
        else:
            place = before[0] + sign * (finite_number(equation.get("staBack")) * scale - before[1])
        back = before[1] + sign * (place - before[0])
        if place < before[0] + 2.0 * _JUMP_M:
            raise InputFileError(path, "its station equations do not rise from the start along the line; correct them")
        rows.append((place, back, ahead))
        sign = -1.0 if equation.get("staIncrement") == "decreasing" else 1.0
        before = (place, ahead)
    return Stations(rows=tuple(rows), last_sign=sign, jump_m=_JUMP_M)


def _point(element: Any, name: str, scale: float, easting_first: bool) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the easting and northing of a child element, shape (2,) [m]."""
    first, second = (finite_number(v) for v in element.find(f"{{*}}{name}").text.split()[:2])
    return np.array([first, second] if easting_first else [second, first]) * scale


def _read_plans(path: str, elements: list[Any], scale: float, crs: str | None) -> tuple[list[Plan], tuple[str, ...]]:
    """Return the elements in plan, and a note if the file has easting first, which LandXML 1.2 does not allow.

    The chosen order is the one in which the coordinates are in the area of the CRS. If this is true of both orders or
    of none, the order with fewer breaks of direction between elements is chosen. Raise InputFileError if the two
    criteria contradict each other.
    """
    plans, broken, inside = [], [], []
    for easting_first in (False, True):
        plan = [p for e in elements if (p := _read_plan(path, e, scale, easting_first)) is not None]
        plans.append(plan)
        broken.append(sum(_turn_at(a, b) > _BROKEN_RAD for a, b in pairwise(plan)))
        inside.append(crs is None or not plan or is_within(crs, np.array([[p.x_m, p.y_m] for p in plan])))
    if inside[0] != inside[1]:
        chosen = int(inside[1])
        if broken[chosen] > broken[1 - chosen]:
            orders = ("northing first", "easting first")
            raise InputFileError(
                path,
                f"with {orders[chosen]}, the coordinates are in the area of {crs}, but curves do not match "
                f"their attribute rot; with {orders[1 - chosen]}, the coordinates are outside it; correct rot or order",
            )
    else:
        chosen = int(broken[1] < broken[0])
    notes = (f"{path}: the file has easting before northing, contrary to LandXML 1.2",) if chosen else ()
    return plans[chosen], notes


def _turn_at(before: Plan, after: Plan) -> float:
    """Return the change of direction between the end of an element and the start of the next element [rad]."""
    ends = before.place_at(before.length_m - np.array([0.0, min(0.01, before.length_m / 2.0)]))
    direction = np.arctan2(*(ends[0] - ends[1])[::-1])
    return float(abs((after.direction_rad - direction + np.pi) % (2.0 * np.pi) - np.pi))


def _read_plan(path: str, element: Any, scale: float, easting_first: bool) -> Plan | None:
    """Return an element in plan; None if it has no length. Raise InputFileError if the type is not supported."""
    kind = element.tag.rsplit("}", 1)[-1]
    start, end = (_point(element, name, scale, easting_first) for name in ("Start", "End"))
    if kind in ("Line", "Curve", "Spiral") and np.hypot(*(end - start)) < _SAME_M:
        return None
    side = 1.0 if element.get("rot") == "ccw" else -1.0
    if kind == "Line":
        step = end - start
        first = last = 0.0
        direction, length, law = np.arctan2(step[1], step[0]), float(np.hypot(*step)), "linear"
    elif kind == "Curve":
        centre = _point(element, "Center", scale, easting_first)
        radius = float(np.hypot(*(start - centre)))
        first = last = side / radius
        arm, other = start - centre, end - centre
        direction = np.arctan2(arm[1], arm[0]) + side * np.pi / 2.0
        turn = side * (np.arctan2(other[1], other[0]) - np.arctan2(arm[1], arm[0]))
        length, law = radius * float(turn % (2.0 * np.pi)), "linear"
    elif kind == "Spiral" and element.get("spiType") in (*_SPIRALS, *_ORDINATES):
        middle = _point(element, "PI", scale, easting_first)
        texts = [element.get(k) for k in ("radiusStart", "radiusEnd")]
        radii = [0.0 if text == "INF" else finite_number(text) * scale for text in texts]
        # some programs write the radius 0 at a straight end
        first, last = (side / radius if radius else 0.0 for radius in radii)
        if element.get("spiType") in _ORDINATES:
            return _read_ordinates(path, _ORDINATES[element.get("spiType")], (start, middle, end), (first, last))
        length, law = finite_number(element.get("length")) * scale, _SPIRALS[element.get("spiType")]
        if last == 0.0:  # use the tangent at the straight end; the turn is curvature * length / 2 for all laws
            direction = np.arctan2(*(end - middle)[::-1]) - first * length / 2.0
        else:
            direction = np.arctan2(*(middle - start)[::-1])
    else:
        kind = f"{kind} {element.get('spiType') or ''}".strip()
        raise InputFileError(
            path, f"element {kind} is not supported; only Line, Curve and Spiral ({', '.join(_CANT_LAWS)}) are"
        )
    return PlanElement(
        x_m=float(start[0]),
        y_m=float(start[1]),
        direction_rad=float(direction),
        first=first,
        last=last,
        length_m=length,
        law=law,
    )


def _read_ordinates(
    path: str, shape: Shape, points: tuple[Floats, Floats, Floats], curvature: tuple[float, float]
) -> OrdinateElement:
    """Create a transition that is defined by offsets from the tangent.

    `points` are the start, the PI and the end; the tangent at the straight end points to the PI.

    Raise InputFileError unless exactly one end is straight and the curvature matches the stated radius.
    """
    start, middle, end = points
    into = curvature[0] == 0.0
    if (curvature[0] == 0.0) == (curvature[1] == 0.0):
        raise InputFileError(
            path, f"a {shape} transition between two curves is not supported; one end has to be straight"
        )
    straight, other = (start, end) if into else (end, start)
    along = (middle - straight) / np.hypot(*(middle - straight))
    tangent, ordinate = along @ (other - straight), along[0] * (other - straight)[1] - along[1] * (other - straight)[0]
    element = OrdinateElement(
        x_m=float(start[0]),
        y_m=float(start[1]),
        direction_rad=float(np.arctan2(*((middle - start) if into else (end - middle))[::-1])),
        tangent_m=float(tangent),
        ordinate_m=float(ordinate),
        shape=shape,
        into=into,
    )
    share = abs((element.last if into else element.first) / (curvature[1] if into else curvature[0]))
    if not _ORDINATE_SHARE[0] < share < _ORDINATE_SHARE[1]:
        raise InputFileError(
            path, f"the curvature at the end of a {shape} transition does not match its radius ({share:.2f} times)"
        )
    if not into:  # convert the direction at the straight end to the direction at the curved end
        element = replace(element, direction_rad=element.direction_rad + element.turn_rad)
    return element


def _read_profile(path: str, profile: Any, scale: float, start: float) -> list[ProfileElement]:
    """Return the profile elements: gradients between points of vertical intersection (PVI), and curves at these points.

    The list is empty without a profile. Raise InputFileError if the stations do not rise or a type is not supported.
    """
    if profile is None:
        return []
    points = []
    for element in _elements(profile):
        kind = element.tag.rsplit("}", 1)[-1]
        if kind not in ("PVI", "ParaCurve", "CircCurve"):
            raise InputFileError(
                path, f"profile element {kind} is not supported; only PVI, ParaCurve and CircCurve are"
            )
        place, height = (finite_number(v) * scale for v in element.text.split()[:2])
        points.append((kind, place - start, height, finite_number(element.get("length") or 0.0) * scale))
    if any(b[1] <= a[1] for a, b in pairwise(points)):
        raise InputFileError(path, "the stations of a profile do not rise from one PVI to the next; put them in order")
    elements: list[ProfileElement] = []
    grades = [(b[2] - a[2]) / (b[1] - a[1]) for a, b in pairwise(points)]
    at = points[0][1]
    for k, grade in enumerate(grades):
        _, place, height, half = points[k][0], points[k][1], points[k][2], points[k][3] / 2.0
        if half and k:
            begin = place - half
            elements.append(
                ProfileElement(
                    start_m=begin,
                    length_m=2.0 * half,
                    height_m=height - grades[k - 1] * half,
                    first=grades[k - 1],
                    last=grade,
                    arc="circle" if points[k][0] == "CircCurve" else "parabola",
                )
            )
            at = place + half
        end = points[k + 1][1] - (points[k + 1][3] / 2.0 if k + 1 < len(grades) else 0.0)
        if end - at > 1e-6:
            elements.append(
                ProfileElement(
                    start_m=at, length_m=end - at, height_m=height + grade * (at - place), first=grade, last=grade
                )
            )
        at = end
    return elements


def _read_cant(cant: Any, scale: float, start: float) -> tuple[list[CantElement], tuple[str, ...]]:
    """Return the cant elements between successive cant stations, and notes.

    The outer rail is raised unless the file states another rotation point. Cant is in millimetres, or in inches if
    lengths are imperial (LandXML 1.2). If all values are below 1, a note states that they are assumed to be in the
    length unit of the file, as in InfraModel.
    """
    if cant is None:
        return [], ()
    lowered = {"center": 0.5, "outsideRail": 1.0}.get(cant.get("rotationPoint", "insideRail"), 0.0)
    found = list(cant.iterfind("{*}CantStation"))
    applied = np.array([finite_number(element.get("appliedCant")) for element in found])
    unit = 1e-3 if scale in _METRIC else 25.4e-3
    notes: tuple[str, ...] = ()
    if 0.0 < np.abs(applied).max(initial=0.0) < 1.0:
        unit = scale
        notes = (
            f"cant: at most {np.abs(applied).max():g}, assumed in the length unit of the file, not in millimetres",
        )
    stations, laws = [], []
    for element, value in zip(found, applied * unit, strict=True):
        # in a clockwise curve, which turns to the right, the left rail is the outer rail
        outer, inner = value * (1.0 - lowered), -value * lowered
        rails = (outer, inner) if element.get("curvature") == "cw" else (inner, outer)
        stations.append((finite_number(element.get("station")) * scale - start, rails))
        laws.append(_CANT_LAWS[element.get("transitionType", "clothoid")])
    elements = [
        CantElement(start_m=a[0], length_m=b[0] - a[0], left_m=(a[1][0], b[1][0]), right_m=(a[1][1], b[1][1]), law=law)
        for (a, b), law in zip(pairwise(stations), laws, strict=False)
        if b[0] > a[0]
    ]
    return elements, notes
