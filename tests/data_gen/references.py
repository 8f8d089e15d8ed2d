"""Images of Mitsuba's own integrators, rendered once and kept: mean and standard error by the hash of a description.

``python -m tests.data_gen.references`` renders those that are missing; with ``--all``, all of them. What a test asks
for has to be in ``ALL``.
"""

import hashlib
import sys
from functools import cache
from pathlib import Path

import numpy as np

STORE = Path(__file__).with_name("references.npz")
COMMAND = "python -m tests.data_gen.references"
# First seed of images to compare with: none of those of what is judged, since samplers may share their paths.
REFERENCES = 1000
# How references are rendered; and as how many images a test gets them
BATCHES, SPP, IMAGES = 16, 512, 24


def references(mi, description, size=None, by=None):
    """Images, (n, H, W, 3), whose mean and whose variance over n are those of the stored reference.

    ``by`` names the sampler of ours whose image it is, where Mitsuba's integrators do not find the light.
    """
    name = key(mi, description, size, by)
    stored = _stored()
    if name not in stored:
        raise AssertionError(f"no reference of this scene; list it in {Path(__file__).name}, and run {COMMAND}")
    return _images(name, stored[name])


def _images(name, found):
    mean, error = found[0].astype(np.float64), found[1].astype(np.float64)
    # Of a pixel's colours together, as of paths: the mean of colours has no less noise.
    noise = np.random.default_rng(int(name[:8], 16)).standard_normal((IMAGES, *mean.shape[:2], 1))
    noise -= noise.mean(axis=0)
    return mean + error * np.sqrt(IMAGES) * noise / noise.std(axis=0, ddof=1)


@cache
def _stored():
    with np.load(STORE) as file:
        names = {name.removesuffix(".mean") for name in file.files if name.endswith(".mean")}
        return {name: (file[f"{name}.mean"], file[f"{name}.error"]) for name in names}


def described(description):
    """The dictionary that a name or a function stands for."""
    from data_gen.scenes.builtin import SCENES

    description = SCENES[description] if isinstance(description, str) else description
    return description() if callable(description) else description


def key(mi, description, size, by=None):
    colours = mi.variant().removesuffix("_polarized").rsplit("_", 1)[1]
    text = "\n".join(_lines(described(description), f"{colours} {size} {by}"))
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _lines(value, place):
    """One for each number or word; arrays by what rounding on another machine does not change."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _lines(part, f"{place}/{name}")
    elif isinstance(value, (list, tuple)) and not all(isinstance(part, (int, float)) for part in value):
        for number, part in enumerate(value):
            yield from _lines(part, f"{place}/{number}")
    elif isinstance(value, str):
        yield f"{place} {_file(value) if value.startswith('/') else value}"
    elif type(value).__name__ == "ScalarTransform4f" or hasattr(value, "matrix"):
        yield f"{place} {_rounded(np.array(value.matrix))}"
    elif isinstance(value, (bool, int, float)):
        yield f"{place} {value:.6g}"
    else:
        array = np.array(value, np.float64)
        assert array.size, f"{place}: {value!r} cannot be hashed"
        parts = array if array.size <= 16 else np.array([array.mean(), array.std(), array.flat[0], array.flat[-1]])
        yield f"{place} {array.shape} {_rounded(parts)}"


def _file(path):
    data = Path(path).read_bytes()
    return data.decode() if data.isascii() else len(data)


def _rounded(array):
    return (np.round(np.asarray(array, np.float64), 4) + 0.0).ravel().tolist()


# ------------------------- Rendering -------------------------


def render(mi, description, size=None, by=None):
    """Mean and standard error, as they are stored: 14 bits of each mean, far below its error."""
    from unbiased import load, render_ours, render_references

    scene = load(mi, described(description), size)
    pixels = np.prod(scene.sensors()[0].film().crop_size())
    spp = SPP * (256 if pixels < 4 else 1)
    if by:
        options = {"points": "independent"}
        images = [s["primal"] for s in render_ours(scene, by, BATCHES, SPP // 4, seed=REFERENCES, **options)]
    else:
        images = render_references(mi, scene, BATCHES, spp)
    mean, error = np.mean(images, axis=0, dtype=np.float64), np.std(images, axis=0, ddof=1, dtype=np.float64)
    bits = (mean.astype(np.float32).view(np.uint32) + 0x100) & np.uint32(0xFFFFFE00)
    return bits.view(np.float32), (error / np.sqrt(BATCHES)).astype(np.float16)


def main(everything):
    folder = Path(__file__).parent
    sys.path[:0] = [str(folder.parents[1]), str(folder)]
    from data_gen.backend import use_variant

    use_variant()
    import mitsuba as mi
    from reference_scenes import ALL

    kept, found = {} if everything or not STORE.exists() else dict(_stored()), {}
    for variant, name, description, size, by in ALL:
        use_variant(variant)
        hashed = key(mi, description, size, by)
        if hashed not in found and hashed not in kept:
            print(name, size, by or "", flush=True)
            kept[hashed] = render(mi, description, size, by)
            _save(kept)
        found[hashed] = kept[hashed]
    _save(found)
    print(f"{len(found)} references, {STORE.stat().st_size / 1e3:.0f} kB in {STORE.name}")


def _save(found):
    arrays = {}
    for hashed, (mean, error) in sorted(found.items()):
        arrays |= {f"{hashed}.mean": mean, f"{hashed}.error": error}
    np.savez_compressed(STORE, **arrays)


if __name__ == "__main__":
    main("--all" in sys.argv)
