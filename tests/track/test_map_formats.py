"""Maps in the formats that users have, and alignments of design files against closed forms."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from scipy.special import fresnel

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track import read_track
from railfix.track.elements import LAWS, PlanElement, ProfileElement, alignment_at
from railfix.track.ifc_file import _plan, _profile, _Step, read_ifc_segments
from railfix.track.read import read_segments
from railfix.track.route import MapReading
from railfix.track.xml_files import read_xml_segments

pyogrio = pytest.importorskip("pyogrio")
shapely = pytest.importorskip("shapely")

pytestmark = pytest.mark.requirement("A1")

#: A line of 1 km in southern Germany, longitude, latitude, height.
LINE = np.stack(
    [np.linspace(11.0, 11.014, 41), 48.0 + 1e-4 * np.sin(np.linspace(0, 3, 41)), np.linspace(480.0, 490.0, 41)], axis=-1
)


def _write(path: Path, driver: str, coordinates: np.ndarray, *, crs: str = "EPSG:4326") -> Path:
    shape = np.array([shapely.to_wkb(shapely.LineString(coordinates), output_dimension=coordinates.shape[1])])
    kind = "LineString" if coordinates.shape[1] == 2 else "LineString Z"
    fields, data = (["Name"], [np.array(["main"], dtype=object)]) if driver not in ("GPX", "DXF") else ([], [])
    pyogrio.raw.write(path, shape, data, fields, driver=driver, geometry_type=kind, crs=crs)
    return path


@pytest.mark.parametrize(
    ("ending", "driver"),
    [
        ("gpkg", "GPKG"),
        ("shp", "ESRI Shapefile"),
        ("fgb", "FlatGeobuf"),
        ("gml", "GML"),
        ("kml", "KML"),
        ("dxf", "DXF"),
    ],
)
def test_a_line_reads_back_from_each_format(tmp_path: Path, ending: str, driver: str) -> None:
    path = _write(tmp_path / f"line.{ending}", driver, LINE)
    track = read_track(path, height_datum="ellipsoidal", crs="EPSG:4326" if driver == "DXF" else None)
    expected = ecef_from_geodetic(LINE[:, 1], LINE[:, 0], LINE[:, 2])
    assert np.linalg.norm(track.ecef_m - expected, axis=1).max() < 0.01
    if driver != "DXF":
        assert track.name == "main"


def test_gpx_and_openstreetmap_have_no_heights_to_use(tmp_path: Path) -> None:
    points = "".join(f'<trkpt lat="{y:.8f}" lon="{x:.8f}"/>' for x, y, _ in LINE)
    gpx = tmp_path / "line.gpx"
    gpx.write_text(
        '<?xml version="1.0"?><gpx version="1.1" creator="test" xmlns="http://www.topografix.com/GPX/1/1">'
        f"<trk><name>main</name><trkseg>{points}</trkseg></trk></gpx>"
    )
    assert [s.metadata["name"] for s in read_segments(gpx, MapReading())] == ["main"]
    nodes = "".join(f'<node id="{k}" version="1" lat="{y:.8f}" lon="{x:.8f}"/>' for k, (x, y, _) in enumerate(LINE, 1))
    way = "".join(f'<nd ref="{k}"/>' for k in range(1, len(LINE) + 1))
    osm = tmp_path / "area.osm"
    osm.write_text(
        f'<?xml version="1.0"?><osm version="0.6">{nodes}<way id="7" version="1">{way}<tag k="railway" v="rail"/></way>'
        f'<way id="8" version="1">{way}<tag k="highway" v="path"/></way></osm>'
    )
    assert [s.metadata["name"] for s in read_segments(osm, MapReading())] == ["way/7"]
    with pytest.raises(InputFileError, match="no height"):
        read_track(osm)


def test_heights_come_from_a_profile_or_from_positions(tmp_path: Path) -> None:
    path = _write(tmp_path / "line.gpkg", "GPKG", LINE[:, :2].copy())
    length = read_track(_write(tmp_path / "l3.gpkg", "GPKG", LINE), height_datum="ellipsoidal").chainage_m[-1]
    profile = tmp_path / "profile.csv"
    profile.write_text(f"# sigma_m: 0.2\nchainage_m,height_m\n0,480\n{length + 1:.3f},490\n")
    track = read_track(path, heights=profile)
    assert np.abs(track.height_m - LINE[:, 2]).max() < 0.1
    assert track.sigma_height_m == 0.2
    rng = np.random.default_rng(1)
    dense = np.stack([np.interp(np.linspace(0, 40, 800), np.arange(41), LINE[:, k]) for k in range(3)], axis=-1)
    rows = [
        f"2024-01-01T00:{k // 60:02d}:{k % 60:02d},{p[1]:.9f},{p[0]:.9f},{p[2] + rng.normal(0, 0.05):.4f},1"
        for k, p in enumerate(dense)
    ]
    log = tmp_path / "run.csv"
    log.write_text("time_gpst,latitude_deg,longitude_deg,height_m,quality\n" + "\n".join(rows) + "\n")
    fitted = read_track(path, heights=log)
    assert np.abs(fitted.height_m - LINE[:, 2]).max() < 0.10
    assert fitted.sigma_height_m == pytest.approx(0.60)
    log.write_text("time_gpst,latitude_deg,longitude_deg,height_m,quality\n" + "\n".join(rows[:300]) + "\n")
    with pytest.raises(InputFileError, match="give positions of the whole line"):
        read_track(path, heights=log)


def _raster(path: Path, *, driver: str, crs: str | None, hole: bool = False) -> Path:
    """A plane of heights about `LINE`: 480 m at 11 E, 700 m a degree of longitude, in cells of about 20 m."""
    rasterio = pytest.importorskip("rasterio")
    transformer = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True)
    x0, y0 = transformer.transform(10.99, 48.01)
    east, north = x0 + 20.0 * (np.arange(150) + 0.5), y0 - 20.0 * (np.arange(120) + 0.5)
    longitude, _ = transformer.transform(*np.meshgrid(east, north), direction="INVERSE")
    cells = (480.0 + 700.0 * (longitude - 11.0)).astype(np.float32)
    if hole:
        cells[:, 60:70] = -9999.0
    profile = {"width": 150, "height": 120, "count": 1, "dtype": "float32", "nodata": -9999.0, "crs": crs}
    transform = rasterio.transform.from_origin(x0, y0, 20.0, 20.0)
    with rasterio.open(path, "w", driver=driver, transform=transform, **profile) as raster:
        raster.write(cells, 1)
    return path


@pytest.mark.parametrize(("name", "driver"), [("dtm.tif", "GTiff"), ("dtm.asc", "AAIGrid")])
def test_heights_come_from_a_raster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, driver: str) -> None:
    path = _write(tmp_path / "line.gpkg", "GPKG", LINE[:, :2].copy())
    raster = _raster(tmp_path / name, driver=driver, crs="EPSG:25832")
    track = read_track(path, heights=raster, height_datum="ellipsoidal", sigma_height_m=0.4)
    assert np.abs(track.height_m - (480.0 + 700.0 * (LINE[:, 0] - 11.0))).max() < 0.01
    assert track.sigma_height_m == 0.4
    assert "heights of the ground" in track.provenance.notes[-1]
    monkeypatch.setattr("railfix.track.height_source._WINDOW_CELLS", 100)
    windows = read_track(path, heights=raster, height_datum="ellipsoidal", sigma_height_m=0.4)
    assert np.array_equal(windows.height_m, track.height_m)
    with pytest.raises(SettingsError, match="--height-datum"):
        read_track(path, heights=raster, sigma_height_m=0.4)
    with pytest.raises(SettingsError, match="--height-sigma"):
        read_track(path, heights=raster, height_datum="ellipsoidal")


def test_rasters_that_cannot_be_used_are_one_sentence(tmp_path: Path) -> None:
    path = _write(tmp_path / "line.gpkg", "GPKG", LINE[:, :2].copy())
    read = partial(read_track, path, height_datum="ellipsoidal", sigma_height_m=0.4)
    with pytest.raises(InputFileError, match=r"points of the map have no height, the first at chainage 418 m"):
        read(heights=_raster(tmp_path / "hole.tif", driver="GTiff", crs="EPSG:25832", hole=True))
    with pytest.raises(InputFileError, match=r"states no CRS; put a \.prj file"):
        read(heights=_raster(tmp_path / "bare.asc", driver="AAIGrid", crs=None))
    with pytest.raises(InputFileError, match="points of the map have no height, the first at chainage 0 m"):
        read(heights=_raster(tmp_path / "elsewhere.tif", driver="GTiff", crs="EPSG:25833"))
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(InputFileError, match="GDAL cannot read this raster"):
        read(heights=tmp_path / "text.tif")


# --- alignments --------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
def test_every_law_has_its_integral_and_ends(law: str) -> None:
    share, integral = LAWS[law]
    t = np.linspace(0.0, 1.0, 20_001)
    numeric = np.concatenate([[0.0], np.cumsum((share(t)[1:] + share(t)[:-1]) / 2.0 * np.diff(t))])
    assert np.abs(numeric - integral(t)).max() < 1e-8
    assert share(np.array([0.0, 1.0])) == pytest.approx([0.0, 1.0], abs=1e-12)
    assert integral(np.array([1.0])) == pytest.approx(0.5)


def test_vertical_circle_lies_on_its_circle() -> None:
    element = ProfileElement(start_m=100.0, length_m=60.0, height_m=5.0, first=0.02, last=-0.01, arc="circle")
    place = np.linspace(100.0, 160.0, 7)
    height = element.height_at(place)
    sines = np.sin(np.arctan([0.02, -0.01]))
    radius = 60.0 / (sines[1] - sines[0])
    centre = np.array([100.0 - radius * sines[0], 5.0 + radius * np.cos(np.arctan(0.02))])
    assert np.hypot(place - centre[0], height - centre[1]) == pytest.approx(abs(radius), abs=1e-9)


def _segments_of(path: Path, kind: str) -> list[list[float]]:
    """Numbers of the segments of an IFC file by plain pattern, a second reading."""
    text = path.read_text()
    points = {
        m[1]: [float(v) for v in m[2].split(",")] for m in re.finditer(r"#(\d+)=IFCCARTESIANPOINT\(\((.*?)\)", text)
    }
    rows = []
    for match in re.finditer(rf"IFCALIGNMENT{kind}SEGMENT\(\$,\$,(.*?),\.", text):
        cells = match[1].split(",")
        start = points[cells[0][1:]] if cells[0].startswith("#") else [float(cells[0])]
        rows.append([*start, *(float(c) for c in cells[1:] if c != "$")])
    return rows


def test_alignment_of_shared_ifc_files_lies_on_the_closed_forms(recordings: Path) -> None:
    """Each arc on its circle, each clothoid on its Fresnel integral, each grade on its line: within 1 mm."""
    folder = recordings / "rail" / "ifc_alignment"
    checked = 0
    for number in (1, 2):
        path = folder / f"UT_AWC_{number}_UT_AWC_{number}_no_geometry.ifc"
        step = _Step(path)
        plan = [_plan(step, e, 1.0, 1.0) for _, e in step.of_kind("IFCALIGNMENTHORIZONTALSEGMENT")]
        rows = _segments_of(path, "HORIZONTAL")
        assert len(plan) == len(rows)
        for element, (x, y, direction, first, last, length) in zip(plan, rows, strict=True):
            way = np.linspace(0.0, length, 11)
            k0, k1 = (1 / r if r else 0.0 for r in (first, last))
            place = np.array([x, y]) + _closed_form(way, direction, k0, k1, length)
            assert np.abs(element.place_at(way) - place).max() < 1e-3
            checked += 1
        profile = [_profile(step, e, 1.0) for _, e in step.of_kind("IFCALIGNMENTVERTICALSEGMENT")]
        for element, (start, length, height, first, last, *_) in zip(
            profile, _segments_of(path, "VERTICAL"), strict=True
        ):
            end = element.height_at(np.array([start, start + length]))
            chord = length * np.tan((np.arctan(first) + np.arctan(last)) / 2.0)
            assert end == pytest.approx([height, height + chord], abs=1e-3)
    assert checked > 30


@pytest.mark.parametrize("last", ["300.", "0.", "$", "1000."])
def test_an_arc_of_ifc_is_an_arc_whatever_its_end_radius_says(tmp_path: Path, last: str) -> None:
    path = tmp_path / "arc.ifc"
    path.write_text(
        "ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\n#28= IFCCARTESIANPOINT((0.,0.));\n"
        f"#29= IFCALIGNMENTHORIZONTALSEGMENT($,$,#28,0.,300.,{last},100.,$,.CIRCULARARC.);\nENDSEC;\n"
    )
    step = _Step(path)
    ((_, entity),) = step.of_kind("IFCALIGNMENTHORIZONTALSEGMENT")
    end = _plan(step, entity, 1.0, 1.0).place_at(np.array([100.0]))[0]
    assert end == pytest.approx([300.0 * np.sin(1 / 3), 300.0 * (1.0 - np.cos(1 / 3))], abs=1e-9)


VIENNESE = """ISO-10303-21;
HEADER;
ENDSEC;
DATA;
#1= IFCALIGNMENT('a',$,'bend',$,$,$,$,$);
#2= IFCALIGNMENTHORIZONTAL('b',$,$,$,$,$,$);
#3= IFCALIGNMENTVERTICAL('c',$,$,$,$,$,$);
#4= IFCALIGNMENTCANT('d',$,$,$,$,$,$,1.5);
#5= IFCCARTESIANPOINT((500000.,5320000.));
#11= IFCALIGNMENTHORIZONTALSEGMENT($,$,#5,0.,0.,300.,100.,1.8,.VIENNESEBEND.);
#12= IFCALIGNMENTVERTICALSEGMENT($,$,0.,100.,10.,0.,0.,$,.CONSTANTGRADIENT.);
#13= IFCALIGNMENTCANTSEGMENT($,$,0.,100.,0.,0.,0.,0.1,.VIENNESEBEND.);
#21= IFCALIGNMENTSEGMENT('e',$,$,$,$,$,$,#11);
#22= IFCALIGNMENTSEGMENT('f',$,$,$,$,$,$,#12);
#23= IFCALIGNMENTSEGMENT('g',$,$,$,$,$,$,#13);
#31= IFCRELNESTS('h',$,$,$,#1,(#2,#3,#4));
#32= IFCRELNESTS('i',$,$,$,#2,(#21));
#33= IFCRELNESTS('j',$,$,$,#3,(#22));
#34= IFCRELNESTS('k',$,$,$,#4,(#23));
ENDSEC;
"""


def test_a_viennese_bend_of_ifc_is_the_polynomial_of_its_standard(tmp_path: Path) -> None:
    """The terms of order 2 to 7 of the curvature that buildingSMART's alignment test set has for this very element."""
    path = tmp_path / "bend.ifc"
    path.write_text(VIENNESE)
    (segment,) = read_ifc_segments(path, MapReading(crs="EPSG:32632", height_datum="ellipsoidal"))
    terms = {2: -125.657906854859, 3: 83.922298125931, 4: 64.2314061308743}
    terms |= {5: -57.7378785242934, 6: 63.7638813456506, 7: -78.8880838459446}
    east, north = Transformer.from_crs(4326, 32632, always_xy=True).transform(
        segment.longitude_deg, segment.latitude_deg
    )
    way = np.linspace(0.0, 100.0, 200001)
    heading = sum(np.sign(a) * way ** (k + 1) / (k + 1) / abs(a) ** (k + 1) for k, a in terms.items())
    half = 0.5 * (heading[1:] + heading[:-1])
    x = 500000.0 + np.concatenate([[0.0], np.cumsum(np.cos(half))]) * (way[1] - way[0])
    y = 5320000.0 + np.concatenate([[0.0], np.cumsum(np.sin(half))]) * (way[1] - way[0])
    assert np.abs(np.interp(east, x, y) - north).max() < 1e-5
    assert north.min() < 5320000.0 - 0.002  # the track swings out first, as the vehicle begins to lean
    assert segment.cant_m[-1] == pytest.approx(0.1)
    curvature = np.gradient(heading, way)
    expected = -1.0 / np.interp(east, x, curvature)
    bent = np.abs(expected) < 2000.0
    assert segment.radius_m[bent] == pytest.approx(expected[bent], rel=1e-3)


