"""Coordinate reference systems of maps, their relation to the ITRF, and PROJ operations between them.

Definitions are from the EPSG dataset (https://epsg.org). Motions of countries relative to their plates are not
corrected; notes to the user state them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal

import numpy as np
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.datadir import get_user_data_dir  # type: ignore[attr-defined]
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from railfix.core.arrays import Floats, Masks
from railfix.core.errors import SettingsError
from railfix.core.files import FilePath

#: EPSG code of the three-dimensional geographic CRS of each ITRF realisation.
_ITRF: Final = {
    "ITRF88": "EPSG:7900", "ITRF89": "EPSG:7901", "ITRF90": "EPSG:7902", "ITRF91": "EPSG:7903", "ITRF92": "EPSG:7904",
    "ITRF93": "EPSG:7905", "ITRF94": "EPSG:7906", "ITRF96": "EPSG:7907", "ITRF97": "EPSG:7908",
    "ITRF2000": "EPSG:7909", "ITRF2005": "EPSG:7910", "ITRF2008": "EPSG:7911", "ITRF2014": "EPSG:7912",
    "ITRF2020": "EPSG:9989",
}  # fmt: skip
#: Frames aligned with a realisation of the ITRF within 1 cm.
_ALIGNED: Final = {
    "ITRF92": "WGS 84 (G730)",
    "ITRF94": "WGS 84 (G873)",
    "ITRF97": "IGS97, SIRGAS-CON DGF00P01",
    "ITRF2000": "IGS00, IGb00, WGS 84 (G1150), SIRGAS-CON DGF01P01, SIRGAS-CON DGF01P02, SIRGAS-CON DGF02P01, "
    "SIRGAS-CON DGF04P01, SIRGAS-CON DGF05P01, SIRGAS-CON DGF06P01",
    "ITRF2005": "IGS05, SIRGAS-CON DGF07P01, SIRGAS-CON DGF08P01, SIRGAS-CON SIR09P01",
    "ITRF2008": "IGS08, IGb08, WGS 84 (G1674), WGS 84 (G1762), PZ-90.11, SIRGAS-CON SIR10P01, SIRGAS-CON SIR11P01, "
    "SIRGAS-CON SIR13P01, SIRGAS-CON SIR14P01, SIRGAS-CON SIR15P01, SRGI2013",
    "ITRF2014": "IGS14, IGb14, WGS 84 (G2139), ATRF2014, SIRGAS-CON SIR17P01",
    "ITRF2020": "IGS20, WGS 84 (G2296)",
}
#: EPSG codes of ITRF realisations, by the name of the realisation or the name of a frame aligned with it.
REALISATIONS: Final = _ITRF | {name: _ITRF[itrf] for itrf, names in _ALIGNED.items() for name in names.split(", ")}


@dataclass(frozen=True)
class HeldFrame:
    """National frame that is a realisation of the ITRF at a fixed epoch."""

    itrf: str  #: Name of the ITRF realisation.
    epoch: float  #: Epoch of the coordinates [year].
    plate: str  #: Plate of the ITRF2020 plate motion model on which most of the country lies.
    #: Lowest and highest speed of points of the country relative to the plate [mm per year].
    rest_mm: tuple[float, float] = (0.0, 1.0)
    but: str = ""  #: Further neglected motions, as a clause of the note to the user.
    #: Second plate of the country, and two points (latitude, longitude) on the border between both plates. Seen from
    #: the first point to the second, the second plate is on the right.
    border: tuple[str, tuple[float, float], tuple[float, float]] | None = None

    @property
    def code(self) -> str:
        """EPSG code of the three-dimensional geographic CRS of the realisation."""
        return _ITRF[self.itrf]

    def plate_at(self, latitude_deg: float, longitude_deg: float) -> str:
        """Return the plate on which a point of the country lies."""
        if self.border is None:
            return self.plate
        other, (south, west), (north, east) = self.border
        cross = (east - west) * (latitude_deg - south) - (north - south) * (longitude_deg % 360.0 - west)
        return other if cross < 0.0 else self.plate

    def describe_rest(self, years: float) -> str:
        """Return a clause that states the neglected motion relative to the plate over a number of years."""
        low, high = (abs(years) * rate / 1000.0 for rate in self.rest_mm)
        but = f", {self.but}" if self.but else ""
        return f"its motion relative to the plate, {low:.2f} to {high:.2f} m, is left out{but}"


_ANDES: Final = "as are earthquakes (metres in Chile since 2010)"
#: National frames that are ITRF realisations at a fixed epoch. PROJ does not model the motion since this epoch.
HELD: Final = {
    "JGD2011": HeldFrame(
        "ITRF2008", 2011.4, "EURA", (5.0, 30.0), "and western Japan has the epoch 1997.0 (--map-epoch 1997)"
    ),
    "JGD2000": HeldFrame("ITRF94", 1997.0, "EURA", (5.0, 30.0), "as is the earthquake of 2011 (up to 5 m)"),
    "KGD2002": HeldFrame("ITRF2000", 2002.0, "AMUR", (0.0, 3.0), "as is the earthquake of 2011 (0.01 to 0.06 m)"),
    "China Geodetic Coordinate System 2000": HeldFrame("ITRF97", 2000.0, "EURA", (3.0, 30.0)),
    "TWD97": HeldFrame("ITRF94", 1997.0, "EURA", (0.0, 80.0), "as is the earthquake of 1999"),
    "Hong Kong Geodetic CS": HeldFrame("ITRF96", 1998.121, "EURA", (5.0, 10.0)),
    "Macao 2008": HeldFrame("ITRF2005", 2008.38, "EURA", (5.0, 10.0)),
    "GDM2000": HeldFrame("ITRF2000", 2000.0, "EURA", (3.0, 10.0), "as is the earthquake of 2004 (up to 0.2 m)"),
    "GSK-2011": HeldFrame("ITRF2008", 2011.0, "EURA", (0.0, 5.0)),
    "TUREF": HeldFrame("ITRF96", 2005.0, "EURA", (0.0, 25.0), "as are the earthquakes of 2023 (metres)"),
    "IGRS": HeldFrame("ITRF2000", 1997.0, "ARAB", (0.0, 5.0)),
    "ONGD14": HeldFrame("ITRF2008", 2013.15, "ARAB"),
    "NZGD2000": HeldFrame(
        "ITRF96",
        2000.0,
        "AUST",
        (0.0, 35.0),
        "as are the earthquakes of 2010 to 2016 (metres); the deformation grid of PROJ (projsync --area-of-use 'New "
        "Zealand') includes the motion and the earthquakes",
        border=("PCFC", (-44.6, 167.8), (-37.6, 178.5)),
    ),
    "PNG94": HeldFrame("ITRF92", 1994.0, "AUST", (0.0, 90.0)),
    "RGNC91-93": HeldFrame("ITRF90", 1989.0, "AUST"),
    "RGPF": HeldFrame("ITRF92", 1993.0, "PCFC"),
    "Hartebeesthoek94": HeldFrame("ITRF91", 1994.0, "NUBI"),
    "Moznet": HeldFrame("ITRF94", 1996.9, "SOMA", (0.0, 4.0)),
    "RGRDC 2005": HeldFrame("ITRF2000", 2005.4, "NUBI", (0.0, 2.0)),
    "RGR92": HeldFrame("ITRF91", 1993.0, "SOMA", (0.0, 2.0)),
    "RGM04": HeldFrame("ITRF2000", 2004.0, "SOMA", (0.0, 2.0), "as are the earthquakes of 2018 (0.2 m)"),
    "ISN93": HeldFrame("ITRF93", 1993.5, "EURA", (0.0, 20.0)),
    "ISN2004": HeldFrame("ITRF2000", 2004.6, "EURA", (0.0, 20.0)),
    "ISN2016": HeldFrame("ITRF2014", 2016.5, "EURA", (0.0, 20.0)),
    "SIRGAS 2000": HeldFrame("ITRF2000", 2000.4, "SOAM", (0.0, 30.0), _ANDES),
    "SIRGAS 1995": HeldFrame("ITRF94", 1995.4, "SOAM", (0.0, 30.0), _ANDES),
    "SIRGAS-ROU98": HeldFrame("ITRF94", 1995.4, "SOAM"),
    "POSGAR 98": HeldFrame("ITRF94", 1995.4, "SOAM", (0.0, 20.0), _ANDES),
    "POSGAR 2007": HeldFrame("ITRF2005", 2006.632, "SOAM", (0.0, 20.0), _ANDES),
    "MAGNA-SIRGAS": HeldFrame("ITRF94", 1995.4, "SOAM", (0.0, 20.0)),
    "MAGNA-SIRGAS 2018": HeldFrame("ITRF2014", 2018.0, "SOAM", (0.0, 20.0)),
    "REGVEN": HeldFrame("ITRF94", 1995.4, "SOAM", (0.0, 20.0)),
    "Peru96": HeldFrame("ITRF94", 1995.4, "SOAM", (0.0, 30.0), _ANDES),
    "RGFG95": HeldFrame("ITRF93", 1995.0, "SOAM"),
    "SIRGAS-Chile 2002": HeldFrame("ITRF2000", 2002.0, "SOAM", (5.0, 35.0), _ANDES),
    "SIRGAS-Chile 2010": HeldFrame("ITRF2008", 2010.0, "SOAM", (5.0, 35.0), _ANDES),
    "SIRGAS-Chile 2013": HeldFrame("ITRF2008", 2013.0, "SOAM", (5.0, 35.0), _ANDES),
    "SIRGAS-Chile 2016": HeldFrame("ITRF2008", 2016.0, "SOAM", (5.0, 35.0), _ANDES),
    "SIRGAS-Chile 2021": HeldFrame("ITRF2014", 2021.0, "SOAM", (5.0, 35.0), _ANDES),
    "CR05": HeldFrame("ITRF2000", 2005.83, "CARB", (0.0, 30.0)),
    "Mexico ITRF92": HeldFrame("ITRF92", 1988.0, "NOAM", (0.0, 50.0)),
    "Mexico ITRF2008": HeldFrame("ITRF2008", 2010.0, "NOAM", (0.0, 50.0)),
    "RGSPM06": HeldFrame("ITRF2000", 2006.0, "NOAM"),
}
#: Frames that are treated as another frame. Each value has the EPSG code of the frame that is used instead, and a
#: clause on the differences between both frames.
SAME: Final = {
    "NAD83(CSRS)": (
        "EPSG:8254",
        "its versions 2 to 8 differ by up to 0.03 m in plan where the crust is stable, and 0.10 m in height",
    ),
    "NAD83(HARN)": ("EPSG:6319", "the frames differ by up to 0.1 m, by up to 0.5 m in the west of California"),
    "NAD83(FBN)": ("EPSG:6319", "the frames differ by up to 0.1 m, by up to 0.5 m in the west of California"),
    "NAD83(NSRS2007)": ("EPSG:6319", "the frames differ by 0.02 m, by up to 0.3 m in the west of California"),
    "RGF93 v2": ("EPSG:7931", "RGF93 v2 is ETRF2000 at the epoch 2009.0"),
    "RGF93 v2b": ("EPSG:7931", "RGF93 v2b is ETRF2000 at the epoch 2019.0"),
}


TRANSIT: Final = "WGS 84 (Transit)"  #: First realisation of WGS 84, which differs by 0.8 m from later realisations.
#: Frame in which positions are computed: the three-dimensional geographic CRS of ITRF2020.
WORKING_FRAME: Final = "EPSG:9989"
#: Usual frames of maps in a region, with the EPSG code of the three-dimensional CRS. Where the areas of several frames
#: overlap, the first frame is the most likely one.
REGIONAL: Final = {
    "ETRS89": "EPSG:4937", "NAD83(2011)": "EPSG:6319", "NAD83(CSRS)": "EPSG:8254", "GDA2020": "EPSG:7843",
    "JGD2011": "EPSG:6667", "KGD2002": "EPSG:4927", "TWD97": "EPSG:3823", "CGCS2000": "EPSG:4480",
    "NZGD2000": "EPSG:4959", "SIRGAS 2000": "EPSG:4989", "Hartebeesthoek94": "EPSG:4941",
}  # fmt: skip
MARGIN_DEG: Final = 0.5  #: The area of use of a CRS is extended by this margin on all sides [deg].
#: A map is rejected if the scale of its grid differs from 1 by more than this (national grids: up to 0.005).
LARGEST_SCALE: Final = 0.01
#: A frame counts as an older datum if all PROJ transformations to the working frame are less accurate than this [m].
MODERN_M: Final = 0.5

Box = tuple[float, float, float, float]  #: South, north, west and east [deg].
#: PROJ operations that are less accurate than this are not used [m]; in the EPSG dataset, 999 m means unknown.
WORST_M: Final = 100.0
#: The steps of a PROJ operation that do not change the datum have names that begin with these words.
_NO_DATUM_CHANGE: Final = ("axis order change", "Conversion from", "Null geographic offset", "Inverse of Conversion")
Kind = Literal["wgs84", "moves with its plate", "dynamic", "older datum"]


@lru_cache(maxsize=32)
def kind_of_frame(crs: str) -> Kind:
    """Return the kind of a CRS by its relation to the ITRF; raise SettingsError if the CRS is unknown.

    "wgs84" is WGS 84 without a realisation, "moves with its plate" a frame fixed to a plate, and "dynamic" an ITRF
    realisation. "older datum" is a datum without a transformation to ITRF2020 that is accurate to `MODERN_M`.
    """
    geodetic = get_geodetic_frame(crs)
    name = geodetic.name
    if name in REALISATIONS:
        return "dynamic"
    if name.startswith("WGS 84") and name != TRANSIT:
        return "wgs84"
    if name in HELD:
        return "moves with its plate"
    return "older datum" if find_operation(crs) is None else "moves with its plate"


@lru_cache(maxsize=64)
def _system(crs: str) -> CRS:
    """Return the CRS that has a given name; raise CRSError if the name is unknown.

    CRS are cached, because PROJ takes a millisecond to create one.
    """
    return CRS.from_user_input(crs)


def find_crs(crs: str, *, path: FilePath = "") -> CRS:
    """Return the CRS that has a given name; raise SettingsError, whose text has `path`, for a name unknown to PROJ."""
    try:
        return _system(crs)
    except CRSError:
        where = f"{path}: " if path else ""
        raise SettingsError(
            f"{where}the CRS {crs!r} is unknown; give for example EPSG:4326 (WGS 84), EPSG:4258 (ETRS89) or EPSG:6677"
        ) from None


def choose_crs(path: FilePath, given: str | None, named: str | None) -> str | None:
    """Return the CRS of a file, either from the user (`given`) or from the file (`named`); None if neither states one.

    If both state the same horizontal CRS, the file's CRS is returned, unless the user's CRS is a compound CRS, which
    also has a height datum. Raise SettingsError if the two CRS contradict each other, or a CRS is unknown.
    """
    if given is None or named is None:
        used = given or named
        if used is not None:
            find_crs(used, path=path)
        return used
    one, other = (find_crs(name, path=path).to_2d() for name in (given, named))
    if not one.equals(other, ignore_axis_order=True):
        raise SettingsError(f"{path}: crs {given} (--crs) contradicts the file's own CRS {named}")
    return given if find_crs(given).is_compound else named  # a compound CRS has a height datum


def unit_of_grid(crs: str, *, path: str) -> float:
    """Return the unit of a projected CRS [m]; raise SettingsError if the CRS is not projected."""
    system = find_crs(crs, path=path)
    if not system.is_projected and not (system.is_compound and system.sub_crs_list[0].is_projected):
        raise SettingsError(
            f"{path}: {crs} is {system.name}, which is not a projected CRS; give the projected CRS of the design, for "
            "example EPSG:25832 (--crs)"
        )
    return float(system.axis_info[0].unit_conversion_factor)


def unit_of_heights(crs: str | None) -> float:
    """Return the unit of the heights of a CRS [m]; 1 if the CRS is None or has no heights."""
    axes = [] if crs is None else find_crs(crs).axis_info
    return float(axes[2].unit_conversion_factor) if len(axes) > 2 else 1.0


def get_vertical_datum(crs: str | None) -> CRS | None:
    """Return the vertical CRS of a compound CRS; None for any other CRS."""
    system = None if crs is None else find_crs(crs)
    return system.sub_crs_list[1] if system is not None and system.is_compound else None


@lru_cache(maxsize=64)
def get_geodetic_frame(crs: str) -> CRS:
    """Return the geodetic CRS on which a CRS is based; raise SettingsError if there is none."""
    geodetic = find_crs(crs).geodetic_crs
    if geodetic is None:
        raise SettingsError(f"the CRS {crs!r} has no geodetic frame; give for example EPSG:4258 (ETRS89)")
    # a CRS without a name, such as +proj=utm +zone=32 +datum=WGS84, is identified by its datum
    authority = geodetic.to_authority() if geodetic.name == "unknown" else None
    return geodetic if authority is None else CRS.from_authority(*authority)


@lru_cache(maxsize=32)
def find_operation(crs: str) -> Transformer | None:
    """Return PROJ's best transformation from the frame of a CRS to the working frame.

    The result is None if no transformation is accurate to `MODERN_M`.
    """
    source = get_geodetic_frame(crs)
    sources = [source] if source.name not in SAME else [source, CRS.from_user_input(SAME[source.name][0])]
    for frame in sources:
        for operation in find_operations(frame.to_3d(), CRS.from_user_input(WORKING_FRAME)).usable:
            if 0.0 <= operation.accuracy <= MODERN_M:
                return operation
    return None


@dataclass(frozen=True, kw_only=True)
class Operations:
    """PROJ operations between two CRS that are valid within a box."""

    usable: tuple[Transformer, ...]  #: Usable operations, best first.
    lacking: tuple[Any, ...] = ()  #: Operations whose grids are not installed.

    def describe_lacking(self, crs: str | None = None) -> str:
        """Return a clause on the best operation whose grids are not installed, and on how to get the grids.

        The clause is empty if there is no such operation. The best operation is the most accurate one whose grids
        projsync can download; if there is none, the most accurate of all.
        """
        if not self.lacking:
            return ""
        best = min(self.lacking, key=lambda o: (not _is_served(o), known_accuracy_m(o.accuracy)))
        grids = [grid for grid in best.grids if not grid.available]
        names = " and ".join(grid.short_name for grid in grids)
        get = (
            "; ".join(f"projsync --file {g.short_name}" for g in grids)
            if _is_served(best)
            else f"put it in {get_user_data_dir()}"
        )
        accuracy = f" ({best.accuracy:g} m)" if best.accuracy >= 0.0 else ""
        name = name_operation(best.name, crs)
        return f"{name!r}{accuracy} needs the grid{'s' * (len(grids) > 1)} {names}, not installed ({get})"


def _is_served(operation: Any) -> bool:
    """Return whether all missing grids of an operation can be downloaded from PROJ's content delivery network."""
    return all(grid.available or "cdn.proj.org" in grid.url for grid in operation.grids)


