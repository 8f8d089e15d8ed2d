"""What entries say of samplers: typed options, one place for each default, names that are nearly right."""

from pathlib import Path

import pytest

import data_gen
import ngpt
from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS, Sampler, check_options, choose, find, register
from ngpt.errors import NgptError

pytest.importorskip("mitsuba")

from data_gen.dataset.config import read_config
from data_gen.dataset.crops import render_input
from data_gen.samplers.__main__ import table
from data_gen.scenes.facts import Facts, scene_facts

ENTRIES = {**SAMPLERS, **FRAME_SAMPLERS}
OPTIONS = [(name, option) for name, entry in ENTRIES.items() for option in entry.options]


@pytest.mark.parametrize(("name", "option"), OPTIONS)
def test_defaults_are_allowed_and_other_values_are_not(name, option):
    entry = ENTRIES[name]
    default = entry.options[option].default
    assert entry.settings({option: default})[option] == default
    wrong = [None, [], "nonsense", "nan", *(["no", 1] if isinstance(default, bool) else [True])]
    low, high = entry.options[option].range
    wrong += [low - 1] if low > float("-inf") else []
    wrong += [high * 2] if high < float("inf") else []
    for value in wrong:
        with pytest.raises(NgptError, match=f"^sampler '{name}', option '{option}': .* is not allowed; it takes "):
            entry.settings({option: value})


def test_names():
    with pytest.raises(NgptError, match="there is a sampler 'gpt' already"):
        register(Sampler("gpt", "another", "other"))
    with pytest.raises(NgptError, match=r"unknown sampler 'gtp'; did you mean 'gpt'\? choose one of: auto, gpt,"):
        find("gtp")
    with pytest.raises(NgptError, match="standing 'useful' is none of use, niche, study"):
        Sampler("new", "another", "other", standing="useful")


def test_options_of_auto_are_refused_with_samplers_that_have_them():
    check_options("auto", {})
    # What all samplers have that "auto" may take goes to whichever is chosen.
    check_options("auto", {"points": "independent", "lamps": "uniform"})
    with pytest.raises(NgptError, match=r"option 'radius' needs a sampler that has it, not 'auto': .*ppm, .*vcm"):
        check_options("auto", {"radius": "2"})
    with pytest.raises(NgptError, match=r"sampler 'auto' has no option 'point'; did you mean 'points'\?"):
        check_options("auto", {"point": "sobol"})
    with pytest.raises(NgptError, match=r"sampler 'auto', option 'points': .*rounds"):
        check_options("auto", {"points": "halton"})


def test_frames_take_options_from_the_command_line(renderer, command):
    line = "render diffuse --frames 0:1 --size 8x6 -o shot --force"
    command(f"{line} --spp 2 --sampler gpt -O caustic=false")
    assert ngpt.read("shot/diffuse.0000.exr").attributes["ngpt:samplerOptions"] == "caustic=false"


def test_the_table_in_the_docs_is_what_entries_say():
    text = (Path(__file__).parents[2] / "docs" / "use" / "rendering.md").read_text()
    _, _, rest = text.partition("<!-- python -m data_gen.samplers -->\n\n")
    assert rest.split("\n\n<!-- end -->")[0] == table(), "python -m data_gen.samplers prints it anew"


def test_light_paths_refuse_hair(renderer):
    """Mitsuba's is not the same in both directions: light paths lost half a percent in it. Within others, too."""
    import mitsuba as mi

    def facts(bsdf):
        parts = {"camera": {"type": "perspective"}, "ball": {"type": "sphere", "bsdf": bsdf}}
        return scene_facts(mi.load_dict({"type": "scene", "integrator": {"type": "path"}} | parts))

    masked = {"type": "mask", "opacity": 0.5, "within": {"type": "hair"}}
    for bsdf in ({"type": "hair"}, masked):
        refused = {name for name, sampler in SAMPLERS.items() if "'hair'" in sampler.refuses(facts(bsdf))}
        assert {name for name in refused if SAMPLERS[name].standing != "study"} == {"bdpt", "vcm", "ppm"}
    assert not facts({"type": "mask", "opacity": 0.5, "within": {"type": "diffuse"}}).hair


def test_the_first_in_rank_that_does_not_refuse_is_chosen():
    assert choose(Facts("path", ("air",))) == ("gpt-basic", SAMPLERS["gpt"].refuses(Facts("path", ("air",))))
    assert choose(Facts("volpath", ("air",)))[0] == choose(Facts("path", ()))[0] == "gpt"
    assert choose(Facts("spectral", ()))[0] == "gpt-basic"


def test_options_of_a_training_set_reach_its_renders(renderer, tmp_path):
    (tmp_path / "data.toml").write_text("scenes = 1\nsampler = 'gpt'\n[samplers.gpt]\ncaustic = false\n")
    stack = render_input(read_config(tmp_path / "data.toml"), data_gen.load_scene("diffuse", (6, 4)), 4, 0, False)
    assert "caustic=false" in stack.attributes["ngpt:samplerOptions"] and "caustic" not in stack
