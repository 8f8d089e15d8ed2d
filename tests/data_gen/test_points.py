"""Points and lamps: nets of pixels and of blocks, what their noise claims, and less noise than without."""

import numpy as np
import pytest
from data_gen_scenes import fog
from renders import dr, mi
from scipy.ndimage import uniform_filter
from scipy.stats import kstest
from unbiased import load, stacks_of

from data_gen.film import GradientFilm
from data_gen.film.claims import box_means, factors
from data_gen.film.nets import ODD, RATES, SHARES, law, split
from data_gen.paths import streams
from data_gen.paths.streams import sample_streams
from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS
from data_gen.scenes.facts import scene_facts
from data_gen.scenes.lamps import lamp_weights, weighed
from ngpt import GradientStack
from ngpt.errors import NgptError
from ngpt.merging import merge

SIDE = 16


def of_image(samples, first=0, net=16, seed=3):
    """Streams of some samples of each pixel of a SIDE x SIDE image, pixel by pixel."""
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
def test_a_round_is_a_net_of_each_pixel_and_of_each_aligned_block(renderer, net, first, n):
    stream = of_image(n, first, net)
    for _ in range(3):
        points = pairs(stream, n)
        assert all(fills(points[y, x]) for y in (0, 5) for x in (0, 9))
        assert fills(points[4:6, 8:10].reshape(-1, 2)) and fills(points[8:12, 4:8].reshape(-1, 2))
        assert not fills(points[1:3, 8:10].reshape(-1, 2))  # not aligned


def test_single_numbers_are_stratified_too(renderer):
    numbers = np.array(of_image(16).next_1d()).reshape(-1, 16)
    assert (np.sort(np.floor(numbers * 16), axis=1) == np.arange(16)).all()


def test_each_point_is_uniform_over_seeds(renderer):
    found = np.array([pairs(of_image(4, seed=seed), 4) for seed in range(64)])
    tests = [kstest(found[:, 3, 11, sample, axis], "uniform") for sample in range(4) for axis in range(2)]
    assert min(test.pvalue for test in tests) > 0.01 / 8
    assert np.allclose(found.mean(axis=(0, 1, 2, 3)), 0.5, atol=1e-3) and found.min() >= 0 and found.max() < 1


def test_dimensions_rounds_seeds_and_tiles_are_independent(renderer):
    stream = of_image(16)
    one, other = pairs(stream, 16), pairs(stream, 16)
    further, again = pairs(of_image(16, 16), 16), pairs(of_image(16, seed=4), 16)
    pixel = dr.arange(mi.UInt32, 64 * 64 * 4)
    tiles = np.array(streams.sample_streams(3, pixel, mi.UInt32(0), 128, 16).next_1d()).reshape(128, 128)
    light = np.array(streams.light_streams(3, dr.arange(mi.UInt32, SIDE * SIDE * 16), 0).next_1d())
    others = [one[..., 1], *(each[..., 0] for each in (other, further, again)), light]
    for a, b in (*((one[..., 0], other) for other in others), (tiles[:64, :64], tiles[64:, :64])):
        # Five standard errors of independent numbers, which nets keep well within
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5 / np.sqrt(a.size)


@pytest.mark.parametrize("net", [0, 16])
def test_streams_replay_skip_and_gather(renderer, net):
    stream = of_image(4, net=net)
    copy, ahead, idle = stream.clone(), stream.clone(), stream.clone()
    numbers = [pairs(stream, 4), np.array(stream.next_1d()), pairs(stream, 4)]
    # Lanes that do not draw stay where they are.
    idle.next_2d(mi.Bool(np.arange(SIDE * SIDE * 4) % 2 == 0))
    assert np.array_equal(np.array(idle.next_1d())[1::2], np.array(copy.clone().next_1d())[1::2])
    assert np.array_equal(numbers[0], pairs(copy, 4))
    ahead.skip(mi.UInt32(3))
    assert np.array_equal(numbers[2], pairs(ahead, 4))
    assert np.array_equal(np.array(copy.at(mi.UInt32([7, 90])).next_1d()), numbers[1][[7, 90]])
    keys = np.array(copy.next_key())
    assert len(np.unique(keys)) > 0.99 * len(keys)


