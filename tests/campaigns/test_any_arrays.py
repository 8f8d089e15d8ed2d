"""Arrays of any kind through every method: a finite image of all that was given, or an error with a name."""

import time
import warnings
from collections import Counter

import numpy as np
import pytest
from full_stack import full_layers
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reliability import at_length, record

import ngpt
from ngpt.errors import NgptError
from ngpt.layers import LAYERS
from ngpt.methods import METHODS, reconstruct

SIZES = [(1, 1), (1, 2), (2, 1), (2, 2), (1, 17), (15, 1), (15, 17), (17, 16), (0, 2), (2, 0)]
DTYPES = ["f4", "f4", "f4", "f2", "f8", ">f4", "i4", "u1", "g", "?", "c8", "O"]
LAYOUTS = {
    "C": lambda a: a,
    "Fortran": np.asfortranarray,
    "upside down": lambda a: np.ascontiguousarray(a[::-1])[::-1],
    "every other": lambda a: np.repeat(a, 2, axis=0)[::2],
    "bottom to top, right to left": lambda a: np.ascontiguousarray(a[::-1, ::-1])[::-1, ::-1],
    "channels reversed": lambda a: np.ascontiguousarray(a[..., ::-1])[..., ::-1],
}
VALUES = [np.nan, np.inf, -np.inf, -0.0, 0.0, -1.0, -100.0, 1e-45, 1e-38, 65505.0, 1e12, 1e20, 1e30, 3.4e38, -3.4e38]
VALUES += [1e39]
TRIED: Counter = Counter()


@st.composite
def stacks(draw):
    """Layers of a plausible image, by name. Some are missing, of another type, or have other values."""
    height, width = draw(st.sampled_from(SIZES))
    made = full_layers(max(height, 1), max(width, 1), seed=draw(st.integers(0, 3)))
    made["direct"] = np.zeros_like(made["primal"])
    made["alpha"] = np.ones_like(made["depth"])
    for name in draw(st.lists(st.sampled_from(list(LAYERS)), max_size=3)):
        if name != "primal":
            made.pop(name, None)
    for name in list(made):
        made[name] = made[name][:height, :width]
    for name in draw(st.lists(st.sampled_from(sorted(made)), max_size=3)):
        value, where = draw(st.sampled_from(VALUES)), draw(st.sampled_from(["all", "one", "some", "column"]))
        layer = made[name].astype("f8")
        if where == "all":
            layer[:] = value
        elif layer.size:
            rng = np.random.default_rng(draw(st.integers(0, 9)))
            place = {"one": rng.integers(len(layer)), "some": rng.random(layer.shape) < 0.3, "column": np.s_[:, -1]}
            layer[place[where]] = value
        made[name] = layer if abs(value) > 3.5e38 and np.isfinite(value) else layer.astype("f4")
    if draw(st.booleans()):
        name, dtype = draw(st.sampled_from(sorted(made))), draw(st.sampled_from(DTYPES))
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            finite = dtype in ("i4", "u1", "O")
            made[name] = (np.nan_to_num(made[name], posinf=9, neginf=0) if finite else made[name]).astype(dtype)
    for name in made:
        made[name] = LAYOUTS[draw(st.sampled_from(list(LAYOUTS)))](made[name])
        made[name].flags.writeable = draw(st.booleans())
    return made


