r"""The gradient-domain path tracer: one base path and four offset paths that join it as early as they can.

Each base path is a path of Mitsuba's ``path``: the power heuristic combines emitter sampling and BSDF sampling, and
Russian roulette depends on the throughput. Its four offset paths go through the neighbours of its pixel with the same
sub-pixel, lens, time and wavelength samples. Where materials allow it, an offset path goes straight to the base path's
next vertex. Elsewhere (mirrors, glass) it replays the base path's random numbers. Behind the vertex that they share,
both paths are the same and are traced only once. So four offset paths cost about as much as the base path, and not four
times as much.

    x, y              base path, offset path y = T(x); x1 is the base path's next vertex
    L, Le             radiance of the base path: Le is emission that the camera sees directly, L is all other light
    J                 |dT/dx|, the Jacobian of the shift
    p, p'             densities of BSDF sampling for the base path and the offset path, in solid angle
    β, β'             throughput f / p of the base path, and f |J| / p of the offset path, with the *base* path's p
    r                 p(y) |J| / p(x), a product with one ratio for each step (survey, eq. 17); 1 while replaying
    w                 1 / (1 + r), or 1 where the shift is rejected: see data_gen.paths.mis.gradient_weight()
    m                 MIS weight of emitter sampling against BSDF sampling; each path has its own
    C                 the contribution f m of a path that one of these two techniques finds
    Δ                 gradient sample: the sum of 2 w (C(y) |J| - C(x)) / p(x) over all lengths of paths and over both
                      techniques, which are shifted separately
    a                 factor of a settled offset path (see below): radiance R that arrives later adds the product of
                      a and R to Δ
    A                 the base path's part of Δ, the sum of 2 w C(x) / p(x)
    rough             whether the path has scattered smoothly at a connectable vertex
    late              whether it has since left a vertex by a mirror, glass or sharp gloss. Its light then belongs to
                      the layer ``caustic`` and is in neither L nor Δ: see data_gen.paths.caustic

An offset path is *apart* from its base path at first. Then it is *joined* for one step: both paths share a vertex, but
arrive there from different directions. After this step it is *settled*: both paths are the same. Offset paths that have
ended or were rejected are settled, too.

If a base path ends while offset paths are apart, it walks on as a *ghost*, which contributes no light. The ghost goes
on drawing random numbers, only so that the offset paths can replay them. Both paths of a pair use the same numbers, so
r = 1, and the light of these offset paths counts in the differences of this pixel with w = 1/2, as in random sequence
replay. Rejecting these offset paths would double their variance.

All paths begin in ``trace``; the rules of shifting are in ``data_gen.paths.shift``; ``plan`` decides which code a scene
needs in its kernel. ``data_gen.paths.space`` knows whether a vertex is in a medium.

Russian roulette looks at all five paths, which survive together, so that none of them is starved. Its probabilities are
left out of r. This is right: a difference of two pixels is sampled by a shift in either direction, and the weights of
the two shifts sum to one, whatever paths survive.

[Kettunen et al. 2015, "Gradient-Domain Path Tracing"; Hua et al. 2019, "A Survey on Gradient-Domain Rendering",
sections 3 and 4.1]
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.film import SHIFTS, GradientFilm
from data_gen.passes import SamplePass
from data_gen.paths.camera import QUARTERS, CameraSamples
from data_gen.paths.features import features
from data_gen.paths.frozen import Frozen
from data_gen.paths.spectrum import to_rgb
from data_gen.samplers.common import GradientIntegrator
from data_gen.samplers.gpt.plan import Plan, make_plan
from data_gen.samplers.gpt.rounds import sharing
from data_gen.samplers.gpt.trace import trace
from data_gen.samplers.shared import VOLUMETRIC, why_not_shared
from data_gen.scenes.facts import Facts, integrator_name, media_of
from data_gen.tails.cache import Known
from ngpt.errors import NgptError


class GPT(GradientIntegrator):
    """Gradient-domain path tracing with reconnection and random sequence replay, for surfaces and media.

    Plugin ``gpt``, with the parameters of Mitsuba's ``path``, the options of its entry, and

    ``volumes``      false: media are not seen, as with ``path``; true: they are, as with ``volpath``
    ``diagnostics``  false; true adds the layer ``shift_failures``: the share, in [0, 1], of a sample's shifts that
                     failed. A shift fails if it is rejected, or has density 0, at a step that the base path takes

    With ``reuse`` the primal has 2.6 times less variance, but the noise of neighbouring pixels is correlated. The shift
    "half-vector" is rarely better than "replay". For the other options see ``data_gen.paths.caustic`` and
    ``data_gen.tails``.

    Not handled: polarised variants, for which rendering raises NgptError. In media only the shift "replay" works. The
    number of collisions in grids is not limited. Each null event at a mask or a thin pane counts in ``max_depth``.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.roughness_threshold, self.shift = self.options["roughness_threshold"], self.options["shift"]
        self.reuse, self.caustic = self.options["reuse"], self.options["caustic"]
        self.volumes = props.get("volumes", False)
        self.follows = "volpath" if self.volumes else "path"

    @classmethod
    def parameters(cls, scene: mi.Scene) -> dict[str, Any]:
        return super().parameters(scene) | {"volumes": integrator_name(scene) in VOLUMETRIC}

    # Not an attribute, because each render of a plugin decides anew whether paths share their tails.
    @property
    def shared(self) -> bool:
        return self.options["tails"] == "shared"

    def facts(self, scene: mi.Scene, sensor: mi.Sensor) -> Facts:
        found = super().facts(scene, sensor)
        return found if self.volumes else replace(found, media=())

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> SamplePass:
        plan = self.plan(scene)
        frozen = Frozen(scene, plan)
        return sharing(self, plan, frozen, partial(self.sample_pass, frozen, plan))

    def plan(self, scene) -> Plan:
        """Returns the plan: what the kernel for a scene contains. Raises NgptError if paths must share their tails (end
        in the cache of ``data_gen.tails``), but cannot with these options or in this variant.
        """
        volumes = self.volumes and bool(media_of(scene))
        if self.shared and (reason := why_not_shared(self.options, mi.variant())):
            raise NgptError(f"gpt: tails=shared is not possible: {reason}; use tails=paths")
        more = {"caustic": self.caustic, "volumes": volumes, "places": self.places, "shared": self.shared}
        return make_plan(scene, self.limits, self.roughness_threshold, self.shift, **more)

    def sample_pass(self, frozen: Frozen, plan: Plan, known: Known | None, camera: CameraSamples, film: GradientFilm):
        """Traces one base path and its four offset paths for each camera sample. Paths may end where the cache has
        ``known`` light.
        """
        values, Δ, inside, A = frozen(self.samples, plan, known, camera.look((0, 0), *SHIFTS.values(), *QUARTERS))
        if self.reuse:
            values["primal"] = reused(camera, A, Δ, inside) + values["direct"]
        film.put_all(values | dict(zip(SHIFTS, zip(Δ, inside, strict=True), strict=True)))

    def samples(self, plan: Plan, known: Known | None, camera: CameraSamples) -> tuple[dict, list, list, list | None]:
        """Returns the layers, Δ for each neighbour in the order of SHIFTS, whether each neighbour is on the film, and A
        for each neighbour if ``reuse`` needs it.
        """
        # ------------------------- Paths -----------------------------
        scene, (ray, importance, _) = plan.space.scene, camera.rays()
        within = plan.space.around(camera.sensor)
        shifted = [camera.rays(shift) for shift in SHIFTS.values()]
        # Paths and features use clones of the random numbers, so that the numbers drawn for features change no path.
        paths = trace(self, plan, camera.random.clone(), (ray, importance), shifted, within, known=known)
        Le = self.emission_in_pixel(scene, camera, paths.Le, plan.space.media, within)
        L, Le, L_caustic = (to_rgb(light, ray.wavelengths) for light in (paths.L, Le, paths.L_caustic))
        Δ = [to_rgb(y.Δ, ray.wavelengths) for y in paths.offsets]

        # ------------------------ Samples ----------------------------
        inside = [inside for _, _, inside in shifted]
        values = {"primal": L + Le, "direct": Le}
        if plan.matt:
            values["shared"] = to_rgb(paths.shared, ray.wavelengths)
        if plan.caustic:
            values["caustic"] = L_caustic
        values |= features(scene, camera.sensor, camera.random.clone(), ray)
        if self.diagnostics:
            values["shift_failures"] = count([y.failed for y in paths.offsets]) / dr.fmax(count(inside), 1)
        A = [to_rgb(y.A, ray.wavelengths) for y in paths.offsets] if self.reuse else None
        return values, Δ, inside, A


def reused(camera: CameraSamples, A: list, Δ: list, inside: list) -> mi.Color3f:
    """Returns L of each sample: the mean of four estimates, one for each neighbour.

    Each estimate combines a base path of this pixel with an offset path that leads to this pixel from the neighbour's
    sample with the same index. ``A`` is the base path's part; the neighbour's A + Δ is the offset path's part.
    [Kettunen et al. 2015, section 5]
    """
    names, lane = list(SHIFTS), dr.arange(mi.Int32, dr.width(inside[0]))
    L = mi.Color3f(0)
    for a, (x, y), active in zip(A, SHIFTS.values(), inside, strict=True):
        back = names.index(next(name for name, shift in SHIFTS.items() if shift == (-x, -y)))
        # The lane of the neighbouring pixel's sample with the same index, which is in the same block
        neighbour = mi.UInt32(lane + dr.opaque(mi.Int32, camera.block * (x + camera.size.x * y)))
        L += (a + dr.gather(mi.Color3f, A[back] + Δ[back], neighbour, active)) / 8
    return L


def count(flags: list[mi.Bool]) -> mi.Float:
    return sum(dr.select(flag, mi.Float(1), 0) for flag in flags)
