"""Points: nets of pixels and of blocks, uniform and independent where they must be, and less noise than without."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import kstest
from unbiased import load

from data_gen.samplers import SAMPLERS
from ngpt import GradientStack
from ngpt.errors import NgptError
from ngpt.merging import merge

SIDE = 16
# What gathers photons alone
BY_PHOTONS = ("ppm", "gpm", "vpm", "gvpm", "bre", "gbre", "beams", "gbeams", "planes", "gplanes")


@pytest.fixture
def streams(renderer):
    from data_gen.paths import streams

    return streams


def of_image(mi, streams, samples, first=0, net=16, seed=3):
    """Streams of some samples of each pixel of a SIDE x SIDE image, pixel by pixel."""
    import drjit as dr

    lane = dr.arange(mi.UInt32, SIDE * SIDE * samples)
    return streams.sample_streams(seed, lane // samples, lane % samples + first, SIDE, net)


def pairs(stream, samples):
    """The next pair of numbers, (SIDE, SIDE, samples, 2)."""
    return np.array(stream.next_2d()).T.reshape(SIDE, SIDE, samples, 2)


def fills(points):
    """Whether each box of area 1 / n, of any shape that is a power of two each way, has one of the n points."""
    n = len(points)
    for k in range(n.bit_length()):
        i, j = np.floor(points * [1 << k, n >> k]).astype(int).T
        if len(set(zip(i, j, strict=True))) < n:
            return False
    return True


@pytest.mark.parametrize(("net", "first", "n"), [(16, 0, 16), (4, 0, 4), (16, 16, 16), (4, 8, 8), (64, 0, 64)])
def test_a_round_is_a_net_of_each_pixel_and_of_each_aligned_block(renderer, streams, net, first, n):
    stream = of_image(renderer, streams, n, first, net)
    for _ in range(3):
        points = pairs(stream, n)
        assert all(fills(points[y, x]) for y in (0, 5) for x in (0, 9))
        assert fills(points[4:6, 8:10].reshape(-1, 2))
        assert fills(points[8:12, 4:8].reshape(-1, 2))
        assert not fills(points[1:3, 8:10].reshape(-1, 2))  # not aligned


def test_single_numbers_are_stratified_too(renderer, streams):
    numbers = np.array(of_image(renderer, streams, 16).next_1d()).reshape(-1, 16)
    assert (np.sort(np.floor(numbers * 16), axis=1) == np.arange(16)).all()


def test_each_point_is_uniform_over_seeds(renderer, streams):
    found = [pairs(of_image(renderer, streams, 4, seed=seed), 4) for seed in range(64)]
    for sample in range(4):
        numbers = np.array([points[3, 11, sample] for points in found])
        # Corrected for eight tests
        assert min(kstest(numbers[:, 0], "uniform").pvalue, kstest(numbers[:, 1], "uniform").pvalue) > 0.01 / 8
    everything = np.concatenate([points.reshape(-1, 2) for points in found])
    assert np.allclose(everything.mean(axis=0), 0.5, atol=1e-3)
    assert everything.min() >= 0
    assert everything.max() < 1


def test_dimensions_rounds_seeds_and_tiles_are_independent(renderer, streams):
    import drjit as dr

    mi = renderer
    stream = of_image(mi, streams, 16)
    one, other = pairs(stream, 16), pairs(stream, 16)
    further, again = pairs(of_image(mi, streams, 16, 16), 16), pairs(of_image(mi, streams, 16, seed=4), 16)
    pixel = dr.arange(mi.UInt32, 64 * 64 * 4)
    tiles = np.array(streams.sample_streams(3, pixel, mi.UInt32(0), 128, 16).next_1d()).reshape(128, 128)
    light = np.array(streams.light_streams(3, dr.arange(mi.UInt32, SIDE * SIDE * 16), 0).next_1d())
    for a, b in (
        (one[..., 0], one[..., 1]),
        (one[..., 0], other[..., 0]),
        (one[..., 0], further[..., 0]),
        (one[..., 0], again[..., 0]),
        (tiles[:64, :64], tiles[64:, :64]),
        (one[..., 0], light),
    ):
        # Five standard errors of independent numbers, which nets keep well within
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5 / np.sqrt(a.size)


def test_streams_replay_skip_and_gather(renderer, streams):
    mi = renderer
    for net in (0, 16):
        stream = of_image(mi, streams, 4, net=net)
        copy, ahead = stream.clone(), stream.clone()
        numbers = [pairs(stream, 4), np.array(stream.next_1d()), pairs(stream, 4)]
        assert np.array_equal(numbers[0], pairs(copy, 4))
        ahead.skip(mi.UInt32(3))
        assert np.array_equal(numbers[2], pairs(ahead, 4))
        few = copy.at(mi.UInt32([7, 90]))
        assert np.array_equal(np.array(few.next_1d()), numbers[1][[7, 90]])
        keys = np.array(copy.next_key())
        assert len(np.unique(keys)) > 0.99 * len(keys)
        # Lanes that do not draw stay where they are.
        stream, copy = of_image(mi, streams, 4, net=net), of_image(mi, streams, 4, net=net)
        lane = np.arange(SIDE * SIDE * 4)
        stream.next_2d(mi.Bool(lane % 2 == 0))
        first = np.array(copy.next_1d())
        assert np.array_equal(np.array(stream.next_1d())[1::2], first[1::2])


def test_a_sample_has_its_points_whatever_is_rendered_with_it(renderer):
    from data_gen.paths.camera import CameraSamples

    mi = renderer
    sensor = load(mi, "diffuse", (12, 8)).sensors()[0]
    whole = CameraSamples(sensor, 5, 32, block=16, net=16)
    part = CameraSamples(sensor, 5, 16, 16, net=16)
    some = CameraSamples(sensor, 5, 16, mi.UInt32([0, 16]), 16, mi.UInt32([17, 17]), net=16)
    numbers = np.array(whole.random.next_1d()).reshape(2, 96, 16)
    assert np.array_equal(numbers[1].ravel(), np.array(part.random.next_1d()))
    assert np.array_equal(numbers[:, 17].ravel(), np.array(some.random.next_1d()))


def test_first_rounds(streams):
    assert [streams.first_round("sobol", n) for n in (1, 4, 5, 64, 100, None)] == [1, 4, 8, 64, 128, 16]
    assert streams.first_round("rounds", 64) == 16
    assert streams.first_round("independent", 64) == 0
    assert streams.first_round("sobol", 2**31 - 1) == 2**20


@pytest.mark.parametrize("sampler", ["primal", "gpt"])
def test_points_take_noise_away_and_no_light(renderer, sampler):
    from data_gen.render import render_stack

    scene, found = load(renderer, "diffuse", (24, 16)), {}
    for points in ("sobol", "independent"):
        stacks = [render_stack(scene, 16, seed, sampler, points=points) for seed in range(16)]
        found[points] = {layer: np.array([stack[layer] for stack in stacks], np.float64) for layer in stacks[0].names}
    better, before = found["sobol"], found["independent"]

    def block_means(images):
        n, height, width, channels = images.shape
        return images.reshape(n, height // 8, 8, width // 8, 8, channels).mean(axis=(2, 4))

    for layer, most, of_blocks in (("primal", 0.9, 0.75), ("dx", 0.98, np.inf)):
        if layer in better:
            quiet = np.argsort(before[layer].var(axis=0).ravel())[: int(0.98 * before[layer][0].size)]
            variances = [images[layer].var(axis=0, ddof=1).ravel()[quiet].mean() for images in (better, before)]
            assert variances[0] < most * variances[1]
            blocks = [np.median(block_means(images[layer]).var(axis=0, ddof=1)) for images in (better, before)]
            assert blocks[0] < of_blocks * blocks[1]
            means = [block_means(images[layer]).reshape(16, -1) for images in (better, before)]
            error = np.sqrt(sum(part.var(axis=0, ddof=1) for part in means) / 16)
            z = (means[0] - means[1]).mean(axis=0) / np.maximum(error, 1e-12)
            assert np.abs(z).max() < 5


def test_a_render_by_time_can_be_had_again_by_its_number_of_samples(renderer):
    from data_gen.render import render_stack

    scene, calls = load(renderer, "diffuse", (16, 12)), []

    def stop():
        calls.append(1)
        return len(calls) > 1

    timed = render_stack(scene, None, 2, "gpt", seconds=60, stop=stop)
    assert timed.attributes["ngpt:samplerOptions"] == "points=rounds"
    again = render_stack(scene, timed.attributes["ngpt:spp"], 2, "gpt", points="rounds")
    assert all(np.array_equal(timed[layer], again[layer], equal_nan=True) for layer in again.names)


def test_claims_of_independent_samples_stay(renderer, rng):
    from data_gen.film import GradientFilm

    samples = rng.normal(size=(64 * 64, 32, 3)).astype(np.float32)
    claimed = []
    for net in (0, 16):
        film = GradientFilm(64, 64, net=net)
        for part in np.split(samples, (16,), axis=1):
            film.put("primal", renderer.Color3f(*part.reshape(-1, 3).T))
            film.end_pass(16)
        claimed.append(film.develop()["primal_var"])
    assert np.allclose(claimed[0].mean(), 1 / 32, rtol=0.02)
    assert np.allclose(claimed[1].mean(), 1 / 32, rtol=0.02)


def test_images_of_one_row_or_column_have_no_differences_in_them(renderer, rng):
    from data_gen.film.gradient_film import GradientFilm

    for width, height in ((1, 1), (2, 1), (1, 2)):
        film = GradientFilm(width, height, net=2)
        for _ in range(2):
            for name in ("primal", "dx+", "dx-", "dy+", "dy-"):
                film.put(name, renderer.Color3f(*rng.random((3, width * height), np.float32)))
            film.end_pass(1)
        layers = film.develop()
        assert np.isfinite(layers["dx_var"]).all() and layers["dx"].shape == (height, width, 3)


@pytest.mark.parametrize("shape", [(36, 64), (5, 4), (1, 7), (1, 1), (0, 7), (1, 0)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_box_means_are_those_of_scipy_to_the_bit(renderer, rng, shape, kind):
    from scipy.ndimage import uniform_filter

    from data_gen.film.claims import box_means

    image = rng.gamma(0.2, size=shape).astype(kind)
    for size in (5, 4):
        assert np.array_equal(box_means(image, size), uniform_filter(image, size))


@pytest.mark.parametrize("size", [(64, 64), (8, 8)])
def test_claims_follow_what_is_seen_between_rounds(renderer, rng, size):
    """Each round of samples sums to little: what is left of the noise of the mean is that of the rounds."""
    from data_gen.film import GradientFilm

    pixels, left = size[0] * size[1], 0.2
    rounds = []
    for n in (16, 16, 32):
        part = rng.normal(size=(pixels, n, 1))
        rounds.append(part - (1 - left**0.5) * part.mean(axis=1, keepdims=True))
    film = GradientFilm(*size, net=16)
    for part in np.split(np.repeat(np.concatenate(rounds, axis=1), 3, axis=2), (16, 48), axis=1):
        for block in np.split(part, part.shape[1] // 16, axis=1):
            film.put("primal", renderer.Color3f(*block.reshape(-1, 3).T.astype(np.float32)))
            film.end_pass(16)
    claimed = film.develop()["primal_var"].mean()
    prior = 4 / (64 + 4) * (1 - left)
    assert left / 64 * 0.8 < claimed < (left + prior) / 64 * 1.3


@pytest.mark.parametrize(
    ("sampler", "scene", "spp"), [("primal", "glossy", 17), ("gpt", "diffuse", 48), ("gpt", "glossy", 17)]
)
def test_claims_are_those_over_seeds(renderer, sampler, scene, spp):
    from data_gen.render import render_stack

    loaded = load(renderer, scene, (64, 40))
    stacks = [
        render_stack(loaded, spp, seed, sampler, features=False)
        if sampler == "primal"
        else render_stack(loaded, spp, seed, sampler)
        for seed in range(16)
    ]
    for layer in ("primal", "dx", "dy", "caustic"):
        if layer in stacks[0].names:
            part = "caustic" if layer == "primal" and "caustic" in stacks[0].names else None
            images = [stack[layer] - stack[part] if part else stack[layer] for stack in stacks]
            seen = np.var(images, axis=0, ddof=1, dtype=np.float64)
            told = np.mean([stack[f"{layer}_var"] for stack in stacks], axis=0, dtype=np.float64)
            quiet = np.argsort(told.ravel())[: int(0.99 * told.size)]
            assert 0.8 < seen.ravel()[quiet].mean() / told.ravel()[quiet].mean() < 1.25, layer


@pytest.mark.parametrize("scene", ["glossy", "lens"])
def test_noise_of_features_is_that_over_seeds(renderer, scene):
    from data_gen.render import render_stack

    loaded = load(renderer, scene, (64, 40))
    stacks = [render_stack(loaded, 16, seed, "primal") for seed in range(8)]
    seen = max(np.var([s[name] for s in stacks], axis=0, ddof=1).mean() for name in ("albedo", "normal"))
    told = [stack.attributes["ngpt:featureNoise"] for stack in stacks]
    assert 0.5 < seen / np.mean(told) < 2
    assert merge(stacks).attributes["ngpt:featureNoise"] == pytest.approx(np.mean(told) / 8)
    for spp, options in ((16, {"features": False}), (1, {})):
        assert "ngpt:featureNoise" not in render_stack(loaded, spp, 0, "primal", **options).attributes


EXTENT = 48, 32


def pixel_samples(mi, seed, numbers, net):
    """Steps in four dimensions, and rare bright samples; (pixels, C) for each of the ``numbers`` of samples."""
    from data_gen.paths.streams import sample_streams

    pixel = np.repeat(np.arange(EXTENT[0] * EXTENT[1], dtype=np.uint32), len(numbers))
    sample = np.tile(np.asarray(numbers, np.uint32), EXTENT[0] * EXTENT[1])
    stream = sample_streams(seed, mi.UInt32(pixel), mi.UInt32(sample), EXTENT[0], net)
    p, q = (np.array(stream.next_2d()) for _ in range(2))
    step = p[0] + 0.6 * p[1] < 0.3 + 0.9 * (pixel % EXTENT[0]) / EXTENT[0]
    rare = 3.0 * ((q[0] < 0.1) & (p[0] < 0.1))
    corner = (p[0] < 0.5) & (q[0] + q[1] < 1.1)
    return np.stack([step, rare, corner], axis=-1).astype(np.float32)


def put_samples(mi, film, seed, n, net):
    """The first ``n`` samples of each pixel, in blocks of 16 and what is left over, as renders put them."""
    for begin in range(0, n, 16):
        numbers = range(begin, min(n, begin + 16))
        film.put("primal", mi.Color3f(*pixel_samples(mi, seed, numbers, net).T))
        film.end_pass(len(numbers))


def put_unevenly(mi, film, seed, net):
    """Blocks of 16 samples, 1 to 5 of them by the row of the pixel."""
    each = 1 + np.arange(EXTENT[0] * EXTENT[1]) // EXTENT[0] % 5
    for begin in range(5):
        some = np.flatnonzero(each > begin).astype(np.uint32)
        values = pixel_samples(mi, seed, range(16 * begin, 16 * begin + 16), net)
        values = values.reshape(-1, 16, 3)[some].reshape(-1, 3)
        film.put("primal", mi.Color3f(*values.T))
        film.end_pass(16, some)


def check_claims(images, variances, where):
    real = np.var(images, axis=0, ddof=1, dtype=np.float64).sum()
    assert 0.8 < real / np.mean(variances, axis=0, dtype=np.float64).sum() < 1.25, where


@pytest.mark.parametrize("n", [7, 8, 16, 17, 31, 48, 65, 129])
@pytest.mark.parametrize("kind", ["sobol", "rounds", "cut"])
def test_claims_hold_at_any_number_of_samples(renderer, kind, n):
    from data_gen.film import GradientFilm
    from data_gen.paths.streams import first_round

    net = 4096 if kind == "cut" else first_round(kind, n)
    found = []
    for seed in range(8):
        film = GradientFilm(*EXTENT, net=net)
        put_samples(renderer, film, seed, n, net)
        found.append(film.develop())
    images, variances = ([layers[name] for layers in found] for name in ("primal", "primal_var"))
    check_claims(images, variances, n)


@pytest.mark.parametrize("kind", ["adaptive", "merged"])
def test_claims_hold_where_samples_come_in_parts(renderer, kind):
    from data_gen.film import GradientFilm

    found = []
    for seed in range(10):
        parts = []
        for i, n in enumerate((17, 9, 4) if kind == "merged" else (0,)):
            net = 16 if kind == "adaptive" else 32
            film = GradientFilm(*EXTENT, net=net)
            if kind == "adaptive":
                put_unevenly(renderer, film, seed, net)
            else:
                put_samples(renderer, film, 100 * i + seed, n, net)
            attributes = {"ngpt:spp": n, "ngpt:seed": str(i), "ngpt:sampler": "primal"}
            parts.append(GradientStack(film.develop(), attributes=attributes))
        found.append(merge(parts) if len(parts) > 1 else parts[0])
    images, variances = ([stack[name] for stack in found] for name in ("primal", "primal_var"))
    check_claims(images, variances, kind)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["glossy", "diffuse", "environment"])
@pytest.mark.parametrize("points", ["sobol", "rounds"])
def test_claims_of_renders_hold_at_every_number_of_samples(renderer, scene, points):
    from bench.claims import every

    loaded = load(renderer, scene, (64, 40))
    found = every(loaded, (64, 40), "gpt", points, range(8, 131), 10)
    for n, layers in found.items():
        for layer in ("primal", "caustic", "dx", "dy"):
            if layer in layers:
                assert 0.7 < layers[layer][0] < 1.4, (n, layer)
    ordered = [found[n]["wcv"] for n in sorted(found)]
    for (before, _), (error, deviation) in pairwise(ordered):
        assert error < 1.1 * before + 3 * deviation


@pytest.mark.parametrize("net", [1, 16, 64])
def test_laws_are_sums_over_pairs_of_samples(net):
    """For any number of samples: the covariances of all pairs, added up one by one."""
    from data_gen.film.nets import RATES, SHARES, law, split

    def variance_of(m):
        return SHARES / m + (1 - SHARES) * m**-RATES

    def covariance(i, j):
        first, size = (0, net) if i < net else (1 << i.bit_length() - 1,) * 2
        if not first <= j < first + size:
            return 0 * RATES
        together = 1 << ((i - first) ^ (j - first)).bit_length()
        return 2 * variance_of(together) - variance_of(together / 2) if together > 1 else 1 + 0 * RATES

    for n in (2, 3, 5, 16, 17, 31, 48, 65):
        pairs = np.array([[covariance(i, j) for j in range(n)] for i in range(n)])
        n1 = split(n)
        assert n / 3 <= n1 <= 2 * n / 3
        weights = np.where(np.arange(n) < n1, -1 / n1, 1 / (n - n1)) * np.sqrt(n1 * (n - n1)) / n
        variance = pairs.mean(axis=(0, 1))
        claimed = (1 - variance) / (n - 1)
        assert np.allclose(law(n, net).truth, variance / claimed)
        assert np.allclose(law(n, net).seen, np.einsum("i,j,ijr->r", weights, weights, pairs) / claimed)
        # What is seen tells which law holds.
        assert (np.diff(law(n, net).seen) < 1e-9).all()


# ------------------------- Lamps -------------------------


def room(mi, weights=(None, None, None)):
    """A floor under a strong lamp and two weak ones."""
    Transform = mi.ScalarTransform4f

    def lamp(x, radiance, weight):
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
        if weight is not None:
            emitter["sampling_weight"] = weight
        place = Transform().translate([x, 0, 2]).rotate([1, 0, 0], 180).scale(0.2)
        return {"type": "rectangle", "to_world": place, "emitter": emitter}

    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {
            "type": "perspective",
            "to_world": Transform().look_at([0, 4, 1.5], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}},
        },
        "floor": {"type": "rectangle", "to_world": Transform().scale(9)},
        "strong": lamp(0.0, 90.0, weights[0]),
        "weak": lamp(1.0, 1.0, weights[1]),
        "other": lamp(-1.0, 1.0, weights[2]),
    }


def test_lamps_are_chosen_by_what_they_bring_and_left_as_they_were(renderer):
    from data_gen.scenes.lamps import lamp_weights, weighed

    scene = load(renderer, room(renderer))
    weights = lamp_weights(scene)
    assert weights.max() > 0.8
    assert np.isclose(weights.sum(), 1)
    assert weights.min() > 0.05
    with weighed(scene, "power"):
        chosen = [float(scene.pdf_emitter(i)[0]) for i in range(3)]
        assert np.allclose(chosen, weights, atol=1e-3)
    assert [emitter.sampling_weight() for emitter in scene.emitters()] == [1, 1, 1]
    assert np.allclose([float(scene.pdf_emitter(i)[0]) for i in range(3)], 1 / 3)
    with weighed(scene, "uniform"):
        assert np.allclose([float(scene.pdf_emitter(i)[0]) for i in range(3)], 1 / 3)
    assert np.array_equal(lamp_weights(scene), weights)


def test_weights_that_a_scene_gives_are_honoured(renderer):
    from data_gen.scenes.lamps import weighed

    scene = load(renderer, room(renderer, (1.0, 0.0, 3.0)))
    with weighed(scene, "power"):
        assert sorted(float(scene.pdf_emitter(i)[0]) for i in range(3)) == [0, 0.25, 0.75]


@pytest.mark.parametrize("sampler", ["primal", "gpt", "gbdpt"])
def test_lamps_take_noise_away_and_no_light(renderer, sampler):
    from data_gen.render import render_stack

    scene, found = load(renderer, room(renderer)), []
    for lamps in ("power", "uniform"):
        stacks = [render_stack(scene, 16, seed, sampler, points="independent", lamps=lamps) for seed in range(16)]
        found.append(np.array([stack["primal"] for stack in stacks], np.float64).mean(axis=-1))
    better, before = found
    assert np.median(better.var(axis=0, ddof=1)) < 0.6 * np.median(before.var(axis=0, ddof=1))
    means = [images.reshape(16, -1).mean(axis=1) for images in found]
    z = (means[0].mean() - means[1].mean()) / np.sqrt(sum(part.var(ddof=1) for part in means) / 16)
    assert abs(z) < 4


def box(mi, weight):
    """Within a grey box, two lamps beside each other, a ball and a square; the ball is chosen by ``weight``."""
    Transform = mi.ScalarTransform4f

    def glows(lamp, radiance, weight, place):
        emitter = {"type": "area", "id": lamp, "sampling_weight": weight}
        return {"emitter": emitter | {"radiance": {"type": "rgb", "value": radiance}}, "to_world": place}

    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {
            "type": "perspective",
            "to_world": Transform().look_at([0, -0.9, 0], [0, 1, -0.3], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}},
        },
        "walls": {"type": "cube", "flip_normals": True},
        "ball": {"type": "sphere"} | glows("hidden", 4.0, weight, Transform().translate([-0.5, -0.2, 0.6]).scale(0.3)),
        "square": {"type": "rectangle"}
        | glows("seen", 4.0, 1.0, Transform().translate([0.5, -0.2, 0.98]).rotate([1, 0, 0], 180).scale(0.4)),
    }


def in_fog(description):
    """The same seen by a camera in fog."""
    fog = {"type": "homogeneous", "id": "fog", "albedo": 0.7, "sigma_t": 0.3}
    scene = {name: part for name, part in description.items() if name != "type"}
    scene["sensor"] = scene["sensor"] | {"medium": {"type": "ref", "id": "fog"}}
    return {"type": "scene", "fog": fog} | scene | {"integrator": {"type": "volpath", "max_depth": 3}}


@pytest.fixture(scope="module")
def light_of_box(renderer):
    """Means of images, where both lamps are chosen."""
    scene = load(renderer, box(renderer, 1.0))
    return np.array([np.array(renderer.render(scene, spp=256, seed=100 + seed)).mean() for seed in range(8)])


@pytest.mark.parametrize(
    "sampler",
    [n if e.standing != "study" else pytest.param(n, marks=pytest.mark.slow) for n, e in SAMPLERS.items()],
)
def test_light_of_a_lamp_that_is_chosen_never_is_found_or_refused(renderer, light_of_box, sampler):
    from data_gen.render import render_stack
    from data_gen.scenes.facts import scene_facts

    scene = load(renderer, box(renderer, 0.0))
    if SAMPLERS[sampler].refuses(scene_facts(scene)):
        scene = load(renderer, in_fog(box(renderer, 0.0)))
    if sampler in BY_PHOTONS:
        with pytest.raises(
            NgptError, match=f"sampler '{sampler}' .*'hidden' has sampling_weight 0; give it a positive"
        ):
            render_stack(scene, 1, 0, sampler)
        return
    spp = 4 if SAMPLERS[sampler].batch == 1 else 32
    means = np.array([render_stack(scene, spp, seed, sampler)["primal"].mean() for seed in range(8)])
    z = (means.mean() - light_of_box.mean()) / np.sqrt((means.var(ddof=1) + light_of_box.var(ddof=1)) / 8)
    assert abs(z) < 5  # about p = 0.001 of so few images
    assert abs(means.mean() / light_of_box.mean() - 1) < 0.1


def test_a_point_that_is_chosen_never_is_off(renderer):
    from data_gen.render import render_stack

    description = box(renderer, 1.0) | {"point": {"type": "point", "position": [0, 0, 0], "sampling_weight": 0.0}}
    without = render_stack(load(renderer, box(renderer, 1.0)), 64, 0, "ppm", lamps="uniform")["primal"].mean()
    found = render_stack(load(renderer, description), 64, 0, "ppm")["primal"].mean()
    assert found == pytest.approx(without, rel=0.05)
