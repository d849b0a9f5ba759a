"""Orbits of SBAS satellites on L5: messages of SouthPAN place it where it is; traps by hand."""

import numpy as np
import pytest

from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.timescale import from_week
from railfix.ranges.sbas import DfmcService, SbasMessages
from railfix.ranges.sbas.dfmc import SbasOrbits, almanacs, ephemerides
from railfix.ranges.sbas.messages import message_type
from railfix.simulate import sbas_stream as stream

pytestmark = pytest.mark.requirement("C5")
#: GPS week, and seconds of the week, first 226 bits of types 39, 40 and 47 as PRN 122 sent them (cssrlib-data).
SENT = (
    (
        2286,
        (525655, "59c310000000000000000fe25bd297eb239213fd94093280000000000"),
        (525715, "5a005b7843680000001aad64a883880000000000000000000000003fc"),
        (525682, "9bc3475cb40016efe2feb201fd6440000000000000000000000000008"),
    ),
    (
        2353,
        (579643, "59c3500000000000000019669f655dbdb98605324974b200000000000"),
        (579732, "aa1065e15d680000001aaaa69b9de60000000000000000000000003fc"),
        (579667, "5bc3475c5c00199966dbdc01321a20000000000000000000000000008"),
    ),
    (
        2380,
        (370832, "c9c350000000000000000866cb57c9a7054008718c38a680000000000"),
        (370889, "3a106b391aa80000001aace7060c500000000000000000000000003fc"),
        (370852, "9bc3475ca4001ac8671a70007174e0000000000000000000000000008"),
    ),
)


def received(week: int, *sent: tuple[float, np.ndarray]) -> SbasMessages:
    sent = tuple(sorted(sent, key=lambda item: item[0]))
    bits, rows = np.array([bits for _, bits in sent], dtype=np.uint8), np.arange(len(sent))
    return SbasMessages(
        time=np.array([from_week(week, t) for t, _ in sent]), prn=np.full(len(rows), 122), bits=bits,
        type=message_type(bits, "L5"), parity_bits=rows * 0 + 24, source=rows * 0, line=rows + 1, band="L5",
    )  # fmt: skip


def real(week: int, *sent: tuple[int, str]) -> SbasMessages:
    return received(week, *((t, np.frombuffer(bytes.fromhex(f"{text:0<64}"), dtype=np.uint8)) for t, text in sent))


def made(*, issue: int = 0, rate: int = 0, provider: int = 1, eccentricity: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Types 39 and 40 of PRN 123: clock 1 m with 0.001 m/s, axis 42,164,000 m, perigee at 06:00."""
    first = stream.message(
        39, 0, (4, 6), (issue, 2), (provider, 5), (0, 19), (0, 19), (rate, 22), (0, 34), (0, 34), (0, 34), (50, 25),
        (25, 16),
    )  # fmt: skip
    second = stream.message(
        40, 1, (issue, 2), (0, 33), (eccentricity, 30), (round((42_164_000 - 6_370_000) / 0.02), 31), (1350, 13),
        (6, 3), *((k, 9) for k in (1, 2, 3, 4)), *((k, 10) for k in (-1, 0, 0, 0, 0, 5)), (7, 4), (3, 4),
    )  # fmt: skip
    return first, second


def orbits(*messages: np.ndarray, apart_s: float = 1.0, valid_s: float = 240.0) -> SbasOrbits:
    return ephemerides(received(2353, *((21600.0 + apart_s * k, m) for k, m in enumerate(messages))), valid_s)


@pytest.mark.parametrize("case", SENT)
def test_southpan_says_where_its_satellite_is(case) -> None:  # type: ignore[no-untyped-def]
    """Inmarsat-4 F1 is at 143.5 degrees east; no eccentricity (2e-4) is sent: 12 km, and 0.02 degrees either way."""
    log = real(*case)
    found, known = ephemerides(log, 240.0), almanacs(log)
    assert (found.prn.tolist(), found.provider.tolist()) == ([122], [8])
    assert (known.prn.tolist(), known.provider.tolist()) == ([122], [8])
    time = log.time[found.row]
    assert -120.0 < (found.reference - time)[0] / np.timedelta64(1, "s") < 0.0
    place = found.position_ecef_m(time)[0]
    latitude, longitude, _ = geodetic_from_ecef(place)
    assert longitude == pytest.approx(143.5, abs=0.4)
    assert abs(latitude) < 5.0
    assert np.linalg.norm(place) == pytest.approx(42_164e3, abs=15e3)
    # steps of an almanac: 650 m and 0.01 to 0.02 degrees (16 km)
    assert np.linalg.norm(known.position_ecef_m(time)[0] - place) < 8e3


def test_an_orbit_is_that_of_the_one_before_carried_on() -> None:
    """Steps of anomalies and times: 96 s later the satellite has gone 0.4 degrees."""
    later = (
        (579738, "a9c3900000000000000019669f655dbdb9860532db814780000000000"),
        (579834, "aa2065e15d680000001aaaa69b9df20000000000000000000000003fc"),
    )
    found = ephemerides(real(*SENT[1], *later), 240.0)
    assert (found.reference[1] - found.reference[0]) / np.timedelta64(1, "s") == 96.0
    assert np.degrees(np.diff(found.orbits.m0)) == pytest.approx(0.4011, abs=1e-4)
    before, after = found.position_ecef_m(np.repeat(found.reference[1], 2))
    assert np.linalg.norm(after - before) < 0.1


def test_an_ephemeris_by_hand() -> None:
    found = orbits(*made(eccentricity=2**20))
    assert found.prn.tolist() == [123]
    # perigee, a (1 - 2^-10), at the node, which was on the meridian of Greenwich at midnight
    place = found.position_ecef_m(found.reference)[0]
    assert np.linalg.norm(place) == pytest.approx(42_164_000 * (1 - 2.0**-10), abs=0.01)
    assert geodetic_from_ecef(place)[1] == pytest.approx(-np.degrees(7.292115146e-5 * 21600), abs=1e-6)


def test_parts_of_one_issue_belong_together() -> None:
    one, other = made(issue=1), made(issue=2)
    assert len(orbits(one[0], other[1]).prn) == 0
    assert orbits(one[1], one[0]).row.tolist() == [1], "in any order"
    assert len(orbits(*one, apart_s=241.0).prn) == 0


def test_what_is_not_known_gives_no_position() -> None:
    """An inclination rate, whose scale sources differ in, and the layout of BDSBAS."""
    found = orbits(*made(rate=1))
    assert not found.usable[0]
    assert np.isnan(found.position_ecef_m(found.reference)).all()
    assert found.notes() == ()
    assert len(orbits(*made(provider=5)).prn) == 0


def test_the_service_says_where_its_satellite_is() -> None:
    week, first, second, almanac = SENT[1]
    degradation = received(week, (579600.0, stream.parameters(1)))
    for sent in ((first, second), (almanac,)):
        own = DfmcService(degradation.merge(real(week, *sent)), prn=122)
        assert own.notes[-1].startswith("according to its own messages, PRN 122 is at 143.7 degrees east, 42,161 km")