def _closed_form(way: np.ndarray, direction: float, k0: float, k1: float, length: float) -> np.ndarray:
    if k0 == k1 == 0.0:
        local = np.stack([way, 0.0 * way], axis=-1)
    elif k0 == k1:
        local = np.stack([np.sin(k0 * way), 1.0 - np.cos(k0 * way)], axis=-1) / k0
    else:
        # a clothoid from the point where its curvature is 0, at way0 before the start
        rate = (k1 - k0) / length
        way0 = k0 / rate
        scale = np.sqrt(np.pi / abs(rate))
        sine, cosine = fresnel((np.append(way0, way0 + way)) / scale)
        curve = scale * np.stack([cosine, np.sign(rate) * sine], axis=-1)
        curve = curve[1:] - curve[0]
        angle = -rate * way0**2 / 2.0
        local = curve @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return local @ np.array([[np.cos(direction), np.sin(direction)], [-np.sin(direction), np.cos(direction)]])


def test_swiss_alignment_has_the_cant_and_the_curves_of_its_design(recordings: Path) -> None:
    """The file writes northing before easting; its README has 126 mm of cant in the first curve, 467 m to the left."""
    path = recordings / "rail" / "ifc_alignment" / "UT_AWC_1_UT_AWC_1_no_geometry.ifc"
    (segment,) = read_ifc_segments(path, MapReading(crs="EPSG:2056", height_datum="ellipsoidal"))
    curve = np.isclose(segment.radius_m, -467.0)
    assert curve.sum() > 5
    assert segment.cant_m[curve] == pytest.approx(0.126)
    assert np.nanmin(segment.cant_m) >= -1e-12
    assert 46.9 < segment.latitude_deg.mean() < 47.2
    assert 9.0 < segment.longitude_deg.mean() < 9.1
    assert any("northing before easting" in note for note in segment.notes)
    track = read_track(path, crs="EPSG:2056", height_datum="ellipsoidal")
    assert track.chainage_m[-1] == pytest.approx(2478.0, abs=2.0)


