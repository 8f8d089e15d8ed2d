"""Makes one shard: opens or makes its scene, finds views, renders inputs and references, and writes the file."""

from __future__ import annotations

import tempfile
import time
import zlib
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from data_gen.backend import use_variant
from data_gen.dataset.config import DatasetConfig, Job
from data_gen.dataset.kept import Again, Kept
from ngpt.errors import NgptError, stop_if_interrupted
from ngpt.merging import merge
from ngpt.methods import reconstruct
from ngpt.repair import repair
from ngpt.stack import GradientStack
from ngpt.subpixels import means, subpixels
from ngpt.training.shards import CropData, write_shard
from ngpt.version import __version__

# The most views to try for a crop. A view may turn out black, and then another one is tried
ATTEMPTS = 6
# The number of independent parts of a reference. They have the same signal but different noise.
HALVES = 2
LIT = 0.1  # the share of pixels of the first input that must have seen any light


def make_shard(config: DatasetConfig, job: Job, folder: str, variant: str, again: Again | None = None) -> str:
    """Renders the crops of ``job`` and writes its shard into ``folder``; returns its name there.

    This function can run in any process. The same config and job give the same bits. A crop that fails is recorded and
    left out. If ``again`` is given, the references exist already, and only inputs are rendered, with new noise.
    """
    if (Path(folder) / job.file).exists():  # a worker made it and died before it reported it
        return job.file
    use_variant(variant)
    import mitsuba as mi

    from data_gen.dataset.cameras import Surroundings
    from data_gen.samplers.reused import Made
    from data_gen.scenes.load import load_scene

    crops: list[CropData] = []
    record: dict = {"scene": job.scene, "batch": job.batch, "crops": [], "failures": []}
    record["versions"] = {"ngpt": __version__, "mitsuba": mi.__version__, "variant": variant}
    start = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory(prefix="ngpt-scene-") as temporary:
            path = job.path or str(made_scene(config, job.scene, Path(temporary)))
            scene = load_scene(path, None, job.parameters, merged=config.frames == 1)
        if again:
            kept = Kept(Path(again.path))
            again_by = partial(make_inputs, config, scene, Made(), kept)
            makers = {crop: partial(again_by, i, again.seed) for crop, i in kept.places.items()}
        else:
            around = Surroundings(scene, job.box)
            makers = {crop: partial(make_crop, config, around, job.scene, crop) for crop in job.crops}
    except (NgptError, RuntimeError) as error:
        stop_if_interrupted(error)
        record["failures"] = [{"crop": crop, "error": " ".join(str(error).split())} for crop in job.crops]
    else:
        record["scene_seconds"] = time.perf_counter() - start
        for crop, make in makers.items():
            try:
                made = make()
            except (NgptError, RuntimeError) as error:
                stop_if_interrupted(error)
                record["failures"].append({"crop": crop, "error": " ".join(str(error).split())})
            else:
                crops += [data for data, _ in made]
                record["crops"] += [facts for _, facts in made]
    write_shard(Path(folder) / job.file, crops, record)
    # Each scene has its own kernels, and a process that makes thousands of scenes would keep them all.
    import drjit as dr

    dr.flush_kernel_cache()
    return job.file


def scene_seed(config: DatasetConfig, name: str) -> tuple[int, int]:
    return config.seed, zlib.crc32(name.encode())


def made_scene(config: DatasetConfig, name: str, folder: Path) -> Path:
    from data_gen.scenes.procedural.scenes import make_scene
    from data_gen.scenes.procedural.variety import SHARES

    return make_scene(scene_seed(config, name), folder, SHARES | config.sights if config.varied else None)


def sample_counts(rng: np.random.Generator, config: DatasetConfig) -> list[int]:
    """Samples per pixel of each input: log-uniform, stratified, smallest first. Both inputs of a pair get the same."""
    low, high = np.log(config.spp[0]), np.log(config.spp[1] + 1)
    if config.pairs:
        return 2 * [int(np.exp(low + rng.random() * (high - low)))]
    u = (rng.random() + np.arange(config.inputs)) / config.inputs
    return [int(n) for n in np.exp(low + u * (high - low))]


