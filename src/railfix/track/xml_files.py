"""Alignments of LandXML 1.2, track centrelines of railML 3, and topology of the ERA RINF as RDF.

Its ontology (http://data.europa.eu/949/, version 3) has each `LinearElement` with its geometry (GeoSPARQL, WKT) and a
`NetRelation` for each pair of ends that meet, as railML 3 has.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, ending, file_sha256, open_stream, read_bytes
from railfix.track.crs import choose_crs
from railfix.track.elements import CantElement, PlanElement, ProfileElement, segment_of_design
from railfix.track.route import RINF_NAMES, RINF_SECTIONS, MapReading, Segment
from railfix.track.vector_file import INSTALL, plan_segment

if TYPE_CHECKING:
    from rdflib import Graph


_METRIC: Final = (1.0, 1e-3, 1e-2, 1e3)
_UNITS: Final = {
    **dict(zip(("meter", "millimeter", "centimeter", "kilometer"), _METRIC, strict=True)),
    "foot": 0.3048,
    "USSurveyFoot": 1200.0 / 3937.0,
    "inch": 0.0254,
    "mile": 1609.344,
}
#: The biquadratic parabola (of InfraModel, Finland) is Helmert's law: the curvature runs by two parabolas.
_SPIRALS: Final = {
    "clothoid": "linear",
    "bloss": "bloss",
    "cosine": "cosine",
    "sinusoid": "sine",
    "biquadraticParabola": "helmert",
}


@dataclass(frozen=True, kw_only=True)
class Relation:
    """Connection of two net elements as railML 3 and RailTopoModel have it."""

    #: Names of the elements.
    first: str
    second: str
    #: 0 where the start of the element is meant, 1 where its end.
    first_end: int
    second_end: int
    navigable: bool  #: Whether trains pass from one to the other.


def _root(path: FilePath) -> Any:
    try:
        from lxml import etree
    except ImportError:
        raise InputFileError(path, f"reading XML maps needs lxml; {INSTALL}") from None
    try:
        parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
        return etree.fromstring(read_bytes(path), parser)
    except etree.XMLSyntaxError as error:
        raise InputFileError(path, f"this is not XML ({error.msg})", line=error.lineno) from None


def read_xml_segments(path: FilePath, reading: MapReading) -> list[Segment]:
    """Read the lines of a LandXML or railML 3 file as segments; InputFileError when it is neither, or has no line."""
    root = _root(path)
    kind = str(root.tag).rsplit("}", 1)[-1]
    if kind == "LandXML":
        return _landxml(str(path), root, reading)
    if kind == "railML":
        return _railml(str(path), root, reading)
    message = f"the root element is {kind!r}; LandXML or railML (3) was expected"
    if any(str(element.tag).rsplit("}", 1)[-1].lower() in RINF_NAMES for element in root.iter()):
        message += f"; {RINF_SECTIONS}"
    raise InputFileError(path, message)


# --- LandXML -----------------------------------------------------------------


def _landxml(path: str, root: Any, reading: MapReading) -> list[Segment]:
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
        start = _number(alignment.get("staStart") or 0.0) * scale
        geometry = alignment.find("{*}CoordGeom")
        if geometry is None:
            continue
        try:
            plan = [_landxml_plan(path, e, scale) for e in _elements(geometry)]
            profile = _landxml_profile(path, alignment.find(".//{*}ProfAlign"), scale, start)
            cant, notes = _landxml_cant(alignment.find(".//{*}Cant"), scale, start)
            notes += _notes(alignment, name)
        except KeyError as error:
            raise InputFileError(
                path, f"alignment {name!r}: cant of transition type {error} is not read; {', '.join(_SPIRALS)} are"
            ) from None
        except (TypeError, ValueError, AttributeError):
            raise InputFileError(
                path, f"alignment {name!r}: an element lacks a number that LandXML 1.2 has, or it is none"
            ) from None
        segments.append(
            segment_of_design(
                path=path,
                name=name,
                plan=plan,
                profile=profile,
                cant=cant,
                reading=replace(reading, crs=choose_crs(path, reading.crs, named)),
                notes=notes,
            )
        )
    if not segments:
        raise InputFileError(path, "there is no Alignment with CoordGeom in this LandXML file")
    return segments


def _notes(alignment: Any, name: str) -> tuple[str, ...]:
    """Return the notes on what of an alignment is not used."""
    notes = []
    if (count := len(alignment.findall(".//{*}ProfAlign"))) > 1:
        notes.append(f"{name}: the first of {count} profiles is used")
    if alignment.find("{*}StaEquation") is not None:
        notes.append(f"{name}: stations are lengths from the start; station equations are not used")
    return tuple(notes)


def _number(text: Any) -> float:
    """Return a finite number of a text; ValueError where it is none."""
    value = float(text)
    if not np.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def _elements(parent: Any) -> list[Any]:
    """Return the children that are neither comments nor extensions of a country or program (`Feature`)."""
    return [e for e in parent if isinstance(e.tag, str) and e.tag.rsplit("}", 1)[-1] != "Feature"]


def _point(element: Any, name: str, scale: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the easting and northing of a child; LandXML writes northing first."""
    north, east = (_number(v) for v in element.find(f"{{*}}{name}").text.split()[:2])
    return np.array([east, north]) * scale


