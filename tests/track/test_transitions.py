"""Transition curves against an independent integration of their curvature, and as LandXML and IFC files have them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

from railfix.core.errors import InputFileError
from railfix.track import read_track
from railfix.track.elements import ProfileElement, Stations
from railfix.track.read import read_segments
from railfix.track.route import MapReading
from railfix.track.transitions import OrdinateElement, cubic_of_length

pytestmark = pytest.mark.requirement("A1")

#: Shape, radius and length on the tangent of ordinary and of sharp transitions [m].
CASES = [("cubic", 400.0, 80.0), ("cubic", 300.0, 120.0), ("half-sine", 600.0, 100.0), ("half-sine", 300.0, 140.0)]
END_OF_HALF_SINE = 0.25 - 1.0 / np.pi**2


def element(shape: str, radius_m: float, tangent_m: float, *, side: float = 1.0, into: bool = True) -> OrdinateElement:
    ordinate = side * tangent_m**2 / radius_m * (1.0 / 6.0 if shape == "cubic" else END_OF_HALF_SINE)
    return OrdinateElement(
        x_m=100.0, y_m=200.0, direction_rad=0.7, tangent_m=tangent_m, ordinate_m=ordinate, shape=shape, into=into
    )  # type: ignore[arg-type]


def curvature(shape: str, radius_m: float, tangent_m: float, x: float) -> float:
    """Curvature of the curve at a place on the tangent, by its derivatives, written out again."""
    if shape == "cubic":
        slope, second = x**2 / (2.0 * radius_m * tangent_m), x / (radius_m * tangent_m)
    else:
        turn = np.pi * x / tangent_m
        slope = tangent_m / radius_m * (x / (2.0 * tangent_m) - np.sin(turn) / (2.0 * np.pi))
        second = (1.0 - np.cos(turn)) / (2.0 * radius_m)
    return float(second / (1.0 + slope**2) ** 1.5)


@pytest.mark.parametrize(("shape", "radius_m", "tangent_m"), CASES)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_transition_is_the_integral_of_its_curvature(
    shape: str, radius_m: float, tangent_m: float, side: float
) -> None:
    """The curvature at x integrated along the curve by an independent solver leads to the same points."""
    curve = element(shape, radius_m, tangent_m, side=side)
    found = solve_ivp(
        lambda _, state: [
            np.cos(state[2]), np.sin(state[2]), side * curvature(shape, radius_m, tangent_m, float(state[0]))
        ],
        (0.0, curve.length_m), [0.0, 0.0, 0.0], rtol=1e-11, atol=1e-12, dense_output=True,
    )  # fmt: skip
    way = np.linspace(0.0, curve.length_m, 33)
    x, y, _ = found.sol(way)
    turned = np.stack([x * np.cos(0.7) - y * np.sin(0.7), x * np.sin(0.7) + y * np.cos(0.7)], axis=-1)
    np.testing.assert_allclose(curve.place_at(way), turned + np.array([100.0, 200.0]), atol=1e-7)
    assert x[-1] == pytest.approx(tangent_m, abs=1e-7)


@pytest.mark.parametrize(("shape", "radius_m", "tangent_m"), CASES)
def test_a_transition_run_the_other_way_is_the_same_curve(shape: str, radius_m: float, tangent_m: float) -> None:
    forth = element(shape, radius_m, tangent_m)
    end = forth.place_at(np.array([forth.length_m]))[0]
    back = OrdinateElement(
        x_m=float(end[0]), y_m=float(end[1]), direction_rad=0.7 + forth.turn_rad + np.pi,
        tangent_m=tangent_m, ordinate_m=forth.ordinate_m, shape=forth.shape, into=False,
    )  # fmt: skip
    way = np.linspace(0.0, forth.length_m, 17)
    np.testing.assert_allclose(back.place_at(way), forth.place_at(forth.length_m - way), atol=1e-8)
    np.testing.assert_allclose(back.curvature_at(way), -forth.curvature_at(forth.length_m - way), atol=1e-10)


@pytest.mark.parametrize("first", [0.0, 1 / 300.0])
def test_forms_of_the_cubic_parabola_end_in_the_curvature_that_they_say(first: float) -> None:
    """Without the correction the curvature falls short by the cube of the cosine; with it, it is that of the arc."""
    last = 1 / 300.0 - first
    own = {"x_m": 0.0, "y_m": 0.0, "direction_rad": 0.0, "first": first, "last": last, "length_m": 90.0}
    for variant in ("length", "tangent", "corrected"):
        curve = cubic_of_length(**own, variant=variant)
        assert curve.length_m == pytest.approx(90.0, abs=1e-6)
        tangent, bend = curve.tangent_m, abs(curve.ordinate_m) / curve.tangent_m**3
        base = 1.0 / (6.0 * 300.0 * (90.0 if variant == "length" else tangent))
        expected = base * ((1.0 + (tangent / 600.0) ** 2) ** 1.5 if variant == "corrected" else 1.0)
        assert bend == pytest.approx(expected, rel=1e-9)
        end = max(abs(curve.first), abs(curve.last))
        if variant == "corrected":
            assert end == pytest.approx(1 / 300.0, rel=5e-3)
        else:
            assert end < 0.975 / 300.0


def test_a_vertical_clothoid_is_the_integral_of_its_curvature() -> None:
    first, last, length = -0.02, 0.015, 120.0
    profile = ProfileElement(start_m=50.0, length_m=length, height_m=10.0, first=first, last=last, arc="clothoid")
    turn = np.arctan(last) - np.arctan(first)

    def angle(way: float, whole: float) -> float:
        return float(np.arctan(first) + turn * (way / whole) ** 2)  # the curvature rises from nothing

    whole = brentq(lambda w: quad(lambda s: np.cos(angle(s, w)), 0.0, w)[0] - length, length, 1.1 * length)
    for share in (0.25, 0.5, 1.0):
        way = share * whole
        place = quad(lambda s: np.cos(angle(s, whole)), 0.0, way)[0]
        height = quad(lambda s: np.sin(angle(s, whole)), 0.0, way)[0]
        assert profile.height_at(np.array([50.0 + place]))[0] == pytest.approx(10.0 + height, abs=1e-5)
        assert profile.gradient_at(np.array([50.0 + place]))[0] == pytest.approx(np.tan(angle(way, whole)), abs=1e-5)


# --- files -------------------------------------------------------------------

HEAD = '<LandXML><CoordinateSystem epsgCode="25832"/><Alignments><Alignment name="A" staStart="1000">{more}<CoordGeom>'
TAIL = "</CoordGeom></Alignment></Alignments></LandXML>"


def landxml(path: Path, elements: str, more: str = "") -> Path:
    path.write_text(HEAD.format(more=more) + elements + TAIL)
    return path


def point(name: str, xy: np.ndarray, *, easting_first: bool = False) -> str:
    values = xy if easting_first else xy[::-1]
    return f"<{name}>{values[0]:.7f} {values[1]:.7f}</{name}>"


def shifted(place: np.ndarray, east_m: float, north_m: float) -> np.ndarray:
    return np.asarray(place + np.array([east_m, north_m]))


def grid(path: Path) -> np.ndarray:
    """Easting and northing of the points that are read."""
    segment = read_segments(path, MapReading(height_datum="ellipsoidal"))[0]
    to_grid = Transformer.from_crs(segment.frame, "EPSG:25832", always_xy=True)
    return np.stack(to_grid.transform(segment.longitude_deg, segment.latitude_deg), axis=-1)


@pytest.mark.parametrize(("kind", "shape"), [
    ("cubic", "cubic"), ("cubicParabola", "cubic"), ("japaneseCubic", "cubic"), ("sineHalfWave", "half-sine"),
])  # fmt: skip
@pytest.mark.parametrize("into", [True, False])
def test_landxml_transitions_of_ordinates_lie_on_their_curve(kind: str, shape: str, into: bool, tmp_path: Path) -> None:
    origin = np.array([650_000.0, 5_320_000.0])
    curve = element(shape, 400.0, 100.0, side=-1.0)
    start, end = (origin + curve.place_at(np.array([way]))[0] for way in (0.0, curve.length_m))
    tangent = np.array([np.cos(0.7), np.sin(0.7)])
    middle = start + tangent * 60.0
    first, last = (start, end) if into else (end, start)
    radii = ("INF", "400") if into else ("400", "0.0")
    turn = "cw" if into else "ccw"
    text = (
        f'<Spiral length="100" radiusStart="{radii[0]}" radiusEnd="{radii[1]}" rot="{turn}" spiType="{kind}">'
        + point("Start", first) + point("PI", middle) + point("End", last) + "</Spiral>"
    )  # fmt: skip
    found = grid(landxml(tmp_path / "a.xml", text))
    x = (found - start) @ tangent
    y = (found - start) @ np.array([-tangent[1], tangent[0]])
    share = x / 100.0
    expected = share**3 / 6.0 if shape == "cubic" else share**2 / 4.0 - (1.0 - np.cos(np.pi * share)) / (2.0 * np.pi**2)
    np.testing.assert_allclose(y, -(100.0**2) / 400.0 * expected, atol=1e-4)


def test_a_transition_that_does_not_end_in_its_radius_is_refused(tmp_path: Path) -> None:
    origin = np.array([650_000.0, 5_320_000.0])
    places = {"Start": origin, "PI": shifted(origin, 60.0, 0.0), "End": shifted(origin, 100.0, 9.0)}
    text = '<Spiral length="100" radiusStart="INF" radiusEnd="400" rot="ccw" spiType="cubic">'
    text += "".join(point(name, place) for name, place in places.items()) + "</Spiral>"
    with pytest.raises(InputFileError, match=r"does not match its radius \(1\.9"):
        read_segments(landxml(tmp_path / "a.xml", text), MapReading())


@pytest.mark.parametrize("easting_first", [False, True])
def test_landxml_is_read_in_the_order_in_which_curves_turn_as_they_say(easting_first: bool, tmp_path: Path) -> None:
    origin = np.array([650_000.0, 5_320_000.0])
    corner, centre = shifted(origin, 300.0, 0.0), shifted(origin, 300.0, 400.0)
    end = centre + 400.0 * np.array([np.sin(0.8), -np.cos(0.8)])

    def element_of(kind: str, **places: np.ndarray) -> str:
        points = "".join(point(name, place, easting_first=easting_first) for name, place in places.items())
        return f'<{kind} rot="ccw">{points}</{kind}>'

    text = element_of("Line", Start=origin, End=corner) + element_of("Line", Start=corner, End=corner)
    text += element_of("Curve", Start=corner, Center=centre, End=end)
    found = grid(landxml(tmp_path / "a.xml", text))
    length = np.hypot(*np.diff(found, axis=0).T).sum()
    assert length == pytest.approx(300.0 + 400.0 * 0.8, abs=0.01)
    assert found[-1] == pytest.approx(end, abs=1e-3)
    notes = " ".join(read_segments(tmp_path / "a.xml", MapReading())[0].notes)
    assert ("easting before northing" in notes) == easting_first


def test_stations_and_their_equations_are_the_kilometrage(tmp_path: Path) -> None:
    origin = np.array([650_000.0, 5_320_000.0])
    text = "<Line>" + point("Start", origin) + point("End", shifted(origin, 900.0, 0.0)) + "</Line>"
    equations = '<StaEquation staAhead="5000" staBack="1300" staInternal="1300" staIncrement="increasing"/>'
    equations += '<StaEquation staAhead="2000" staBack="5200" staInternal="1500" staIncrement="decreasing"/>'
    profile = tmp_path / "profile.csv"
    profile.write_text("# sigma_m: 0.2\nchainage_m,height_m\n-10,480\n5000,480\n")
    track = read_track(landxml(tmp_path / "a.xml", text, equations), heights=profile)
    scale = track.chainage_m[-1] / 900.0  # the ground is longer than the grid
    at = np.array([100.0, 299.0, 301.0, 450.0, 499.0, 501.0, 850.0])
    expected = [1100.0, 1299.0, 5001.0, 5150.0, 5199.0, 1999.0, 1650.0]
    np.testing.assert_allclose(track.kilometrage_at(at * scale), expected, atol=0.35)
    plain = Stations(rows=((0.0, 0.0, 250.0),))
    assert plain.at(np.array([0.0, 40.0])) == pytest.approx([250.0, 290.0])


IFC = """ISO-10303-21;
HEADER;
ENDSEC;
DATA;
#1= IFCALIGNMENT('a',$,'bend',$,$,$,$,$);
#2= IFCALIGNMENTHORIZONTAL('b',$,$,$,$,$,$);
#3= IFCALIGNMENTVERTICAL('c',$,$,$,$,$,$);
#5= IFCCARTESIANPOINT((500000.,5320000.));
#6= IFCCARTESIANPOINT(({x:.9f},{y:.9f}));
#11= IFCALIGNMENTHORIZONTALSEGMENT($,$,#5,0.,0.,300.,90.,$,.CUBIC.);
#10= IFCALIGNMENTHORIZONTALSEGMENT($,$,#6,{turn:.12f},300.,300.,60.,$,.CIRCULARARC.);
#12= IFCALIGNMENTVERTICALSEGMENT($,$,0.,150.,10.,0.01,0.05,$,.CONSTANTGRADIENT.);
#21= IFCALIGNMENTSEGMENT('e',$,$,$,$,$,$,#11);
#20= IFCALIGNMENTSEGMENT('e',$,$,$,$,$,$,#10);
#22= IFCALIGNMENTSEGMENT('f',$,$,$,$,$,$,#12);
#31= IFCRELNESTS('h',$,$,$,#1,(#2,#3));
#32= IFCRELNESTS('i',$,$,$,#2,(#21,#20));
#33= IFCRELNESTS('j',$,$,$,#3,(#22));
ENDSEC;
"""


@pytest.mark.parametrize("variant", ["length", "tangent", "corrected"])
def test_a_cubic_of_ifc_is_the_form_whose_end_meets_the_arc(variant: str, tmp_path: Path) -> None:
    curve = cubic_of_length(
        x_m=500_000.0, y_m=5_320_000.0, direction_rad=0.0, first=0.0, last=1 / 300.0, length_m=90.0, variant=variant
    )
    x, y = curve.place_at(np.array([90.0]))[0]
    path = tmp_path / "a.ifc"
    path.write_text(IFC.format(x=x, y=y, turn=curve.turn_rad))
    segment = read_segments(path, MapReading(crs="EPSG:25832", height_datum="ellipsoidal"))[0]
    assert not any("do not meet" in note for note in segment.notes)
    to_grid = Transformer.from_crs(segment.frame, "EPSG:25832", always_xy=True)
    found = np.stack(to_grid.transform(segment.longitude_deg, segment.latitude_deg), axis=-1)
    on_cubic = found[found[:, 0] <= x + 1e-6]
    place = on_cubic[:, 0] - 500_000.0
    np.testing.assert_allclose(
        on_cubic[:, 1] - 5_320_000.0, curve.ordinate_m * (place / curve.tangent_m) ** 3, atol=1e-4
    )
    # a constant gradient is one, whatever its end says
    assert segment.height_m[-1] == pytest.approx(10.0 + 0.01 * 150.0, abs=1e-6)
    assert any("constant gradient have two values" in note for note in segment.notes)
