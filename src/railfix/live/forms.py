"""Message forms: functions that encode an output as bytes.

``json``: one line per message. ``cbor``: see `railfix.io.train_message`; in files and streams, each message is preceded
by its length in two bytes, most significant first. ``nmea``: GGA, RMC, GST. ``tpv``: gpsd TPV report. ``etcs``:
SUBSET-026 position report (packet 0), one JSON line. ``positions``, ``train``, ``passings``: rows of the result tables,
one JSON line per row.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.core.timescale import GPS_EPOCH, gpst_minus_utc
from railfix.io.train_message import MessageStatus, TrainMessage, Unknown, encode, etcs_report, to_json
from railfix.live.engine import LiveOutput
from railfix.live.settings import LiveSettings
from railfix.pipeline.results import Result
from railfix.run.tally import TABLES

Form = Callable[[LiveOutput], bytes]
#: No ETCS position report is made if the uncertainty is at least this, because reports cannot express it [cm].
_LONGEST_DOUBT_CM: Final = 32_700_000


def json_bytes(output: LiveOutput) -> bytes:
    """Return the message as a JSON line."""
    return to_json(output.message).encode() + b"\n"


def cbor_bytes(output: LiveOutput) -> bytes:
    """Return the message in CBOR, preceded by its length in two bytes."""
    data = encode(output.message)
    return len(data).to_bytes(2, "big") + data


def nmea_bytes(output: LiveOutput) -> bytes:
    """Return the NMEA 0183 sentences GGA, RMC and GST of the first antenna.

    The result is empty if the output belongs to a period without input. Without a position, GGA and RMC have no
    coordinates, and GST is omitted.
    """
    place = _geodetic(output)
    if output.result is None:
        return b""
    utc = _utc(output.message)
    clock = f"{utc[11:13]}{utc[14:16]}{utc[17:19]}.{utc[20:22]}"
    day = f"{utc[8:10]}{utc[5:7]}{utc[2:4]}"
    valid = output.message.status in (MessageStatus.POSITION, MessageStatus.COASTING)
    used = max((int(a.n_used[-1]) for a in output.result.antennas.values()), default=0)
    if place is None:
        sentences = [f"GPGGA,{clock},,,,,0,{used:02d},,,M,,M,,", f"GPRMC,{clock},V,,,,,,,{day},,,N"]
        return b"".join(map(_sentence, sentences))
    latitude, longitude, height, sigma = place
    angles = (
        f"{_angle(latitude, 2)},{'N' if latitude >= 0 else 'S'},{_angle(longitude, 3)},{'E' if longitude >= 0 else 'W'}"
    )
    quality = (6 if output.message.status is MessageStatus.COASTING else 1) if valid else 0
    speed = output.message.speed_cmps
    knots = "" if speed is None else f"{abs(speed) * 0.01 * 3600.0 / 1852.0:.2f}"
    sentences = [
        f"GPGGA,{clock},{angles},{quality},{used:02d},,{height:.2f},M,0.00,M,,",
        f"GPRMC,{clock},{'A' if valid else 'V'},{angles},{knots},,{day},,,{'A' if valid else 'N'}",
        f"GPGST,{clock},,{sigma:.2f},,,{sigma:.2f},{sigma:.2f},{2 * sigma:.2f}",
    ]
    return b"".join(map(_sentence, sentences))


def gga_sentence(output: LiveOutput) -> bytes:
    """Return the GGA sentence of a valid position; the result is empty if the output has no valid position."""
    valid = output.message.status in (MessageStatus.POSITION, MessageStatus.COASTING)
    return nmea_bytes(output).split(b"\r\n")[0] + b"\r\n" if valid and _geodetic(output) is not None else b""


def tpv_bytes(output: LiveOutput) -> bytes:
    """Return a gpsd TPV report as a JSON line, with the height above the ellipsoid (altHAE)."""
    place = _geodetic(output)
    report: dict[str, Any] = {"class": "TPV", "device": "railfix", "mode": 1, "time": _utc(output.message)[:23] + "Z"}
    if place is not None:
        latitude, longitude, height, sigma = place
        report |= {"mode": 3, "lat": round(latitude, 9), "lon": round(longitude, 9), "altHAE": round(height, 3)}
        report["eph"] = round(sigma, 3)
    if output.message.speed_cmps is not None:
        report["speed"] = abs(output.message.speed_cmps) / 100.0
    return json.dumps(report, separators=(",", ":")).encode() + b"\n"


def etcs_form(settings: LiveSettings) -> Form:
    """Return the form that encodes SUBSET-026 position reports (packet 0) as JSON lines.

    `settings` specifies the reference location. There is no report if the front end's position is unknown, or if its
    bound is unknown or exceeds the packet's range (327 km).
    """

    def etcs_bytes(output: LiveOutput) -> bytes:
        message = output.message
        if message.chainage_cm is None or message.over_cm is None or message.over_cm >= _LONGEST_DOUBT_CM:
            return b""
        if Unknown.FRONT_END in message.unknown:
            return b""
        report = etcs_report(message, reference_cm=round(settings.reference_m * 100.0), reference=settings.reference)
        return json.dumps(report, separators=(",", ":")).encode() + b"\n"

    return etcs_bytes


def _rows_form(table_of: Callable[[Result], pl.DataFrame | None]) -> Form:
    """Return the form that encodes a table's rows, one JSON line per row; without rows, the form yields no bytes."""

    def rows_bytes(output: LiveOutput) -> bytes:
        table = None if output.result is None else table_of(output.result)
        return b"" if table is None else _json_rows(table)

    return rows_bytes