LANDXML = """<?xml version="1.0"?><LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2">
<Units><Metric linearUnit="meter"/></Units><CoordinateSystem epsgCode="25832"/>
<Alignments><Alignment name="T1" length="450" staStart="1000"><CoordGeom>
<Line><Start>5320000 650000</Start><End>5320000 650100</End></Line>
<Curve rot="cw" crvType="arc"><Start>5320000 650100</Start><Center>5319500 650100</Center><End>{end}</End></Curve>
</CoordGeom><Profile><ProfAlign name="p"><PVI>1000 500</PVI><ParaCurve length="60">1100 501</ParaCurve>
<PVI>1300 500</PVI></ProfAlign></Profile>
<Cant><CantStation station="1000" appliedCant="0"/><CantStation station="1100" appliedCant="0" curvature="cw"/>
<CantStation station="1150" appliedCant="90" curvature="cw"/>
<CantStation station="1300" appliedCant="90" curvature="cw"/>
</Cant></Alignment></Alignments></LandXML>"""


def test_landxml_alignment_is_its_circle_parabola_and_cant(tmp_path: Path) -> None:
    turn = 0.4
    end = f"{5319500 + 500 * np.cos(turn):.6f} {650100 + 500 * np.sin(turn):.6f}"
    path = tmp_path / "line.xml"
    path.write_text(LANDXML.format(end=end))
    track = read_track(path, height_datum="ellipsoidal")
    assert track.chainage_m[-1] == pytest.approx(300.0, rel=5e-4)  # the scale of UTM
    assert track.radius_m[-2] == pytest.approx(500.0)
    assert track.cant_m[-2] == pytest.approx(0.090)
    top = np.argmin(np.abs(track.chainage_m - 100.0))
    assert track.height_m[top] == pytest.approx(501.0 - 60.0 * 0.015 / 8.0, abs=2e-3)
    assert track.height_m[-1] == pytest.approx(500.0 + 0.090 / 2.0, abs=1e-6)  # the middle between the rail tops


