"""Jammers and spoofers put into the observations of a simulated train."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.core.timescale import seconds
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.gnss.orbits import satellite_states

#: Path loss at 1 m on L1 [dB]; noise of the receiver [dBm/Hz]; bandwidth of a chirp jammer [dB-Hz].
_LOSS_1M_DB, _NOISE_DBM, _BANDWIDTH_DBHZ = 36.4, -172.0, 70.0
#: Below this the receiver tracks nothing [dB-Hz].
TRACKED_DBHZ: Final = 24.0
#: How long a receiver needs to take over signals that do not fit the old ones [s].
_RELOCK_S: Final = 2.0


@dataclass(frozen=True)
class Scene:
    """Observations of one antenna, its true positions, and the satellites."""

    observations: Observations
    navigation: Navigation
    ecef_m: Floats
    sat_ecef_m: Floats

    @classmethod
    def of(cls, observations: Observations, navigation: Navigation, ecef_m: Floats) -> Scene:
        states = satellite_states(
            observations.time, observations.satellite, observations.signal, observations.code_m, navigation
        )
        return cls(observations, navigation, ecef_m, states.position_ecef_m)

    @property
    def seconds(self) -> Floats:
        return seconds(self.observations.time - self.observations.time[0])

    def longer_m(self, ecef_m: Floats) -> Floats:
        """By how much ranges from other positions (T, 3) are longer than the true ones, shape (T, M) [m]."""
        new, old = (np.linalg.norm(self.sat_ecef_m - place[:, None, :], axis=2) for place in (ecef_m, self.ecef_m))
        return new - old

    def lengthened(self, longer_m: Floats, begun: Masks, *, relock: bool) -> Observations:
        """Codes, phases and Dopplers with longer ranges (T, M) from the epochs of the attack on, as one."""
        log = self.observations
        wavelength = SPEED_OF_LIGHT / carrier_frequency_hz(log.satellite, log.signal)
        added = np.where(begun[:, None], longer_m, 0.0)
        rate = np.where(begun[:, None], np.gradient(longer_m, self.seconds, axis=0), 0.0)
        start = self.seconds[np.argmax(begun)]
        lost = relock & (self.seconds >= start) & (self.seconds < start + _RELOCK_S)
        away = np.where(lost[:, None], np.nan, 0.0)
        return replace(
            log,
            code_m=log.code_m + added + away,
            phase_cycles=log.phase_cycles + added / wavelength + away,
            doppler_hz=log.doppler_hz - rate / wavelength + away,
            cn0_dbhz=log.cn0_dbhz + away,
        )


def jammed(scene: Scene, at: int, power_dbm: float, rng: np.random.Generator, *, aside_m: float = 50.0) -> Observations:
    """A jammer of some radiated power, passed at a distance at epoch `at`."""
    log, fall = scene.observations, fall_db(scene, at, power_dbm, aside_m=aside_m)[:, None]
    cn0 = log.cn0_dbhz - fall
    noise = 0.3 * (10.0 ** (fall / 20.0) - 1.0) * rng.standard_normal(log.code_m.shape)
    gone = np.where(cn0 < TRACKED_DBHZ, np.nan, 0.0)
    return replace(
        log,
        code_m=log.code_m + noise + gone,
        phase_cycles=log.phase_cycles + gone,
        doppler_hz=log.doppler_hz + gone,
        cn0_dbhz=cn0 + gone,
    )


def fall_db(scene: Scene, at: int, power_dbm: float, *, aside_m: float = 50.0) -> Floats:
    """Fall of C/N0 by the noise of the jammer, shape (T,) [dB]."""
    distance = np.hypot(np.linalg.norm(scene.ecef_m - scene.ecef_m[at], axis=1), aside_m)
    received = power_dbm - _LOSS_1M_DB - 20.0 * np.log10(distance)
    return 10.0 * np.log10(1.0 + 10.0 ** ((received - _BANDWIDTH_DBHZ - _NOISE_DBM) / 10.0))


def repeated(scene: Scene, at: int, east_north_m: tuple[float, float], delay_m: float) -> Observations:
    """The signals of another antenna sent out again (meaconing), from an epoch on."""
    latitude, longitude, _ = geodetic_from_ecef(scene.ecef_m[at])
    axes = enu_axes(latitude, longitude)
    other = scene.ecef_m[at] + east_north_m[0] * axes[0] + east_north_m[1] * axes[1] + 10.0 * axes[2]
    path = np.linalg.norm(scene.ecef_m - other, axis=1)[:, None] + delay_m
    begun = np.arange(len(scene.ecef_m)) >= at
    return scene.lengthened(scene.longer_m(np.broadcast_to(other, scene.ecef_m.shape)) + path, begun, relock=True)


def pulled(
    scene: Scene,
    at: int,
    rate_mps: float,
    *,
    systems: str = "",
    power: str = "own",
    straight: bool = False,
    rng: np.random.Generator,
) -> Observations:
    """A position pulled along the track from an epoch on, codes, phases and Dopplers agreeing.

    `systems`: of these constellations alone; all where it is blank. `power`: "own" keeps the C/N0 of each satellite,
    "equal" is that of one transmitter. `straight`: in the direction of the track at the first epoch.
    """
    since = np.maximum(scene.seconds - scene.seconds[at], 0.0)
    along = np.gradient(scene.ecef_m, axis=0)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 0.1, along / np.maximum(length, 0.1), np.nan)
    # where the train stands, the direction is that of the epoch before
    row = np.maximum.accumulate(np.where(np.isfinite(along[:, 0]), np.arange(len(along)), 0))
    along = along[row]
    # a train that turns back keeps the direction of the line
    turned = np.where((along[1:] * along[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    along *= np.cumprod(np.concatenate([[1.0], turned]))[:, None]
    along = along[[at]] if straight else along
    chosen = np.isin(scene.observations.system, list(systems or "GJEC"))
    begun = np.arange(len(since)) >= at
    longer = scene.longer_m(scene.ecef_m + (rate_mps * since)[:, None] * along) * chosen
    log = scene.lengthened(longer, begun, relock=False)
    if power == "own":
        return log
    equal = 46.0 + 0.4 * rng.standard_normal(log.cn0_dbhz.shape)
    taken = begun[:, None] & chosen & np.isfinite(log.cn0_dbhz)
    return replace(log, cn0_dbhz=np.where(taken, np.round(equal), log.cn0_dbhz))
