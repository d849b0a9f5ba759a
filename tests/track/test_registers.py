"""Maps of registers: topology of ERA RINF, and the track tables of EGNSS MATE."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from scipy.integrate import cumulative_simpson

from railfix.core.errors import InputFileError
from railfix.track.network_read import read_network
from railfix.track.read import read_segments
from railfix.track.route import NO_HEIGHTS, MapReading

pytestmark = pytest.mark.requirement("A1")

# --- ERA RINF ----------------------------------------------------------------

#: A switch by hand, after the ontology: a stem and two legs, that meet at (5.01, 50.0).
TURTLE = """
@prefix era: <http://data.europa.eu/949/> .
@prefix gsp: <http://www.opengis.net/ont/geosparql#> .
@prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
@prefix nav: <http://data.europa.eu/949/concepts/navigabilities/> .
@prefix : <http://data.europa.eu/949/topology/netElements/> .
:stem a era:LinearElement ; gsp:hasGeometry [ gsp:asWKT "LINESTRING (5.0 50.0, 5.005 50.0, 5.01 50.0)" ] .
:left a era:LinearElement ; rdfs:label "L36 track A" ; gsp:hasGeometry [
  gsp:asWKT "<http://www.opengis.net/def/crs/OGC/1.3/CRS84> LINESTRING (5.01 50.0, 5.02 50.0001)" ] .
:right a era:LinearElement ; gsp:hasGeometry [ gsp:asWKT "LINESTRING (5.02 49.9999, 5.01 50.0)" ] .
:station a era:NonLinearElement .
<http://example.org/r1> a era:NetRelation ; era:elementA :stem ; era:isOnOriginOfElementA false ;
  era:elementB :left ; era:isOnOriginOfElementB true ; era:navigability nav:Both .
<http://example.org/r2> a era:NetRelation ; era:elementA :stem ; era:isOnOriginOfElementA false ;
  era:elementB :right ; era:isOnOriginOfElementB false ; era:navigability nav:Both .
<http://example.org/r3> a era:NetRelation ; era:elementA :left ; era:isOnOriginOfElementA true ;
  era:elementB :right ; era:isOnOriginOfElementB false ; era:navigability nav:None .
"""


@pytest.mark.parametrize("kind", ["ttl", "rdf", "nt", "jsonld"])
def test_topology_of_the_register_is_a_network(tmp_path: Path, kind: str) -> None:
    rdflib, path = pytest.importorskip("rdflib"), tmp_path / f"rinf.{kind}"
    formats = {"ttl": "turtle", "rdf": "xml", "nt": "nt", "jsonld": "json-ld"}
    text = rdflib.Graph().parse(data=TURTLE, format="turtle").serialize(format=formats[kind])
    path.write_text("\n".join(sorted(text.splitlines(), reverse=True)) if kind == "nt" else text)  # blank nodes first
    network = read_network([path])
    assert set(network.names) == {"stem", "L36 track A", "right"}
    assert all(t.height_datum == NO_HEIGHTS for t in network.tracks)
    stem, left, right = (network.find_index(name) for name in ("stem", "L36 track A", "right"))
    assert network.tracks[left].latitude_deg.tolist() == [50.0, 50.0001]
    assert network.shortest_route([stem, right]) == [stem, right]
    assert network.route_over([left, right]) is None  # from leg to leg no train passes
    assert "3 net relations" in network.notes[0]


def test_a_register_without_geometry_is_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("rdflib")
    path = tmp_path / "rinf.ttl"
    path.write_text("@prefix era: <http://data.europa.eu/949/> . <http://e.org/1> a era:LinearElement .")
    with pytest.raises(InputFileError, match=r"no era:LinearElement has a geometry"):
        read_segments(path, MapReading())
    path.write_text("no turtle")
    with pytest.raises(InputFileError, match=r"this is not valid turtle"):
        read_segments(path, MapReading())
    path.write_text(TURTLE.replace("era:isOnOriginOfElementB true", 'era:name "x"'))
    with pytest.raises(InputFileError, match=r"r1 has no isOnOriginOfElementB"):
        read_network([path])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "rinf.xml",
            '<Country><SectionOfLine><SOLOPStart Value="BE1"/><SOLLength Value="5,2"/></SectionOfLine></Country>',
        ),
        ("rinf.csv", "SOLLineIdentification,SOLOPStart,SOLOPEnd,SOLLength\n36,BE1,BE2,5.2\n"),
    ],
)
def test_sections_of_line_are_refused_with_the_form_that_is_read(tmp_path: Path, name: str, text: str) -> None:
    """Elements as programs that read the register's XML name them (SectionOfLine, SOLOPStart, UniqueOPID)."""
    (tmp_path / name).write_text(text)
    with pytest.raises(InputFileError, match=r"no geometry of tracks; export the register's topology as RDF \(.ttl"):
        read_segments(tmp_path / name, MapReading())