def test_first_rounds():
    assert [streams.first_round("sobol", n) for n in (1, 4, 5, 64, 100, None)] == [1, 4, 8, 64, 128, 16]
    assert streams.first_round("rounds", 64) == 16
    assert streams.first_round("independent", 64) == 0
    assert streams.first_round("sobol", 2**31 - 1) == 2**20


def block_means(images, side=8):
    n, height, width, channels = images.shape
    return images.reshape(n, height // side, side, width // side, side, channels).mean(axis=(2, 4))


def test_points_take_noise_away(renderer):
    """Of pixels, and more of blocks; that they take no light, see ``laws``."""
    scene, found = load(renderer, "diffuse", (24, 16)), []
    for points in ("sobol", "independent"):
        stacks = stacks_of(scene, "gpt", 16, 16, points=points)
        found.append({name: np.array([stack[name] for stack in stacks], np.float64) for name in ("primal", "dx")})
    for layer, most, of_blocks in (("primal", 0.9, 0.75), ("dx", 0.98, np.inf)):
        images = [layers[layer] for layers in found]
        quiet = np.argsort(images[1].var(axis=0).ravel())[: int(0.98 * images[1][0].size)]
        better, before = (each.var(axis=0, ddof=1).ravel()[quiet].mean() for each in images)
        assert better < most * before, layer
        better, before = (np.median(block_means(each).var(axis=0, ddof=1)) for each in images)
        assert better < of_blocks * before, layer


# ------------------------- What variances claim -------------------------


def test_images_of_one_row_or_column_have_no_differences_in_them(renderer, rng):
    for width, height in ((1, 1), (2, 1), (1, 2)):
        film = GradientFilm(width, height, net=2)
        for _ in range(2):
            for name in ("primal", "dx+", "dx-", "dy+", "dy-"):
                film.put(name, renderer.Color3f(*rng.random((3, width * height), np.float32)))
            film.end_pass(1)
        layers = film.develop()
        assert np.isfinite(layers["dx_var"]).all() and layers["dx"].shape == (height, width, 3)


@pytest.mark.parametrize("shape", [(36, 64), (1, 7), (0, 7)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_box_means_are_those_of_scipy_to_the_bit(renderer, rng, shape, kind):
    image = rng.gamma(0.2, size=shape).astype(kind)
    for size in (5, 4):
        assert np.array_equal(box_means(image, size), uniform_filter(image, size))


CLAIMS = [("primal", "glossy", (48, 32), 17), ("gpt", "glossy", (48, 32), 17)]
# Over passes of one sample: just after half of a net, where the claim was 0.7 of the noise
CLAIMS += [("ppm", "diffuse", (48, 32), 17)]
SLOW = [("bdpt", "diffuse", (64, 40), 12), ("vcm", "diffuse", (64, 40), 17), ("bre", fog, (32, 24), 17)]


@pytest.mark.parametrize(
    ("sampler", "scene", "size", "spp"), [*CLAIMS, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)]
)
def test_claims_are_those_over_seeds(renderer, sampler, scene, size, spp):
    assert_claims_are_those_over_seeds(renderer, sampler, scene, size, spp)


def assert_claims_are_those_over_seeds(renderer, sampler, scene, size, spp):
    scene, options = load(renderer, scene, size), {"features": False} if sampler == "primal" else {}
    stacks = stacks_of(scene, sampler, 10, spp, **options)
    for layer in ("primal", "dx", "dy", "caustic"):
        if layer in stacks[0].names:
            part = "caustic" if layer == "primal" and "caustic" in stacks[0].names else None
            images = [stack[layer] - stack[part] if part else stack[layer] for stack in stacks]
            seen = np.var(images, axis=0, ddof=1, dtype=np.float64)
            told = np.mean([stack[f"{layer}_var"] for stack in stacks], axis=0, dtype=np.float64)
            quiet = np.argsort(told.ravel())[: int(0.99 * told.size)]
            real, claimed = (each.ravel()[quiet].mean() for each in (seen, told))
            # Of light that only the noisiest pixels have, the others have none, to the digits of the stack.
            none = layer == "caustic" and max(real, claimed) <= 1e-12 * told.max()
            assert none or 0.8 < real / claimed < 1.25, (layer, real, claimed)


def test_noise_of_features_is_that_over_seeds(renderer):
    scene = load(renderer, "lens", (64, 40))
    stacks = stacks_of(scene, "primal", 8, 16)
    seen = max(np.var([s[name] for s in stacks], axis=0, ddof=1).mean() for name in ("albedo", "normal"))
    told = np.mean([stack.attributes["ngpt:featureNoise"] for stack in stacks])
    assert 0.5 < seen / told < 2
    for spp, options in ((16, {"features": False}), (1, {})):
        assert "ngpt:featureNoise" not in render_stack(scene, spp, 0, "primal", unbiased=True, **options).attributes


EXTENT = 48, 32


def put_samples(film, seed, numbers, net, some=None):
    """Samples of these ``numbers`` of all pixels, or of ``some``: steps in four dimensions, and rare bright ones."""
    some = np.arange(EXTENT[0] * EXTENT[1], dtype=np.uint32) if some is None else some
    pixel, sample = np.repeat(some, len(numbers)), np.tile(np.asarray(numbers, np.uint32), len(some))
    stream = sample_streams(seed, mi.UInt32(pixel), mi.UInt32(sample), EXTENT[0], net)
    p, q = (np.array(stream.next_2d()) for _ in range(2))
    step = p[0] + 0.6 * p[1] < 0.3 + 0.9 * (pixel % EXTENT[0]) / EXTENT[0]
    rare = 3.0 * ((q[0] < 0.1) & (p[0] < 0.1))
    corner = (p[0] < 0.5) & (q[0] + q[1] < 1.1)
    film.put("primal", mi.Color3f(*np.stack([step, rare, corner]).astype(np.float32)))
    film.end_pass(len(numbers), *([] if len(some) == EXTENT[0] * EXTENT[1] else [some]))


def evenly(seed, n, net):
    """The first ``n`` samples of each pixel, in blocks of 16 and what is left over, as renders put them."""
    film = GradientFilm(*EXTENT, net=net)
    for begin in range(0, n, 16):
        put_samples(film, seed, range(begin, min(n, begin + 16)), net)
    return film.develop()


def adaptively(seed):
    """Blocks of 16 samples, 1 to 5 of them by the row of the pixel."""
    film = GradientFilm(*EXTENT, net=16)
    each = 1 + np.arange(EXTENT[0] * EXTENT[1]) // EXTENT[0] % 5
    for begin in range(5):
        some = np.flatnonzero(each > begin).astype(np.uint32)
        put_samples(film, seed, range(16 * begin, 16 * begin + 16), 16, some)
    return film.develop()


def merged(seed):
    """Stacks of 17, 9 and 4 samples as one."""
    parts = []
    for i, n in enumerate((17, 9, 4)):
        attributes = {"ngpt:spp": n, "ngpt:seed": str(i), "ngpt:sampler": "primal"}
        parts.append(GradientStack(evenly(100 * i + seed, n, 32), attributes=attributes))
    return merge(parts)


def check_claims(stacks):
    real = np.var([stack["primal"] for stack in stacks], axis=0, ddof=1, dtype=np.float64).sum()
    assert 0.8 < real / np.mean([stack["primal_var"] for stack in stacks], axis=0, dtype=np.float64).sum() < 1.25


@pytest.mark.parametrize("n", [7, 16, 17, 31, 65, 129])
@pytest.mark.parametrize("net", [16, 4096, None])
def test_claims_hold_at_any_number_of_samples(renderer, net, n):
    """In rounds, in a part of a net, and in the net that is made for this number."""
    net = net or streams.first_round("sobol", n)
    check_claims([evenly(seed, n, net) for seed in range(8)])


@pytest.mark.parametrize("n", [32, 128])
def test_claims_hold_of_smooth_light_beside_light_found_by_luck(renderer, rng, n):
    """Smooth light is all but gone at these numbers, and faster than that of steps: the claim was 0.7 of the noise."""
    pixel, sample = np.divmod(np.arange(EXTENT[0] * EXTENT[1] * n, dtype=np.uint32), n)
    x, stacks = pixel % EXTENT[0] / EXTENT[0], []
    for seed in range(6):
        film = GradientFilm(*EXTENT, net=n)
        u, v = np.array(sample_streams(seed, mi.UInt32(pixel), mi.UInt32(sample), EXTENT[0], n).next_2d())
        smooth = np.cos(np.pi * u) * (1 - x) + (2 * v - 1) * x + (2 * u - 1) * (2 * v - 1)
        light = (1 + x / 2) * smooth + 0.4 * rng.normal(size=len(pixel))
        film.put("primal", mi.Color3f(mi.Float(light.astype(np.float32))))
        film.end_pass(n)
        stacks.append(film.develop())
    check_claims(stacks)


@pytest.mark.parametrize("stack_of", [adaptively, merged])
def test_claims_hold_where_samples_come_in_parts(renderer, stack_of):
    check_claims([stack_of(seed) for seed in range(10)])


def test_two_samples_say_nothing_of_the_law(rng):
    """Their contrast is their sample variance, whatever the law; what it says was up to the last digit once."""
    a, b = rng.normal(size=(2, 32, 48, 3)) * rng.gamma(0.3, size=(32, 48, 1))
    found = factors((b - a) / 2, np.var([a, b], axis=0, ddof=1) / 2, np.full((32, 48), 2), 2)
    assert np.ptp(found) == 0 and 0.6 < found.mean() < 1


@pytest.mark.parametrize("pixels", [1, 4, 1 << 14])
def test_the_more_pixels_the_more_they_say(rng, pixels):
    """Whether samples are independent or not is known of many pixels, and not of one, which decides nothing."""
    for rate in (1.0, 1.5):
        values = rng.normal(size=(pixels, 16))
        # Pairs of quarters, halves and the whole of a net have less and less noise of their own.
        for m in (2, 4, 8, 16):
            blocks = values.reshape(pixels, -1, m)
            blocks -= blocks.mean(axis=-1, keepdims=True) * (1 - 2 ** ((1 - rate) / 2))
        contrast, variance = (
            (values[:, 8:].mean(axis=1) - values[:, :8].mean(axis=1)) / 2,
            values.var(axis=1, ddof=1) / 16,
        )
        found = factors(contrast.reshape(1, -1, 1), variance.reshape(1, -1, 1), np.full((1, pixels), 16), 16).mean()
        low, high = (0.8, 1.25) if pixels > 64 else (0.1, 2)
        truth = values.mean(axis=1).var() / variance.mean() if pixels > 64 else 1
        assert low < found / truth < high, rate


@pytest.mark.parametrize("net", [1, 16, 64])
def test_laws_are_sums_over_pairs_of_samples(net):
    """For any number of samples: the covariances of all pairs, added up one by one."""

    def variance_of(m):
        return SHARES / m + (1 - SHARES) * (ODD if np.log2(m) % 2 else 1) * m**-RATES

    def covariance(i, j):
        first, size = (0, net) if i < net else (1 << i.bit_length() - 1,) * 2
        if not first <= j < first + size:
            return 0 * RATES
        together = 1 << ((i - first) ^ (j - first)).bit_length()
        return 2 * variance_of(together) - variance_of(together / 2) if together > 1 else 1 + 0 * RATES

    for n in (2, 3, 5, 16, 17, 31, 48, 65):
        covariances = np.array([[covariance(i, j) for j in range(n)] for i in range(n)])
        n1 = split(n)
        assert n / 3 <= n1 <= 2 * n / 3
        weights = np.where(np.arange(n) < n1, -1 / n1, 1 / (n - n1)) * np.sqrt(n1 * (n - n1)) / n
        variance = covariances.mean(axis=(0, 1))
        claimed = (1 - variance) / (n - 1)
        assert np.allclose(law(n, net).truth, variance / claimed)
        assert np.allclose(law(n, net).seen, np.einsum("i,j,ijr->r", weights, weights, covariances) / claimed)
        assert (law(n, net).seen > 0).all() and (law(n, net).truth > 0).all()


# ------------------------- Lamps -------------------------


def lamp_at(kind, radiance, weight, place):
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return {"type": kind, "to_world": place, "emitter": emitter | ({} if weight is None else weight)}


def seen(origin, target):
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}},
        },
    }