def _landxml_plan(path: str, element: Any, scale: float) -> PlanElement:
    kind = element.tag.rsplit("}", 1)[-1]
    start, end = _point(element, "Start", scale), _point(element, "End", scale)
    side = 1.0 if element.get("rot") == "ccw" else -1.0
    if kind == "Line":
        step = end - start
        first = last = 0.0
        direction, length, law = np.arctan2(step[1], step[0]), float(np.hypot(*step)), "linear"
    elif kind == "Curve":
        centre = _point(element, "Center", scale)
        radius = float(np.hypot(*(start - centre)))
        first = last = side / radius
        arm, other = start - centre, end - centre
        direction = np.arctan2(arm[1], arm[0]) + side * np.pi / 2.0
        turn = side * (np.arctan2(other[1], other[0]) - np.arctan2(arm[1], arm[0]))
        length, law = radius * float(turn % (2.0 * np.pi)), "linear"
    elif kind == "Spiral" and element.get("spiType") in _SPIRALS:
        middle = _point(element, "PI", scale)
        first, last = (
            0.0 if element.get(k) == "INF" else side / (_number(element.get(k)) * scale)
            for k in ("radiusStart", "radiusEnd")
        )
        length, law = _number(element.get("length")) * scale, _SPIRALS[element.get("spiType")]
        if last == 0.0:  # parabolas are laid out from the tangent at the straight; half the bend is turned by each law
            direction = np.arctan2(*(end - middle)[::-1]) - first * length / 2.0
        else:
            direction = np.arctan2(*(middle - start)[::-1])
    else:
        kind = f"{kind} {element.get('spiType') or ''}".strip()
        raise InputFileError(path, f"element {kind} is not read; Line, Curve and Spiral ({', '.join(_SPIRALS)}) are")
    return PlanElement(
        x_m=float(start[0]),
        y_m=float(start[1]),
        direction_rad=float(direction),
        first=first,
        last=last,
        length_m=length,
        law=law,
    )


def _landxml_profile(path: str, profile: Any, scale: float, start: float) -> list[ProfileElement]:
    """Return the elements of points of vertical intersection and the curves at them."""
    if profile is None:
        return []
    points = []
    for element in _elements(profile):
        kind = element.tag.rsplit("}", 1)[-1]
        if kind not in ("PVI", "ParaCurve", "CircCurve"):
            raise InputFileError(path, f"profile element {kind} is not read; PVI, ParaCurve and CircCurve are")
        place, height = (_number(v) * scale for v in element.text.split()[:2])
        points.append((kind, place - start, height, _number(element.get("length") or 0.0) * scale))
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


