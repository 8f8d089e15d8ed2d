"""A toy shows what it takes to add a sampler; the laws of all are in ``laws``."""

import sys
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import pytest
from unbiased import load, same

import ngpt
from data_gen.dataset.config import read_config
from data_gen.dataset.crops import render_input
from data_gen.film import SHIFTS
from data_gen.inspect import inspect_scene
from data_gen.paths.features import features
from data_gen.render import render_stack
from data_gen.samplers import SAMPLERS, Option, Sampler, choose, find, register
from data_gen.scenes.facts import Facts
from ngpt.cli import main
from ngpt.errors import NgptError


class Toy:
    """Random replay in batches: the samples of a pixel in a pass are all one and the same, and a share is splatted."""

    def __init__(self, scene, share):
        from data_gen.samplers.common import radiance

        find("gpt-basic").made(scene)  # refuses what it cannot render
        self.scene, self.estimate, self.share = scene, radiance(scene, scene.integrator()), share

    def __call__(self, camera, film):
        def radiance(shift=(0, 0)):
            ray, importance, inside = camera.rays(shift)
            L = self.estimate(camera.random.clone(), ray, None, inside) * importance
            dr.eval(L, inside)  # or each gather would trace the paths anew
            first = dr.arange(mi.UInt32, dr.width(camera.pixel)) // camera.block * camera.block
            return dr.gather(mi.Color3f, L, first), dr.gather(mi.Bool, inside, first)

        L, _ = radiance()
        values = {"primal": (L, mi.Bool(True))}
        for name, shift in SHIFTS.items():
            L_shifted, inside = radiance(shift)
            values[name] = (L_shifted - L, inside)
        for name, (value, active) in values.items():
            film.put(name, value * (1 - self.share), active)
            film.splat(name, camera.pixel, value * self.share, active)
        film.put_all(features(self.scene, camera.sensor, camera.random.clone(), camera.rays()[0]))


TOY = Sampler(
    "toy",
    "a toy",
    "toys",
    refusals=(
        lambda facts, name: "" if facts.integrator in ("path", "volpath") else "toys know only 'path' and 'volpath'",
    ),
    notes={"transport": "toys"},
    options={"share": Option(0.5, "of each value that is splatted", range=(0, 1))},
    rank=5,
    batch=8,
)


@pytest.fixture(autouse=True)
def toy(monkeypatch):
    """One registration, undone after each test."""
    monkeypatch.setitem(sys.modules, "toys", SimpleNamespace(make=Toy))
    register(TOY)
    yield
    del SAMPLERS["toy"]


def test_a_toy_is_found_by_all_that_ask(renderer, capsys, tmp_path):
    with pytest.raises(SystemExit):
        main(["render", "--help"])
    assert "toy" in capsys.readouterr().out
    assert main(["info"]) == 0 and "a toy" in capsys.readouterr().out
    assert main(["info", "toy"]) == 0
    assert "of each value that is splatted (a number from 0 to 1; default 0.5)" in capsys.readouterr().out
    # gpt, to which media are invisible where 'path' renders them, leaves this scene to the next in rank.
    assert choose(Facts("path", ("air",))) == ("toy", SAMPLERS["gpt"].refuses(Facts("path", ("air",))))
    assert choose(Facts("volpath", ("air",)))[0] == "gpt"
    assert choose(Facts("path", ()))[0] == "gpt"
    assert choose(Facts("spectral", ()))[0] == "gpt-basic"
    plan = inspect_scene("diffuse")["plan"]
    assert not any("toy" in line for line in plan)  # it can, and is not chosen
    with pytest.raises(NgptError, match=r"toys know only 'path' and 'volpath'; use --sampler gpt-basic"):
        find("toy", Facts("spectral", ()))
    scene = load(renderer, "diffuse", (6, 4))
    with pytest.raises(NgptError, match="sampler 'toy' has no option 'loud'; it has: share"):
        render_stack(scene, 1, sampler="toy", loud=True, unbiased=True)
    with pytest.raises(NgptError, match="sampler 'toy' has no option 'features'; it has: share"):
        render_stack(scene, 1, sampler="toy", with_features=False, unbiased=True)
    target = tmp_path / "toy.exr"
    line = ["render", "diffuse", "--size", "6x4", "--spp", "4", "--sampler", "toy", "-o", str(target)]
    assert main([*line, "-O", "share=1.5"]) == 2
    assert "option 'share': '1.5' is not allowed; it takes a number from 0 to 1" in capsys.readouterr().err
    assert main([*line, "-O", "share=0.25"]) == 0
    by_command, by_python = ngpt.read(target), render_stack(scene, 4, sampler="toy", share=0.25, unbiased=True)
    assert by_command.attributes["ngpt:sampler"] == "toy"
    assert by_command.attributes["ngpt:samplerOptions"] == by_python.attributes["ngpt:samplerOptions"] == "share=0.25"
    same(by_command, by_python)
    (tmp_path / "data.toml").write_text("scenes = 1\nsampler = 'toy'\n[samplers.toy]\nshare = 0.25\n")
    by_config = render_input(read_config(tmp_path / "data.toml"), scene, 4, 0, False)
    assert by_config.attributes["ngpt:samplerOptions"] == "share=0.25"
    same(by_config, by_python)
