"""Images of photons, on surfaces, in media and with connections, and their differences. Of studies most is slow."""

from dataclasses import dataclass, field, replace

import bdpt_scenes
import data_gen_scenes
import media_scenes
import numpy as np
import pytest
from photon_laws import assert_alike, assert_no_bias, gain, passes
from references import REFERENCES, references
from unbiased import light_of_gradients, load, render_ours

from data_gen.render import render_stack
from data_gen.scenes import builtin
from data_gen.scenes.builtin import _camera, _light, _wall
from ngpt.io.exr import pass_through
from ngpt_studies.photons.gradients.differences import Gathered

# Rooms whose images are stored, (16, 16), and where no light is seen directly
STORED = ("haze", "colours", "forward", "dense", "nested", "fog")


def named(name, **integrator):
    """The scene of that name, on surfaces or in media, with other parameters of its integrator."""

    def described():
        rooms = (bdpt_scenes.SCENES, builtin.SCENES, vars(bdpt_scenes), vars(data_gen_scenes))
        if hasattr(media_scenes, name):
            scene = getattr(media_scenes, name)()
        else:
            found = next(room[name] for room in rooms if name in room)
            scene = (builtin.SCENES[found] if isinstance(found, str) else found)()
        return scene | {"integrator": {"type": scene["integrator"]["type"], **integrator}} if integrator else scene

    return described


def cases(quick, slow):
    return [*quick, *(pytest.param(*case, marks=pytest.mark.slow) for case in slow)]


# ------------------------- Images -------------------------


@dataclass
class Image:
    """How first passes are compared with an image by Mitsuba, or ``by`` another sampler of ours, of so many spp."""

    radius: float = 0.4
    photons: int | None = 24
    block: int = 4
    batches: int = 6
    size: tuple = (16, 16)
    share: float = 0.03
    by: str = "primal"
    references: int = 128
    images: int = 12
    options: dict = field(default_factory=dict)

    def assert_alike(self, renderer, sampler, name, **integrator):
        description = named(name, **integrator)
        scene, options = load(renderer, description, self.size), {"radius": self.radius, **self.options}
        if self.photons:
            options["photons"] = self.photons
        # As renders draw them: few images of independent photons have tails that their variance does not know.
        ours = passes(scene, self.batches, 1, sampler, net=1, **options)
        if name in STORED and not integrator:
            theirs = references(renderer, getattr(media_scenes, name, data_gen_scenes.fog), self.size)
        else:
            theirs = render_ours(scene, self.by, self.images, self.references, seed=REFERENCES)
            # Light that is seen directly is its expectation in ours, and has its own edges.
            theirs = np.stack([light_of_gradients(stack) for stack in theirs])
        ours = np.stack([light_of_gradients(stack) for stack in ours])
        assert_alike(ours, theirs, self.block, self.share)


IN_MEDIA = Image(images=6)
PPM = Image(radius=0.3, photons=64, block=6, batches=12, size=(24, 24), references=64, images=24)
VPM = replace(IN_MEDIA, photons=128, batches=8)
BRE = replace(IN_MEDIA, photons=96)
PLANES = replace(IN_MEDIA, options={"planes": 512})
VCM = Image(0.5, None, 6, 64, (24, 24), 0.02, by="bdpt", references=32, images=8)
# Where nothing but merging finds light
ALONE = replace(VCM, radius=2.0, batches=24, by="ppm", references=1, images=24)

