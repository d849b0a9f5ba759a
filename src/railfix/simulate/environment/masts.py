"""Masts, beams and wires: diffraction of the direct signal by straight conductors, and scattering off them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Complexes, Floats
from railfix.simulate.environment.correlator import edge_amplitude, per_metre, strip_field
from railfix.simulate.environment.settings import ElectrificationSettings
from railfix.simulate.environment.walls import Rays

#: Conductors are left out below this weight.
_LEAST_WEIGHT: Final = 0.005


@dataclass(frozen=True, kw_only=True)
class Conductor:
    """One straight conductor for each of N rays."""

    #: Its axis in the plane perpendicular to it, from the antenna; shape (N,) [m].
    p: Floats
    q: Floats
    #: Direction to the satellite in that plane, and along the conductor; shape (N,).
    ray_p: Floats
    ray_q: Floats
    ray_axis: Floats
    #: Ends along the axis, from the antenna.
    low_m: Floats | float
    high_m: Floats | float

    width_m: float

    def obstruction(self, wavelength_m: Floats) -> Complexes:
        """Field that the conductor removes from the direct signal (0: nothing), shape (N,).

        The field of a strip times the share of its length that obstructs, and the cosine of the angle to it.
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

    def scattered(self, wavelength_m: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Amplitude, extra path [m], and direction (p, q) of the signal scattered to the antenna from behind.

        A metal cylinder in geometrical optics: sqrt(a cos(b/2) / (2 rho)) with radius a, distance rho and
        bistatic angle b; extra path rho c (1 - cos(phi)), c the part of the ray perpendicular to the conductor and
        phi its angle to it. Half the power has the antenna's polarisation.
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
        """Share of the conductor that obstructs: 1 between its ends, 0 beyond."""
        inside = np.minimum(at_m - self.low_m, self.high_m - at_m) * scale
        return 1.0 - edge_amplitude(inside)


class Electrification:
    """Masts, beams and wires of an electrified line."""

    def __init__(self, settings: ElectrificationSettings) -> None:
        self.settings = settings

    def _number(self, chainage_m: Floats, every: int) -> Floats:
        """Chainage of the nearest of every n-th mast."""
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
        """1 on sides with masts, else 0."""
        side = {"both": sign, "right": 1.0, "left": -1.0}[self.settings.sides]
        return np.where(sign == side, 1.0, 0.0)

    def transmitted(self, rays: Rays) -> Complexes:
        """Direct field behind masts, beam and wires: 1 where nothing obstructs, shape (N,)."""
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

    def scattered(self, rays: Rays) -> list[tuple[Floats, Floats, Floats]]:
        """Amplitude, extra path and its growth [m/m] of the signals scattered by mast and beam, each of shape (N,)."""
        sign = np.where(rays.y > 0.0, -1.0, 1.0)
        conductors = [(self._mast(rays, sign, rays.chainage_m), self._stands(sign))]
        if self.settings.beam_every:
            half = 0.5 * self.settings.spacing_m * self.settings.beam_every
            conductors.append(
                (self._beam(rays, rays.chainage_m - np.sign(rays.x) * half * 0.999), np.ones(len(rays.x)))
            )
        rows = []
        for conductor, stands in conductors:
            amplitude, extra, toward_x, _ = conductor.scattered(rays.wavelength_m)
            rows.append((amplitude * stands, extra, rays.x - toward_x))
        return rows
