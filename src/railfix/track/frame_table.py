"""Frames that PROJ does not move to today's ITRF: realisations of it, national frames held at an epoch, and other
names.

Definitions are those that the EPSG dataset gives in the words of each datum's anchor (https://epsg.org). What a
country moves against its plate is an order of size, for the notes alone: nothing is moved by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

#: Three-dimensional codes of the realisations of the ITRF.
_ITRF: Final = {
    "ITRF88": "EPSG:7900",
    "ITRF89": "EPSG:7901",
    "ITRF90": "EPSG:7902",
    "ITRF91": "EPSG:7903",
    "ITRF92": "EPSG:7904",
    "ITRF93": "EPSG:7905",
    "ITRF94": "EPSG:7906",
    "ITRF96": "EPSG:7907",
    "ITRF97": "EPSG:7908",
    "ITRF2000": "EPSG:7909",
    "ITRF2005": "EPSG:7910",
    "ITRF2008": "EPSG:7911",
    "ITRF2014": "EPSG:7912",
    "ITRF2020": "EPSG:9989",
}
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
#: Code of the realisation of the ITRF that a frame of a name is.
REALISATIONS: Final = _ITRF | {name: _ITRF[itrf] for itrf, names in _ALIGNED.items() for name in names.split(", ")}


@dataclass(frozen=True)
class HeldFrame:
    """A frame that is a realisation of the ITRF at an epoch."""

    itrf: str  #: Name of the realisation.
    epoch: float  #: [year].
    plate: str  #: Plate of the ITRF2020 model that carries most of the country.
    #: What the country moves against that plate, at the least and the most [mm a year].
    rest_mm: tuple[float, float] = (0.0, 1.0)
    but: str = ""  #: What else is left out.
    #: Another plate, and two places (latitude, longitude) of a line to the right of which it carries the country.
    border: tuple[str, tuple[float, float], tuple[float, float]] | None = None

    @property
    def code(self) -> str:
        """Three-dimensional code of the realisation."""
        return _ITRF[self.itrf]

    def plate_at(self, latitude_deg: float, longitude_deg: float) -> str:
        """The plate that carries a place of the country."""
        if self.border is None:
            return self.plate
        other, (south, west), (north, east) = self.border
        cross = (east - west) * (latitude_deg - south) - (north - south) * (longitude_deg % 360.0 - west)
        return other if cross < 0.0 else self.plate

    def left_out(self, years: float) -> str:
        """What is left out after some years, in words."""
        low, high = (abs(years) * rate / 1000.0 for rate in self.rest_mm)
        return f"its motion against that plate, {low:.2f} to {high:.2f} m, is left out" + (
            f", {self.but}" * bool(self.but)
        )


_ANDES: Final = "as are earthquakes, metres in Chile since 2010"
#: National frames that are a realisation of the ITRF held at an epoch, where PROJ has no motion for them.
HELD: Final = {
    "JGD2011": HeldFrame(
        "ITRF2008", 2011.4, "EURA", (5.0, 30.0), "and the epoch 1997.0 of western Japan, of which --map-epoch is asked"
    ),
    "JGD2000": HeldFrame("ITRF94", 1997.0, "EURA", (5.0, 30.0), "as is the earthquake of 2011, up to 5 m"),
    "KGD2002": HeldFrame("ITRF2000", 2002.0, "AMUR", (0.0, 3.0), "as is the earthquake of 2011, 0.01 to 0.06 m"),
    "China Geodetic Coordinate System 2000": HeldFrame("ITRF97", 2000.0, "EURA", (3.0, 30.0)),
    "TWD97": HeldFrame("ITRF94", 1997.0, "EURA", (0.0, 80.0), "as is the earthquake of 1999"),
    "Hong Kong Geodetic CS": HeldFrame("ITRF96", 1998.121, "EURA", (5.0, 10.0)),
    "Macao 2008": HeldFrame("ITRF2005", 2008.38, "EURA", (5.0, 10.0)),
    "GDM2000": HeldFrame("ITRF2000", 2000.0, "EURA", (3.0, 10.0), "as is the earthquake of 2004, up to 0.2 m"),
    "GSK-2011": HeldFrame("ITRF2008", 2011.0, "EURA", (0.0, 5.0)),
    "TUREF": HeldFrame("ITRF96", 2005.0, "EURA", (0.0, 25.0), "as are the earthquakes of 2023, metres"),
    "IGRS": HeldFrame("ITRF2000", 1997.0, "ARAB", (0.0, 5.0)),
    "ONGD14": HeldFrame("ITRF2008", 2013.15, "ARAB"),
    "NZGD2000": HeldFrame(
        "ITRF96",
        2000.0,
        "AUST",
        (0.0, 35.0),
        "as are the earthquakes of 2010 to 2016, metres; the deformation grid of PROJ (projsync --area-of-use 'New "
        "Zealand') has both",
        border=("PCFC", (-44.6, 167.8), (-37.6, 178.5)),
    ),
    "PNG94": HeldFrame("ITRF92", 1994.0, "AUST", (0.0, 90.0)),
    "RGNC91-93": HeldFrame("ITRF90", 1989.0, "AUST"),
    "RGPF": HeldFrame("ITRF92", 1993.0, "PCFC"),
    "Hartebeesthoek94": HeldFrame("ITRF91", 1994.0, "NUBI"),
    "Moznet": HeldFrame("ITRF94", 1996.9, "SOMA", (0.0, 4.0)),
    "RGRDC 2005": HeldFrame("ITRF2000", 2005.4, "NUBI", (0.0, 2.0)),
    "RGR92": HeldFrame("ITRF91", 1993.0, "SOMA", (0.0, 2.0)),
    "RGM04": HeldFrame("ITRF2000", 2004.0, "SOMA", (0.0, 2.0), "as are the earthquakes of 2018, 0.2 m"),
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
#: Frames whose coordinates are those of another one: its three-dimensional code, and how well.
SAME: Final = {
    "NAD83(CSRS)": (
        "EPSG:8254",
        "its versions 2 to 8 differ by up to 0.03 m in plan where the crust is stable, 0.10 m in height",
    ),
    "NAD83(HARN)": ("EPSG:6319", "it differs by up to 0.1 m, 0.5 m in the west of California"),
    "NAD83(FBN)": ("EPSG:6319", "it differs by up to 0.1 m, 0.5 m in the west of California"),
    "NAD83(NSRS2007)": ("EPSG:6319", "it differs by 0.02 m, up to 0.3 m in the west of California"),
    "RGF93 v2": ("EPSG:7931", "it is that frame at 2009.0"),
    "RGF93 v2b": ("EPSG:7931", "it is that frame at 2019.0"),
}
