"""OpenStreetMap: its ways as every exporter writes them, and its own files (OSM XML, Overpass JSON).

Ways are known by their ids and tags (https://wiki.openstreetmap.org/wiki/Key:railway). Exporters write the tags as
columns, as one object or JSON text (`tags`), as hstore text (`other_tags` of GDAL) or as a class (`fclass` of
Geofabrik's shapefiles), and the id in a dozen forms.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from os import PathLike
from typing import Any, Final
from xml.etree.ElementTree import ParseError, iterparse

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.files import open_stream
from railfix.track.segment import Segment

#: Standard deviation in plan of a track of OpenStreetMap where its file states none [m]: drawn from aerial pictures,
#: whose own offset is often metres.
SIGMA_M: Final = 2.0
#: Origin of a segment, in its metadata.
ORIGIN: Final = {"origin": "OpenStreetMap"}
#: Values of the tag railway that are tracks on which trains run.
_RAILWAYS: Final = ("rail", "light_rail", "subway", "tram", "narrow_gauge", "preserved", "monorail", "rack")
#: Values of that tag that are no such tracks, by which a feature of OpenStreetMap is known.
_OTHERS: Final = (
    "abandoned", "construction", "disused", "dismantled", "demolished", "funicular", "historic", "loading_ramp",
    "miniature", "planned", "platform", "platform_edge", "proposed", "razed", "removed", "station", "traverser",
    "turntable", "yard",
)  # fmt: skip
#: Columns of the id of a feature; those that only exporters of OpenStreetMap write come first.
_IDS: Final = ("osm_id", "osmid", "osm_way_id", "full_id", "@id", "id")
_KINDS: Final = ("@type", "osm_type", "element_type", "element", "type")
_ID: Final = re.compile(r"\W*(way|relation|[wr])?\W*(\d+)\)?")
_HSTORE: Final = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')


@dataclass(frozen=True, kw_only=True)
class Way:
    """A way of an own file: id, tags, and points of shape (n, 2), longitude and latitude [deg]."""

    row: dict[str, Any]
    points_deg: np.ndarray[Any, np.dtype[np.float64]]


def tags_of(row: Mapping[str, Any]) -> dict[str, Any]:
    """Tags of a feature, and its other columns."""
    tags = dict(row)
    for name in ("tags", "all_tags", "other_tags"):
        value = row.get(name)
        if isinstance(value, str) and value.lstrip().startswith("{"):
            try:
                value = json.loads(value)
            except json.JSONDecodeError:
                continue
        elif isinstance(value, str):
            value = dict(_HSTORE.findall(value))
        if isinstance(value, Mapping):
            tags |= {key: text for key, text in value.items() if tags.get(key) in (None, "")}
    if tags.get("railway") in (None, ""):
        classes = (tags.get(key) for key in ("fclass", "type"))
        tags["railway"] = next((c for c in classes if c in _RAILWAYS or c in _OTHERS), None)
    return tags


def is_of_openstreetmap(row: Mapping[str, Any]) -> bool:
    """Whether a feature is one of OpenStreetMap, by its id or kind."""
    names = (str(row.get(key) or "") for key in ("@id", "id"))
    of_id = any(row.get(key) is not None for key in _IDS[:4])
    of_kind = any(row.get(key) in ("way", "relation") for key in _KINDS)
    return of_id or of_kind or any(re.fullmatch(r"(way|relation|node)/\d+|[wrn]\d+", name) for name in names)


def no_track(row: Mapping[str, Any], *, of_openstreetmap: bool) -> str:
    """Why a feature is no track: of OpenStreetMap those not tagged as railways that run; empty for tracks."""
    railway = tags_of(row).get("railway")
    railway = railway if isinstance(railway, str) and railway else None
    if railway in _RAILWAYS or not (of_openstreetmap or railway in _OTHERS):
        return ""
    return f"railway={railway}" if railway else "no railway"


def metadata_of(row: Mapping[str, Any]) -> dict[str, str]:
    """`ORIGIN` and the name of a way, its id with the name that it is tagged with ("way/7 Main Line").

    Without a name where nothing but the tag railway is that of OpenStreetMap; empty for other features.
    """
    tags = tags_of(row)
    if not is_of_openstreetmap(row):
        return ORIGIN if tags.get("railway") in _RAILWAYS else {}
    found = next((m for key in _IDS if (m := _ID.fullmatch(str(tags.get(key) or "")))), None)
    if found is None:
        return ORIGIN
    kind = "relation" if str(found[1]).startswith("r") else "way"
    words = [f"{kind}/{found[2]}", *(str(tags[key]) for key in ("name", "ref") if tags.get(key))]
    return {"name": " ".join(words[:2]), **ORIGIN}


def with_left_out(path: str | PathLike[str], segments: list[Segment], reasons: Counter[str]) -> list[Segment]:
    """Segments of a file, the first with a note on its lines that are no tracks; InputFileError where none is left."""
    left_out = ", ".join(f"{n} {why}" for why, n in reasons.items())
    note = f"{path}: lines left out that are no tracks: {left_out}"
    if not segments:
        why = f" ({note})" if reasons else ""
        raise InputFileError(path, f"there is no track in this file; LineStrings were expected{why}")
    return [replace(segments[0], notes=(*segments[0].notes, note)), *segments[1:]] if reasons else segments


def read_osm_xml(path: str | PathLike[str]) -> list[Way]:
    """Read the railway ways of an OSM XML file, in any order of its elements; InputFileError."""
    nodes: dict[str, tuple[float, float]] = {}
    ways: list[tuple[dict[str, Any], list[Any]]] = []
    try:
        with open_stream(path, content="bytes") as stream:
            for _, element in iterparse(stream):
                kind = element.tag
                if kind == "node":
                    nodes[str(element.get("id"))] = _place(path, element.get("lon"), element.get("lat"))
                elif kind == "way":
                    row = {str(tag.get("k")): tag.get("v") for tag in element.iterfind("tag")}
                    if row.get("railway"):
                        points = [nd.get("ref") if nd.get("lat") is None else _place(path, nd.get("lon"), nd.get("lat"))
                                  for nd in element.iterfind("nd")]  # fmt: skip
                        ways.append((row | {"@id": f"way/{element.get('id')}"}, points))
                if kind in ("node", "way", "relation"):
                    element.clear()
    except ParseError as error:
        raise InputFileError(path, f"this is not XML ({error})") from None
    return _ways(path, ways, nodes)


def read_overpass(path: str, elements: Any) -> list[Way]:
    """Read the railway ways of the elements of an Overpass JSON file (`out geom`, or ways with their nodes)."""
    if not isinstance(elements, list) or not all(isinstance(e, dict) for e in elements):
        raise InputFileError(path, "elements is not a list of objects, as Overpass writes them")
    nodes = {str(e["id"]): _place(path, e.get("lon"), e.get("lat")) for e in elements if e.get("type") == "node"}
    ways = []
    for element in elements:
        if element.get("type") != "way" or not (element.get("tags") or {}).get("railway"):
            continue
        points: list[Any] = [str(ref) for ref in element.get("nodes") or []]
        if geometry := element.get("geometry"):
            points = [None if p is None else _place(path, p.get("lon"), p.get("lat")) for p in geometry]
        ways.append((element["tags"] | {"@id": f"way/{element.get('id')}"}, points))
    return _ways(path, ways, nodes)


def _place(path: str | PathLike[str], lon: Any, lat: Any) -> tuple[float, float]:
    for text in (lon, lat):
        if "," in str(text):
            raise InputFileError(path, f"{text}: has a comma in a number; a point was expected")
    try:
        return float(lon), float(lat)
    except (TypeError, ValueError):
        raise InputFileError(path, f"a node has longitude {lon!r}, latitude {lat!r}; numbers were expected") from None


def _ways(
    path: str | PathLike[str],
    ways: Iterable[tuple[dict[str, Any], list[Any]]],
    nodes: Mapping[str, tuple[float, float]],
) -> list[Way]:
    """Ways with their points, in parts where some lie outside the extract; InputFileError where a way has no two."""
    found = []
    for row, refs in ways:
        points = [nodes.get(ref) if isinstance(ref, str) else ref for ref in refs]
        parts = [[p for p in part if p] for inside, part in groupby(points, key=lambda p: p is not None) if inside]
        if not any(len(part) > 1 for part in parts):
            raise InputFileError(
                path,
                f"{row['@id']}: the file has {sum(map(len, parts))} of its {len(refs)} nodes; ask Overpass for them, "
                "too (out geom;)",
            )
        found += [Way(row=row, points_deg=np.array(part, dtype=np.float64)) for part in parts if len(part) > 1]
    if not found:
        raise InputFileError(path, "there is no way with a tag railway in this file")
    return found
