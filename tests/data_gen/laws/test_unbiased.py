"""Every sampler has the means of Mitsuba's integrators: of the image, and of differences over one and eight pixels.

Wrong densities and weights of neighbours drown in the noise; over eight pixels they stand out of it. A case as a whole
has a level of 1 %, with fixed seeds. In media pixels are wide, and the sum of all z² is tested, too.
"""

from dataclasses import dataclass, field

import media_scenes
import pytest
from bdpt_scenes import SCENES as OF_ALL_LAMPS
from reference_scenes import BUILTIN, LARGE, MEDIA, PLACES, SMALL, at_place, of
from references import references
from registered import quick, slow
from unbiased import DISTANCES, FAR, assert_unbiased, load, render_ours, sum_of_squares

from data_gen.samplers import SAMPLERS
from ngpt.errors import NgptError

# In media images are of 16 x 16 pixels, and differences go over four.
WIDE = 4


@dataclass(frozen=True)
class Case:
    """A sampler in a scene, with options, over so many pixels; ``by`` is whose image it has, if not Mitsuba's."""

    sampler: str
    scene: str
    pixels: tuple[int, ...] = DISTANCES
    options: dict = field(default_factory=dict)
    size: tuple[int, int] = LARGE
    spp: int = 32
    by: str | None = None
    place: tuple | None = None

    @property
    def in_media(self):
        return self.pixels[-1] == WIDE

    def __str__(self):
        return "-".join([self.sampler, self.scene, *(f"{name}={value}" for name, value in self.options.items())])

    def description(self, mi):
        if self.scene == "quick":
            return quick(mi, self.sampler)
        if self.place:
            return at_place(*self.place)
        if self.scene.startswith("lit: "):
            return OF_ALL_LAMPS[self.scene.removeprefix("lit: ")]
        if self.scene.endswith(" by mis"):
            return media_scenes.by_mis(of(self.scene.removesuffix(" by mis")))
        name, _, depth = self.scene.partition(" to ")
        return of("limited")(int(depth)) if depth else of(name)


def registered(study, pixels=DISTANCES):
    """Every sampler but those that say they are biased, which are held to what they converge to: alike everywhere, and
    where there are holes and no environment, where Mitsuba's ``path`` loses light (docs/use/rendering.md)."""
    names = [name for name, entry in SAMPLERS.items() if not entry.biased and (entry.standing == "study") == study]
    return [*(Case(name, "quick", pixels) for name in names), *(Case(name, "leaf", (FAR,)) for name in names)]


def moved(place, options=None, spp=32):
    return Case("gpt", f"moved {place}", (1,), options or {}, (24, 24), spp, place=place)


UNCONNECTABLE = {"roughness_threshold": 10.0}
# What other cases of the same sampler below show as well; ``test_holes`` has more holes than the leaf.
SHOWN = {("gpt", "quick"), ("gpt", "leaf"), ("bdpt", "quick")}
QUICK = [
    # Over eight pixels, which see all that one does and more; users have differences over one, as ``plenty`` below.
    *(case for case in registered(False, (FAR,)) if (case.sampler, case.scene) not in SHOWN),
    Case("gpt", "glass", (FAR,)),
    Case("gpt", "lens", (FAR,)),
    Case("gpt", "hidden_lamp", (FAR,)),
    # Lamps with a size and without behind masks and panes, where paths may end among them
    Case("gpt", "few_edges", (FAR,), size=SMALL, spp=64),
    # All that is not a mirror is connectable: paths reconnect where they hardly can.
    Case("gpt", "plenty", (1,), {"roughness_threshold": 0.0}),
    # And either shift where nothing is.
    moved(PLACES[0], {"shift": "half-vector"} | UNCONNECTABLE, spp=64),
    moved(PLACES[-1]),
    Case("gpt", "panels", (FAR,), size=(24, 24)),
    Case("gpt", "colours by mis", (WIDE,), size=SMALL, spp=48),
    Case("gpt-basic", "within_fog", (1,), size=SMALL, spp=48),
    # Paths end at a step that is written out.
    Case("gpt-simple", "courtyard to 2", (1,), size=SMALL, spp=64),
    Case("bdpt", "lit: areas", options={"joined_depth": 1}),
]
LONG = {"spp": 256}
SLOW = [
    *registered(True),
    *registered(False),
    *(Case("gpt", scene, **LONG) for scene in (*BUILTIN, "glass", "hidden_lamp", "plenty")),
    Case("gpt", "plenty", options=UNCONNECTABLE),
    *(moved(place) for place in PLACES),
    *(
        Case("gpt", scene, options={"shift": "half-vector", "roughness_threshold": 0.35})
        for scene in ("plenty", "glass", "environment")
    ),
    *(Case("gpt", scene, (1,), options={"reuse": True}) for scene in ("glossy", "plenty")),
    *(Case("gpt", scene, (1, WIDE), size=SMALL, **LONG) for scene in (*MEDIA, "fog", "within_fog")),
    Case("gpt", "coloured_smoke by mis", (1, WIDE), size=SMALL, **LONG),
    *(Case("gpt-basic", scene, **LONG) for scene in (*BUILTIN, "glass", "fog", "within_fog", "hidden_lamp")),
    *(Case("gpt-simple", scene, **LONG) for scene in ("diffuse", "lens", "courtyard")),
    Case("gpt-simple", "courtyard to 3", (1,), size=SMALL, spp=64),
    Case("gpt-simple", "panels", (FAR,), size=(24, 24)),
    *(Case("bdpt", f"lit: {scene}", spp=16) for scene in OF_ALL_LAMPS),
    Case("bdpt", "lit: areas", options={"joined_depth": 3}),
    Case("gpt", "curtains", (FAR,), spp=64),
]


@pytest.mark.parametrize("case", [*QUICK, *(slow(case, id=f"{case}-long") for case in SLOW)], ids=str)
def test_unbiased(renderer, case):
    holds(renderer, case)


def holds(renderer, case):
    """The law of one case."""
    description = case.description(renderer)
    expected, scene = references(renderer, description, case.size, case.by), load(renderer, description, case.size)
    for pixels in case.pixels[: 1 + SAMPLERS[case.sampler].gradients]:
        try:
            stacks = render_ours(scene, case.sampler, 12, case.spp, pixels, **case.options)
        except NgptError as error:
            assert case.scene == "leaf", error
            pytest.skip(f"it refuses holes: {error}")
        assert ("dx" in stacks[0]) == SAMPLERS[case.sampler].gradients
        assert_unbiased(stacks, expected, 0.01 / (3 * len(case.pixels)), pixels)
        if case.in_media:
            assert sum_of_squares(stacks, expected, pixels) > 1e-3
