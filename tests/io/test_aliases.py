"""Layer names: each producer's files, overrides, ambiguities, and what is refused."""

import re
from pathlib import Path

import pytest

from ngpt.errors import NgptError
from ngpt.io.aliases import ALIASES, format_aliases
from ngpt.io.resolution import propose, resolve, resolve_alone
from ngpt.layers import LAYERS


def names(*layers: str) -> list[str]:
    """Spells channel names out: names("dx.RGB", "A") are dx.R, dx.G, dx.B and A."""
    channels = []
    for layer in layers:
        prefix, dot, suffixes = layer.rpartition(".")
        channels += [f"{prefix}.{suffix}" for suffix in suffixes] if dot else list(layer)
    return channels


def spelled(text: str, separator: str) -> list[str]:
    """The channels of a list in ``producers.txt``."""
    words = text.split(separator)
    return [channel for word in words for channel in ([word[1:]] if word.startswith("=") else names(word))]


def producers() -> dict[str, tuple[list, dict]]:
    """What ``producers.txt`` holds: name -> (parts, layer -> channels)."""
    found: dict[str, tuple[list, dict]] = {}
    text = re.sub(r"^#.*\n", "", Path(__file__).with_name("producers.txt").read_text(), flags=re.M)
    for line in text.replace("\n        ", " ").splitlines():
        if not line.startswith(" "):
            parts, layers = found[line] = [], {}
        elif line.startswith("    -> "):
            for entry in line.removeprefix("    -> ").split(", "):
                layer, _, channels = entry.partition(" = ")
                layers[layer] = spelled(channels, " + ")
        else:
            part, colon, channels = line.strip().rpartition(": ")
            parts.append((part if colon else "", spelled(channels, ", ")))
    return found


PRODUCERS = producers()


@pytest.mark.parametrize("producer", PRODUCERS)
def test_each_producer_is_understood(producer):
    parts, expected = PRODUCERS[producer]
    found = resolve(parts)
    assert {name: list(where.channels) for name, where in found.items()} == expected
    for name, where in found.items():
        assert set(where.channels) <= set(parts[where.part][1]), name


TWO_VIEWS = [("", names("Near.Combined.RGBA", "Far.Combined.RGBA", "Near.Denoising Albedo.RGB", "Far.Depth.Z"))]


def test_two_view_layers_are_ambiguous_until_an_override_settles_it():
    with pytest.raises(NgptError) as caught:
        resolve(TWO_VIEWS, path="shot.exr")
    message = str(caught.value)
    assert message.startswith("shot.exr: layer 'primal' could be any of ")
    assert '"Near.Combined", "Far.Combined"' in message and '--layer primal="Near.Combined"' in message
    found = resolve(TWO_VIEWS, {"primal": "Far.Combined"})
    assert found["primal"].channels[0] == "Far.Combined.R"
    assert found["alpha"].channels == ("Far.Combined.A",)
    assert found["depth"].name == "Far.Depth" and "albedo" not in found  # Near's is of another image
    assert resolve(TWO_VIEWS, {"primal": "Far.Combined", "albedo": "Near.Denoising Albedo"})["albedo"].name[0] == "N"


def test_the_layer_of_primal_decides_where_the_others_come_from():
    both = ("Combined.RGBA", "Denoising Albedo.RGB", "Denoising Normal.XYZ", "Vector.XYZW")
    layers = [f"{view}.{layer}" for view in ("Near", "Far") for layer in both]
    parts = [(name.rpartition(".")[0], names(name)) for name in layers]  # as Blender 5 writes them
    for listing in ([("", names(*layers))], parts):
        for view in ("Near", "Far"):
            found = resolve(listing, {"primal": f"{view}.Combined"})
            assert {"albedo", "normal", "motion", "alpha"} < set(found)
            assert all(where.name.startswith(f"{view}.") for where in found.values())
            # A result keeps the input elsewhere, and says where it came from.
            result = [*listing, ("ngpt", names("RGBA", "primal.RGB"))]
            again = resolve(result, origin=f"{view}.Combined")
            assert again["primal"].channels[0] == "primal.R" and again["albedo"] == found["albedo"]
        assert propose([("", names("Near.Combined.RGB", "Far.Combined.RGB", "Far.albedo_x.RGB"))], found) == {}