def _landxml_cant(cant: Any, scale: float, start: float) -> tuple[list[CantElement], tuple[str, ...]]:
    """Return elements between cant stations and notes; the outer rail is raised unless named; units are mm, inches
    where lengths are imperial (LandXML 1.2), metres in InfraModel.
    """
    if cant is None:
        return [], ()
    lowered = {"center": 0.5, "outsideRail": 1.0}.get(cant.get("rotationPoint", "insideRail"), 0.0)
    found = list(cant.iterfind("{*}CantStation"))
    applied = np.array([_number(element.get("appliedCant")) for element in found])
    unit = 1e-3 if scale in _METRIC else 25.4e-3
    notes: tuple[str, ...] = ()
    if 0.0 < np.abs(applied).max(initial=0.0) < 1.0:
        unit = scale
        notes = (
            f"cant: at most {np.abs(applied).max():g} in the file; taken in its unit of length, not in millimetres",
        )
    stations, laws = [], []
    for element, value in zip(found, applied * unit, strict=True):
        # clockwise is a curve to the right: the left rail is the outer one
        outer, inner = value * (1.0 - lowered), -value * lowered
        rails = (outer, inner) if element.get("curvature") == "cw" else (inner, outer)
        stations.append((_number(element.get("station")) * scale - start, rails))
        laws.append(_SPIRALS[element.get("transitionType", "clothoid")])
    elements = [
        CantElement(start_m=a[0], length_m=b[0] - a[0], left_m=(a[1][0], b[1][0]), right_m=(a[1][1], b[1][1]), law=law)
        for (a, b), law in zip(pairwise(stations), laws, strict=False)
        if b[0] > a[0]
    ]
    return elements, notes


# --- railML ------------------------------------------------------------------


def _railml(path: str, root: Any, reading: MapReading) -> list[Segment]:
    systems = {s.get("id"): s.get("crsDefinition") for s in root.iterfind(".//{*}geometricPositioningSystem")}
    segments = []
    for element in root.iterfind(".//{*}netElement"):
        found = [(i, i.find("{*}geometricCoordinate")) for i in element.iterfind(".//{*}intrinsicCoordinate")]
        found = [(intrinsic, place) for intrinsic, place in found if place is not None]
        if len(found) < 2:
            continue
        name, used = str(element.get("id")), {place.get("positioningSystemRef") for _, place in found}
        if len(used) > 1:
            raise InputFileError(path, f"netElement {name!r} has coordinates of {len(used)} systems; give it in one")
        try:
            rows = [
                [_number(i.get("intrinsicCoord")), *(_number(p.get(k)) for k in "xy"), _number(p.get("z", "0"))]
                for i, p in found
            ]
        except (TypeError, ValueError):
            raise InputFileError(
                path, f"netElement {name!r}: a coordinate lacks a number that railML 3 has, or it is none"
            ) from None
        points = np.array(sorted(rows))[:, 1:]
        if any(place.get("z") is None for _, place in found):
            points = points[:, :2]
        definition = systems.get(used.pop(), next(iter(systems.values()), None))
        named = definition.replace("urn:ogc:def:crs:", "").replace("::", ":") if definition else None
        of_element = replace(reading, crs=choose_crs(path, reading.crs, named))
        segments.append(plan_segment(points, of_element, path=path, name=name))
    if not segments:
        raise InputFileError(path, "no netElement of this railML file has geometric coordinates; railML 3 was expected")
    return segments


def read_railml_relations(path: FilePath) -> list[Relation]:
    """Read the net relations of a railML 3 file; empty for other XML files."""
    root = _root(path)
    relations = []
    for item in root.iterfind(".//{*}netRelation"):
        first, second = item.find("{*}elementA"), item.find("{*}elementB")
        if first is None or second is None:
            raise InputFileError(path, f"netRelation {item.get('id')} names no two elements", line=item.sourceline)
        relations.append(
            Relation(
                first=str(first.get("ref")),
                second=str(second.get("ref")),
                first_end=int(float(item.get("positionOnA"))),
                second_end=int(float(item.get("positionOnB"))),
                navigable=str(item.get("navigability") or "both").lower() != "none",
            )
        )
    return relations