def finite_or_named(call, unwelcome=Warning):
    """What a call returns, without such a warning; None where it raises an error of one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", unwelcome)
            result = call()
    except NgptError as error:
        assert "\n" not in str(error) and 20 < len(str(error)) <= 1000, error
        TRIED["named error"] += 1
        return None
    TRIED["finite image"] += 1
    return result


def check(layers, method, options):
    """A finite image, with all repairs counted; or an error. Nothing that was given is changed."""
    before = {name: array.copy() for name, array in layers.items()}
    stacks = []

    def call():
        stacks.append(ngpt.GradientStack.from_arrays(path="s.exr", **layers))
        return reconstruct(stacks[0], method, **options)

    result = finite_or_named(call, RuntimeWarning)
    for name, array in before.items():
        assert np.array_equal(array, layers[name], equal_nan=array.dtype.kind in "fc"), f"{name} was modified"
    if result is None:
        return
    image, primal = result.image, stacks[0]["primal"]
    direct = stacks[0].layers.get("direct", np.zeros_like(primal))
    assert image.shape == primal.shape and image.dtype == np.float32 and np.isfinite(image).all()
    good = np.isfinite(primal).all(axis=-1) & np.isfinite(direct).all(axis=-1)
    assert result.repaired == np.sum(~good)
    if result.method == "primal":
        # Neither the dark nor the bright end is clamped; taking direct emission off and adding it rounds.
        rounding = 1e-6 * (np.abs(primal[good]) + np.abs(direct[good]))
        assert (np.abs(image[good] - primal[good]) <= rounding).all()


OPTIONS = [{}, {}, {}, {"alpha": "auto"}, {"alpha": 0.2}, {"alpha": 1e-6}, {"alpha": 0.0}, {"alpha": -1.0}]
OPTIONS += [{"alpha": float("nan")}, {"alpha": float("inf")}, {"alpha": 1e300}, {"alpha": 1e-300}, {"alpha": "x"}]


def options_of(method, options):
    return options if method in METHODS and "alpha" in METHODS[method].options else {}


QUICK = settings(
    max_examples=10, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
# Studies promise it of stacks as samplers make them.
FOR_USE = ["auto", *(name for name, method in METHODS.items() if method.standing != "study")]
# Networks that get neither variances nor a base promise nothing of the kind.
BLIND = ("oidn",)
SEEING = [name for name in FOR_USE[1:] if not METHODS[name].missing() and (METHODS[name].variant or name) not in BLIND]


@pytest.mark.parametrize(
    ("methods", "count"), [*(pytest.param([name], 10, id=name) for name in FOR_USE), at_length(FOR_USE, 500)]
)
def test_every_method_takes_any_arrays(methods, count):
    TRIED.clear()
    begun = time.perf_counter()
    for method in methods:
        # Each run of the long form tries other arrays.
        @settings(QUICK, max_examples=count, derandomize=count < 500)
        @given(layers=stacks(), options=st.sampled_from(OPTIONS))
        def try_them(method, layers, options):
            check(layers, method, options_of(method, options))

        try_them(method)
    seconds = round(time.perf_counter() - begun, 1)
    record("Arrays of any kind through every method", TRIED.total(), dict(TRIED), seconds=seconds)


@QUICK
@given(layers=stacks(), method=st.sampled_from(["auto", "l2", "wcv"]), announced=st.booleans())
def test_the_denoiser_takes_any_arrays(layers, method, announced):
    layers.pop("alpha", None)
    noisy, normals = layers.pop("primal"), layers.pop("normal", None)
    height, width = noisy.shape[:2]

    def call():
        denoiser = ngpt.Denoiser((width, height), announced, announced, method=method)
        return denoiser(noisy, normals=normals, to_sensor=np.eye(4), **layers)

    result = finite_or_named(call)
    assert result is None or (result.shape == noisy.shape and np.isfinite(result).all())


@QUICK
@given(layers=stacks(), method=st.sampled_from(["auto", "l2", "wcv"]))
def test_denoise_takes_any_arrays(layers, method):
    image, alpha = layers.pop("primal"), layers.pop("alpha", None)
    if alpha is not None and alpha.dtype == image.dtype:
        image = np.concatenate([image, alpha], axis=-1)
    result = finite_or_named(lambda: ngpt.denoise(image, method, **layers))
    if result is not None:
        assert result.shape == image.shape and np.isfinite(result[..., :3]).all()
        assert result.dtype == image.dtype and np.array_equal(result[..., 3:], image[..., 3:], equal_nan=True)


@pytest.mark.parametrize("method", SEEING)
def test_a_converged_image_of_any_range_keeps_its_range(method):
    """Negative, tiny and huge: where nothing is noisy, what comes out is not clamped to what displays show."""
    layers = full_layers(16, 17)
    layers |= {name: np.zeros_like(layers[name]) for name in ("dx", "dy", "primal_var", "dx_var", "dy_var")}
    for value in (1e6, 65505.0, 1e-6):
        layers["primal"] = np.full_like(layers["primal"], value)
        image = ngpt.denoise(ngpt.GradientStack(dict(layers)), method)
        assert np.allclose(image, value, rtol=0.05), (method, value, image.min(), image.max())


DENOISER = ngpt.Denoiser((4, 3))
REFUSALS = {
    "a number": (lambda a: DENOISER(1.0), r"noisy has shape \(\)"),
    "nothing": (lambda a: DENOISER(None), r"noisy has shape \(\)"),
    "matrix": (
        lambda a: ngpt.Denoiser((4, 3), normals=True)(a, normals=a, to_sensor=np.eye(5)),
        r"to_sensor is \(5, 5\) of float64",
    ),
}


@pytest.mark.parametrize("what", REFUSALS)
def test_what_the_denoiser_cannot_use_is_named(what):
    call, message = REFUSALS[what]
    with pytest.raises(NgptError, match=message):
        call(np.ones((3, 4, 3)))