def test_landxml_of_inframodel_is_read(tmp_path: Path) -> None:
    """Extensions of a country are passed over; transitions are biquadratic parabolas; the cant is in metres."""
    radius, length = 800.0, 160.0
    transition = PlanElement(
        x_m=650100.0, y_m=5320000.0, direction_rad=0.0, first=0.0, last=-1.0 / radius, length_m=length, law="helmert"
    )
    end_x, end_y = transition.place_at(np.array([length]))[0]
    path = tmp_path / "line.xml"
    path.write_text(
        f"""<?xml version="1.0"?><LandXML xmlns="http://www.inframodel.fi/inframodel" version="1.2">
<Units><Metric linearUnit="meter"/></Units><CoordinateSystem epsgCode="25832"/>
<Alignments><Alignment name="T1" staStart="0"><CoordGeom>
<Line><Start>5320000 650000</Start><End>5320000 650100</End></Line><!-- Q1 --><Feature code="IM_x"/>
<Spiral length="160" radiusStart="INF" radiusEnd="800" rot="cw" spiType="biquadraticParabola">
<Start>5320000 650100</Start><PI>5320000 650200</PI><End>{end_y:.6f} {end_x:.6f}</End></Spiral>
</CoordGeom><Profile><ProfAlign name="p"><PVI>0 10</PVI><PVI>260 10</PVI><Feature code="IM_y"/></ProfAlign></Profile>
<Cant rotationPoint="insideRail"><CantStation station="0" appliedCant="0" curvature="cw"/>
<CantStation station="100" appliedCant="0" curvature="cw" transitionType="biquadraticParabola"/>
<CantStation station="260" appliedCant="0.150" curvature="cw"/></Cant></Alignment></Alignments></LandXML>"""
    )
    (segment,) = read_xml_segments(path, MapReading(height_datum="ellipsoidal"))
    assert any("at most 0.15, assumed in the length unit of the file" in note for note in segment.notes)
    assert not any("do not meet" in note for note in segment.notes)
    assert segment.cant_m[-1] == pytest.approx(0.150)
    assert segment.radius_m[-1] == pytest.approx(800.0)
    # Helmert's law at a quarter of the transition: 2 t^2 = 1/8 of the cant and of the curvature.
    x = 650100.0 + 40.0
    east, _ = Transformer.from_crs(4326, 25832, always_xy=True).transform(segment.longitude_deg, segment.latitude_deg)
    assert np.interp(x, east, segment.cant_m) == pytest.approx(0.150 / 8.0, abs=1e-3)


