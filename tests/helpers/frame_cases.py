"""Frames of five continents, their definitions, and how far railfix puts them from those."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer

from railfix.core.arrays import Floats
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track.frames import FrameShift, points_at
from railfix.track.georeference import georeference

TIME, YEAR = np.datetime64("2026-07-02T12:00:00"), 2026.5
#: Geocentric codes of the realisations of the ITRF, for a way that is not the code's own.
ITRF = {"91": 4913, "93": 4915, "94": 4916, "96": 4917, "97": 4918, "2000": 4919, "2005": 4896, "2008": 5332}
ITRF |= {"2014": 7789, "2020": 9988}
#: Rotation of plates [mas a year]: Altamimi et al. 2023, table 2.
ROTATION = {
    "EURA": (-0.085, -0.519, 0.753),
    "AMUR": (-0.131, -0.551, 0.837),
    "AUST": (1.487, 1.175, 1.223),
    "PCFC": (-0.404, 1.021, -2.154),
    "SOAM": (-0.261, -0.282, -0.157),
    "NUBI": (0.090, -0.585, 0.717),
    "NOAM": (0.045, -0.666, -0.098),
}
#: Code, place, and definition: the ITRF at an epoch on a plate, or the geocentric code of a frame that PROJ moves.
FRAMES = {
    "CGCS2000": ("EPSG:4490", (31.2, 121.5), ("97", 2000.0, "EURA")),
    "CGCS2000, a grid": ("EPSG:4549", (31.2, 120.5), ("97", 2000.0, "EURA")),
    "KGD2002": ("EPSG:4737", (37.5, 127.0), ("2000", 2002.0, "AMUR")),
    "TWD97": ("EPSG:3826", (25.0, 121.5), ("94", 1997.0, "EURA")),
    "JGD2011": ("EPSG:6677", (35.7, 139.8), ("2008", 2011.4, "EURA")),
    "JGD2000": ("EPSG:4612", (35.7, 139.8), ("94", 1997.0, "EURA")),
    "GSK-2011": ("EPSG:7683", (55.7, 37.6), ("2008", 2011.0, "EURA")), "KSA-GRF17": ("EPSG:9333", (24.7, 46.7), 9331),
    "NZGD2000 of Auckland": ("EPSG:2193", (-36.9, 174.8), ("96", 2000.0, "AUST")),
    "NZGD2000 of Christchurch": ("EPSG:2193", (-43.5, 172.6), ("96", 2000.0, "PCFC")),
    "GDA94": ("EPSG:4283", (-33.9, 151.2), 4938), "GDA2020": ("EPSG:7844", (-33.9, 151.2), 7842),
    "SIRGAS 2000": ("EPSG:4674", (-15.8, -47.9), ("2000", 2000.4, "SOAM")),
    "SIRGAS 2000, a grid": ("EPSG:31983", (-23.5, -46.6), ("2000", 2000.4, "SOAM")),
    "POSGAR 2007": ("EPSG:5340", (-34.6, -58.4), ("2005", 2006.632, "SOAM")),
    "MAGNA-SIRGAS": ("EPSG:4686", (4.6, -74.1), ("94", 1995.4, "SOAM")),
    "SIRGAS-Chile 2016": ("EPSG:9153", (-33.4, -70.7), ("2008", 2016.0, "SOAM")),
    "Hartebeesthoek94": ("EPSG:4148", (-26.2, 28.0), ("91", 1994.0, "NUBI")),
    "Mexico ITRF2008": ("EPSG:6365", (19.4, -99.1), ("2008", 2010.0, "NOAM")),
    "NAD83(CSRS)": ("EPSG:4617", (51.0, -114.1), 8253), "NAD83(CSRS), a grid": ("EPSG:2955", (51.0, -114.1), 8253),
    "NAD83(CSRS)v6": ("EPSG:8252", (45.4, -75.7), 8250), "NAD83(HARN)": ("EPSG:4152", (39.7, -105.0), 6317),
    "NAD83(NSRS2007)": ("EPSG:4759", (39.7, -105.0), 6317), "NAD83(2011)": ("EPSG:6318", (39.7, -105.0), 6317),
    "NAD83(PA11)": ("EPSG:6322", (21.3, -157.9), 6320), "ETRS89": ("EPSG:4258", (50.8, 4.4), 10569),
    "ETRF2000": ("EPSG:9067", (50.8, 4.4), 7930), "RGF93 v2b": ("EPSG:9782", (48.9, 2.4), 7930),
    "EST97": ("EPSG:3301", (59.4, 24.7), 10569), "IGb08": ("EPSG:9017", (50.8, 4.4), ("2008", YEAR, None)),
    "IGb14": ("EPSG:9380", (50.8, 4.4), ("2014", YEAR, None)),
    "IGS20": ("EPSG:10178", (50.8, 4.4), ("2020", YEAR, None)),
    "WGS 84 (G1150)": ("EPSG:9055", (50.8, 4.4), ("2000", YEAR, None)),
    "ITRF2014 of 2010": ("EPSG:9000", (50.8, 4.4), ("2014", 2010.0, "EURA")),
    "ITRF2008 of 2005": ("EPSG:8999", (39.7, -105.0), ("2008", 2005.0, "NOAM")),
    "JGD2011 of 1997": ("EPSG:6668", (34.7, 135.5), ("2008", 1997.0, "EURA")),
}  # fmt: skip
#: Epoch and plate that are given with a map, by name of the frame.
MOTION: dict[str, dict[str, object]] = {
    "ITRF2014 of 2010": {"epoch": 2010.0, "plate": "EURA"},
    "ITRF2008 of 2005": {"epoch": 2005.0, "plate": "NOAM"},
    "JGD2011 of 1997": {"epoch": 1997.0},
}


@dataclass(frozen=True)
class FrameCase:
    """A place of a frame as the map has it, as railfix moves it, and as its definition does; ECEF, shape (1, 3) [m]."""

    place: Floats
    moved: Floats
    expected: Floats
    shift: FrameShift

    @property
    def off_m(self) -> float:
        """Distance from the definition."""
        return float(np.linalg.norm(self.moved - self.expected))


def moved(name: str) -> FrameCase:
    """Move the place of a frame by railfix, and by steps of PROJ or the plate's rotation, which are not railfix's."""
    code, (latitude, longitude), definition = FRAMES[name]
    grid = CRS(code)
    x, y = (np.array([v]) for v in (longitude, latitude))
    if grid.is_projected:
        x, y = Transformer.from_crs(grid.geodetic_crs, grid, always_xy=True).transform(x, y)
    there = georeference(code, x, y, path="map")
    frame, place = there.frame, ecef_from_geodetic(there.latitude_deg, there.longitude_deg, np.array([100.0]))
    by_railfix, shift = points_at(place, frame, TIME, **MOTION.get(name, {}))
    if isinstance(definition, int):
        steps = Transformer.from_crs(definition, 9988, allow_ballpark=False)
        expected = np.stack(steps.transform(*place.T, np.array([YEAR]))[:3], axis=-1)
    else:
        itrf, epoch, plate = definition
        steps = Transformer.from_crs(ITRF[itrf], 9988)
        at = np.stack(steps.transform(*place.T, np.array([epoch]))[:3], axis=-1)
        rate = np.radians(np.array(ROTATION[plate] if plate else (0.0, 0.0, 0.0)) / 3.6e6)
        expected = at + np.cross(rate, at) * (YEAR - epoch)
    return FrameCase(place, by_railfix, expected, shift)