def test_overrides_beat_aliases_match_tails_and_settle_only_their_own_layer():
    parts = [("", [*names("RGB", "albedo.RGB", "View.Paint.RGB"), "distance"])]
    found = resolve(parts, {"albedo": "Paint", "depth": "distance"})
    assert found["albedo"].channels[0] == "View.Paint.R" and found["depth"].channels == ("distance",)
    parts = [("", names("RGB", "a.Denoising Albedo.RGB", "b.Denoising Albedo.RGB"))]
    for overrides in ({}, {"albedo": "Denoising Albedo"}, {"depth": "R"}):
        with pytest.raises(NgptError, match="layer 'albedo' could be any of"):
            resolve(parts, overrides)
    assert resolve(parts, {"albedo": "b.Denoising Albedo"})["albedo"].channels[1] == "b.Denoising Albedo.G"


@pytest.mark.parametrize(
    ("channels", "overrides", "expected"),
    [
        (names("RGB", "dx.RG"), {}, "layer 'dx' is incomplete: 'dx' lacks channel B (it holds dx.R, dx.G)"),
        ([*names("RGB", "dy.RGB"), "dy.red"], {}, "layer 'dy' has one channel twice, dy.R and dy.red"),
        (names("a.RGB", "fog.RGB"), {}, 'holds "a" (R G B), "fog" (R G B); name it with --layer primal="NAME"'),
        (names("N.XYZ", "albedo.RGB"), {}, "no primal image"),
        ([*"XYZ"], {}, "holds channel Y beside others but no colours R G B"),
        ([], {}, "no primal image"),
        (names("RGB"), {"colour": "x"}, "no layer is called 'colour'; use one of primal, direct, caustic, dx"),
        (names("RGB", "N.XYZ"), {"albedo": "Paint"}, '--layer albedo="Paint" fits no layer with channels R G B; '),
        (names("RGB", "N.XYZ"), {"dx": "albed"}, '"root" (R G B), "N" (X Y Z)'),
        (names("RGB", "v.RG"), {"motion": "v.R,-v.G,B"}, "fits no layer with channels X Y"),
    ],
)
def test_files_and_names_that_make_no_stack(channels, overrides, expected):
    with pytest.raises(NgptError) as caught:
        resolve([("", channels)], overrides, path="a.exr")
    assert str(caught.value).startswith("a.exr: ") and expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["beauty", "fog", "Normal lights.beauty"])
def test_the_only_layer_of_colour_is_the_colour(name):
    more = names("albedo.RGB", "N.XYZ", "CryptoObject00.rgba", "worldPosition.RGB", "albedo_var.RGB", "diffuse.RGB")
    found = resolve([("", [*names(f"{name}.RGBA"), *more])])
    assert found["primal"].name == name and found["alpha"].channels == (f"{name}.A",)
    assert found["albedo"].name == "albedo"
    parts = [("albedo", list("RGB")), (name, list("RGBA"))]
    assert resolve(parts)["primal"].part == 1


def test_motion_of_cycles_is_turned_to_ours():
    """XY leads to the frame before with y up: seen in files of Blender 5.0."""
    found = resolve([("", names("ViewLayer.Combined.RGB", "ViewLayer.Vector.XYZW"))])["motion"]
    assert found.channels == ("ViewLayer.Vector.X", "ViewLayer.Vector.Y") and found.factors == (1, -1)
    # A vector of somebody else is none.
    assert "motion" not in resolve([("", names("RGB", "Vector.XYZ"))])


@pytest.mark.parametrize(
    ("text", "channels", "factors"),
    [
        ("-0.5*velocity.R, +1e2*velocity.G", ("velocity.R", "velocity.G"), (-0.5, 100)),
        ("mv.x,-mv.y", ("beauty.mv.x", "beauty.mv.y"), (1, -1)),
    ],
)
def test_channels_with_signs_and_factors_make_a_layer(text, channels, factors):
    parts = [("", names("RGB", "velocity.RGB", "beauty.mv.xy", "N.XYZ"))]
    found = resolve(parts, {"motion": text})["motion"]
    assert (found.channels, found.factors) == (channels, factors)