def test_a_landxml_parabola_is_laid_out_from_the_straight(tmp_path: Path) -> None:
    """Towards a straight: the tangent from PI to End holds; that from Start to PI is off by the cube of the angle."""
    element = PlanElement(
        x_m=0.0, y_m=0.0, direction_rad=0.05, first=1.0 / 800.0, last=0.0, length_m=160.0, law="helmert"
    )
    x, y = element.place_at(np.array([160.0]))[0]
    direction = element.direction_at(np.array([160.0]))[0]
    path = tmp_path / "line.xml"
    path.write_text(
        '<LandXML><Alignments><Alignment name="T1"><CoordGeom><Spiral length="160" radiusStart="800" radiusEnd="INF" '
        'rot="ccw" spiType="biquadraticParabola"><Start>5320000 650000</Start>'
        f"<PI>{5320000 + y - 90.0 * np.sin(direction):.9f} {650000 + x - 90.0 * np.cos(direction):.9f}</PI>"
        f"<End>{5320000 + y:.9f} {650000 + x:.9f}</End></Spiral></CoordGeom></Alignment></Alignments></LandXML>"
    )
    (segment,) = read_xml_segments(path, MapReading(crs="EPSG:25832"))
    end = Transformer.from_crs(4326, 25832, always_xy=True).transform(
        segment.longitude_deg[-1], segment.latitude_deg[-1]
    )
    assert end == pytest.approx([650000 + x, 5320000 + y], abs=1e-4)


