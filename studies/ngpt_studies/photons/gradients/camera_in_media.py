"""Camera paths of a pixel and its neighbours through media, side by side from piece to piece: for ``gbre``.

As ``camera``, but a level is a piece of a ray through one medium, up to a vertex or to a boundary that bends nothing.
Where the base path goes through a boundary, the neighbours' paths must do so, too, or end. ``depth`` numbers segments,
and each piece of a segment is a level.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from data_gen.paths import media
from data_gen.samplers.photons.passes import Start
from ngpt_studies.photons.gradients.camera import (
    CameraPaths,
    Level,
    Path,
    at_lanes,
    emission_of,
    scattered,
    survive,
    taken,
)


@dataclass
class Piece(Path):
    """A piece of a camera path through one ``medium`` of extinction ``σ``; β is that with which it begins.

    Where it meets nothing, ``hit.t`` is how far its ray goes.
    """

    medium: mi.MediumPtr
    σ: mi.Spectrum

    def length(self) -> mi.Float:
        return self.hit.t

    def end(self, alive: mi.Bool) -> Path:
        β = self.β * dr.exp(-media.depth(self.σ, self.length()))
        return Path(self.ray, self.hit, β, alive, self.sky)


def ended(hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f) -> mi.PreliminaryIntersection3f:
    hit.t = dr.select(hit.is_valid(), hit.t, media.end_of(ray))
    return hit


class PathsByPieces(CameraPaths):
    """The paths of ``gbre``, ``gbeams`` and ``gplanes``."""

    def is_last(self, number: int) -> bool:
        return False

    def begun(self, start: Level, random, rays: list) -> Level:
        pieces, fog = [], self.world.fog
        for path in (self.first(*ray) for ray in rays):
            medium = dr.gather(mi.MediumPtr, fog.within, dr.zeros(mi.UInt32, dr.width(path.ray)))
            hit = self.integrator.first_surface(self.world.scene, fog.media, path.ray, medium, mi.Bool(True))
            path.hit = ended(hit, path.ray)
            pieces.append(Piece(**vars(path), medium=medium, σ=media.extinction(medium, path.ray)))
        return replace(start, paths=pieces)

    def onward(self, level: Level, random) -> Level:
        """The paths behind the next boundary or event; what they meet there and σ are unknown yet."""
        random, materials = random.clone(), self.world.materials
        u_lobe, u_direction, u_survival = random.next_1d(), random.next_2d(), random.next_1d()
        η, depth, passes, after = level.η, level.depth, self.goes_through(level.paths[0]), []
        for k, piece in enumerate(level.paths):
            # Straight on together with the base path, or by an event at a surface, or the path ends.
            straight = passes & self.goes_through(piece)
            scatters = piece.alive & ~passes & ~self.goes_through(piece) & (depth < self.limits.max_depth)
            at_surface = piece.end(scatters)
            path, eta = scattered(at_surface, materials, u_lobe, u_direction)
            si = at_surface.hit.compute_surface_interaction(piece.ray, active=straight | path.alive)
            d = dr.select(straight, piece.ray.d, path.ray.d)
            changes = si.is_valid() & si.is_medium_transition()
            medium = dr.select(changes, si.target_medium(d), piece.medium)
            β = dr.select(straight, at_surface.β, path.β)
            alive = (straight | path.alive) & (dr.max(β) > 0)
            ray = si.spawn_ray(d)
            ray.maxt = dr.select(straight, piece.ray.maxt - piece.hit.t, ray.maxt)
            after.append(Piece(ray, piece.hit, β, alive, path.sky, medium, piece.σ))
            if k == 0:
                η = dr.select(path.alive, η * eta, η)
        survive(after, u_survival, ~passes & (depth >= self.limits.rr_depth), η)
        depth = dr.select(passes, depth, depth + 1)
        return replace(level, paths=after, depth=depth, η=η, numbers=random.state)

    def further(self, level: Level, random, lanes: mi.UInt32) -> Level:
        scene, depth, pieces = self.world.scene, taken(level.depth, lanes), []
        for piece in (at_lanes(piece, lanes) for piece in level.paths):
            ray, alive, medium = piece.ray, piece.alive, taken(piece.medium, lanes)
            if not self.limits.hide_emitters:
                hit = scene.ray_intersect_preliminary(ray, active=alive)
            else:
                seen = self.integrator.first_surface(scene, self.world.fog.media, ray, medium, alive & (depth == 1))
                hit = dr.select(depth == 1, seen, scene.ray_intersect_preliminary(ray, active=alive & (depth > 1)))
            pieces.append(replace(piece, hit=ended(hit, ray), medium=medium, σ=media.extinction(medium, ray)))
        return self.of_lanes(level, pieces, random.at(lanes), lanes)

    def direct(self, level: Level, start: Start, frozen: Callable) -> mi.Spectrum:
        return frozen(self.seen_directly, level.paths[0])

    def seen_directly(self, base: Piece) -> mi.Spectrum:
        fog, none = self.world.fog, mi.UInt32(0)
        lamps = self.integrator.lamps_in_fog(self.world.scene, fog.media, mi.Ray3f(base.ray), fog.within, none)
        return base.β * lamps

    def emitted(self, level: Level) -> list:
        """``CameraPaths.emitted()`` of those that have met a vertex."""
        paths = self.ends(level.paths)
        for path in paths:
            path.alive &= level.depth > 1
        return emission_of(self.world.scene, paths)

    def at_surfaces(self, level: Level, frozen: Callable) -> list[Path]:
        paths = frozen(self.ends, level.paths)
        dr.eval(paths)
        return paths

    def ends(self, pieces: list[Piece]) -> list[Path]:
        """All paths that end at a surface or escape; those that go on behind a boundary are not alive."""
        passes = self.goes_through(pieces[0])
        return [piece.end(piece.alive & ~passes & ~self.goes_through(piece)) for piece in pieces]

    def goes_through(self, piece: Piece) -> mi.Bool:
        return piece.alive & piece.hit.is_valid() & self.world.fog.media.passes(piece.hit.shape)
