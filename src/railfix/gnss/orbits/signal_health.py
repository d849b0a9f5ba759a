"""Health and group delay of a signal from Keplerian records."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.core.constants import CARRIER_FREQUENCY, FREQUENCY_L1
from railfix.gnss.navigation import KeplerRecords

#: Galileo: data validity and signal health by band, E1-B, E5a, E5b (RINEX 3.05, table A8; OS SIS ICD 5.1.9.3).
GALILEO_HEALTH: Final[Mapping[str, int]] = {"1": 0b111, "5": 0b111_000, "7": 0b111_000_000}
#: QZSS: bits of the health word that concern a signal (IS-QZSS-PNT-006, 4.1.2.3(4)): L1, L1C/A, L2C, L5, L1C, L1C/B
#: from the most significant one. 1 (no L1C/B) is broadcast by satellites with L1C/A since 2022.
QZSS_HEALTH: Final[Mapping[str, int]] = {
    "1C": 0b110_000, "1E": 0b100_001, "1S": 0b10, "1L": 0b10, "1X": 0b10,
    "2S": 0b1000, "2L": 0b1000, "2X": 0b1000, "5I": 0b100, "5Q": 0b100, "5X": 0b100,
}  # fmt: skip
#: A record that states an accuracy beyond this (GPS and QZSS: URA index 8 and more, 15 is no prediction at all;
#: IS-GPS-200, 20.3.3.3.1.3) is of no use [m]; the performance standard of GPS calls such a signal marginal.
LARGEST_ACCURACY_M: Final = 48.0
#: All bits.
_ANY: Final = -1


def unhealthy(records: KeplerRecords, signal: str) -> Masks:
    """Flag the records in which a signal is unhealthy, shape (n,).

    GPS: any of the six bits. QZSS and Galileo: the bits of the signal; Galileo also where no
    accuracy is predicted (SISA "NAPA", written as -1; OS SDD 1.3, 2.3.1.4 calls that marginal).
    BeiDou: SatH1. All: an accuracy beyond `LARGEST_ACCURACY_M`.
    """
    system = records.satellite.astype("<U1")
    bits = np.full(len(records), _ANY, dtype=np.int64)
    bits[system == "J"] = QZSS_HEALTH.get(signal, _ANY)
    bits[system == "E"] = GALILEO_HEALTH.get(signal[:1], _ANY)
    no_accuracy = ((system == "E") & (records.accuracy_m < 0.0)) | (records.accuracy_m > LARGEST_ACCURACY_M)
    return np.asarray(((records.health & bits) != 0) | no_accuracy)


def group_delay_s(
    records: KeplerRecords, signal: str, *, clock: Literal["broadcast", "ionosphere_free"] = "broadcast"
) -> Floats:
    """Compute the group delay of a signal relative to the satellite clock, shape (n,) [s].

    ======== =====================================================================================
    GPS,     TGD on L1, scaled by (f1/f)^2 elsewhere (IS-GPS-200, 20.3.3.3.3.2). L5 and the civil
    QZSS     L2 signals would need inter-signal corrections that LNAV does not contain: some decimetres.
    Galileo  OS SIS ICD 5.1.5. Clocks of I/NAV refer to E1 and E5b, of F/NAV to E1 and E5a. E1 uses
             the BGD of its clock; E5a and E5b follow from both BGDs. F/NAV has no BGD E5b/E1:
             BGD E5a/E1 is used in its place. NaN on E6, whose delay is not broadcast.
    BeiDou   The clock is that of B3I (B1I ICD 3.0, 5.2.4.10): TGD1 on B1I, TGD2 on B2I, 0 on B3I;
             NaN on signals whose delay D1 and D2 do not contain (B1C, B2a, B2b).
    ======== =====================================================================================

    Parameters
    ----------
    records : KeplerRecords
    signal : str
        RINEX 3 code without its type letter: "1C".
    clock : {"broadcast", "ionosphere_free"}
        Clock of the record, or of SP3 files, which refers to the ionosphere-free pair L1/L2 of GPS and QZSS (the
        same as broadcast), E1/E5a of Galileo, B1I/B3I of BeiDou.
    """
    delay = np.full(len(records), np.nan)
    system = records.satellite.astype("<U1")
    band = signal[:1]
    for letter in ("G", "J"):
        frequency = CARRIER_FREQUENCY[letter].get(band, np.nan)
        here = system == letter
        delay[here] = records.group_delay_1_s[here] * (FREQUENCY_L1 / frequency) ** 2
    here = system == "E"
    delay[here] = _galileo(records, band, always_fnav=clock == "ionosphere_free")[here]
    here = system == "C"
    delay[here] = _beidou(records, signal, ionosphere_free=clock == "ionosphere_free")[here]
    return delay


def _galileo(records: KeplerRecords, band: str, *, always_fnav: bool) -> Floats:
    inav = records.message == "INAV"
    e5a = records.group_delay_1_s
    e5b = np.where(inav, records.group_delay_2_s, e5a)
    on_e1 = e5a if always_fnav else np.where(inav, e5b, e5a)
    # BGD(E1, x) = (delay on E1 - delay on x) / (1 - (f1/fx)^2)
    frequency = CARRIER_FREQUENCY["E"]
    on_e5a = on_e1 - e5a * (1.0 - (FREQUENCY_L1 / frequency["5"]) ** 2)
    on_e5b = on_e1 - e5b * (1.0 - (FREQUENCY_L1 / frequency["7"]) ** 2)
    by_band = {"1": on_e1, "5": on_e5a, "7": on_e5b, "8": 0.5 * (on_e5a + on_e5b)}
    return by_band.get(band, np.full(len(records), np.nan))


def _beidou(records: KeplerRecords, signal: str, *, ionosphere_free: bool) -> Floats:
    tgd1 = records.group_delay_1_s
    by_signal = {"2": tgd1, "6": np.zeros(len(records))}
    # 7I and 7Q are B2I; 7D, 7P and 7Z are B2b.
    if signal in ("7I", "7Q", "7X"):
        by_signal["7"] = records.group_delay_2_s
    delay = by_signal.get(signal[:1], np.full(len(records), np.nan))
    f1, f3 = CARRIER_FREQUENCY["C"]["2"] ** 2, CARRIER_FREQUENCY["C"]["6"] ** 2
    return delay - f1 / (f1 - f3) * tgd1 if ionosphere_free else delay
