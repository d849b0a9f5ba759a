"""Detect the kind of a file from its content."""

from __future__ import annotations

import codecs
import re
from typing import Final, Literal

from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, ending
from railfix.io.mate import mate_table
from railfix.io.receiver.framing import is_receiver_log, read_head

FileKind = Literal[
    "observations", "navigation", "rinex", "sp3", "sbas", "receiver", "nmea", "novatel", "rtklib", "gpx", "table",
    "parquet", "mate", "geojson", "kml", "osm", "xml", "rdf", "ifc", "dxf", "gml", "gpkg", "shp", "fgb", "pbf", "toml",
    "android", "unknown",
]  # fmt: skip
#: Kinds of position logs. A table or GPX file may also be a track map.
POSITIONS: Final[tuple[FileKind, ...]] = ("table", "rtklib", "nmea", "novatel", "gpx", "receiver")
#: Kinds of track maps that are read by GDAL.
GDAL: Final[tuple[FileKind, ...]] = ("gpkg", "shp", "fgb", "gml", "dxf", "pbf")
#: All kinds of track maps.
MAPS: Final[tuple[FileKind, ...]] = ("table", "mate", "geojson", "kml", "gpx", "osm", "xml", "rdf", "ifc", *GDAL)
#: Description of each kind of file for messages; in brackets, the command-line option for such a file.
KIND_WORDS: Final[dict[FileKind, str]] = {
    "observations": "a RINEX observation file (--front, --rear)", "navigation": "a RINEX navigation file (--nav)",
    "rinex": "a RINEX clock or meteorological file", "sp3": "an SP3 file of precise orbits (--sp3)",
    "sbas": "a log of SBAS messages (--sbas)", "receiver": "a receiver's log", "nmea": "an NMEA log",
    "novatel": "a NovAtel log", "rtklib": "an RTKLIB solution (.pos)", "gpx": "a GPX file", "table": "a table",
    "parquet": "a Parquet table",
    "android": "a log of Android's GnssLogger, which can write RINEX files instead", "mate": "an EGNSS MATE table",
    "geojson": "a JSON file", "kml": "a KML file", "osm": "an OpenStreetMap file", "xml": "an XML file",
    "rdf": "an RDF file", "ifc": "an IFC file", "dxf": "a DXF file", "gml": "a GML file", "gpkg": "a GeoPackage",
    "shp": "a Shapefile", "fgb": "a FlatGeobuf file", "pbf": "an OpenStreetMap file (.pbf)", "toml": "a TOML file",
    "unknown": "no log, table or map of a known form",
}  # fmt: skip
#: First bytes of each kind of binary file.
_BINARY: Final[dict[FileKind, bytes]] = {
    "parquet": b"PAR1", "gpkg": b"SQLite format 3\0", "shp": b"\0\0\x27\n", "fgb": b"fgb\x03",
    "dxf": b"AutoCAD Binary DXF",
}  # fmt: skip
#: Patterns that identify a kind in the first bytes of a text, in the order in which they are tried.
_TEXT: Final[dict[FileKind, re.Pattern[bytes]]] = {
    "sp3": re.compile(rb"\A#[a-d][PV]\d"),
    "ifc": re.compile(rb"\A\s*ISO-10303-21;"),
    "rdf": re.compile(
        rb'\A\s*(?:#.*\n\s*)*(?:@prefix|@base|PREFIX\s|BASE\s|(?:<https?:[^>]*>|_:\S+)\s+<|\[\s*\{|\{\s*"@(?:context|graph)")'
    ),
    "geojson": re.compile(rb"\A\s*\{"),
    "dxf": re.compile(rb"\A\s*(?:999\s*\n.*\n\s*)*0\s*\n\s*SECTION"),
    "android": re.compile(rb"\A# ?\r?\n|\A# Header Description|\ARaw,"),
    "nmea": re.compile(rb"\$(?:[A-Z]{2}(?:GGA|RMC|ZDA|GSA|GSV|GLL|VTG|GNS|GST|TXT)|P[A-Z]{3})"),
    "novatel": re.compile(rb"^[#%](?:BEST(?:GNSS)?POSA|INSPVA[SX]?A|[A-Z0-9]+A),", re.MULTILINE),
    "rtklib": re.compile(rb"^%.*(?:latitude|ecef|baseline|program|GPST|UTC|JST)", re.MULTILINE),
    "sbas": re.compile(
        rb"^\s*(?:\d+\s+[\d.]+\s+1\d\d\s+\d+\s*:\s*|1\d\d(?:\s+[\d.]+){6}\s+\d+\s+)[0-9A-Fa-f]{32}", re.MULTILINE
    ),
}
_ROOT: Final = re.compile(rb"\s*(?:<[?!][^>]*>\s*|<!--.*?-->\s*)*<(?:[\w.-]+:)?(\w+)", re.DOTALL)
#: Kind of XML file for each name of the root element in lower case.
_ROOTS: Final[dict[str, FileKind]] = {
    "kml": "kml", "gpx": "gpx", "osm": "osm", "rdf": "rdf", "featurecollection": "gml",
}  # fmt: skip
_RINEX: Final[dict[str, FileKind]] = {"O": "observations", "B": "sbas", "M": "rinex", "C": "rinex"}
#: Kind for each ending of a file name, used if the content fits no kind.
_ENDINGS: Final[dict[str, FileKind]] = {
    ".csv": "table", ".pos": "rtklib", ".nmea": "nmea", ".gpx": "gpx", ".kml": "kml", ".osm": "osm", ".pbf": "pbf",
    ".geojson": "geojson", ".json": "geojson", ".xml": "xml", ".landxml": "xml", ".railml": "xml", ".ifc": "ifc",
    ".ttl": "rdf", ".rdf": "rdf", ".nt": "rdf", ".jsonld": "rdf", ".gpkg": "gpkg", ".shp": "shp", ".fgb": "fgb",
    ".gml": "gml", ".dxf": "dxf",
}  # fmt: skip