def name_operation(description: str, crs: str | None = None) -> str:
    """Shorten the name of a PROJ operation to the steps that change the datum; `crs` is the source CRS."""
    system = None if crs is None else find_crs(crs).to_2d()
    conversion = None if system is None else system.coordinate_operation
    left_out = (*_NO_DATUM_CHANGE, *([f"Inverse of {conversion.name}"] if conversion is not None else []))
    parts = [part for part in description.split(" + ") if not part.startswith(left_out)]
    return " + ".join(parts) or description


def find_operations(source: CRS, target: CRS, box: Box | None = None) -> Operations:
    """Find PROJ's operations between two CRS that are valid in a box, except ballpark operations.

    Without a box, all operations are returned in PROJ's order. With a box, usable operations worse than `WORST_M` are
    left out.
    """
    area: Any = None if box is None else AreaOfInterest(box[2], box[0], box[3], box[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the result lists missing grids
        try:
            group = TransformerGroup(source, target, always_xy=True, allow_ballpark=False, area_of_interest=area)
        # pyproj raises IndexError for an operation that PROJ knows only at a single epoch
        except (ProjError, IndexError):
            return Operations(usable=())
    if box is None:
        return Operations(usable=tuple(group.transformers), lacking=tuple(group.unavailable_operations))
    usable = [t for t in group.transformers if contains(t.area_of_use, box) and t.accuracy <= WORST_M]
    lacking = [o for o in group.unavailable_operations if contains(o.area_of_use, box) and o.grids]
    return Operations(usable=tuple(sorted(usable, key=rank_operation)), lacking=tuple(lacking))


def rank_operation(operation: Transformer) -> tuple[bool, float]:
    """Return a sort key that puts operations for land first, and then sorts by accuracy."""
    area = "" if operation.area_of_use is None else operation.area_of_use.name
    return "offshore" in area and "onshore" not in area, known_accuracy_m(operation.accuracy)


def known_accuracy_m(accuracy_m: float) -> float:
    """Return an accuracy stated by PROJ [m]; infinity for a negative accuracy, which means unknown."""
    return accuracy_m if accuracy_m >= 0.0 else np.inf


def contains(area: Any, box: Box) -> bool:
    """Return whether an area of use contains a box; True if the area is None."""
    if area is None:
        return True
    south, north, west, east = box
    corners = np.array([south, north]), np.array([west, east])
    return bool(_in_bounds((area.south, area.north, area.west, area.east), *corners, 1e-6).all())


def is_in_area(crs: CRS, latitude_deg: Floats, longitude_deg: Floats, *, margin_deg: float) -> Masks:
    """Return a mask of the points in the area of use of a CRS, extended by a margin; all True for a CRS without an
    area.
    """
    area = crs.area_of_use
    if area is None:
        return np.ones(len(latitude_deg), dtype=bool)
    return _in_bounds((area.south, area.north, area.west, area.east), latitude_deg, longitude_deg, margin_deg)


def _in_bounds(bounds: Box, latitude_deg: Floats, longitude_deg: Floats, margin_deg: float) -> Masks:
    """Return a mask of the points inside bounds extended by a margin; the bounds may cross the date line."""
    south, north, west, east = bounds
    inside = (latitude_deg >= south - margin_deg) & (latitude_deg <= north + margin_deg)
    width = (east - west) % 360.0 if east - west < 360.0 else 360.0
    with np.errstate(invalid="ignore"):  # outside a grid, the longitude is undefined
        from_west = (longitude_deg - west + margin_deg) % 360.0
    return np.asarray(inside & (from_west <= width + 2.0 * margin_deg))