# --- EGNSS MATE --------------------------------------------------------------

#: Lengths of line, clothoid, circle, clothoid and line [m], and place of the start in LV95.
LENGTHS = (200.0, 120.0, 300.0, 80.0, 150.0)
EAST, NORTH, AZIMUTH, RADIUS = 2_600_000.0, 1_200_000.0, 0.7, 500.0


def _line(side: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Way, place and azimuth along the edge each centimetre, its curvature integrated; positive to the right."""
    knots = np.concatenate([[0.0], np.cumsum(LENGTHS)])
    way = np.linspace(0.0, knots[-1], 85_001)
    bend = np.interp(way, knots, np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0]) * side / RADIUS)
    azimuth = AZIMUTH + cumulative_simpson(bend, x=way, initial=0.0)
    east = EAST + cumulative_simpson(np.sin(azimuth), x=way, initial=0.0)
    north = NORTH + cumulative_simpson(np.cos(azimuth), x=way, initial=0.0)
    return way, east, north, azimuth


def _tables(folder: Path, side: float, constant: str, *, turned: bool) -> Path:
    """The tables of that edge; `turned`: the second clothoid is given from its end."""
    way, east, north, azimuth = _line(side)
    knots = np.concatenate([[0.0], np.cumsum(LENGTHS)])
    at = np.searchsorted(way, knots - 1e-6)
    centre = np.array(
        [east[at[2]] + side * RADIUS * np.cos(azimuth[at[2]]), north[at[2]] - side * RADIUS * np.sin(azimuth[at[2]])]
    )
    arc = side * RADIUS * (np.arctan2(east[at[2]] - centre[0], north[at[2]] - centre[1]) % (2.0 * np.pi * side))

    def clothoid(length: float) -> float:
        product = RADIUS * length
        return side * float({"A": np.sqrt(product), "RL": product, "rate": 1.0 / product}[constant])

    # the second clothoid runs to its point without curvature: 80 m before it, or from it back
    back = [4, 0.0, (azimuth[at[4]] + np.pi) % (2.0 * np.pi), -clothoid(80.0), -1]
    ahead = [4, -80.0, azimuth[at[4]], -clothoid(80.0), 1]
    origin, first, angle, size, direction = back if turned else ahead
    head = (
        "TRACK_EDGE_ID,TRACK_SEGMENT_TYPE,TRACK_SEGMENT_REFERENCE_POSITION,TRACK_SEGMENT_LENGTH,TRACK_SEGMENT_DIRECTION,"
        "UTM_CELL,NORTH,EAST,AZIMUTH,INITIAL_ARC_LENGTH,RADIUS,CLOTHOID_CONSTANT"
    )
    rows = [
        f"e1,line,0,200,1,LV95,{north[0]:.4f},{east[0]:.4f},{AZIMUTH},,,",
        f"e1,clothoid,200,120,1,LV95,{north[at[1]]:.4f},{east[at[1]]:.4f},{azimuth[at[1]]:.8f},0,,{clothoid(120.0)!r}",
        f"e1,circle,320,300,1,LV95,{centre[1]:.4f},{centre[0]:.4f},,{arc:.4f},{side * RADIUS},",
        f"e1,clothoid,620,80,{direction},LV95,{north[at[origin]]:.4f},{east[at[origin]]:.4f},{angle:.8f},{first},,{size!r}",
        f"e1,line,700,150,1,LV95,{north[at[4]]:.4f},{east[at[4]]:.4f},{azimuth[at[4]]:.8f},,,",
    ]
    path = folder / "S_DM_TRACK_SEGMENT_POSITION.csv"
    path.write_text("\n".join([head, *rows[::-1]]) + "\n")
    return path


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("constant", "turned"), [("A", False), ("RL", True), ("rate", True)])
def test_track_tables_are_the_line_whose_curvature_they_state(
    tmp_path: Path, side: float, constant: str, turned: bool
) -> None:
    path = _tables(tmp_path, side, constant, turned=turned)
    head = (
        "TRACK_EDGE_ID,TRACK_SEGMENT_TYPE,TRACK_SEGMENT_REFERENCE_POSITION,TRACK_SEGMENT_LENGTH,TRACK_SEGMENT_DIRECTION"
    )
    (tmp_path / "S_DM_TRACK_SEGMENT_GRADIENT.csv").write_text(
        f"{head},INITIAL_HEIGHT,GRADIENT,RADIUS\ne1,line,0,300,1,500,10,\ne1,circle,300,100,1,503,10,10000\n"
        "e1,line,400,450,1,504.5,20,\n"
    )
    (tmp_path / "S_DM_TRACK_SEGMENT_CANT.csv").write_text(
        f"{head},INITIAL_CANT,END_CANT,TRACK_GAUGE\ne1,line,200,120,1,0,0.1,1.5\ne1,line,320,300,1,0.1,0.1,1.5\n"
        "e1,line,620,80,1,0.1,0,1.5\n"
    )
    (segment,) = read_segments(path, MapReading())
    assert (segment.metadata["name"], segment.crs, segment.height_datum) == ("e1", "EPSG:2056", "ellipsoidal")
    to_grid = Transformer.from_crs(segment.frame, "EPSG:2056", always_xy=True)
    x, y = to_grid.transform(segment.longitude_deg, segment.latitude_deg)
    way, east, north, _ = _line(side)
    nearest = np.array([np.argmin(np.hypot(east - a, north - b)) for a, b in zip(x, y, strict=True)])
    assert np.hypot(east[nearest] - x, north[nearest] - y).max() < 0.02
    assert (nearest[0], nearest[-1]) == (0, len(way) - 1)
    place = way[nearest]
    circle = (place > 321.0) & (place < 619.0)
    np.testing.assert_allclose(segment.radius_m[circle], side * RADIUS, rtol=1e-4)
    np.testing.assert_allclose(segment.cant_m[circle], 0.1, atol=1e-6)
    expected = np.interp(place, [0.0, 300.0, 400.0, 850.0], [500.0, 503.0, 504.5, 513.5])
    bow = np.where((place > 300.0) & (place < 400.0), (place - 300.0) * (400.0 - place) / 20_000.0, 0.0)
    np.testing.assert_allclose(segment.height_m, expected - bow, atol=0.01)


def test_segments_that_do_not_meet_and_broken_rows_are_sentences(tmp_path: Path) -> None:
    path = _tables(tmp_path, 1.0, "A", turned=False)
    text = path.read_text()
    path.write_text(text.replace("e1,line,700,150,1,LV95,", "e1,line,700,150,1,LV95,1"))
    with pytest.raises(InputFileError, match=r"edge 'e1': segment 5 starts .* m from the end of the previous"):
        read_segments(path, MapReading())
    path.write_text(text.replace("circle", "spline"))
    with pytest.raises(InputFileError, match=r"'spline'; line, circle or clothoid was expected"):
        read_segments(path, MapReading())
    path.write_text(text.replace(f",{RADIUS},", ",,"))
    with pytest.raises(InputFileError, match=r"a circle has RADIUS ''; a number was expected"):
        read_segments(path, MapReading())
