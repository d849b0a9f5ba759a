"""Multipath and blockage along a line as a function of the geometry; diffraction by masts, beams and wires."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Complexes, Floats, Indices, Masks, Strings
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.timescale import seconds
from railfix.gnss.observations import carrier_frequency_hz
from railfix.simulate.environment.correlator import (
    cross_polar_gain,
    edge_amplitude,
    per_metre,
    reflection_amplitude,
    roughness_loss,
    strip_field,
    track_paths,
)
from railfix.simulate.environment.settings import (
    CN0_HORIZON_DBHZ,
    CN0_RISE_DB,
    Disturbance,
    ElectrificationSettings,
    EnvironmentSettings,
    SightGeometry,
)
from railfix.simulate.environment.structures import BEYOND_M, build_structures, draw_sections, tree_rows
from railfix.simulate.environment.walls import (
    FREE_V,
    Rays,
    equipment_amplitude,
    foliage,
    neighbour_clearance,
    neighbour_reflection,
    reflections,
    roof_amplitude,
    second_reflection,
    shadow,
    side_streets,
    street_reflections,
)

_LEAST_WEIGHT: Final = 0.005  #: An obstruction is neglected if the weight of its field is smaller than this.


@dataclass(frozen=True, kw_only=True)
class Conductor:
    """Straight conductor for each of N rays.

    The coordinates are relative to the antenna; the axes p and q are perpendicular to the conductor.
    """

    p: Floats  #: Coordinate p of the conductor relative to the antenna, shape (N,) [m].
    q: Floats  #: Coordinate q of the conductor relative to the antenna, shape (N,) [m].
    ray_p: Floats  #: Component p of the unit vector to the satellite, shape (N,).
    ray_q: Floats  #: Component q of the unit vector to the satellite, shape (N,).
    ray_axis: Floats  #: Component, along the conductor, of the unit vector to the satellite, shape (N,).
    low_m: Floats | float  #: Coordinate of the lower end, along the conductor, relative to the antenna.
    high_m: Floats | float  #: Coordinate of the upper end, along the conductor, relative to the antenna.
    width_m: float

    def obstruction(self, wavelength_m: Floats) -> Complexes:
        """Return the field that the conductor removes from the direct signal, shape (N,).

        The field of an infinite strip is weighted by the obstructing fraction of the conductor and by the cosine of the
        angle between ray and conductor in the plane (p, q).
        """
        plane = np.sqrt(self.ray_p**2 + self.ray_q**2) + 1e-9
        away = np.hypot(self.p, self.q)
        toward = (self.p * self.ray_p + self.q * self.ray_q) / plane
        beside = (self.q * self.ray_p - self.p * self.ray_q) / plane
        far = toward / plane
        scale = per_metre(far, wavelength_m)
        weight = np.maximum(toward, 0.0) / away * self._share(far * self.ray_axis, scale * plane)
        kept = np.flatnonzero(weight > _LEAST_WEIGHT)
        field = np.zeros(len(weight), dtype=np.complex128)
        field[kept] = weight[kept] * strip_field(beside[kept] * scale[kept], self.width_m * scale[kept])
        return field

    def scatter(self, wavelength_m: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return amplitude, extra path [m] and direction (p, q) of the signal scattered to the antenna.

        A conductor scatters only if the antenna is between conductor and satellite. A metal cylinder scatters the
        amplitude sqrt(a cos(b/2) / (2 rho)) in geometrical optics, with radius a, distance rho and bistatic angle b;
        half of the scattered power has the antenna's polarisation. The extra path is rho c (1 - cos(phi)), where c is
        the component of the ray perpendicular to the conductor and phi the angle between this component and the
        direction to the conductor.
        """
        plane = np.sqrt(self.ray_p**2 + self.ray_q**2) + 1e-9
        away = np.hypot(self.p, self.q)
        cosine = (self.p * self.ray_p + self.q * self.ray_q) / (plane * away)
        scale = per_metre(away, wavelength_m)
        share = self._share(away / plane * self.ray_axis, scale * plane)
        # sin(phi / 2) is cos(b / 2).
        half = np.sqrt(np.maximum(0.5 * (1.0 - cosine), 0.0))
        amplitude = np.sqrt(0.5) * np.sqrt(0.25 * self.width_m * half / away) * share
        behind = np.where(cosine < 0.0, np.minimum(1.0, -4.0 * cosine), 0.0)
        return amplitude * behind, away * plane * (1.0 - cosine), plane * self.p / away, plane * self.q / away

    def _share(self, at_m: Floats, scale: Floats) -> Floats:
        """Return the obstructing fraction of the conductor: 1 between its ends, falling to 0 beyond its ends."""
        inside = np.minimum(at_m - self.low_m, self.high_m - at_m) * scale
        return 1.0 - edge_amplitude(inside)