def uneven_inputs(config: DatasetConfig, name: str, crop: int, counts: list[int]) -> list[bool]:
    """Which inputs of a crop get adaptive samples: the share ``config.adaptive`` of the inputs with enough samples.

    The choice uses separate random numbers, so that views, seeds and references are the same as with even samples.
    """
    if not config.adaptive:
        return [False] * len(counts)
    from data_gen.adaptive import LEAST

    rng = np.random.default_rng((*scene_seed(config, name), crop, zlib.crc32(b"adaptive")))
    return [bool(rng.random() < config.adaptive) and n >= LEAST for n in counts]


def render_input(config: DatasetConfig, scene, spp: int, seed: int, uneven: bool, made: Any = None) -> GradientStack:
    """Renders one input. If the set has ``adaptive`` inputs, all its inputs have the layer ``samples``."""
    from data_gen.render import render_stack

    options = {"made": made, "unbiased": True, "gradients": True, "subpixels": config.subpixels, **config.options}
    stack = render_stack(scene, spp, seed, config.sampler, adaptive=uneven, **options)
    if config.adaptive and "samples" not in stack:
        stack = stack.replace(samples=np.full((stack.height, stack.width, 1), spp, np.float32))
    return stack


def make_crop(config: DatasetConfig, around, name: str, crop: int) -> list[tuple[CropData, dict]]:
    """One crop and its record, or one for each frame of a shot. ``around`` is the ``Surroundings`` of its scene."""
    from data_gen.dataset.cameras import find_view
    from data_gen.dataset.movement import Movement, random_movement
    from data_gen.frames.motion import motion_vectors, snapshot

    rng = np.random.default_rng((*scene_seed(config, name), crop))
    counts = sample_counts(rng, config)
    uneven = uneven_inputs(config, name, crop, counts)
    scene, moving = around.scene, config.frames > 1
    clock = time.perf_counter()
    for _ in range(ATTEMPTS):
        view = find_view(around, rng, config.size, config.roll, config.lens)
        movement = random_movement(around, view, rng, config.frames) if moving else Movement(view)
        movement.apply(scene, 0)
        found = time.perf_counter() - clock
        seeds = _seeds(rng, config)
        clock = time.perf_counter()
        first = render_input(config, scene, counts[0], seeds[0], uneven[0], around.made)
        if np.mean(np.nan_to_num(first["primal"]).max(axis=-1) > 0) > LIT:
            break
    else:
        raise NgptError(f"{name}: {ATTEMPTS} views in a row were black")
    made: list[tuple[CropData, dict]] = []
    before = None
    try:
        for frame in range(config.frames):
            if frame:
                clock = time.perf_counter()
                movement.apply(scene, frame)
                found = time.perf_counter() - clock
                seeds = _seeds(rng, config)
                clock = time.perf_counter()
                first = render_input(config, scene, counts[0], seeds[0], uneven[0], around.made)
            data, facts = _crop(config, scene, first, counts, seeds, uneven, clock=clock, made=around.made)
            facts = {"crop": crop, "view": asdict(movement.view_at(frame))} | facts
            facts["seconds"] = {part: round(value, 4) for part, value in (facts["seconds"] | {"camera": found}).items()}
            if moving:
                now = snapshot(scene, None if before is None or movement.shape else before.shapes)
                motion = np.full((config.size, config.size, 2), np.nan, np.float32)
                data = replace(data, motion=motion if before is None else motion_vectors(scene, now, before))
                facts |= {"frame": frame, "movement": movement.record()}
                before = now
            made.append((data, facts))
    finally:
        # Other crops need the scene in its original state.
        movement.apply(scene, 0)
    return made


def make_inputs(
    config: DatasetConfig, scene, made: Any, kept: Kept, place: int, seed: int
) -> list[tuple[CropData, dict]]:
    """Renders new inputs for the crop at ``place`` in a file of kept references; returns the crop and its record.

    Inputs and references have the same view. The noise of the inputs depends on ``seed``.
    """
    from data_gen.dataset.cameras import CameraView

    facts = kept.record["crops"][place]
    rng = np.random.default_rng((*scene_seed(config, kept.record["scene"]), facts["crop"], seed))
    counts = sample_counts(rng, config)
    seeds = [int(seed) for seed in rng.integers(0, 2**32, config.inputs)]
    uneven = uneven_inputs(config, kept.record["scene"], facts["crop"], counts)
    clock = time.perf_counter()
    CameraView.of(facts["view"]).apply(scene)
    cleaned = [finite(render_input(config, scene, *each, made)) for each in zip(counts, seeds, uneven, strict=True)]
    new: dict[str, Any] = {"spp": counts, "seeds": seeds, "repaired": [count for _, count in cleaned]}
    new["seconds"] = {"inputs": round(time.perf_counter() - clock, 4)}
    images: Any = kept.images(place)
    return [(CropData([stack for stack, _ in cleaned], counts, *images), facts | new)]


