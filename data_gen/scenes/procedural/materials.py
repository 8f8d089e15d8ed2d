"""Materials of things: every scene has the same plugins, with different pictures and numbers.

Dr.Jit compiles a kernel for each *set* of plugins, in 10 s and more, and keeps it. Every scene has one material for
each entry of ``SLOTS``, so all scenes can use the kernels of the first. Some parameters are constants in kernels:
transforms of textures, and scales of bump maps and environments. Meshes and pictures vary instead of these. The
refractive index of glass is the same in all scenes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from xml.etree import ElementTree as xml

import numpy as np

from data_gen.scenes.procedural.textures import leaf, random_picture

# Role of a part -> the slots of materials that it may have
ROLES = {
    "wall": ["matte0", "matte1", "bump0"],
    "floor": ["matte2", "varnish0", "principled0", "varnish0"],
    "wood": ["varnish0", "varnish1", "matte3"],
    "object": ["plastic0", "varnish1", "principled0", "principled1", "matte3", "matte4", "bump0", "metal1"],
    "fabric": ["matte2", "matte4", "bump0"],
    "metal": ["metal0", "metal1", "principled1", "mirror"],
    "mirror": ["mirror"],
    "glass": ["glass", "glass", "frosted"],
    "pane": ["pane", "frosted"],
    "paper": ["paper"],
    "leaf": ["leaf"],
    "lamp": ["lamp"],
}
SLOTS = tuple(dict.fromkeys(slot for slots in ROLES.values() for slot in slots if slot != "lamp"))

METALS = ("Al", "Au", "Cu", "Ag", "Cr", "W")


def plugin(tag: str, kind: str, name: str | None = None, **values) -> xml.Element:
    """An element of a scene file; numbers become <float>, colours <rgb>, words <string>."""
    element = xml.Element(tag, {"type": kind} | ({"name": name} if name else {}))
    for key, value in values.items():
        if isinstance(value, bool):
            xml.SubElement(element, "boolean", name=key, value=str(value).lower())
        elif isinstance(value, int):
            xml.SubElement(element, "integer", name=key, value=str(value))
        elif isinstance(value, str):
            xml.SubElement(element, "string", name=key, value=value)
        elif np.ndim(value):
            xml.SubElement(element, "rgb", name=key, value=" ".join(f"{v:.6g}" for v in value))
        else:
            xml.SubElement(element, "float", name=key, value=f"{value:.7g}")
    return element


def inside(element: xml.Element, *children: xml.Element) -> xml.Element:
    element.extend(children)
    return element


def add_transform(element: xml.Element, **steps: Mapping[str, Iterable[float]]) -> None:
    """Adds a ``to_world`` to an element: its ``steps`` by name, such as ``scale``, each with its vectors by name."""
    transform = xml.SubElement(element, "transform", name="to_world")
    for step, vectors in steps.items():
        texts = {name: ", ".join(f"{x:.6g}" for x in vector) for name, vector in vectors.items()}
        xml.SubElement(transform, step, texts)


def two_sided(bsdf: xml.Element) -> xml.Element:
    return inside(plugin("bsdf", "twosided"), bsdf)


class Palette:
    """Makes the materials of one scene. ``save(image, raw)`` stores a picture and returns its file name."""

    def __init__(self, rng: np.random.Generator, save):
        self.rng, self.save = rng, save

    def material(self, slot: str) -> xml.Element:
        kind = slot.rstrip("0123456789")
        return getattr(self, f"_{kind}")()

    def picture(self, name: str, image: np.ndarray | None = None, raw: bool = False) -> xml.Element:
        image = random_picture(self.rng) if image is None else image
        return plugin("texture", "bitmap", name, filename=self.save(image, raw), raw=raw)

    def _roughness(self, low: float, high: float) -> float:
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def _matte(self) -> xml.Element:
        return two_sided(inside(plugin("bsdf", "diffuse"), self.picture("reflectance")))

    def _paper(self) -> xml.Element:
        image = random_picture(self.rng, ("text", "blots", "dots", "stripes"), 0.03, 0.9)
        return two_sided(inside(plugin("bsdf", "diffuse"), self.picture("reflectance", image)))

    def _varnish(self) -> xml.Element:
        names = ("wood", "wood", "noise", "marble", "checks", "bricks")
        coat = plugin("bsdf", "roughplastic", alpha=self._roughness(0.04, 0.4), distribution="ggx", nonlinear=True)
        return two_sided(inside(coat, self.picture("diffuse_reflectance", random_picture(self.rng, names))))

    def _bump(self) -> xml.Element:
        name = str(self.rng.choice(["noise", "weave", "bricks", "dots"]))
        relief = random_picture(self.rng, (name,)).mean(axis=-1)
        # The picture contains the height, since the plugin's own scale would be compiled into the kernel.
        bump = plugin("bsdf", "bumpmap", scale=0.3)
        bump.append(self.picture("arbitrary", self.rng.uniform(0.15, 1) * relief, raw=True))
        # Not roughplastic, which is NaN in Mitsuba where a direction is below the horizon of the tilted frame
        return two_sided(inside(bump, self._disney()))

    def _plastic(self) -> xml.Element:
        return two_sided(inside(plugin("bsdf", "plastic", nonlinear=True), self.picture("diffuse_reflectance")))

    def _principled(self) -> xml.Element:
        return two_sided(self._disney())

    def _disney(self) -> xml.Element:
        # Never 0, which would remove the lobe from the kernel
        rng, metallic = self.rng, 1.0 if self.rng.random() < 0.4 else 0.01
        principled = plugin(
            "bsdf", "principled", metallic=metallic, specular=rng.uniform(0.2, 0.8), clearcoat=rng.uniform(0.01, 1)
        )
        low, high = sorted(np.sqrt(rng.uniform(0.02, 0.5, 2)))
        gloss = low + (high - low) * random_picture(self.rng, low=0, high=1).mean(axis=-1)
        principled.append(self.picture("base_color"))
        principled.append(self.picture("roughness", gloss, raw=True))
        return principled

    def _metal(self) -> xml.Element:
        material, alpha = str(self.rng.choice(METALS)), self._roughness(0.02, 0.4)
        return two_sided(plugin("bsdf", "roughconductor", material=material, alpha=alpha, distribution="ggx"))

    def _mirror(self) -> xml.Element:
        return two_sided(plugin("bsdf", "conductor", material=str(self.rng.choice(METALS))))

    def _glass(self) -> xml.Element:
        return plugin("bsdf", "dielectric", int_ior=1.5)

    def _frosted(self) -> xml.Element:
        return plugin("bsdf", "roughdielectric", int_ior=1.5, alpha=self._roughness(0.05, 0.4), distribution="ggx")

    def _pane(self) -> xml.Element:
        return plugin("bsdf", "thindielectric", int_ior=1.5)

    def _leaf(self) -> xml.Element:
        image = random_picture(self.rng, ("noise", "stripes"), 0.05, 0.5) * [0.6, 1, 0.35]
        mask = plugin("bsdf", "mask")
        opacity = plugin("texture", "bitmap", "opacity", filename=self.save(leaf(), True), raw=True)
        diffuse = inside(plugin("bsdf", "diffuse"), self.picture("reflectance", image))
        return inside(mask, opacity, two_sided(diffuse))