class Electrification:
    """Masts, beams and wires of an electrified line."""

    def __init__(self, settings: ElectrificationSettings) -> None:
        self.settings = settings

    def _number(self, chainage_m: Floats, every: int) -> Floats:
        """Return the chainage of the nearest mast, where only every n-th mast counts, with n = `every`."""
        spacing = self.settings.spacing_m * every
        return self.settings.first_m + spacing * np.rint((chainage_m - self.settings.first_m) / spacing)

    def _mast(self, rays: Rays, sign: Floats, near_m: Floats) -> Conductor:
        s = self.settings
        return Conductor(
            p=self._number(near_m, 1) - rays.chainage_m,
            q=sign * s.lateral_m,
            ray_p=rays.x,
            ray_q=rays.y,
            ray_axis=rays.z,
            low_m=-rays.height_m,
            high_m=s.height_m - rays.height_m,
            width_m=s.width_m,
        )

    def _beam(self, rays: Rays, near_m: Floats) -> Conductor:
        s = self.settings
        return Conductor(
            p=self._number(near_m, s.beam_every) - rays.chainage_m,
            q=np.full(len(near_m), s.beam_height_m - rays.height_m),
            ray_p=rays.x,
            ray_q=rays.z,
            ray_axis=rays.y,
            low_m=-s.lateral_m,
            high_m=s.lateral_m,
            width_m=s.beam_depth_m,
        )

    def _stands(self, sign: Floats) -> Floats:
        """Return 1 on sides with masts, otherwise 0; `sign` is 1 on the right, -1 on the left."""
        side = {"both": sign, "right": 1.0, "left": -1.0}[self.settings.sides]
        return np.where(sign == side, 1.0, 0.0)

    def transmit(self, rays: Rays) -> Complexes:
        """Return the direct field behind masts, beams and wires, shape (N,); 1 where nothing obstructs."""
        s = self.settings
        sign = np.where(rays.y > 0.0, 1.0, -1.0)
        lateral = np.maximum(np.abs(rays.y), 1e-3)
        mast = self._mast(rays, sign, rays.chainage_m + s.lateral_m * rays.x / lateral)
        field = 1.0 - mast.obstruction(rays.wavelength_m) * self._stands(sign)
        if s.beam_every:
            over = s.beam_height_m - rays.height_m
            beam = self._beam(rays, rays.chainage_m + over * rays.x / np.maximum(rays.z, 0.02))
            field = field * (1.0 - beam.obstruction(rays.wavelength_m))
        for height in (s.wire_height_m, s.messenger_height_m):
            field = field * (1.0 - self._wire(rays, height).obstruction(rays.wavelength_m))
        return np.asarray(field)

    def _wire(self, rays: Rays, height_m: float) -> Conductor:
        n = len(rays.x)
        return Conductor(
            p=np.zeros(n),
            q=np.full(n, height_m - rays.height_m),
            ray_p=rays.y,
            ray_q=rays.z,
            ray_axis=rays.x,
            low_m=-1e6,
            high_m=1e6,
            width_m=self.settings.wire_width_m,
        )

    def scatter(self, rays: Rays) -> list[tuple[Floats, Floats, Floats]]:
        """Return the signals that the nearest mast and beam scatter to the antenna.

        Each signal has amplitude, extra path [m] and growth of the extra path with the chainage [m/m], shape (N,) each.
        """
        sign = np.where(rays.y > 0.0, -1.0, 1.0)
        conductors = [(self._mast(rays, sign, rays.chainage_m), self._stands(sign))]
        if self.settings.beam_every:
            half = 0.5 * self.settings.spacing_m * self.settings.beam_every
            conductors.append(
                (self._beam(rays, rays.chainage_m - np.sign(rays.x) * half * 0.999), np.ones(len(rays.x)))
            )
        rows = []
        for conductor, stands in conductors:
            amplitude, extra, toward_x, _ = conductor.scatter(rays.wavelength_m)
            rows.append((amplitude * stands, extra, rays.x - toward_x))
        return rows