def find_kind(path: FilePath) -> FileKind:
    """Return the kind of a file, detected from its first decompressed bytes or, failing that, from its name ending.

    TOML files are recognised by name, and EGNSS MATE tables by name or header. The kind is "unknown" if neither the
    bytes nor the name fit a kind.
    """
    if mate_table(path):
        return "mate"
    if ending(path) == ".toml":
        return "toml"
    head = read_head(path)
    if kind := next((kind for kind, magic in _BINARY.items() if head.startswith(magic)), None):
        return kind
    if b"OSMHeader" in head[:32]:
        return "pbf"
    if is_receiver_log(head):
        return "receiver"
    text = head.removeprefix(codecs.BOM_UTF8)
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = head.decode("utf-16", "ignore").encode()
    first = text.partition(b"\n")[0].decode("latin-1")
    if first[60:80].strip() == "RINEX VERSION / TYPE":
        return _RINEX.get(first[20:21].upper(), "navigation")
    if (root := _ROOT.match(text)) and not _TEXT["rdf"].search(text):
        return _ROOTS.get(root[1].decode().lower(), "xml")
    if kind := next((kind for kind, pattern in _TEXT.items() if pattern.search(text)), None):
        return kind
    header = _header_line(text)
    if any(mark in header for mark in ",;\t|") and any(letter.isalpha() for letter in header):
        return "mate" if {"TRACK_EDGE_ID", "TRACK_SEGMENT_TYPE"} <= {*re.split("[,;\t]", header.upper())} else "table"
    return _ENDINGS.get(ending(path), "unknown")


#: Words that occur in the header of a position table but not in the header of a track map.
_OF_POSITIONS: Final = ("time", "unix", "tow", "quality", "sigma_north", "antenna")


def wrong_kind(path: FilePath, expected: str) -> InputFileError:
    """Return the error for a file that is not of the expected kind."""
    return InputFileError(path, f"is {KIND_WORDS[find_kind(path)]}; {expected} was expected")


def has_times(path: FilePath) -> bool:
    """Return whether a table or GPX file has times, quality numbers or other columns that a track map lacks."""
    head = read_head(path)
    names = _header_line(head).lower()
    return b"time>" in head or any(word in names for word in _OF_POSITIONS)


def _header_line(head: bytes) -> str:
    """Return the first line that is neither blank nor a comment, or "" if there is none."""
    coding = "utf-16" if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    lines = head.decode(coding, "replace").splitlines()
    return next((line for line in lines if line.strip() and not line.startswith("#")), "")


def read_column_names(path: FilePath) -> tuple[str, ...]:
    """Return the column names in the header line of a text table."""
    line = _header_line(read_head(path))
    separator = next((mark for mark in ",;\t|" if mark in line), ",")
    return tuple(name.strip().strip('"') for name in line.split(separator))