def test_landxml_cant_of_an_unknown_transition_is_refused(tmp_path: Path) -> None:
    text = LANDXML.format(end="5319900 650250").replace(
        'appliedCant="0" c', 'transitionType="wienerBogen" appliedCant="0" c'
    )
    path = tmp_path / "line.xml"
    path.write_text(text)
    with pytest.raises(InputFileError, match=r"alignment 'T1': cant of transition type 'wienerBogen' is not supported"):
        read_track(path, height_datum="ellipsoidal")


def test_railml_net_elements_are_lines(tmp_path: Path) -> None:
    points = "".join(
        f'<intrinsicCoordinate intrinsicCoord="{k / 40}"><geometricCoordinate positioningSystemRef="g" x="{x}" y="{y}" '
        f'z="{z}"/></intrinsicCoordinate>'
        for k, (x, y, z) in enumerate(LINE)
    )
    path = tmp_path / "net.railml"
    path.write_text(
        '<railML xmlns="https://www.railml.org/schemas/3.2" version="3.2"><common><positioning>'
        '<geometricPositioningSystems><geometricPositioningSystem id="g" crsDefinition="urn:ogc:def:crs:EPSG::4258"/>'
        "</geometricPositioningSystems></positioning></common><infrastructure><topology><netElements>"
        f'<netElement id="ne1"><associatedPositioningSystem id="a">{points}</associatedPositioningSystem></netElement>'
        "</netElements></topology></infrastructure></railML>"
    )
    track = read_track(path, height_datum="ellipsoidal")
    assert track.name == "ne1"
    assert track.provenance.frame == "EPSG:4258"
    assert np.abs(track.height_m - LINE[:, 2]).max() < 1e-9


def test_broken_design_files_are_one_sentence(tmp_path: Path) -> None:
    bad = tmp_path / "a.ifc"
    bad.write_text("hello")
    with pytest.raises(InputFileError, match="not an IFC file"):
        read_track(bad)
    bad = tmp_path / "a.xml"
    bad.write_text("<a>")
    with pytest.raises(InputFileError, match="not XML"):
        read_track(bad)
    bad = tmp_path / "a.gpkg"
    bad.write_text("x")
    with pytest.raises(InputFileError, match="GDAL cannot read"):
        read_track(bad)


def test_constant_curvature_meets_at_a_joint() -> None:
    plan = [
        PlanElement(x_m=0.0, y_m=0.0, direction_rad=0.0, first=0.0, last=0.0, length_m=50.0),
        PlanElement(x_m=50.0, y_m=0.0, direction_rad=0.0, first=0.01, last=0.01, length_m=50.0),
    ]
    points = alignment_at(np.array([0.0, 50.0, 100.0]), plan, [], [])
    assert points.xy_m[2] == pytest.approx([50.0 + 100.0 * np.sin(0.5), 100.0 * (1.0 - np.cos(0.5))])
    assert points.curvature == pytest.approx([0.0, 0.01, 0.01])
