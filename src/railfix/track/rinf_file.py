"""Topology of the European register of infrastructure (ERA RINF) as RDF: linear elements and their relations.

Its ontology (http://data.europa.eu/949/, version 3) has each `LinearElement` with its geometry (GeoSPARQL, WKT) and a
`NetRelation` for each pair of ends that meet, as railML 3 has. Turtle, RDF/XML, N-Triples and JSON-LD are read by
`rdflib`. The register's XML and CSV have sections of line between operational points alone, no geometry of tracks.
"""

from __future__ import annotations

import re
import warnings
from functools import lru_cache
from os import PathLike
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.files import ending, file_sha256, open_stream
from railfix.track.crs import used_crs
from railfix.track.segment import RINF_SECTIONS, MapReading, Segment
from railfix.track.vector_file import INSTALL, plan_segment
from railfix.track.xml_files import Relation

if TYPE_CHECKING:
    from rdflib import Graph

#: Endings of RDF, and the format of each.
FORMATS: Final = {".ttl": "turtle", ".rdf": "xml", ".nt": "nt", ".jsonld": "json-ld"}
_ERA: Final = "http://data.europa.eu/949/"
_GEO: Final = "http://www.opengis.net/ont/geosparql#"
_LABEL: Final = "http://www.w3.org/2000/01/rdf-schema#label"
_TYPE: Final = "http://www.w3.org/1999/02/22-rdf-syntax-ns#type"
#: A line in WKT, with the CRS that GeoSPARQL puts before it.
_WKT: Final = re.compile(r"\s*(?:<(?P<crs>[^>]+)>)?\s*LINESTRING\s*Z?\s*\((?P<points>[^)]*)\)\s*", re.IGNORECASE)
_CODE: Final = re.compile(r".*/crs/(?P<name>OGC|EPSG)/[^/]*/(?P<code>\w+)")


def read_rinf_segments(path: str | PathLike[str], reading: MapReading) -> list[Segment]:
    """Read the linear elements that have a geometry as segments, in the order of their addresses.

    InputFileError: when the file is no RDF, or has no linear element with a line.
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
            raise InputFileError(path, f"{element}: its WKT has points of other than two or three numbers") from None
        of_file = MapReading(**{**vars(reading), "crs": used_crs(path, reading.crs, named)})
        segments.append(plan_segment(points, of_file, path=str(path), name=_name(graph, element)))
    if not segments:
        raise InputFileError(
            path,
            f"no era:LinearElement has a geometry (geosparql:hasGeometry, asWKT LINESTRING); {RINF_SECTIONS}",
        )
    return segments


def read_rinf_relations(path: str | PathLike[str]) -> list[Relation]:
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
                name=_name(graph, item),
                first=_name(graph, first),
                second=_name(graph, second),
                first_end=0 if at_first.toPython() else 1,
                second_end=0 if at_second.toPython() else 1,
                navigable=way != ["none"],
            )
        )
    return relations


def _graph(path: str | PathLike[str]) -> Graph:
    return _parsed(str(path), file_sha256(path))


@lru_cache(maxsize=2)
def _parsed(path: str, _: str) -> Graph:
    """The triples of a file, kept for its relations."""
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
