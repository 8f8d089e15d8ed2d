"""Methods, samplers, losses and metrics of other packages, by entry points: the pages show these packages."""

import re
import sys
import tomllib
from pathlib import Path

import pytest
from full_stack import full_stack

import ngpt
from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS
from ngpt.errors import NgptError
from ngpt.measure.metrics import METRICS
from ngpt.methods import METHODS

ROOT = Path(__file__).parents[1]
PAGES = {
    "method": "docs/methods/add-a-method.md",
    "sampler": "docs/samplers/add-a-sampler.md",
    "loss": "docs/train/add-a-loss.md",
    "network": "docs/train/add-a-network.md",
}


def install(folder: Path, name: str, groups: dict[str, dict[str, str]]) -> None:
    """What an installation of a package leaves beside its code, in a folder of sys.path."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    points = {group: "".join(f"{key} = {value}\n" for key, value in found.items()) for group, found in groups.items()}
    (info / "entry_points.txt").write_text("".join(f"[{group}]\n{lines}" for group, lines in points.items()))


def install_page(folder: Path, page: str) -> None:
    """The packages of a page: blocks of code that begin with the name of a file; pyproject.toml ends one."""
    for code in re.findall(r"```(?:python|toml)\n(# .*?)```", (ROOT / page).read_text(), re.S):
        file = code.partition("\n")[0].removeprefix("# ")
        if file == "pyproject.toml":
            project = tomllib.loads(code)["project"]
            install(folder, project["name"], project["entry-points"])
        elif file.startswith("ngpt_"):
            (folder / file).parent.mkdir(exist_ok=True)
            (folder / file).write_text(code)


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder of packages; what is imported from there is forgotten in the end."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    modules = set(sys.modules)
    registries = [METHODS, METRICS, SAMPLERS, FRAME_SAMPLERS]
    if "torch" in sys.modules:
        from ngpt.network.config import KINDS
        from ngpt.training.loss import TERMS

        registries += [TERMS, KINDS]
    before = [set(registry._imported) for registry in registries]
    yield folder
    for registry, names in zip(registries, before, strict=True):
        for name in registry._imported - names:
            del registry[name]
        registry._imported &= names
    for name in set(sys.modules) - modules:
        if str(folder) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


@pytest.fixture(autouse=True)
def stack(tmp_path):
    stack = full_stack(18, 26)
    ngpt.write(tmp_path / "stack.exr", stack)
    return stack


def test_the_method_of_the_page(site, stack, command):
    install_page(site, PAGES["method"])
    assert ": median, " in command("denoise stack.exr --method median -O size=5").err
    assert not (ngpt.denoise(stack, "median") == ngpt.denoise(stack, "primal")).all()
    assert "pixels of its side" in command("info median").out
    assert "median" in command("info").out and "median" in command("info stack.exr").out
    told = command("denoise stack.exr -m median -O size=x --force", 2).err
    assert "method 'median', option 'size': 'x' is not allowed" in told


def test_what_a_method_raises_is_one_line_with_its_place(site, stack, command):
    install(site, "ngpt-wrong", {"ngpt.methods": {"wrong": "ngpt_wrong:METHOD"}})
    code = "from ngpt.methods import Method\n\n\ndef run(data):\n    return data.features['colour']\n\n\n"
    (site / "ngpt_wrong.py").write_text(code + 'METHOD = Method("fails", ("primal",), run, {})\n')
    told = command("denoise stack.exr -m wrong", 1).err
    assert f"method 'wrong' failed: KeyError: 'colour' ({site / 'ngpt_wrong.py'}, line 5)\n" in told
    with pytest.raises(NgptError, match="method 'wrong' failed"):
        ngpt.denoise(stack, "wrong")


def test_the_metric_of_the_page(site, command):
    install_page(site, PAGES["method"])
    assert re.search(r"^bias +0$", command("diff stack.exr stack.exr").out, re.M)


def test_the_sampler_of_the_page(renderer, site, command):
    """It is random replay, to the last bit."""
    install_page(site, PAGES["sampler"])
    for sampler in ("replay", "replay-path", "gpt-basic"):
        command(f"render diffuse --sampler {sampler} --spp 2 --size 12x8 -o {sampler}.exr")
    *both, theirs = (ngpt.read(f"{name}.exr") for name in ("replay", "replay-path", "gpt-basic"))
    for ours in both:
        assert ours.names == theirs.names and all((ours[n] == theirs[n]).all() for n in ("primal", "dx", "dy"))
    assert "gradients by random replay" in command("info replay").out
    from data_gen.code import code

    # Both are keyed by a file of their package, which only one of them names.
    before = code("replay"), code("replay-path")
    (site / "ngpt_replay" / "replay.py").write_text("changed = 1\n")
    assert code("replay") != before[0] and code("replay-path") != before[1]


def write_views(folder):
    """A training set of two views in the folder "views"."""
    for i in range(2):
        view = folder / "views" / f"view{i}"
        view.mkdir(parents=True)
        ngpt.write(view / "few.exr", full_stack(32, 32, seed=i))
        ngpt.write(view / "reference.exr", full_stack(32, 32, seed=2 + i)["primal"])


def test_the_network_of_the_page(site, tmp_path, command, one_thread):
    install_page(site, PAGES["network"])
    write_views(tmp_path)
    text = (ROOT / PAGES["network"]).read_text()
    (line,) = re.findall(r"^    ngpt (train .*)$", text, re.M)
    command(f"{line} --set data.folders='[\"views\"]' --set data.crop=32 --set run.steps=2 --set run.batch=1")
    assert "layers" in command("info run/weights.safetensors").out
    command("denoise stack.exr -m ngpt --weights run/weights.safetensors -o image.exr")
    told = command(f"{line.replace('layers', 'layer')} --set data.folders='[\"views\"]'", 1, 2).err
    assert "unknown network 'layer'" in told


@pytest.mark.parametrize("changes", ["loss.squared=0.5", "loss.kind=squared loss.relative=0 loss.gradient=0"])
def test_the_loss_of_the_page(site, tmp_path, command, changes, one_thread):
    install_page(site, PAGES["loss"])
    write_views(tmp_path)
    changes = f"data.folders=['views'] data.crop=32 run.steps=2 run.batch=1 {changes}".split()
    given = " ".join(f'--set "{change}"' for change in changes)
    output = command(f"train --config tiny --out run {given}").out
    assert "loss squared" in output and ("loss relative" in output) == (len(changes) == 5)
    command("train --config tiny --init mine.toml")
    assert "another package's term: Mean of (p - t)^2 / (t^2 + 1).\n# squared = 0.0\n" in (
        (tmp_path / "mine.toml").read_text()
    )


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"squared": "much"}, "squared = 'much': must be a number, the weight of that term"),
        ({"squared": -1.0}, "squared = -1.0: must be finite and not negative"),
        ({"squarred": 1.0}, "unknown key 'squarred'"),
        ({"kind": "squarred"}, "kind = 'squarred': choose one of"),
        ({"vector": 1.0}, r"vector: returned a tensor of shape \(2,\); return its mean, a scalar"),
    ],
)
def test_wrong_weights_of_a_loss_are_refused(site, changes, complaint):
    torch = pytest.importorskip("torch")
    from ngpt.training.loss import make_loss

    install_page(site, PAGES["loss"])
    (site / "vector.py").write_text("def vector(p, t):\n    return (p - t).mean(dim=(1, 2, 3))\n")
    install(site, "vectors", {"ngpt.losses": {"vector": "vector:vector"}})
    with pytest.raises(NgptError, match=complaint):
        make_loss({"kind": "l1"} | changes)(torch.ones(2, 3, 16, 16), torch.ones(2, 3, 16, 16), torch.Generator())


FAULTS = {
    "nowhere": ("nowhere.module:X", ""),  # its package is not there any more
    "broken": ("broken:METHOD", "raise RuntimeError('no\\nGPU')"),
    "absent": ("absent:OTHER", ""),
    "wrong": ("wrong:METHOD", "METHOD = 3"),
}


def test_a_package_that_is_broken_costs_one_line_and_nothing_else(site, command):
    for name, (target, code) in FAULTS.items():
        if name != "nowhere":
            (site / f"{name}.py").write_text(code)
        install(site, name, {"ngpt.methods": {name: target}})
    install_page(site, PAGES["method"])
    output, errors = command("info")
    assert "median" in output and "wcv" in output
    assert sorted(line.partition(" of the package")[0] for line in errors.splitlines()) == [
        f"ngpt: ngpt.methods: '{name}'" for name in ("absent", "broken", "wrong")
    ]
    assert "cannot be imported: RuntimeError: no" in errors
    for name in ("absent", "broken", "wrong"):
        (line,) = command(f"denoise stack.exr -m {name}", 1).err.splitlines()
        assert line.startswith(f"ngpt: error: ngpt.methods: '{name}' of the package '{name}'")
    command("denoise stack.exr -m nowhere", 2)
    assert len(command("denoise stack.exr -m wcv").err.splitlines()) == 1


def test_names_of_ours_are_refused(site, capsys):
    (site / "own.py").write_text(
        "from ngpt.methods import METHODS\nfrom ngpt.measure.metrics import METRICS\n"
        "METHOD, METRIC = METHODS['l1'], METRICS['MSE']\n"
    )
    groups = {"ngpt.methods": {"wcv": "own:METHOD", "auto": "own:METHOD"}, "ngpt.metrics": {"relMSE": "own:METRIC"}}
    groups |= {"ngpt.samplers": {"gpt": "own:METHOD"}, "ngpt.frame_samplers": {"primal": "own:METHOD"}}
    install(site, "own", groups)
    before = dict(METHODS), dict(METRICS), dict(SAMPLERS), dict(FRAME_SAMPLERS)
    for registry in (METHODS, METRICS, SAMPLERS, FRAME_SAMPLERS):
        registry.load()
    assert (dict(METHODS), dict(METRICS), dict(SAMPLERS), dict(FRAME_SAMPLERS)) == before
    told = capsys.readouterr().err
    for name in ("wcv", "auto", "relMSE", "gpt", "primal"):
        assert f"'{name}' of the package 'own' is left out: ngpt has a" in told
    assert "Traceback" not in told and len(told.splitlines()) == 5