def room(weights=(None, None, None)):
    """A floor under a strong lamp and two weak ones."""
    at, lamps = mi.ScalarTransform4f(), {}
    for i, weight in enumerate(weights):
        given = None if weight is None else {"sampling_weight": weight}
        place = at.translate([(0, 1, -1)[i], 0, 2]).rotate([1, 0, 0], 180).scale(0.2)
        lamps[f"lamp{i}"] = lamp_at("rectangle", (90.0, 1.0, 1.0)[i], given, place)
    return seen([0, 4, 1.5], [0, 0, 0]) | {"floor": {"type": "rectangle", "to_world": at.scale(9)}} | lamps


def test_lamps_are_chosen_by_what_they_bring_and_left_as_they_were(renderer):
    scene = load(renderer, room())

    def chosen():
        return [float(scene.pdf_emitter(i)[0]) for i in range(3)]

    weights = lamp_weights(scene)
    assert weights.max() > 0.8 and weights.min() > 0.05 and np.isclose(weights.sum(), 1)
    with weighed(scene, "power"):
        assert np.allclose(chosen(), weights, atol=1e-3)
    assert [emitter.sampling_weight() for emitter in scene.emitters()] == [1, 1, 1]
    assert np.allclose(chosen(), 1 / 3)
    with weighed(scene, "uniform"):
        assert np.allclose(chosen(), 1 / 3)
    assert np.array_equal(lamp_weights(scene), weights)


