"""The sampler as an axis: columns, equal time, tables; of folders of stacks, and of a scene that is rendered."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from folders import evaluated, read, write_scene

import ngpt
from bench.frontier import Point, draw
from data_gen import service
from ngpt.errors import NgptError
from ngpt.evaluation.config import Config, read_config
from ngpt.evaluation.stacks import SceneStacks
from ngpt.report.evaluation import write_evaluation_report

VARIANTS = {
    "wcv-replayed": {"method": "wcv", "sampler": "gpt-basic"},
    "raw": {"method": "primal", "stack": "gradients", "sampler": "gpt"},
    "photons": {"method": "primal", "sampler": "ppm"},
}


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        # One sampler: names and stacks are as they were before samplers were an axis.
        ({}, "primal: path; wcv: gradients; oidn: features"),
        ({"samplers": ("gpt-basic",)}, "primal: path; wcv: gradients gpt-basic; oidn: features"),
        (
            {"samplers": ("auto", "gpt-basic"), "rivals": ("primal", "ppm")},
            "primal (primal): path; primal (ppm): features ppm; wcv (auto): gradients; "
            "wcv (gpt-basic): gradients gpt-basic; oidn (primal): features; oidn (ppm): features ppm",
        ),
        # A variant names its own sampler.
        (
            {"methods": ("wcv", *VARIANTS), "samplers": ("gpt", "toy"), "variants": VARIANTS},
            "wcv (gpt): gradients gpt; wcv (toy): gradients toy; wcv-replayed: gradients gpt-basic; "
            "raw: gradients gpt; photons: features ppm",
        ),
    ],
)
def test_methods_appear_once_for_each_sampler_of_their_kind_of_stack(entries, expected):
    config = Config(**{"scenes": ("diffuse",), "methods": ("primal", "wcv", "oidn")} | entries)
    columns = config.columns()
    assert "; ".join(f"{column.name}: {column.render.name}" for column in columns) == expected
    for column in columns:
        assert column.method == VARIANTS.get(column.name, {"method": column.name.split(" (")[0]})["method"]


def test_tables_of_samplers_are_their_options(tmp_path):
    """Under names of their own where two are of one sampler; options are part of what stacks are cached as."""
    text = """
        scenes = ["diffuse"]
        methods = ["primal", "wcv"]
        rivals = ["primal", "ppm"]
        clock = "gpt"
        [samplers.gpt]
        caustic = true
        [samplers.gpt-followed]
        sampler = "gpt"
        shift = "manifold"
        [samplers.ppm]
        radius = 1
        photons = 2
    """
    (tmp_path / "eval.toml").write_text(text)
    config = read_config(tmp_path / "eval.toml")
    assert {column.name: (column.render.name, column.sampler) for column in config.columns()} == {
        "primal (primal)": ("path", "primal"),
        "primal (ppm)": ("features ppm radius=1 photons=2", "ppm"),
        "wcv (gpt)": ("gradients gpt", "gpt"),
        "wcv (gpt-followed)": ("gradients gpt shift=manifold", "gpt-followed"),
    }
    assert config.render("path", "ppm").options == {"sampler": "ppm", "radius": "1", "photons": "2"}
    (tmp_path / "eval.toml").write_text(text.replace("radius = 1", "radius = -1"))
    with pytest.raises(NgptError, match=r"samplers\.ppm: sampler 'ppm', option 'radius': '-1' is not allowed"):
        read_config(tmp_path / "eval.toml")
    (tmp_path / "eval.toml").write_text(text.replace('sampler = "gpt"', 'sampler = "gtp"'))
    with pytest.raises(NgptError, match=r"samplers\.gpt-followed: unknown sampler 'gtp'; did you mean 'gpt'"):
        read_config(tmp_path / "eval.toml")


def test_folders_of_stacks_have_samplers_without_a_renderer(tmp_path, rng, monkeypatch):
    """Any names: nobody asks the registry."""
    monkeypatch.setattr(SceneStacks, "load", lambda self: pytest.fail("asked for the renderer"))
    room = tmp_path / "room"
    for name in ("gradients-ours", "gradients-theirs"):
        write_scene(room, rng, gradients=name)
    text = f'scenes = ["{room}"]\nspp = [4, 16]\nseeds = 2\nmethods = ["primal", "l2"]\nimages = "all"\n'
    text += 'samplers = ["ours", "theirs"]\nmetrics = ["relMSE", "relMSE trimmed"]\n'
    results = evaluated(read(text, tmp_path), tmp_path / "out")
    names = ["primal", "l2 (ours)", "l2 (theirs)"]
    assert list(results["methods"]) == names and not any(cell["absent"] for cell in results["cells"])
    entry = results["methods"]["l2 (theirs)"]
    assert (entry["family"], entry["method"], entry["stack"], entry["sampler"]) == ("l2", "l2", "gradients", "theirs")
    assert (tmp_path / "out" / "images" / "room" / "16-l2-theirs-seed1.exr").is_file()
    points = [Point(r["method"], r["spp"], 1.0, r["error"], r["method"][:2]) for r in results["summary"] if r["scene"]]
    plot = ElementTree.ElementTree(ElementTree.fromstring(draw(points, "room", "relMSE")))
    texts = [element.text for element in plot.iter("{http://www.w3.org/2000/svg}text")]
    assert set(names) <= set(texts)
    lines = [e for e in plot.iter("{http://www.w3.org/2000/svg}path") if e.get("stroke-width") == "1.6"]
    (_, ours, theirs) = [(e.get("stroke"), e.get("stroke-dasharray")) for e in lines]
    assert ours[0] == theirs[0] and ours[1] != theirs[1]  # one colour for l2, dashes by sampler
    page = write_evaluation_report(tmp_path / "out", tmp_path / "report.html").read_text()
    assert "l2 (theirs)" in page and "equal rendering time to 4 spp of sampler auto" in page
    # A single sampler that is not the usual one: names are those of the methods.
    results = evaluated(read(text.replace('"theirs"', "").replace('"ours", ', '"ours"'), tmp_path), tmp_path)
    assert list(results["methods"]) == ["primal", "l2"]


SETTINGS = """
scenes = ["diffuse"]
size = [32, 24]
spp = [8]
seeds = 2
methods = ["primal", "wcv"]
metrics = ["relMSE", "relMSE trimmed"]
reference_spp = 128
timing_spp = 8
timing_repeats = 3
"""


# Sampler -> seconds of a sample, by a clock of ours
SECONDS = {"auto": 3.0, "gpt": 3.0, "gpt-basic": 6.0, "primal": 1.5}


def by_our_clock(scene, options, spp, seed, clock):
    """``ngpt.renderer.Renderer.timed`` whose seconds no other work on the machine changes; features take a third."""
    cost = SECONDS[options["sampler"]] * (1 if options.get("with_features", True) else 2 / 3)
    return service.render(scene, options, spp, seed, seconds=None), cost * spp


def test_two_samplers_at_equal_time(renderer, tmp_path, monkeypatch):
    monkeypatch.setattr(service, "timed", by_our_clock)
    out = tmp_path / "out"
    before = evaluated(read(SETTINGS, tmp_path), out)
    text = SETTINGS + 'samplers = ["gpt", "gpt-basic"]\nrivals = ["primal", "ppn"]\n'
    results = evaluated(read(text, tmp_path), out)
    names = ["primal (primal)", "primal (ppn)", "wcv (gpt)", "wcv (gpt-basic)"]
    assert list(results["methods"]) == names
    cells = {(cell["method"], cell["seed"]): cell for cell in results["cells"]}
    # What cannot be compared is a row that says why.
    assert "unknown sampler 'ppn'; did you mean 'ppm'? choose one of: auto, gpt" in cells["primal (ppn)", 0]["absent"]
    # Equal time: a sample of gpt-basic costs more, so there are fewer of them; those of gpt, which "auto" is, count.
    costs = results["scenes"]["diffuse"]["cost"]
    assert costs["gradients"]["sampler"] == "gpt" and costs["gradients gpt-basic"]["sampler"] == "gpt-basic"
    kinds = ("gradients", "gradients gpt-basic", "features", "path")
    assert [costs[kind]["median"] for kind in kinds] == pytest.approx([3, 6, 1.5, 1])
    used = {method: cells[method, 0]["spp used"] for method in names}
    assert used == {"primal (primal)": 24, "primal (ppn)": None, "wcv (gpt)": 8, "wcv (gpt-basic)": 4}
    assert cells["wcv (gpt-basic)", 0]["seconds"]["render"] == cells["primal (primal)", 0]["seconds"]["render"] == 24
    # What was measured and rendered before stays: the clock is the same, and so are the cells.
    assert {name: costs[name] for name in before["scenes"]["diffuse"]["cost"]} == before["scenes"]["diffuse"]["cost"]
    for old, new in (("primal", "primal (primal)"), ("wcv", "wcv (gpt)")):
        mine = [cell["metrics"] for cell in before["cells"] if cell["method"] == old]
        assert mine == [cells[new, seed]["metrics"] for seed in range(2)]
    # Stacks of their own, under names of their own; gpt's are the usual ones.
    cache = out / "cache"
    assert "albedo" not in ngpt.read(next(cache.glob("diffuse-*/path-*-0.exr")))
    stack = ngpt.read(next(cache.glob("diffuse-*/gradients-gpt-basic-*-1.exr")))
    assert stack.attributes["ngpt:sampler"] == "gpt-basic"
    assert not list(cache.glob("*/gradients-gpt-[0-9]*")) and len(list(cache.glob("diffuse-*/gradients-8-1.exr"))) == 1
    references = sorted(cache.glob("diffuse-*/reference*"))
    assert [path.name for path in references] == ["reference-128spp-a.exr", "reference-128spp-b.exr"]
    seeds = {ngpt.read(path).attributes["ngpt:seed"] for path in references}
    assert len(seeds) == 2 and results["scenes"]["diffuse"]["reference"]["spp"] == 128
    page = write_evaluation_report(out, tmp_path / "report.html").read_text()
    assert "Milliseconds a sample" in page and "gradients gpt-basic" in page
    # Another clock: the nominal samples are those of gpt-basic, of which gpt has more.
    slow = evaluated(read(SETTINGS + 'clock = "gpt-basic"\n', tmp_path), out)
    assert next(c["spp used"] for c in slow["cells"] if c["method"] == "wcv") == 16


def test_the_tiny_configuration_has_a_column_for_each_method():
    columns = read_config(Path(__file__).parents[2] / "configs" / "eval-tiny.toml").columns()
    assert {column.name: column.render.name for column in columns}["primal-gpt"] == "gradients" and len(columns) == 9
