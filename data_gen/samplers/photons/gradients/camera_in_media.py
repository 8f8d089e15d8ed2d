"""Camera paths of a pixel and its neighbours through media, side by side from piece to piece: for ``gbre``.

As ``camera``, but a level is a piece of a ray through one medium, up to a vertex or to a boundary that bends nothing.
Where the base path goes through a boundary, those of the neighbours must do so, too, or end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths import media
from data_gen.paths.vertex import Materials
from data_gen.samplers.photons.gradients.camera import Level, Path, scattered
from data_gen.samplers.photons.map.fog import Fog


@dataclass
class Piece(Path):
    """A piece of a camera path through one ``medium`` of extinction ``σ``; β is that with which it begins."""

    medium: mi.MediumPtr
    σ: mi.Spectrum

    def length(self) -> mi.Float:
        return dr.select(self.hit.is_valid(), self.hit.t, dr.inf)

    def end(self, alive: mi.Bool) -> Path:
        """The path where the piece ends."""
        β = self.β * dr.exp(-media.depth(self.σ, self.length()))
        return Path(self.ray, self.hit, β, alive, self.sky_seen)


def levels_in_media(
    scene: mi.Scene,
    fog: Fog,
    materials: Materials,
    random: mi.Sampler,
    rays: list,
    first_surface: Callable,
    hide_emitters: bool,
    max_depth: int,
    rr_depth: int,
    frozen: Callable,
) -> Iterator[Level]:
    """As ``camera.levels()``; ``first_surface`` (scene, ray, medium, active) is what camera rays themselves meet.

    ``depth`` numbers segments, of which each piece is a level.
    """
    n = dr.width(rays[0][0].o)
    lanes, numbers, first = dr.arange(mi.UInt32, n), random.random, True
    η, depth = dr.opaque(mi.Float, 1, n), dr.opaque(mi.UInt32, 1, n)
    limits = dr.opaque(mi.UInt32, max_depth), dr.opaque(mi.UInt32, rr_depth)
    pieces = frozen(begun, scene, fog, rays, first_surface, hide_emitters, fixed=True)
    dr.eval(lanes)
    while True:
        dr.eval(pieces)
        yield Level(first, lanes, depth, pieces[0], pieces[1:])
        pieces, depth, η, numbers = frozen(onward, fog, materials, pieces, depth, η, type(random)(numbers), limits)
        dr.eval(pieces, depth, η, numbers)
        go_on = dr.compress(pieces[0].alive)
        if not dr.width(go_on):
            return
        surfaces = first_surface if hide_emitters else None
        pieces, lanes, depth, η, numbers = frozen(further, scene, pieces, lanes, depth, η, numbers, go_on, surfaces)
        dr.eval(lanes, depth, η, numbers)
        first = False


def begun(scene, fog: Fog, rays: list, first_surface: Callable, hide_emitters: bool) -> list[Piece]:
    """The first pieces of these rays: (ray, importance, whether it is on the film) of each."""
    pieces = []
    for ray, importance, inside in rays:
        ray, n = mi.Ray3f(ray.o, ray.d, ray.time, ray.wavelengths), dr.width(ray)
        # An environment that hides from the camera hides as well behind holes, where nothing has been scattered yet.
        sky_seen = dr.full(mi.Bool, not hide_emitters, n)
        β = mi.Spectrum(importance) + dr.zeros(mi.Spectrum, n)
        alive = inside & (mi.UInt32(0) == dr.zeros(mi.UInt32, n))
        medium = dr.gather(mi.MediumPtr, fog.within, dr.zeros(mi.UInt32, n))
        hit = first_surface(scene, ray, medium, mi.Bool(True))
        pieces.append(Piece(ray, hit, β, alive, sky_seen, medium, media.extinction(medium, ray)))
    return pieces


def through(fog: Fog, piece: Piece) -> mi.Bool:
    """Whether the path goes straight on at the end of the piece."""
    return piece.alive & piece.hit.is_valid() & fog.media.passes(piece.hit.shape)


def ends(fog: Fog, base: Piece, offsets: list[Piece]) -> list[Path]:
    """All paths where they end at a surface, or nowhere; those that go on behind a boundary are not alive."""
    return [piece.end(piece.alive & ~through(fog, base) & ~through(fog, piece)) for piece in (base, *offsets)]


def onward(fog: Fog, materials: Materials, pieces: list[Piece], depth, η, random, limits: tuple) -> tuple:
    """The paths behind the next boundary or event; what they meet there and σ are unknown yet."""
    random, (max_depth, rr_depth) = random.clone(), limits
    u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
    passes, after = through(fog, pieces[0]), []
    for k, piece in enumerate(pieces):
        straight = passes & through(fog, piece)
        at_surface = piece.end(piece.alive & ~passes & ~through(fog, piece) & (depth < max_depth))
        path, eta = scattered(at_surface, materials, u_lobe, u_direction)
        si = at_surface.hit.compute_surface_interaction(piece.ray, active=straight | path.alive)
        d = dr.select(straight, piece.ray.d, path.ray.d)
        changes = si.is_valid() & si.is_medium_transition()
        medium = dr.select(changes, si.target_medium(d), piece.medium)
        β = dr.select(straight, at_surface.β, path.β)
        alive = (straight | path.alive) & (dr.max(β) > 0)
        after.append(Piece(si.spawn_ray(d), piece.hit, β, alive, path.sky_seen, medium, piece.σ))
        if k == 0:
            η = dr.select(path.alive, η * eta, η)
    # All five survive together. As in ``path``: η² undoes what refraction does to radiance.
    brightest = mi.Float(0)
    for piece in after:
        brightest = dr.fmax(brightest, dr.select(piece.alive, dr.max(piece.β), 0))
    endless = passes | (depth < rr_depth)
    survival = dr.select(endless, 1, dr.fmin(brightest * dr.square(η), 0.95))
    after[0].alive &= u_survival < survival
    for piece in after:
        piece.β /= survival
    return after, dr.select(passes, depth, depth + 1), η, random.random


def further(scene, pieces: list[Piece], lanes, depth, η, numbers, go_on: mi.UInt32, first_surface) -> tuple:
    """What belongs to the lanes ``go_on`` alone, up to what their rays hit; ``first_surface`` unless all is seen."""

    def taken(value: Any):
        return dr.gather(type(value), value, go_on)

    depth, found = taken(depth), []
    for piece in pieces:
        old = piece.ray
        time = taken(old.time) if dr.width(old.time) > 1 else old.time
        wavelengths = taken(old.wavelengths) if dr.width(old.wavelengths) > 1 else old.wavelengths
        ray = mi.Ray3f(taken(old.o), taken(old.d), time, wavelengths)
        alive, medium = taken(piece.alive), taken(piece.medium)
        if first_surface is None:
            hit = scene.ray_intersect_preliminary(ray, active=alive)
        else:
            seen = first_surface(scene, ray, medium, alive & (depth == 1))
            hit = dr.select(depth == 1, seen, scene.ray_intersect_preliminary(ray, active=alive & (depth > 1)))
        known = taken(piece.β), alive, taken(piece.sky_seen)
        found.append(Piece(ray, hit, *known, medium, media.extinction(medium, ray)))
    random = mi.PCG32()
    random.state, random.inc = taken(numbers.state), taken(numbers.inc)
    return found, taken(lanes), depth, taken(η), random