def test_weights_that_a_scene_gives_are_honoured(renderer):
    scene = load(renderer, room((1.0, 0.0, 3.0)))
    with weighed(scene, "power"):
        assert sorted(float(scene.pdf_emitter(i)[0]) for i in range(3)) == [0, 0.25, 0.75]


def test_lamps_take_noise_away_and_no_light(renderer):
    scene, found = load(renderer, room()), []
    for lamps in ("power", "uniform"):
        stacks = stacks_of(scene, "gpt", 16, 16, points="independent", lamps=lamps)
        found.append(np.array([stack["primal"] for stack in stacks], np.float64).mean(axis=-1))
    better, before = (np.median(images.var(axis=0, ddof=1)) for images in found)
    assert better < 0.6 * before
    means = [images.reshape(16, -1).mean(axis=1) for images in found]
    z = (means[0].mean() - means[1].mean()) / np.sqrt(sum(part.var(ddof=1) for part in means) / 16)
    assert abs(z) < 4


def box(weight, fog=False):
    """Within a grey box, two lamps beside each other, a ball and a square; the ball is chosen by ``weight``."""
    at = mi.ScalarTransform4f()
    ball, square = at.translate([-0.5, -0.2, 0.6]).scale(0.3), at.translate([0.5, -0.2, 0.98]).rotate([1, 0, 0], 180)
    scene = seen([0, -0.9, 0], [0, 1, -0.3]) | {
        "walls": {"type": "cube", "flip_normals": True},
        "ball": lamp_at("sphere", 4.0, {"id": "hidden", "sampling_weight": weight}, ball),
        "square": lamp_at("rectangle", 4.0, {"id": "seen", "sampling_weight": 1.0}, square.scale(0.4)),
    }
    if fog:
        scene["sensor"]["medium"] = {"type": "ref", "id": "fog"}
        air = {"type": "homogeneous", "id": "fog", "albedo": 0.7, "sigma_t": 0.3}
        scene = {"type": "scene", "fog": air} | scene | {"integrator": {"type": "volpath", "max_depth": 3}}
    return scene


