"""The sampler as an axis: columns, equal time, tables; of folders of stacks, and of a scene that is rendered."""

import numpy as np
import pytest
from folders import evaluated, read, write_scene

import ngpt
from data_gen import service
from ngpt.denoisers import oidn
from ngpt.errors import NgptError
from ngpt.evaluation import cells
from ngpt.evaluation.config import EvaluationConfig
from ngpt.evaluation.stacks import SceneStacks
from ngpt.methods import reconstruct
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
    config = EvaluationConfig(**{"scenes": ("diffuse",), "methods": ("primal", "wcv", "oidn")} | entries)
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
        [samplers.gpt-half]
        sampler = "gpt"
        shift = "half-vector"
        [samplers.ppm]
        radius = 1
        photons = 2
    """
    config = read(text, tmp_path)
    assert {column.name: (column.render.name, column.sampler) for column in config.columns()} == {
        "primal (primal)": ("path", "primal"),
        "primal (ppm)": ("features ppm radius=1 photons=2", "ppm"),
        "wcv (gpt)": ("gradients gpt", "gpt"),
        "wcv (gpt-half)": ("gradients gpt shift=half-vector", "gpt-half"),
    }
    assert config.render("path", "ppm").options == {"sampler": "ppm", "radius": "1", "photons": "2"}
    with pytest.raises(NgptError, match=r"samplers\.ppm: sampler 'ppm', option 'radius': '-1' is not allowed"):
        read(text.replace("radius = 1", "radius = -1"), tmp_path)
    with pytest.raises(NgptError, match=r"samplers\.gpt-half: unknown sampler 'gtp'; did you mean 'gpt'"):
        read(text.replace('sampler = "gpt"', 'sampler = "gtp"'), tmp_path)


SUBPIXELS = """
methods = ["oidn"]
rivals = ["primal", "fine", "by-default"]
[samplers.fine]
sampler = "primal"
subpixels = 2
[samplers.by-default]
sampler = "primal"
points = "independent"
subpixels = "auto"
"""


def test_subpixels_are_part_of_what_a_column_is_given(tmp_path):
    """And of its name, by which stacks, costs and cells are cached. Without them it is the name that it was."""
    text = 'scenes = ["diffuse"]' + SUBPIXELS
    plain, fine, by_default = (column.render for column in read(text, tmp_path).columns())
    assert (plain.name, fine.name) == ("features", "features primal subpixels=2")
    assert by_default.name == "features primal points=independent subpixels=auto"
    assert read(text.replace("= 2", "= 1"), tmp_path).columns()[1].render == plain
    with pytest.raises(NgptError, match=r"samplers\.fine: '3' subpixels cannot be kept; write 1, 2, 4, or auto"):
        read(text.replace("= 2", "= 3"), tmp_path)
    with pytest.raises(NgptError, match=r"samplers\.fine: sampler 'bdpt' puts light on any pixel and has no subpixels"):
        read(text.replace('"primal"\nsub', '"bdpt"\nsub'), tmp_path)


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
    # Stacks of their own, and two references
    cache = out / "cache"
    assert "albedo" not in ngpt.read(next(cache.glob("diffuse-*/path-*-0.exr")))
    stack = ngpt.read(next(cache.glob("diffuse-*/gradients-gpt-basic-*-1.exr")))
    assert stack.attributes["ngpt:sampler"] == "gpt-basic"
    seeds = {ngpt.read(path).attributes["ngpt:seed"] for path in cache.glob("diffuse-*/reference*")}
    assert len(seeds) == 2 and results["scenes"]["diffuse"]["reference"]["spp"] == 128
    # Another clock: the nominal samples are those of gpt-basic, of which gpt has more.
    slow = evaluated(read(SETTINGS + 'clock = "gpt-basic"\n', tmp_path), out)
    assert next(c["spp used"] for c in slow["cells"] if c["method"] == "wcv") == 16


@pytest.mark.slow
@pytest.mark.skipif(bool(oidn.missing()), reason=oidn.missing())
def test_a_column_with_subpixels_is_its_method_on_stacks_with_them(renderer, tmp_path, monkeypatch):
    monkeypatch.setattr(service, "timed", by_our_clock)
    calls = []

    def counted(*given, **options):
        calls.append(given)
        return reconstruct(*given, **options)

    monkeypatch.setattr(cells, "reconstruct", counted)
    text = SETTINGS.replace('methods = ["primal", "wcv"]', "").replace("[8]", "[4, 32]").replace("= 2", "= 1")
    text += SUBPIXELS.replace('points = "independent"', "").replace('"oidn"', '"clean"')
    text += '[variants.clean]\nmethod = "oidn"\nauxiliary = "clean"\n'
    results = evaluated(read(text, tmp_path), tmp_path)
    found = {(cell["method"], cell["spp used"]): cell for cell in results["cells"]}
    scene = service.load("diffuse", (32, 24))
    for spp in (8, 64):
        stack = service.render(scene, {"sampler": "primal", "subpixels": 2}, spp, 0, seconds=None)
        assert stack.fine
        fine, plain = (ngpt.read(tmp_path / found[f"clean ({name})", spp]["image"]) for name in ("fine", "primal"))
        assert np.allclose(fine["primal"], reconstruct(stack, "oidn", auxiliary="clean").image, rtol=1e-4, atol=1e-5)
        assert np.abs(fine["primal"] - plain["primal"]).max() > 0.01
        # By default `ngpt render` keeps them from FEWEST samples on.
        same = "fine" if spp == 64 else "primal"
        assert found["clean (by-default)", spp]["metrics"] == found[f"clean ({same})", spp]["metrics"]
    # OIDN begins for images of either size, before its time counts.
    assert len(calls) == 6 + 2
