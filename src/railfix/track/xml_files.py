"""Readers of LandXML alignments, railML 3 track centrelines, and ERA RINF topology in RDF.

In the RINF ontology (http://data.europa.eu/949/, version 3), a `LinearElement` has a geometry (GeoSPARQL, WKT). A
`NetRelation` connects the ends of two elements that meet, as in railML 3.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.extras import needs_extra
from railfix.core.files import FilePath, file_sha256, read_bytes
from railfix.io.xml_lines import read_root, tag
from railfix.track.crs import choose_crs
from railfix.track.landxml_file import finite_number, read_landxml_segments
from railfix.track.route import RINF_NAMES, RINF_SECTIONS, MapReading, Segment
from railfix.track.vector_file import plan_segment

if TYPE_CHECKING:
    from rdflib import Graph


@dataclass(frozen=True, kw_only=True)
class Relation:
    """Connection of two net elements, as in railML 3 and RailTopoModel."""

    first: str  #: Name of the first element.
    second: str  #: Name of the second element.
    first_end: int  #: Connected end of the first element: 0 for the start, 1 for the end.
    second_end: int  #: Connected end of the second element: 0 for the start, 1 for the end.
    navigable: bool  #: Whether trains can pass from one element to the other.


def read_xml_segments(path: FilePath, reading: MapReading) -> list[Segment]:
    """Read the lines of a LandXML or railML 3 file as segments; raise InputFileError if there is no line."""
    root = read_root(path)
    kind = tag(root)
    if kind == "LandXML":
        return read_landxml_segments(str(path), root, reading)
    if kind == "railML":
        return _railml(str(path), root, reading)
    message = f"the root element is {kind!r}; LandXML or railML (3) was expected"
    if any(tag(element).lower() in RINF_NAMES for element in root.iter()):
        message += f"; {RINF_SECTIONS}"
    raise InputFileError(path, message)


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
            raise InputFileError(
                path, f"netElement {name!r} has coordinates in {len(used)} systems; give all coordinates in one system"
            )
        try:
            rows = [
                [
                    finite_number(i.get("intrinsicCoord")),
                    *(finite_number(p.get(k)) for k in "xy"),
                    finite_number(p.get("z", "0")),
                ]
                for i, p in found
            ]
        except (TypeError, ValueError):
            raise InputFileError(
                path,
                f"netElement {name!r}: a number that railML 3 requires in a coordinate is missing or invalid",
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
    """Read the net relations of a railML 3 file; the list is empty for other XML files."""
    root = read_root(path)
    relations = []
    for item in root.iterfind(".//{*}netRelation"):
        first, second = item.find("{*}elementA"), item.find("{*}elementB")
        if first is None or second is None:
            raise InputFileError(path, f"netRelation {item.get('id')} does not name two elements")
        try:
            ends = [int(float(str(item.get(key)))) for key in ("positionOnA", "positionOnB")]
        except ValueError:
            what = f"netRelation {item.get('id')} must have positionOnA and positionOnB, each 0 or 1"
            raise InputFileError(path, what) from None
        relations.append(
            Relation(
                first=str(first.get("ref")),
                second=str(second.get("ref")),
                first_end=ends[0],
                second_end=ends[1],
                navigable=str(item.get("navigability") or "both").lower() != "none",
            )
        )
    return relations


_ERA: Final = "http://data.europa.eu/949/"
_GEO: Final = "http://www.opengis.net/ont/geosparql#"
_LABEL: Final = "http://www.w3.org/2000/01/rdf-schema#label"
_TYPE: Final = "http://www.w3.org/1999/02/22-rdf-syntax-ns#type"
#: LINESTRING in WKT; in GeoSPARQL, the CRS can precede it.
_WKT: Final = re.compile(r"\s*(?:<(?P<crs>[^>]+)>)?\s*LINESTRING\s*Z?\s*\((?P<points>[^)]*)\)\s*", re.IGNORECASE)
_CODE: Final = re.compile(r".*/crs/(?P<name>OGC|EPSG)/[^/]*/(?P<code>\w+)")


def read_rinf_segments(path: FilePath, reading: MapReading) -> list[Segment]:
    """Read the linear elements of a RINF file as segments.

    Elements without a geometry are left out. Raise InputFileError if no element has a geometry.
    """
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
            raise InputFileError(path, f"{element}: each point of its WKT must have two or three numbers") from None
        of_file = MapReading(**{**vars(reading), "crs": choose_crs(path, reading.crs, named)})
        segments.append(plan_segment(points, of_file, path=str(path), name=_name(graph, element)))
    if not segments:
        raise InputFileError(
            path, f"no era:LinearElement has a geometry (geosparql:hasGeometry, asWKT LINESTRING); {RINF_SECTIONS}"
        )
    return segments


def read_rinf_relations(path: FilePath) -> list[Relation]:
    """Read the net relations of a RINF file.

    A relation with the navigability "none" joins two ends between which trains cannot pass.
    """
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
    """Return the triples of a file, which are cached because segments and relations are read in separate calls."""
    with needs_extra(f"{path}: RDF"):
        from rdflib import Graph
    data = read_bytes(path)
    begin = data.lstrip()[:5]
    # N-Triples is a subset of Turtle
    name = "json-ld" if begin[:1] in (b"{", b"[") else "turtle" if begin[:1] != b"<" or begin == b"<http" else "xml"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # the warnings concern rdflib's own classes
            return Graph().parse(data=data, format=name)
    except Exception as error:  # noqa: BLE001 - each rdflib parser raises its own errors
        raise InputFileError(path, f"this is not valid {name} ({str(error).splitlines()[0]})") from None


def _all(graph: Graph, kind: str) -> list[Any]:
    from rdflib import URIRef

    return sorted(graph.subjects(URIRef(_TYPE), URIRef(_ERA + kind)), key=str)


def _values(graph: Graph, subject: Any, predicate: str) -> list[Any]:
    from rdflib import URIRef

    return sorted(graph.objects(subject, URIRef(predicate)), key=str)


def _name(graph: Graph, subject: Any) -> str:
    """Return the label of a resource, or the last part of the resource's address if it has no label."""
    labels = _values(graph, subject, _LABEL)
    return str(labels[0]) if labels else re.split(r"[/#]", str(subject))[-1]