#: Chip length divided by the length of a C/A chip, by constellation and band; 1 for other signals (BPSK(1), BOC(1,1)).
CHIP_RATIO: Final = {"C2": 0.5, "C6": 0.1, "E7": 0.1, "E5": 0.1, "E8": 0.1, "G5": 0.1, "J5": 0.1, "C5": 0.1, "C7": 0.1}
ANTENNAS: Final = ("front", "rear")  #: Names of the antennas of the vehicle.
_NO_FIELD: Final = 0.01  #: Reflections with a smaller amplitude are neglected.
PLATFORM_M: Final = 1.1  #: Height of platforms above the rails [m].
_HARMONICS: Final = 4  #: Number of harmonics of the gain ripple over azimuth.
_BLOCK: Final = 8192  #: Number of signals computed in one step; their arrays fit into the processor's cache.
_LEAST_ELEVATION_DEG: Final = 0.5  #: Multipath and blockage are computed only above this elevation [deg].


class Environment:
    """Multipath and blockage along a line.

    `clear_cn0_dbhz` has the C/N0 of an unobstructed signal at the horizon, and the increase of C/N0 from the horizon to
    the zenith. Structures are drawn from the seed; if `EnvironmentSettings.shares` is given, sections are drawn too.
    """

    def __init__(
        self,
        settings: EnvironmentSettings,
        *,
        line_length_m: float,
        seed: int,
        clear_cn0_dbhz: tuple[float, float] = (CN0_HORIZON_DBHZ, CN0_RISE_DB),
    ) -> None:
        self.settings = settings
        self._clear_cn0_dbhz = clear_cn0_dbhz
        self.sections = settings.sections
        if settings.shares:
            self.sections = draw_sections(
                settings.shares, line_length_m, section_length_m=settings.section_length_m, seed=seed
            )
        self.structures = build_structures(self.sections, line_length_m, seed)
        self._trees = tree_rows(settings.trees, line_length_m, seed)
        ends = {"first_m": -BEYOND_M, "last_m": line_length_m + BEYOND_M}
        streets = settings.side_streets
        self._streets = (
            () if streets is None else tuple(side_streets(streets, seed=seed, side=side, **ends) for side in (0, 1))
        )
        self._ripple = _GainRipple(seed)
        self._conductors = None if settings.electrification is None else Electrification(settings.electrification)

    def label_at(self, chainage_m: ArrayLike) -> Strings:
        """Return the kind of section at chainages; "open" outside all sections."""
        section = np.searchsorted(self.structures.borders_m, np.asarray(chainage_m, dtype=np.float64), side="right")
        return self.structures.kinds[section]

    def __call__(self, geometry: SightGeometry) -> Disturbance:
        """Return the disturbance of T epochs and M channels, shapes (T, M); the code is NaN where a signal is lost."""
        shape = geometry.elevation_deg.shape
        code, phase, doppler, cn0 = np.zeros((4, *shape))
        if self.settings.empty:
            return Disturbance(code_m=code, phase_m=phase, doppler_hz=doppler, cn0_db=cn0)
        label = self.label_at(geometry.chainage_m)
        inside = label == "tunnel"
        code[inside], cn0[inside] = np.nan, -99.0
        epoch, channel = np.nonzero((geometry.elevation_deg > _LEAST_ELEVATION_DEG) & ~inside[:, None])
        platform = label == "station"
        clock_s = seconds(geometry.time - geometry.time.astype("datetime64[D]"))
        wavelength = SPEED_OF_LIGHT / carrier_frequency_hz(geometry.satellite, geometry.signal)
        names = zip(geometry.satellite.tolist(), geometry.signal.tolist(), strict=True)
        ratio = np.array([CHIP_RATIO.get(name[0] + signal[:1], 1.0) for name, signal in names])
        receiver = self.settings.receiver
        chip = receiver.chip_m * ratio
        for first in range(0, len(epoch), _BLOCK):
            e, c = epoch[first : first + _BLOCK], channel[first : first + _BLOCK]
            rays = _rays(geometry, e, c, wavelength, self.settings.antenna_height_m)
            field, extra, growth = self._paths(rays, platform[e], clock_s[e])
            got = track_paths(field, extra, growth * geometry.speed_mps[e], rays.wavelength_m, chip[c], receiver)
            clear = self._clear_cn0_dbhz[0] + self._clear_cn0_dbhz[1] * rays.z
            lost = clear + got.gain_db < receiver.tracking_cn0_dbhz
            code[e, c] = np.where(lost, np.nan, got.code_m)
            phase[e, c] = got.phase_m
            doppler[e, c] = -got.rate_mps / rays.wavelength_m
            cn0[e, c] = got.gain_db
            if self.settings.antenna is not None and self.settings.antenna.ripple_sigma_db > 0.0:
                cn0[e, c] += self.settings.antenna.ripple_sigma_db * self._ripple.at(rays, geometry.antenna)
        return Disturbance(code_m=code, phase_m=phase, doppler_hz=doppler, cn0_db=cn0)

    def _paths(self, rays: Rays, platform: Masks, clock_s: Floats) -> tuple[Complexes, Floats, Floats]:
        """Return complex amplitudes, extra paths [m] and their growth [m/m] of all P paths of N signals, shapes (P, N).

        Amplitudes are relative to the unobstructed direct signal; growth is per metre of the antenna's chainage.
        """
        field, delay = self._direct(rays, clock_s)
        nothing = np.zeros(len(rays.x))
        rows: list[tuple[Floats | Complexes, Floats, Floats]] = [(field, delay, nothing)]
        if self.settings.ground_reflection > 0.0:
            rows.append((-self._ground(rays), 2.0 * (rays.height_m - PLATFORM_M * platform) * rays.z, nothing))
        if self._conductors is not None:
            rows += [(-amplitude, extra, growth) for amplitude, extra, growth in self._conductors.scatter(rays)]
        rows += [self._reflection(r, rays) for r in range(len(self.structures.walls))]
        rows += self._further(rays, clock_s)
        for trees in self._trees:
            left, scatter, extra = foliage(trees, rays)
            rows[0] = (rows[0][0] * left, *rows[0][1:])
            rows.append((scatter * np.abs(rows[0][0]), extra, rays.x - 0.5))
        fields, extra_m, growth = zip(*rows, strict=True)
        return np.stack([field.astype(np.complex128) for field in fields]), np.stack(extra_m), np.stack(growth)

    def _further(self, rays: Rays, clock_s: Floats) -> list[tuple[Floats | Complexes, Floats, Floats]]:
        """Return the reflections by walls of side streets, by other vehicles, and by two rows on opposite sides of the
        line (double reflections).
        """
        settings, antenna = self.settings, self.settings.antenna
        rows: list[tuple[Floats | Complexes, Floats, Floats]] = []
        if (streets := settings.side_streets) is not None:
            for amplitude, extra, growth, cosine in street_reflections(
                self._streets, rays, candidates=streets.candidates, roughness_m=streets.roughness_m
            ):
                gain = 1.0 if antenna is None else reflection_amplitude(cosine, rays.z, antenna)
                rows.append((-amplitude * gain, extra, growth))
        if settings.second_reflections == "opposite" and self.structures.walls:
            rows.append(second_reflection(self.structures.walls, rays, antenna))
        for neighbour in settings.neighbours:
            amplitude, extra, growth = neighbour_reflection(neighbour, rays, clock_s)
            # Reflection by metal is left-handed except at grazing incidence.
            gain = 1.0 if antenna is None else float(cross_polar_gain(0.0, antenna))
            rows.append((-amplitude * gain, extra, growth))
        return rows

    def _direct(self, rays: Rays, clock_s: Floats) -> tuple[Complexes, Floats]:
        """Return the direct field and its excess path due to diffraction [m], shapes (N,).

        Only the most obstructing of several walls and vehicles is used.
        """
        v = np.full(len(rays.x), FREE_V)
        for row in self.structures.walls:
            v = np.maximum(v, shadow(row, rays))
        for neighbour in self.settings.neighbours:
            v = np.maximum(v, neighbour_clearance(neighbour, rays, clock_s))
        amplitude = edge_amplitude(v)
        if self.settings.equipment:
            amplitude = amplitude * equipment_amplitude(self.settings.equipment, rays)
        for roofs in self.structures.roofs:
            amplitude = amplitude * roof_amplitude(roofs, rays)
        field = amplitude.astype(np.complex128)
        if self._conductors is not None:
            field *= self._conductors.transmit(rays)
        # The excess path is h^2 / (2 D) for a depth h in the shadow of an edge at distance D.
        return field, 0.25 * rays.wavelength_m * np.clip(v, 0.0, 30.0) ** 2

    def _ground(self, rays: Rays) -> Floats:
        strength = self.settings.ground_reflection * 10.0 ** (-self.settings.receiver.backward_db / 20.0)
        rough = np.full(len(rays.x), self.settings.ground_roughness_m)
        return np.asarray(strength * roughness_loss(rough, rays.z, rays.wavelength_m))

    def _reflection(self, r: int, rays: Rays) -> tuple[Floats, Floats, Floats]:
        """Return amplitude, extra path [m] and growth [m/m] of the reflection by row `r` of walls, shapes (N,).

        Any row on the satellite's side may obstruct the incident ray; rows nearer than the wall may obstruct the
        reflected ray.
        """
        image = reflections(self.structures.walls[r], rays)
        amplitude = image.amplitude.copy()
        if self.settings.antenna is not None:
            amplitude *= reflection_amplitude(image.cosine, rays.z, self.settings.antenna)
        kept = np.flatnonzero(amplitude > _NO_FIELD)
        if len(kept):
            some = rays.take(kept)
            v = np.full(len(kept), FREE_V)
            for row in self.structures.walls:
                v = np.maximum(v, shadow(row, some, x0=image.x_m[kept], y0=image.y_m[kept]))
            back = replace(some, x=image.back_x[kept], y=image.back_y[kept])
            for row in self.structures.walls[:r]:
                v = np.maximum(v, shadow(row, back))
            open_above = np.ones(len(kept))
            for roofs in self.structures.roofs:
                open_above = open_above * roof_amplitude(roofs, back)
            amplitude[kept] *= edge_amplitude(v) * open_above
        return -amplitude, image.extra_m, image.rate