QUICK = [
    ("ppm", "areas", PPM),
    ("ppm", "sky", PPM),
    ("vcm", "glass", VCM),
    ("bre", "colours", BRE),
    # Liquids in clear and in frosted glass: few photons get there
    ("bre", "milk", replace(BRE, block=8, batches=10)),
    ("bre", "wisps", replace(BRE, radius=0.3, photons=64, block=8, references=32)),
]
# Along boundaries that bend nothing, of media within each other, it is too dark by a share that falls like the radius.
SLOW = [
    ("ppm", "glass", PPM),
    ("ppm", "points", replace(PPM, by="bdpt")),
    *(("vcm", name, VCM) for name in ("areas", "points", "sky")),
    # Grids that fade: their density is not blurred
    ("vpm", "wisps", replace(VPM, radius=0.6, photons=40, references=32)),
    *(("vpm", name, VPM) for name in ("haze", "forward", "colours", "milk")),
    ("vpm", "nested", replace(VPM, radius=0.2, photons=256, block=16)),
    ("bre", "forward", BRE),
    ("bre", "nested", replace(BRE, radius=0.15, photons=192, block=16)),
    *(("beams", name, IN_MEDIA) for name in ("colours", "haze", "forward", "dense", "fog")),
    ("beams", "milk", replace(IN_MEDIA, block=8)),
    ("beams", "nested", replace(IN_MEDIA, block=16)),
    ("beams", "wisps", replace(IN_MEDIA, radius=0.3, block=8)),
    *(("planes", name, PLANES) for name in ("colours", "haze", "dense", "fog")),
    *(("planes", name, replace(PLANES, block=16)) for name in ("forward", "nested")),
    ("planes", "milk", replace(PLANES, block=8)),
]


@pytest.mark.parametrize(("sampler", "name", "image"), cases(QUICK, SLOW))
def test_small_radii_have_the_image_of_paths(renderer, sampler, name, image):
    """All lights, mirrors, glass and media, within what such a radius blurs."""
    image.assert_alike(renderer, sampler, name)


def test_light_that_merging_alone_finds(renderer):
    """As much as ``ppm`` does, where ``bdpt`` is black."""
    ALONE.assert_alike(renderer, "vcm", "seen_through_glass")
    scene = load(renderer, bdpt_scenes.seen_through_glass, (24, 24))
    assert render_ours(scene, "bdpt", 1, 8)[0]["primal"].mean() < 1e-4


@pytest.mark.parametrize(
    ("sampler", "name", "max_depth", "image"),
    cases(
        [
            # Further emission in glass, and more bounces of photons seen through it
            *(("ppm", "glass", depth, replace(PPM, size=(16, 16), block=4)) for depth in (2, 4)),
            ("bre", "haze", 2, replace(BRE, radius=0.3, photons=48)),
        ],
        [("vpm", "haze", 2, VPM), ("vpm", "haze", 3, VPM), ("beams", "haze", 2, IN_MEDIA)],
    ),
)
def test_paths_are_no_longer_than_the_scene_says(renderer, sampler, name, max_depth, image):
    """With two edges light is scattered once, in the medium or on a surface; of one, see ``laws``."""
    image.assert_alike(renderer, sampler, name, max_depth=max_depth)


@pytest.mark.parametrize(
    ("sampler", "name", "size", "photons", "least"),
    cases(
        [("ppm", "diffuse", 32, 4, -0.6), ("bre", "fog", 16, 8, -0.6)],
        [("vpm", "fog", 16, 16, -4 / 9), ("beams", "fog", 16, 2, -0.6), ("vcm", "seen_through_glass", 24, None, -0.55)],
    ),
)
def test_it_converges(renderer, sampler, name, size, photons, least):
    """The squared error of the mean falls with passes: noise like n^-α, what is left of the blur like n^(-2/3), of
    balls n^(-4/9)."""
    scene = load(renderer, named(name), (size, size))
    if photons:
        options, counts = {"radius": 1.0, "photons": photons}, (2, 8, 32)
        known = {"diffuse": "diffuse", "fog": data_gen_scenes.fog}[name]
        reference = references(renderer, known, (size, size)).mean(axis=0)
    else:
        options, counts = {"radius": 2.0}, (4, 16, 64, 256)
        reference = render_stack(scene, 768, REFERENCES, "ppm", photons=4, radius=1.0, unbiased=True)["primal"]

    def error(n):
        x = render_stack(scene, n, 0, sampler, unbiased=True, **options)["primal"]
        return np.mean((x - reference) ** 2 / (reference**2 + 0.01))

    slope, _ = np.polyfit(np.log(counts), np.log([error(n) for n in counts]), 1)
    assert slope < least