@pytest.fixture(scope="module")
def light_of_box(renderer):
    """Means of images, where both lamps are chosen."""
    scene = load(renderer, box(1.0))
    return np.array([np.array(renderer.render(scene, spp=256, seed=100 + seed)).mean() for seed in range(8)])


@pytest.mark.parametrize(
    "sampler",
    [n if e.standing != "study" else pytest.param(n, marks=pytest.mark.slow) for n, e in SAMPLERS.items()],
)
def test_light_of_a_lamp_that_is_chosen_never_is_found_or_refused(renderer, light_of_box, sampler):
    scene = load(renderer, box(0.0))
    if SAMPLERS[sampler].refuses(scene_facts(scene)):
        scene = load(renderer, box(0.0, fog=True))
    # Of what gathers photons alone
    if "photons" in SAMPLERS[sampler].options:
        with pytest.raises(NgptError, match=f"'{sampler}' .*'hidden', which has sampling_weight 0; give it a positive"):
            render_stack(scene, 1, 0, sampler, unbiased=True)
        return
    spp = 3 if SAMPLERS[sampler].batch == 1 else 16
    means = np.array([stack["primal"].mean() for stack in stacks_of(scene, sampler, 8, spp)])
    z = (means.mean() - light_of_box.mean()) / np.sqrt((means.var(ddof=1) + light_of_box.var(ddof=1)) / 8)
    # About p = 0.001 of so few images
    assert abs(z) < 5 and abs(means.mean() / light_of_box.mean() - 1) < 0.1


