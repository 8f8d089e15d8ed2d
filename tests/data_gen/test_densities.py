"""A material samples directions with the density that it tells others of them, from behind and below horizons too."""

import numpy as np
import pytest
from renders import dr

from data_gen.paths.vertex import SMOOTH, consistent, evaluate, event_kind

MATERIALS = {
    "diffuse": {"type": "diffuse"},
    "black": {"type": "diffuse", "reflectance": 0.0},
    "metal": {"type": "roughconductor", "alpha": 0.4},
    "streaked": {"type": "roughconductor", "distribution": "ggx", "alpha_u": 0.1, "alpha_v": 0.4},
    "plastic": {"type": "plastic"},
    "matte plastic": {"type": "roughplastic", "alpha": 0.3},
    "frosted": {"type": "roughdielectric", "alpha": 0.3},
    "principled": {"type": "principled", "roughness": 0.5, "spec_trans": 0.5, "metallic": 0.3},
    "blend": {"type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "roughconductor"}},
    "two sides": {"type": "twosided", "nested": {"type": "roughconductor", "alpha": 0.3}},
    "bowed": {
        "type": "normalmap",
        "normalmap": {"type": "rgb", "value": [0.8, 0.5, 0.8]},
        "bsdf": {"type": "diffuse"},
    },
}
LANES = 1 << 14


def sampled(mi, material):
    """A vertex seen from all sides, its material, and samples with what was said of them: as they come."""
    bsdf = mi.load_dict(material)
    numbers = np.random.default_rng(4).random((5, LANES), np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.t, si.sh_frame = mi.Float(1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.n, si.dp_du, si.dp_dv = mi.Normal3f(0, 0, 1), mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.wi = mi.warp.square_to_uniform_sphere(mi.Point2f(*numbers[:2]))
    sample, f_p = bsdf.sample(mi.BSDFContext(), si, mi.Float(numbers[2]), mi.Point2f(*numbers[3:]))
    return si, bsdf, sample, f_p


@pytest.mark.parametrize("name", MATERIALS)
def test_a_sampled_direction_has_the_density_that_others_are_told(renderer, name):
    si, bsdf, sample, f_p = sampled(renderer, MATERIALS[name])
    before = np.array(sample.pdf)
    ours = np.array(consistent(bsdf, si, sample, f_p).pdf)
    told = np.array(evaluate(bsdf, si, sample.wo)[1])
    smooth = np.array(event_kind(sample.sampled_type)) == SMOOTH
    # At the very horizon rounding decides.
    assert np.mean((ours > 0) != (told > 0), where=smooth) < 1e-3
    # What has light, or could have for another colour, is left as it is.
    kept = (np.array(f_p).max(axis=0) > 0) | ~smooth | (told > 0)
    assert np.array_equal(ours[kept], before[kept])
    if name in ("diffuse", "black", "metal"):
        assert np.mean((before > 0) & (told == 0)) > 0.01  # the trap is there
