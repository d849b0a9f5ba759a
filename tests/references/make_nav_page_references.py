"""Write nav_pages.json: broadcast records, and what cssrlib 1.2.1 reads from pages that are made of them.

Not a dependency of the tests: ``pip install --no-deps cssrlib==1.2.1`` and its `bitstruct`, then
``python tests/references/make_nav_page_references.py``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

from nav_pages import bcnav1_frame, bcnav2_messages, cnav_pages, fnav_pages, words_of  # noqa: E402

#: GPS PRN 30 on 2025-02-15, 17:30, as a RINEX 4 file has its CNAV record.
CNAV = {
    "af0_s": -2.154015528504e-04, "af1": 8.778755500316e-12, "af2": 0.0, "a_dot": -1.091194152832e-02,
    "crs": -1.109375, "delta_n": 4.840023034958e-09, "m0": -1.850114967343, "cuc": -2.188608050346e-07,
    "eccentricity": 7.393874460831e-03, "cus": 1.196842640638e-05, "sqrt_a": 5.153737392546e03, "top": 522_000.0,
    "cic": 9.685754776001e-08, "omega0": 5.215160808152e-01, "cis": -3.725290298462e-08, "i0": 9.360045234312e-01,
    "crc": 133.921875, "omega": -2.430782382266, "omega_dot": -8.035992537681e-09, "i_dot": 1.662569252683e-10,
    "delta_n_dot": 9.589458451713e-14, "ned_0": -6.0, "ned_1": 2.0, "accuracy_index": -2.0, "health": 1.0,
    "group_delay_1_s": 3.725290298462e-09, "ned_2": 7.0, "inter_signal_0": -1.513399183750e-09,
    "inter_signal_1": -2.968590706587e-09, "inter_signal_2": 2.706656232476e-09,
    "inter_signal_3": 3.608874976635e-09, "toe_sow_s": 581_400.0,
}  # fmt: skip
#: A Galileo orbit, every harmonic different.
FNAV = {
    "iod": 89.0, "toe_sow_s": 575_400.0, "af0_s": -4.3e-4, "af1": -7.1e-12, "af2": 3e-18, "sisa": 107.0,
    "group_delay_1_s": 1.1641532182693481e-09, "e5a_health": 1.0, "e5a_invalid": 0.0, "m0": -2.2137,
    "omega_dot": -5.49e-9,
    "eccentricity": 3.21e-4, "sqrt_a": 5440.6123, "omega0": 1.7654, "i_dot": -4.1e-10, "i0": 0.98123, "omega": -1.2345,
    "delta_n": 2.87e-9, "cuc": -5.1e-6, "cus": 9.3e-6, "crc": 151.3, "crs": -109.7, "cic": 3.1e-8, "cis": -6.2e-8,
}  # fmt: skip
#: A BeiDou-3 medium orbit, every harmonic different.
BCNAV2 = {
    "kind": 3.0, "flags": 0.0, "sismai": 5.0, "health": 1.0, "iode": 117.0, "iodc": 629.0, "toe_sow_s": 576_000.0,
    "toc_s": 576_000.0, "af0_s": -5.7e-4, "af1": 1.9e-11, "af2": 4e-19, "group_delay_1_s": -3.2e-9,
    "group_delay_2_s": 1.7e-9, "inter_signal_0": 2.3e-10,
    "inter_signal_1": -4.1e-10, "sqrt_a": 5282.6123, "a_dot": -0.0123, "delta_n": 3.7e-9,
    "delta_n_dot": -2.2e-14, "m0": 1.7321, "eccentricity": 7.31e-4, "omega": -0.9876, "omega0": -2.4567, "i0": 0.95512,
    "omega_dot": -6.79e-9, "i_dot": 2.6e-10, "cuc": -4.4e-6, "cus": 8.7e-6, "crc": 187.3, "crs": -93.7, "cic": 5.5e-8,
    "cis": -3.9e-8,
}  # fmt: skip


def named(eph: Any) -> dict[str, float]:
    """Numbers of cssrlib's ephemeris by the names here."""
    names = {
        "af0_s": "af0", "af1": "af1", "af2": "af2", "delta_n": "deln", "m0": "M0", "eccentricity": "e",
        "omega0": "OMG0",
        "i0": "i0", "omega": "omg", "omega_dot": "OMGd", "i_dot": "idot", "cuc": "cuc", "cus": "cus", "crc": "crc",
        "crs": "crs", "cic": "cic", "cis": "cis", "toe_sow_s": "toes", "group_delay_1_s": "tgd",
    }  # fmt: skip
    return {"sqrt_a": float(np.sqrt(eph.A)), **{name: float(getattr(eph, their)) for name, their in names.items()}}


def main() -> None:
    from cssrlib.gnss import prn2sat, uGNSS
    from cssrlib.rawnav import RawNav

    raw, cnav, fnav = RawNav(), None, None
    for page in cnav_pages(CNAV, 30):
        cnav = raw.decode_gps_cnav(2353, None, prn2sat(uGNSS.GPS, 30), words_of(page)) or cnav
    for kind, page in enumerate(fnav_pages(FNAV, 5), start=1):
        fnav = raw.decode_gal_fnav(2353, None, prn2sat(uGNSS.GAL, 5), kind, words_of(page)) or fnav
    beidou = None
    for page in bcnav2_messages(BCNAV2, 27):
        beidou = raw.decode_bds_b2a(2353, None, prn2sat(uGNSS.BDS, 27), words_of(page)) or beidou
    bits = bcnav1_frame(BCNAV2, 27)  # as cssrlib's decode_sbf.py hands it on
    page = np.concatenate([bits[72:672], np.zeros(8, np.uint8), bits[1272:1536], bits[21:29]])
    b1c = raw.decode_bds_b1c(2353, None, prn2sat(uGNSS.BDS, 27), words_of(page))
    of_beidou = {}
    for message, k, eph in (("bcnav1", 0, b1c), ("bcnav2", 1, beidou)):
        of_beidou[message] = named(eph) | {"a_dot": float(eph.Adot), "delta_n_dot": float(eph.delnd)}
        of_beidou[message] |= {"group_delay_2_s": float(eph.tgd_b), f"isc_{k}": float(eph.isc[k])}
    of_cnav = named(cnav)
    of_cnav |= {"a_dot": float(cnav.Adot), "delta_n_dot": float(cnav.delnd)}
    of_cnav |= {f"isc_{k}": float(cnav.isc[k]) for k in range(4)}
    found = {"cnav": {"given": CNAV, "cssrlib": of_cnav}, "fnav": {"given": FNAV, "cssrlib": named(fnav)}}
    found["bcnav1"] = {"cssrlib": of_beidou["bcnav1"]}
    found["bcnav2"] = {"given": BCNAV2, "cssrlib": of_beidou["bcnav2"]}
    path = ROOT / "tests" / "references" / "nav_pages.json"
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
