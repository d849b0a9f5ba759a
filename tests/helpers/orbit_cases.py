"""Made navigation records for tests of orbits: plausible numbers of no real satellite."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from railfix.gnss.navigation import GlonassRecords, KeplerRecords, Navigation

TOE = np.datetime64("2024-03-13T08:00:00", "ns")
HOUR = np.timedelta64(3600, "s")

_COMMON: dict[str, Any] = {
    "af0_s": -2.5e-4, "af1": 3.1e-12, "af2": 0.0, "delta_n": 4.3e-9, "omega_dot": -8.1e-9, "i_dot": 2.7e-10,
    "cuc": -3.1e-6, "cus": 8.9e-6, "crc": 210.5, "crs": -41.25, "cic": 1.3e-7, "cis": -9.1e-8, "m0": -1.234567,
    "omega0": 2.04, "omega": 0.71, "health": 0, "accuracy_m": 2.0, "iode": 7, "iodc": 7, "data_source": 0,
    "group_delay_1_s": -1.1e-8, "group_delay_2_s": np.nan, "fit_interval_h": np.nan,
    "a_dot": 0.0, "delta_n_dot": 0.0, "inter_signal_s": (np.nan,) * 6,
}  # fmt: skip
#: One satellite of each kind: what differs from the common numbers.
KINDS: dict[str, dict[str, Any]] = {
    "G05": {"message": "LNAV", "sqrt_a": 5153.65, "eccentricity": 0.0059, "i0": 0.972, "fit_interval_h": 4.0},
    "J02": {
        "message": "LNAV", "sqrt_a": 6493.3, "eccentricity": 0.0751, "i0": 0.7101, "omega": -1.571,
        "fit_interval_h": 2.0,
    },
    "E11": {
        "message": "INAV", "sqrt_a": 5440.61, "eccentricity": 0.000231, "i0": 0.958, "data_source": 517,
        "group_delay_1_s": -3.3e-9, "group_delay_2_s": -4.1e-9, "accuracy_m": 3.12,
    },
    "E14": {
        "message": "FNAV", "sqrt_a": 5289.4, "eccentricity": 0.1661, "i0": 0.872, "data_source": 258,
        "group_delay_1_s": 2.2e-9, "group_delay_2_s": 0.0, "accuracy_m": 3.12,
    },
    "C20": {
        "message": "D1", "sqrt_a": 5282.63, "eccentricity": 0.00093, "i0": 0.9637,
        "group_delay_1_s": 2.3e-8, "group_delay_2_s": 1.7e-8,
    },
    "C03": {
        "message": "D2", "sqrt_a": 6493.36, "eccentricity": 0.00037, "i0": 0.0888, "crc": -620.0,
        "group_delay_1_s": 5.1e-9, "group_delay_2_s": -9.0e-9,
    },
    "C38": {
        "message": "D1", "sqrt_a": 6493.1, "eccentricity": 0.0021, "i0": 0.9701,
        "group_delay_1_s": 1.0e-9, "group_delay_2_s": 2.0e-9,
    },
}  # fmt: skip


def kepler(*rows: dict[str, Any]) -> KeplerRecords:
    """Records; each row names its satellite and what differs from the made numbers of that kind."""
    full = []
    for row in rows:
        values = {**_COMMON, **KINDS.get(row["satellite"], {"message": "LNAV", "sqrt_a": 5153.7, "i0": 0.96}), **row}
        values.setdefault("eccentricity", 0.004)
        toe = values.setdefault("toe", TOE)
        values.setdefault("toc", toe)
        values.setdefault("transmitted", np.datetime64("NaT", "ns"))
        own = toe - np.timedelta64(14, "s") if row["satellite"][0] == "C" else toe
        sow = (own - np.datetime64("1980-01-06", "ns")) / np.timedelta64(1, "s") % 604_800
        values.setdefault("toe_sow_s", float(sow))
        full.append(values)
    kinds = {"satellite": "<U3", "message": "<U4", "toc": "M8[ns]", "toe": "M8[ns]", "transmitted": "M8[ns]"}
    kinds |= dict.fromkeys(("health", "iode", "iodc", "data_source"), "int64")
    table = {
        item.name: np.array([row[item.name] for row in full], dtype=kinds.get(item.name, "float64"))
        for item in fields(KeplerRecords)
    }
    return KeplerRecords(**{**table, "inter_signal_s": table["inter_signal_s"].reshape(-1, 6)})


def glonass(*rows: dict[str, Any]) -> GlonassRecords:
    """GLONASS records; each row names its satellite and what differs from the made numbers."""
    common: dict[str, Any] = {
        "toe": TOE, "transmitted": np.datetime64("NaT", "ns"), "clock_bias_s": 5.3e-5, "relative_frequency": 1.8e-12,
        "position_ecef_m": (10_908_942.38, -2_885_726.07, 22_883_539.55),
        "velocity_ecef_mps": (1407.806396, 2795.855522, -316.998482),
        "acceleration_ecef_mps2": (-1.862645e-6, 0.931323e-6, -2.793968e-6),
        "health": 0, "frequency_channel": 1, "age_days": 0.0,
    }  # fmt: skip
    full = [{**common, **row} for row in rows]
    kinds = {"satellite": "<U3", "toe": "M8[ns]", "transmitted": "M8[ns]", "health": "int64"}
    kinds["frequency_channel"] = "int64"
    shapes = {name: (len(rows), 3) for name in common if name.endswith(("_m", "_mps", "_mps2"))}
    return GlonassRecords(
        **{
            item.name: np.array([row[item.name] for row in full], dtype=kinds.get(item.name, "float64")).reshape(
                shapes.get(item.name, (len(rows),))
            )
            for item in fields(GlonassRecords)
        }
    )


def navigation(*rows: dict[str, Any], **more: Any) -> Navigation:
    """All rows as one `Navigation`."""
    return Navigation(
        kepler=kepler(*[r for r in rows if r["satellite"][0] != "R"]),
        glonass=glonass(*[r for r in rows if r["satellite"][0] == "R"]),
        **more,
    )


def one_record(source: Navigation, row: int, *, of_glonass: bool = False) -> Navigation:
    """A `Navigation` with a single record of another one."""
    table: KeplerRecords | GlonassRecords = source.glonass if of_glonass else source.kepler
    single = type(table)(**{item.name: getattr(table, item.name)[row : row + 1] for item in fields(table)})
    if isinstance(single, GlonassRecords):
        return replace(source, kepler=kepler(), glonass=single)
    return replace(source, kepler=single, glonass=glonass())