@pytest.mark.parametrize(
    ("name", "parts", "channels"),
    [
        ("albedo", [("", list("RGBA"))], list("RGB")),
        ("normal", [("", list("RGB"))], list("RGB")),
        ("depth", [("", ["Y"])], ["Y"]),
        ("depth", [("", list("RGBA"))], ["R"]),
        ("albedo", [("", names("ViewLayer.Paint.RGB"))], names("ViewLayer.Paint.RGB")),
        ("albedo", [("", names("RGBA", "Denoising Albedo.RGB"))], names("Denoising Albedo.RGB")),
        ("albedo", [("beauty", list("RGB")), ("paint", list("RGB"))], list("RGB")),
        ("normal", [("", names("uv.RG", "bend.XYZ"))], names("bend.XYZ")),
    ],
)
def test_a_layer_in_a_file_of_its_own(name, parts, channels):
    found = resolve_alone(parts, name, "a.exr")
    assert list(found.channels) == channels and found.part == 0


@pytest.mark.parametrize(
    ("channels", "expected"),
    [
        (names("RGB", "x.BaseColor.RGB", "shading_normal.XYZ", "CameraDistance.R"),
         {"albedo": "x.BaseColor", "normal": "shading_normal", "depth": "CameraDistance"}),
        (names("RGB", "Grad_X.RGB", "Grad_Y.RGB"), {"dx": "Grad_X", "dy": "Grad_Y"}),
        (names("RGB", "albedo_variance.RGB", "diffuse.RGB", "emission.RGB"), {}),
        (names("RGB", "ZDepth.Z", "VRayZDepth.RGB"), {}),
        (names("RGB", "motionvector.RGB"), {"motion": "-motionvector.R,motionvector.G"}),
        (names("RGB", "view.velocity.XYZ"), {"motion": "-view.velocity.X,view.velocity.Y"}),
    ],
)  # fmt: skip
def test_layers_that_look_like_missing_ones_are_proposed(channels, expected):
    parts = [("", channels)]
    proposed = propose(parts, resolve(parts))
    assert proposed == expected
    # What is proposed can be asked for.
    found = resolve(parts, proposed)
    assert {name: found[name].name for name in proposed} == expected


@pytest.mark.parametrize(
    ("layer", "channels", "taken"),
    [
        ("direct", "direct.RGB", {"writer": "ngpt"}),
        ("direct", "direct.RGB", {"overrides": {"direct": "direct"}}),
        ("caustic", "caustic.RGB", {"overrides": {"caustic": "caustic"}}),
        ("albedo", "diffuse.RGB", {"writer": "V-Ray"}),
        ("diffuse", "diffuse.RGB", {"writer": "ngpt"}),
        ("specular", "specular.RGB", {"writer": "ngpt"}),
        ("specular", "specular.RGB", {"overrides": {"specular": "specular"}}),
    ],
)
def test_names_that_mean_something_else_elsewhere(layer, channels, taken):
    """Names like these are any light or colour in the files of others."""
    parts = [("", names("RGB", channels))]
    assert layer not in resolve(parts) and layer in resolve(parts, **taken)


def test_layers_that_nobody_else_writes_tell_what_those_beside_them_mean():
    for layer, beside in (("direct", "dy"), ("caustic", "dx"), ("caustic", "caustic_var"), ("diffuse", "diffuse_var")):
        assert layer in resolve([("", names("RGB", f"{layer}.RGB", f"{beside}.RGB"))])


def test_the_alias_table_is_complete_and_printed_in_full():
    assert {alias.layer for alias in ALIASES} == set(LAYERS)
    assert len(format_aliases().splitlines()) == len(ALIASES) + 1
    for name in LAYERS:
        assert next(alias.name for alias in ALIASES if alias.layer == name) == name, "canonical names come first"