class _GainRipple:
    """Gain ripple of the antennas over azimuth, with standard deviation 1 at the horizon."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 7106])
        self._phase = dict(zip(ANTENNAS, rng.uniform(0.0, 2.0 * np.pi, (len(ANTENNAS), _HARMONICS)), strict=True))

    def at(self, rays: Rays, antenna: str) -> Floats:
        """Return the gain minus the mean gain, shape (N,); the unit is the standard deviation at the horizon."""
        azimuth = np.arctan2(rays.y, rays.x)
        level = np.sqrt(np.maximum(1.0 - rays.z**2, 0.0))
        order = np.arange(1, _HARMONICS + 1)[:, None]
        waves = np.cos(order * azimuth + self._phase[antenna][:, None])
        return np.asarray(level * np.sqrt(2.0 / _HARMONICS) * waves.sum(axis=0))


def _rays(geometry: SightGeometry, epoch: Indices, channel: Indices, wavelength_m: Floats, height_m: float) -> Rays:
    elevation = np.radians(geometry.elevation_deg[epoch, channel])
    relative = np.radians(geometry.azimuth_deg[epoch, channel] - geometry.heading_deg[epoch])
    level = np.cos(elevation)
    return Rays(
        chainage_m=geometry.chainage_m[epoch],
        height_m=height_m,
        x=level * np.cos(relative),
        y=level * np.sin(relative),
        z=np.sin(elevation),
        wavelength_m=wavelength_m[channel],
    )