#: Form that encodes the rows of each table in `TABLES`.
ROW_FORMS: Final = {name: _rows_form(table_of) for name, table_of in TABLES.items()}


def _json_rows(table: pl.DataFrame) -> bytes:
    """Return the rows as JSON lines. Numbers have all digits; NaN is null, and infinities are "inf" and "-inf"."""
    texts = table.with_columns(pl.col(pl.Datetime).dt.strftime("%Y-%m-%dT%H:%M:%S%.9f"))
    lines = []
    for row in texts.iter_rows(named=True):
        values = {
            name: None if value != value else str(value) if value in (math.inf, -math.inf) else value
            for name, value in row.items()
        }
        lines.append(json.dumps(values, separators=(",", ":"), allow_nan=False))
    return "".join(line + "\n" for line in lines).encode()


def forms(settings: LiveSettings) -> dict[str, Form]:
    """Return all message forms by name."""
    return {
        "json": json_bytes,
        "cbor": cbor_bytes,
        "nmea": nmea_bytes,
        "tpv": tpv_bytes,
        "etcs": etcs_form(settings),
        **ROW_FORMS,
    }


def _geodetic(output: LiveOutput) -> tuple[float, float, float, float] | None:
    """Return latitude, longitude [deg], ellipsoidal height, sigma [m] of the first antenna; None if any is unknown."""
    place = output.place
    if place is None or place.geodetic is None or not math.isfinite(place.sigma_m):
        return None
    return *place.geodetic, place.sigma_m


def _utc(message: TrainMessage) -> str:
    """Return the UTC time of a message, ISO 8601 to the microsecond."""
    gpst = GPS_EPOCH + np.timedelta64(message.time_ns, "ns")
    return str((gpst - gpst_minus_utc(gpst).astype("timedelta64[s]")).astype("datetime64[us]"))


def _angle(value: float, digits: int) -> str:
    """Return the magnitude of an angle [deg] in NMEA format, ddmm.mmmmmmm, with `digits` digits for the degrees."""
    minutes = round(abs(value) * 60.0, 7)
    return f"{int(minutes // 60):0{digits}d}{minutes % 60:010.7f}"


def _sentence(body: str) -> bytes:
    checksum = 0
    for value in body.encode("ascii"):
        checksum ^= value
    return f"${body}*{checksum:02X}\r\n".encode("ascii")


def wants(form: Form, output: LiveOutput) -> bool:
    """Return whether a form applies to an output: table forms require rows, all other forms require a message."""
    return output.part != ("message" if form in ROW_FORMS.values() else "rows")


def whole_message(form: Form, output: LiveOutput) -> bytes:
    """Return the encoded message for a target that separates messages, without the length prefix that streams need."""
    data = form(output)
    return data[2:] if form is cbor_bytes else data
