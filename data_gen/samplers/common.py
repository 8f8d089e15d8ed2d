"""Code that several samplers share: the estimates of Mitsuba's integrators, and the base class of our plugins."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Self

import drjit as dr
import mitsuba as mi
import numpy as np

from data_gen.budget import Budget
from data_gen.film import GradientFilm
from data_gen.passes import SamplePass, render_passes
from data_gen.paths import segments
from data_gen.paths.camera import QUARTERS, CameraSamples
from data_gen.paths.frozen import Frozen
from data_gen.paths.holes import has_holes
from data_gen.paths.lights import emission_in_pixel, emission_seen
from data_gen.paths.media import Media
from data_gen.paths.walk import Limits
from data_gen.samplers.registry import SAMPLERS, Sampler, by_plugin, find
from data_gen.samplers.sharing import sharing_of
from data_gen.scenes.cameras import check_camera
from data_gen.scenes.facts import Facts, scene_facts, shapes_of
from data_gen.scenes.integrators import own_estimate
from data_gen.scenes.lamps import Places, weighed
from data_gen.scenes.load import check_scene, path_depths, reference_integrator
from data_gen.scenes.lost import without_size
from ngpt.layers import LAYERS
from ngpt.options import written


def loses_light(scene: mi.Scene, integrator: mi.SamplingIntegrator) -> bool:
    """Whether the integrator is Mitsuba's ``path``, and ``path`` is biased in this scene.

    Holes are surfaces that let a share of the light go straight through. ``path`` returns 0 for a path that escapes
    after passing only holes, and drops the light that emitter sampling found at partly opaque masks. Scenes with an
    environment are not affected by this. ``path`` also never finds light that lamps without size send through holes.
    """
    if integrator.class_name() != "PathIntegrator":
        return False
    found = scene.environment() or integrator.hide_emitters
    if found and not without_size(scene):
        return False
    return any(has_holes(shape.bsdf()) for shape in shapes_of(scene) if shape.bsdf())


def radiance(scene: mi.Scene, integrator: mi.SamplingIntegrator) -> Callable[..., mi.Spectrum]:
    """A function (sampler, ray, medium, active) -> radiance of the integrator, or of ``prb`` if it ``loses_light``."""
    if loses_light(scene, integrator):
        integrator = mi.load_dict({"type": "prb", **path_depths(integrator)})
    return own_estimate(scene, integrator)


def recorded(
    scene: mi.Scene, samples: Callable[[CameraSamples], dict], *owners: object, shifts: Iterable = QUARTERS
) -> SamplePass:
    """Returns a pass that puts the results of ``samples`` on the film. ``samples`` is recorded once: see ``Frozen``.

    Besides the camera rays, ``samples`` may use rays displaced by the ``shifts``.
    """
    frozen = Frozen(scene, *owners)
    return lambda camera, film: film.put_all(frozen(samples, camera.look((0, 0), *shifts)))


class GradientIntegrator(mi.SamplingIntegrator):
    """An integrator that renders the layers of a gradient stack.

    ``render()`` returns a tensor (height, width, channels) whose channels ``aov_names()`` lists, in the order of the
    layers of a stack. The film's reconstruction filter is not used, since a gradient is a difference of box-filtered
    pixels. Derived classes implement ``begin()``.
    """

    follows = "path"  # Mitsuba's integrator whose image is rendered
    nested = False  # whether another integrator traces the paths; then there are no ``limits``

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        # The name of the sampler. Its ``entry`` in the registry has the options and the refusals
        self.name = by_plugin(props.plugin_name()).name
        self.options = self.entry.settings({name: props[name] for name in self.entry.options if name in props})
        # Whether the user has set the option ``tails``. If not, ``share_tails`` sets the option for each render
        self.given_tails = "tails" in self.entry.options and "tails" in props
        # Whether the film counts failed shifts, if the sampler ``diagnoses`` them
        self.diagnostics = props.get("diagnostics", False)
        if not self.nested:
            self.limits = Limits.read(props)
        self.channels: list[str] = []
        # Chooses lamps, if the sampler can choose lamps by place and the scene has many lamps
        self.places: Places | None = None

    # Not an attribute, because Dr.Jit traverses all attributes if an integrator is among the variables of a loop.
    @property
    def entry(self) -> Sampler:
        return SAMPLERS[self.name]

    @classmethod
    def like_path(cls, scene: mi.Scene, plugin: str, places: Places | None = None, **options) -> Self:
        """An integrator ``plugin`` of this class, with the parameters of the scene's ``path`` and the ``options``.

        Lamps are chosen by ``places``. Raises NgptError where the parameters cannot be read.
        """
        props = mi.Properties(plugin)
        for name, value in (cls.parameters(scene) | options).items():
            props[name] = value
        integrator = cls(props)
        integrator.places = places
        return integrator

    @classmethod
    def parameters(cls, scene: mi.Scene) -> dict[str, Any]:
        """Returns the parameters that this integrator takes over from the scene's own."""
        return Limits.of(reference_integrator(scene)).parameters()

    def reference(self) -> mi.SamplingIntegrator:
        return mi.load_dict({"type": self.follows, **self.limits.parameters()})

    def facts(self, scene: mi.Scene, sensor: mi.Sensor) -> Facts:
        """The facts about the scene if this integrator renders it instead of the scene's own integrator."""
        return scene_facts(scene, sensor, self.reference())

    def prepare(self, scene: mi.Scene, sensor: mi.Sensor | None = None) -> SamplePass:
        """Returns the function that takes a pass of samples for ``sensor``, or for the scene's first sensor.

        Raises NgptError if the sampler refuses the scene by its rules in the registry.
        """
        sensor = sensor or scene.sensors()[0]
        find(self.name, self.facts(scene, sensor))
        return self.begin(scene, sensor)

    def begin(self, scene: mi.Scene, sensor: mi.Sensor) -> SamplePass:
        """As ``prepare()``, for a scene that the sampler does not refuse."""
        raise NotImplementedError

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """Returns only the primal estimate, as the ``reference()`` computes it."""
        return self.reference().sample(scene, sampler, ray, medium, active)

    def render_film(self, scene, sensor, seed: int, spp: int) -> GradientFilm:
        check_camera(sensor)
        check_scene(scene)
        limits = {
            "lane_bytes": self.entry.lane_bytes,
            "batch": self.entry.batch,
            "points": self.options.get("points", "independent"),
        }
        with weighed(scene, self.options["lamps"], self.entry.by_place) as self.places:
            budget = self.share_tails(scene, sensor, Budget(spp))
            return render_passes(self.prepare(scene, sensor), sensor, seed, budget, **limits)

    def share_tails(self, scene: mi.Scene, sensor: mi.Sensor, budget: Budget) -> Budget:
        """Decides whether paths share their tails (may end in a cache of light that other paths have found), if the
        user has not decided it. Returns the budget that remains beside the cache.
        """
        if "tails" not in self.options:
            return budget
        found = sharing_of(sensor, self.entry, self.facts(scene, sensor), self.options, budget)
        if not self.given_tails:
            self.options["tails"] = "paths" if found.not_now else "shared"
        return found.rest if self.options["tails"] == "shared" else budget

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """Renders all layers: see ``mitsuba.Integrator.render()`` for the parameters."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        spp = spp or sensor.sampler().sample_count()
        layers = self.render_film(scene, sensor, seed, spp).develop()
        self.channels = [f"{name}.{c}" for name in layers for c in LAYERS[name].channels]
        return mi.TensorXf(np.concatenate(list(layers.values()), axis=-1))

    def aov_names(self):
        """The channels of the last render. `ngpt.GradientStack.from_aovs` needs them to make a stack of its tensor."""
        return self.channels

    def to_string(self):
        limits = {} if self.nested else self.limits.parameters()
        lines = "".join(f"  {name} = {written(value)},\n" for name, value in (limits | self.options).items())
        return f"{type(self).__name__}[\n{lines}]"

    def first_hit(self, scene, ray, active=True, *, coherent=True) -> mi.PreliminaryIntersection3f:
        """The first hit of a camera ray. If emitters are hidden, the ray passes through lamps."""
        ray = mi.Ray3f(ray)
        hit = scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        if self.hide_emitters:
            lamp = hit.is_valid() & (hit.shape.emitter() != None)  # noqa: E711 - a comparison of arrays of pointers
            si = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, lamp)
            hit = dr.select(lamp, self.skip_area_emitters(scene, si.spawn_ray(ray.d), True, lamp), hit)
        return hit

    def first_surface(self, scene, media: Media, ray, medium, active) -> mi.PreliminaryIntersection3f:
        """``first_hit()`` of a piece of a camera ray. As in ``volpath``, hidden lamps block rays inside a medium."""
        # Where a boundary coincides with a surface, coherent rays meet the boundary half as often as other rays do.
        # Rays of ``volpath`` are never coherent, so in scenes with boundaries these rays are not coherent either.
        coherent = not media.boundaries
        hit = self.first_hit(scene, ray, active, coherent=coherent)
        if self.hide_emitters:
            found = scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
            hit = dr.select(medium == None, hit, found)  # noqa: E711 - a comparison of arrays of pointers
        return hit

    def emission_in_pixel(self, scene, camera: CameraSamples, Le, media: Media | None = None, within=None):
        """``lights.emission_in_pixel`` for this integrator; the camera may be ``within`` one of the ``media``."""
        if not self.limits.shows:
            return Le
        if media:
            emission = partial(self.lamps_in_fog, scene, media, within=within, channel=mi.UInt32(0))
        else:
            emission = partial(emission_seen, scene, self, None, active=mi.Bool(True))
        return emission_in_pixel(scene, camera, Le, emission)

    def lamps_in_fog(self, scene, media: Media, ray, within, channel) -> mi.Spectrum:
        """The layer ``direct``: the expected emission of lamps and the environment, seen through homogeneous media."""
        if not self.limits.shows:
            return mi.Spectrum(0)
        trace = partial(self.first_surface, scene, media)
        T, hit, ray = segments.clear_view(media, trace, ray, within, channel, mi.Bool(True))
        si = hit.compute_surface_interaction(ray)
        return T * si.emitter(scene).eval(si, hit.is_valid() if media.grids else mi.Bool(True))

    def behind_grids(self, scene, media: Media, segment: segments.Segment) -> mi.Spectrum:
        """Returns Le at the end of the first ``segment`` of a path, if the segment crosses grids (media of varying
        density), or if it escapes in a scene with grids.

        This light is not in ``direct``, since it has noise. A path finds either this light or light that was scattered
        on the way, so the sum of both has less noise. The environment is included here in all pixels: if it were
        included only behind grids, the box around a cloud would stand out from the sky.
        """
        if not self.limits.shows or not media.grids:
            return mi.Spectrum(0)
        si = segment.hit.compute_surface_interaction(segment.ray)
        arrives = ~segment.place.scatters & ((segment.nulls.M > 0) | ~segment.hit.is_valid())
        return si.emitter(scene).eval(si, arrives)