@pytest.mark.parametrize(
    ("better", "worse", "radius", "photons", "times"),
    cases([("bre", "vpm", 1.0, 4, 5)], [("beams", "bre", 0.5, 2, 2)]),
)
def test_they_have_less_noise_than_points(renderer, better, worse, radius, photons, times):
    """The noise of the same light paths, in thin fog; ``bre`` was measured to have 25 times less than ``vpm``."""
    scene = load(renderer, media_scenes.haze, (16, 16))
    noise = []
    for name in (better, worse):
        stacks = passes(scene, 5, 1, name, radius=radius, photons=photons)
        noise.append(np.stack([stack["primal"] for stack in stacks]).var(axis=0, ddof=1).mean())
    assert noise[0] < noise[1] / times


def behind_panes(max_depth):
    """Nothing but a lamp, behind two panes."""
    panes = {f"pane{z}": _wall([0, 0, z], [0, 0, 1], (4, 4), {"type": "thindielectric"}) for z in (1, 2)}
    lamp = {"lamp": _light([0, 0, 0], [0, 0, 1], (4, 4), (1, 1, 1))} | panes
    sensor = {"type": "scene", "sensor": _camera([0, 0, 4], [0, 0, 0], 40)}
    return sensor | {"integrator": {"type": "path", "max_depth": max_depth}} | lamp


def test_a_lamp_behind_two_panes_is_three_edges_away(renderer):
    stacks = [render_stack(load(renderer, behind_panes(depth), (4, 4)), 4, 0, "ppm", unbiased=True) for depth in (2, 3)]
    assert [stack["primal"].any() for stack in stacks] == [False, True]


# ------------------------- Differences -------------------------


def without_glass():
    """The sky, whose sun no camera path meets by chance: that is rarer than any test has samples for."""
    scene = bdpt_scenes.SCENES["sky"]()
    del scene["glass"]
    return scene


@pytest.fixture
def by_planes_alone(monkeypatch):
    """What changes a sampler of that name into one without beams."""
    from ngpt_studies.photons.media.gplanes import GPLANES, NearPlanes
    from ngpt_studies.photons.media.planes import planes_of

    def near(integrator, passes, traced):
        yield Gathered(None, NearPlanes(planes_of(passes, traced)))

    def sampler_of(name):
        if name == "planes alone":
            monkeypatch.setattr(GPLANES, "near", near)
        return "gplanes" if name == "planes alone" else name

    return sampler_of


# How passes are rendered whose differences are judged
GRADIENTS = {
    "gpm": {"radius": 0.7, "photons": 2},
    "gvpm": {"radius": 0.7, "photons": 8},
    "gbre": {"radius": 0.7, "photons": 2},
    "gbeams": {"radius": 0.5, "photons": 1},
    "gplanes": {"radius": 0.5},
    "planes alone": {"planes": 144},
    "gvcm": {"radius": 0.7},
}
IN_FOG = [("colours", 4), ("haze", 1), ("haze", 4), ("forward", 4), ("dense", 4), ("nested", 4), ("milk", 4)]
IN_GRIDS = [("wisps", 1), ("wisps", 4), ("smoke", 4), ("coloured_smoke", 4), ("before_the_sky", 1)]
ON_SURFACES = [("areas", 4), ("areas", 1), ("glass", 1), ("points", 1), ("points", 4), ("sky", 1), ("sky", 4)]


