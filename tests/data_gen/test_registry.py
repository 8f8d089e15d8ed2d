"""What entries say of samplers: typed options, one place for each default, names that are nearly right."""

from pathlib import Path

import pytest

from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS, Sampler, by_standing, check_options, find, register
from ngpt.errors import NgptError

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


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("bdpt", {"joined_depth": 0}, "'joined_depth': '0' is not allowed; it takes a whole number from 1 to 64$"),
        ("ppm", {"radius": 0}, "'radius': '0' is not allowed; it takes a number from 1e-06 to 1e.06$"),
        ("gpt", {"shift": "half-vektor"}, "it takes replay, half-vector, manifold; did you mean 'half-vector'"),
        ("gpt", {"reus": True}, "sampler 'gpt' has no option 'reus'; did you mean 'reuse'"),
        ("split", {"reuse": True}, "sampler 'split' has no option 'reuse'; it has: points, lamps"),
    ],
)
def test_errors_come_before_the_plugin_and_say_what_goes(renderer, name, options, message):
    from data_gen.render import render_stack
    from data_gen.scenes.load import load_scene

    with pytest.raises(NgptError, match=message):
        render_stack(load_scene("diffuse", (4, 4)), 1, sampler=name, **options)


def test_names():
    with pytest.raises(NgptError, match="there is a sampler 'gpt' already"):
        register(Sampler("gpt", "another"))
    with pytest.raises(NgptError, match="there is a sampler 'restir' already"):
        register(Sampler("restir", "another"))
    with pytest.raises(NgptError, match=r"unknown sampler 'gtp'; did you mean 'gpt'\? choose one of: auto, gpt,"):
        find("gtp")
    with pytest.raises(NgptError, match=r"; for shots \(--frames\): restir$"):
        find("foo")
    with pytest.raises(NgptError, match="standing 'useful' is none of use, niche, study"):
        Sampler("new", "another", standing="useful")


def test_help_fits_a_screen_and_begins_with_what_users_need(capsys, monkeypatch):
    from ngpt.cli import main

    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main(["render", "--help"])
    text = capsys.readouterr().out
    assert len(text.splitlines()) <= 80
    words = " ".join(text.split())
    places = [words.index(f"{name}: ") for name in ("auto", "gpt", "gbdpt", "ppm", "vcm", "primal")]
    assert places == sorted(places)
    assert set(by_standing("use")) == {"gpt", "gbdpt", "ppm", "vcm", "primal"} and "gplanes" not in words


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
    check_options("restir", {"history": "4"})
    with pytest.raises(NgptError, match="sampler 'restir', option 'history': '0' is not allowed"):
        check_options("restir", {"history": "0"})


def test_frames_take_options_from_the_command_line(renderer, tmp_path):
    import ngpt
    from ngpt.cli import main

    line = ["render", "diffuse", "--frames", "0:1", "--size", "8x6", "-o", str(tmp_path)]
    assert main([*line, "--sampler", "restir", "-O", "gradients=after"]) == 0
    assert ngpt.read(tmp_path / "diffuse.0000.exr").attributes["ngpt:samplerOptions"] == "gradients=after"
    assert main([*line, "--force", "--spp", "2", "--sampler", "gpt", "-O", "caustic=false"]) == 0
    stack = ngpt.read(tmp_path / "diffuse.0000.exr")
    assert stack.attributes["ngpt:samplerOptions"] == "caustic=false"
    assert main([*line, "--force", "--sampler", "gpt", "-O", "history=4"]) == 2


def test_the_table_in_the_docs_is_what_entries_say():
    from data_gen.samplers.__main__ import table

    text = (Path(__file__).parents[2] / "docs" / "use" / "rendering.md").read_text()
    _, _, rest = text.partition("<!-- python -m data_gen.samplers -->\n\n")
    assert rest.split("\n\n<!-- end -->")[0] == table(), "python -m data_gen.samplers prints it anew"


def test_light_paths_refuse_hair(renderer):
    """Mitsuba's is not the same in both directions: light paths lost half a percent in it. Within others, too."""
    import mitsuba as mi

    from data_gen.samplers import SAMPLERS
    from data_gen.scenes.facts import scene_facts

    def facts(bsdf):
        parts = {"camera": {"type": "perspective"}, "ball": {"type": "sphere", "bsdf": bsdf}}
        return scene_facts(mi.load_dict({"type": "scene", "integrator": {"type": "path"}} | parts))

    masked = {"type": "mask", "opacity": 0.5, "within": {"type": "hair"}}
    for bsdf in ({"type": "hair"}, masked):
        refused = {name for name, sampler in SAMPLERS.items() if "'hair'" in sampler.refuses(facts(bsdf))}
        assert refused == {"bdpt", "gbdpt", "vcm", "gvcm", "ppm", "gpm"}
    assert not facts({"type": "mask", "opacity": 0.5, "within": {"type": "diffuse"}}).hair