def _seeds(rng: np.random.Generator, config: DatasetConfig) -> list[int]:
    return [int(seed) for seed in rng.integers(0, 2**32, config.inputs + HALVES)]


def _crop(
    config: DatasetConfig,
    scene,
    first: GradientStack,
    counts: list[int],
    seeds: list[int],
    uneven: list[bool],
    *,
    clock: float,
    made: Any,
) -> tuple[CropData, dict]:
    """The crop whose first input is ``first``, and its record. ``clock`` is the time at which ``first`` was begun."""
    from data_gen.render import render_stack

    further = zip(counts[1:], seeds[1:-HALVES], uneven[1:], strict=True)
    stacks = [first] + [render_input(config, scene, *each, made) for each in further]
    seconds = {"inputs": time.perf_counter() - clock}
    cleaned = [finite(stack) for stack in stacks]
    facts: dict[str, Any] = {"spp": counts, "seeds": seeds} | ({"adaptive": uneven} if config.adaptive else {})
    facts |= {"repaired": [count for _, count in cleaned], "seconds": seconds}
    if config.pairs:
        return CropData([stack for stack, _ in cleaned], counts), facts
    clock = time.perf_counter()
    spp, method = -(-config.reference_spp // HALVES), config.reference_method
    options = {"made": made, "unbiased": True, "gradients": True, **config.unbiased_options}
    halves = [render_stack(scene, spp, seed, config.sampler, **options) for seed in seeds[-HALVES:]]
    converged = merge(halves)
    reference, caustic = references(converged, method)
    apart = [references(half, method)[0] for half in halves]
    seconds["reference"] = time.perf_counter() - clock
    direct = np.nan_to_num(converged["direct"], posinf=0)
    light = np.maximum(reference, direct)
    light = light if caustic is None else light + caustic
    parts = tuple(np.maximum(half, direct) for half in apart)
    return CropData([stack for stack, _ in cleaned], counts, light, direct, caustic, parts), facts


def references(converged: GradientStack, method: str) -> tuple[np.ndarray, np.ndarray | None]:
    """The clean image without the light of the layer ``caustic``, and this light (None if the layer is missing)."""
    image = reconstruct(converged, method=method).image
    if "caustic" not in converged:
        return image, None
    none = np.zeros_like(image)
    without = converged.replace(primal=converged["primal"] - converged["caustic"], caustic=none)
    rest = reconstruct(without, method=method).image
    return rest, image - rest


def finite(stack: GradientStack) -> tuple[GradientStack, int]:
    """The stack with all values made finite, and the number of pixels and differences that were not finite.

    Pixels are filled from their neighbours, and gradients become 0. An unknown variance becomes the square of the
    value, as if the value were only noise. Pixels stay the means of their subpixels.
    """
    whole = repair(stack)
    layers = {"primal": whole.image + whole.direct, "direct": whole.direct}
    if "caustic" in stack:
        layers["caustic"] = np.zeros_like(whole.image) if whole.caustic is None else whole.caustic
        layers["primal"] = layers["primal"] + layers["caustic"]
    if whole.dx is not None:
        layers |= {"dx": whole.dx, "dy": whole.dy}
    layers |= {name: part for name, part in whole.parts.items() if not name.endswith("_var")}
    bad = whole.pixels + whole.gradients
    for name in [name for name in layers if name != "direct"]:
        variance = stack[f"{name}_var"]
        unknown = ~np.isfinite(variance)
        bad += int(unknown.any(axis=-1).sum())
        layers[f"{name}_var"] = np.where(unknown, np.square(layers[name]), variance)
    for name in ("albedo", "normal", "depth"):
        layers[name] = np.nan_to_num(stack[name], posinf=0, neginf=0)
    layers |= {name: means(layer, subpixels(whole.fine, stack.width)) for name, layer in whole.fine.items()}
    return replace(stack.replace(**layers), fine=whole.fine), bad