@pytest.mark.parametrize(
    ("sampler", "name", "pixels", "options"),
    cases(
        # Where all strategies find light
        [("gpm", "glass", 4, {}), ("gvcm", "glass", 4, {"radius": 0.5})],
        # Where nothing but merging does. Over four pixels no photon is near to both.
        [("gvcm", "seen_through_glass", 1, {"radius": 2.0}), ("gvcm", "caustics", 4, {}), ("gvcm", "areas", 4, {})]
        + [("gvcm", "glass", 4, {"radius": 0.1}), ("planes alone", "colours", 4, {})]
        + [("gpm", *case, {}) for case in ON_SURFACES]
        + [(s, *case, {}) for s in ("gvpm", "gbre", "gbeams", "gplanes") for case in IN_FOG]
        + [("gvpm", *case, {}) for case in IN_GRIDS],
    ),
)
def test_differences_are_those_of_the_image(renderer, by_planes_alone, sampler, name, pixels, options):
    """In one pass after another: with the same photons, so that the noise of both falls out in part."""
    scene = load(renderer, without_glass if name == "sky" else named(name), (12, 12))
    stacks = passes(scene, 32, pixels, by_planes_alone(sampler), **GRADIENTS[sampler] | options)
    assert np.mean([stack["primal"].mean() for stack in stacks]) > 0.01
    assert_no_bias(stacks, pixels)


TWINS = [("gvpm", "vpm"), ("gbre", "bre"), ("gbeams", "beams"), ("gplanes", "planes")]


@pytest.mark.parametrize(
    ("pair", "name"),
    cases(
        [(("gpm", "ppm"), "glass"), (("gpm", "ppm"), "hidden_sky")],
        [(("gvcm", "vcm"), "glass"), *((pair, "nested") for pair in TWINS), (TWINS[1], "milk")]
        + [(TWINS[0], name) for name in ("milk", "wisps", "before_the_sky")],
    ),
)
def test_the_primal_is_that_of_the_sampler_without_gradients(renderer, pair, name):
    """Camera paths and photons are the same. Russian roulette differs: it looks at five paths instead of one."""
    scene = load(renderer, named(name, max_depth=5, rr_depth=9), (24, 16))
    ours, theirs = (render_ours(scene, sampler, 1, 2, radius=1.0)[0] for sampler in pair)
    for layer in ("primal", "direct", "albedo", "normal", "depth"):
        alike = np.isclose(ours[layer], theirs[layer], rtol=1e-3 if pair[0] != "gpm" else 1e-4, atol=1e-5)
        assert alike.mean() > 0.99 if pair[0] == "gvcm" else alike.all(), layer


@pytest.mark.parametrize(
    ("sampler", "name", "size", "options", "fails", "mean", "median"),
    cases(
        [
            # Measured: 0.945, 12.7 and 91; for gvcm, of photons that are near to both of two pixels, 1.9
            ("gpm", "diffuse", 64, {"radius": 1.0}, 0.1, 5, 30),
            ("gbre", "fog", 32, {"radius": 1.0}, 0.1, 5, 30),
            ("gvcm", "seen_through_glass", 32, {"radius": 3.0}, None, 1.5, 1.5),
        ],
        [
            # Photons from glass are near to both, as long as the radius is wide. No other photon has a copy.
            ("gpm", "caustics", 32, {"radius": 3.0}, None, 1.5, 2),
            ("gvpm", "fog", 48, {"radius": 1.0}, 0.1, 5, 30),
            ("gbeams", "fog", 32, {"radius": 0.5}, 0.15, 3, 5),
            # Where a grid is empty there are none: more fail than in fog.
            ("gvpm", "wisps", 24, {"radius": 0.7, "photons": 8}, 0.2, 6, 15),
            # Measured, 48x48: 0.02, 66 and 106
            ("planes alone", "haze", 32, {}, 0.1, 10, 20),
        ],
    ),
)
def test_there_are_copies_and_differences_have_little_noise(
    renderer, by_planes_alone, sampler, name, size, options, fails, mean, median
):
    """No z-test asks for that: a sampler that rejects every shift is unbiased."""
    scene, sampler = load(renderer, named(name), (size, size)), by_planes_alone(sampler)
    if fails:
        stack = render_stack(scene, 2, 0, sampler, diagnostics=True, unbiased=True, **options)
        assert pass_through(stack)["diagnostics.shiftFailures"].mean() < fails
    gained = gain(passes(scene, 8, 1, sampler, **options))
    assert gained[0] > mean and gained[1] > median, gained