#: Endings of RDF, and the format of each.
FORMATS: Final = {".ttl": "turtle", ".rdf": "xml", ".nt": "nt", ".jsonld": "json-ld"}
_ERA: Final = "http://data.europa.eu/949/"
_GEO: Final = "http://www.opengis.net/ont/geosparql#"
_LABEL: Final = "http://www.w3.org/2000/01/rdf-schema#label"
_TYPE: Final = "http://www.w3.org/1999/02/22-rdf-syntax-ns#type"
#: A line in WKT, with the CRS that GeoSPARQL puts before it.
_WKT: Final = re.compile(r"\s*(?:<(?P<crs>[^>]+)>)?\s*LINESTRING\s*Z?\s*\((?P<points>[^)]*)\)\s*", re.IGNORECASE)
_CODE: Final = re.compile(r".*/crs/(?P<name>OGC|EPSG)/[^/]*/(?P<code>\w+)")


def read_rinf_segments(path: FilePath, reading: MapReading) -> list[Segment]:
    """Read the linear elements that have a geometry as segments; InputFileError where there is none."""
    graph, segments = _graph(path), []
    for element in _all(graph, "LinearElement"):
        texts = [
            str(t) for g in _values(graph, element, f"{_GEO}hasGeometry") for t in _values(graph, g, f"{_GEO}asWKT")
        ]
        lines = [match for text in texts if (match := _WKT.fullmatch(text))]
        if not lines:
            continue
        crs = _CODE.fullmatch(lines[0]["crs"] or "")
        named = f"{crs['name']}:{crs['code']}" if crs else "OGC:CRS84"
        try:
            points = np.array([[float(v) for v in p.split()] for p in lines[0]["points"].split(",")])
        except ValueError:
            raise InputFileError(path, f"{element}: its WKT has points of other than two or three numbers") from None
        of_file = MapReading(**{**vars(reading), "crs": choose_crs(path, reading.crs, named)})
        segments.append(plan_segment(points, of_file, path=str(path), name=_name(graph, element)))
    if not segments:
        raise InputFileError(
            path, f"no era:LinearElement has a geometry (geosparql:hasGeometry, asWKT LINESTRING); {RINF_SECTIONS}"
        )
    return segments


def read_rinf_relations(path: FilePath) -> list[Relation]:
    """Read the net relations of the register; navigability None joins two ends that no train passes between."""
    graph, relations = _graph(path), []
    for item in _all(graph, "NetRelation"):
        found = {key: _values(graph, item, _ERA + key) for key in (
            "elementA", "elementB", "isOnOriginOfElementA", "isOnOriginOfElementB")}  # fmt: skip
        if missing := [key for key, values in found.items() if not values]:
            raise InputFileError(path, f"era:NetRelation {item} has no {', '.join(missing)}")
        first, second, at_first, at_second = (values[0] for values in found.values())
        way = [str(value).rsplit("/", 1)[-1].lower() for value in _values(graph, item, f"{_ERA}navigability")]
        relations.append(
            Relation(
                first=_name(graph, first),
                second=_name(graph, second),
                first_end=0 if at_first.toPython() else 1,
                second_end=0 if at_second.toPython() else 1,
                navigable=way != ["none"],
            )
        )
    return relations


def _graph(path: FilePath) -> Graph:
    return _parse(str(path), file_sha256(path))


@lru_cache(maxsize=2)
def _parse(path: str, _: str) -> Graph:
    """Return the triples of a file, kept for its relations."""
    try:
        from rdflib import Graph
    except ImportError:
        raise InputFileError(path, f"reading RDF needs rdflib; {INSTALL}") from None
    with open_stream(path, content="bytes") as stream:
        data = stream.read()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of rdflib's own classes
            return Graph().parse(data=data, format=FORMATS[ending(path)])
    except Exception as error:  # noqa: BLE001 - each of rdflib's parsers has its own
        raise InputFileError(path, f"this is no {FORMATS[ending(path)]} ({str(error).splitlines()[0]})") from None


def _all(graph: Graph, kind: str) -> list[Any]:
    from rdflib import URIRef

    return sorted(graph.subjects(URIRef(_TYPE), URIRef(_ERA + kind)), key=str)


def _values(graph: Graph, subject: Any, predicate: str) -> list[Any]:
    from rdflib import URIRef

    return sorted(graph.objects(subject, URIRef(predicate)), key=str)


def _name(graph: Graph, subject: Any) -> str:
    """Label of a resource, else the last part of its address."""
    labels = _values(graph, subject, _LABEL)
    return str(labels[0]) if labels else re.split(r"[/#]", str(subject))[-1]