def test_a_point_that_is_chosen_never_is_off(renderer):
    description = box(1.0) | {"point": {"type": "point", "position": [0, 0, 0], "sampling_weight": 0.0}}
    without = render_stack(load(renderer, box(1.0)), 64, 0, "ppm", lamps="uniform", unbiased=True)["primal"].mean()
    found = render_stack(load(renderer, description), 64, 0, "ppm", unbiased=True)["primal"].mean()
    assert found == pytest.approx(without, rel=0.05)


def test_pixels_that_lost_their_samples_say_nothing_about_others():
    """Points take most of the noise away in all of them, also in those that are grouped last."""
    random, size, n = np.random.default_rng(5), (32, 32), 16
    variance = random.gamma(4, size=(*size, 1))
    contrast = 0.2 * random.normal(size=(*size, 1)) * np.sqrt(variance)
    variance[3, 4] = contrast[3, 4] = np.nan
    found = factors(contrast, variance, np.full(size, n), n)[..., 0]
    assert found[3, 4] == 1 and np.delete(found.ravel(), 3 * 32 + 4).max() < 0.7


def test_claims_of_a_pixel_go_by_the_noise_around_it():
    """In an even area, the factor hardly depends on whether a pixel has a rare sample itself.

    Grouped by their own variance, pixels without one have a fourteenth of the factor.
    """
    random, size, n = np.random.default_rng(5), (64, 64), 16
    rare = random.random(size) < 0.02
    variance = np.where(rare, 100.0, 1.0)[..., None]
    # Points cancel the noise of smooth light, and not that of rare samples.
    contrast = random.normal(size=(*size, 1)) * np.sqrt(variance * np.where(rare, 1.0, 0.05)[..., None])
    found = factors(contrast, variance, np.full(size, n), n)[..., 0]
    assert found[~rare].mean() > 0.4 * found[rare].mean()
