"""What is there of a render counts as far as it goes: the same command goes on with it, and takes no other for it."""

import math
from pathlib import Path

import numpy as np
import pytest
from unbiased import load, same

import ngpt
from ngpt.errors import NgptError
from ngpt.stack import GradientStack

pytest.importorskip("mitsuba")

from data_gen import begun, passes
from data_gen.adaptive import LEAST
from data_gen.begun import Asked, Rest, frame_seed, part_seed, scene_name
from data_gen.cli import onlook, render
from data_gen.film import GradientFilm
from data_gen.session import render_scene
from data_gen.shot_files import write_frames

UNIFORM, TAILS = {"lamps": "uniform"}, {"tails": "paths"}
GPT = "render diffuse --size 16x12 --sampler gpt"
ONE_PASS = 16 * 12 * 16  # lanes


def there(path, software="", **attributes):
    """A file of a render of 16x12 pixels by `gpt`."""
    names = {"spp": 336, "seed": "3", "sampler": "gpt", "seconds": 14.0, "scene": "box 1"} | attributes
    stack = GradientStack({"primal": np.ones((12, 16, 3), np.float32)})
    stack.attributes.update({f"ngpt:{name}": value for name, value in names.items()})
    stack.attributes |= {"software": software} if software else {}
    return ngpt.write(path, stack, overwrite=True)


def test_a_file_is_finished_where_it_has_what_is_asked_for(tmp_path):
    path = there(tmp_path / "a.exr")
    assert Asked("box 1", 3, spp=336).left(path) is None
    assert Asked("box 1", 3, spp=100_000, size=(16, 12), sampler="gpt").left(path) == Rest(1, 99_664, None, None, "gpt")
    # A time that is over, though a few seconds of it were left; one that was broken off; and a longer one.
    there(path, time=15.0)
    assert Asked("box 1", 3, seconds=15.0).left(path) is None
    assert Asked("box 1", 3, seconds=20.0).left(path).seconds == 5.0
    there(path, time=15.0, unfinished="interrupted")
    assert Asked("box 1", 3, seconds=15.0).left(path).seconds == pytest.approx(1.0)
    assert Asked("box 1", 3, spp=300, seconds=15.0).left(path) is None
    # An error: of two parts with 0.1 and e together it is 0.06.
    there(path, error=0.1, adaptive="wcv")
    assert Asked("box 1", 3, error=0.1).left(path) is None
    rest = Asked("box 1", 3, error=0.06).left(path)
    assert rest.adaptive == "wcv" and 1 / math.hypot(1 / rest.error, 10) == pytest.approx(0.06)
    assert Asked("box 1", 3, spp=340, error=0.06).left(path) == Rest(1, 4, None, None, "gpt")
    # An adaptive render that was broken off before a sample was shared out
    there(path, unfinished="interrupted")
    assert Asked("box 1", 3, spp=400, adaptive="auto").left(path).adaptive == "auto"
    there(path, seed=f"3 {part_seed(3, 1)}", samplerOptions="points=rounds")
    assert Asked("box 1", 3, spp=400).left(path).options(3)["seed"] == part_seed(3, 2)


def test_a_file_of_another_render_is_neither_taken_nor_replaced(tmp_path):
    path = there(tmp_path / "a.exr", samplerOptions="lamps=uniform", software="ngpt 1, Mitsuba 3 cuda_ad_rgb")
    for what, asked in {
        "scene box 1, not ball 1": Asked("ball 1", 3, spp=9),
        r"scene box 1, not box 2 \(its file, -D, --sensor, .* was another\)": Asked("box 2", 3, spp=9),
        "size 16x12, not 16x16": Asked("box 1", 3, size=(16, 16), spp=9),
        "seed 3, not 4": Asked("box 1", 4, spp=9),
        "sampler gpt, not primal": Asked("box 1", 3, "primal", spp=9),
        "options lamps=uniform, not none": Asked("box 1", 3, "gpt", spp=9),
        "options lamps=uniform, not lamps=uniform, reuse=true": Asked(
            "box 1", 3, "gpt", {"lamps": "uniform", "reuse": True}, spp=9
        ),
        r"colours rgb, not spectral": Asked("box 1", 3, "gpt", UNIFORM, spp=9, variant="llvm_ad_spectral"),
        r"samples alike for all pixels, not for 'wcv' \(--adaptive\)": Asked(
            "box 1", 3, "gpt", UNIFORM, spp=9, adaptive="wcv"
        ),
        "frame unknown, not 7": Asked("box 1", 3, frame=7, spp=9),
    }.items():
        with pytest.raises(NgptError, match=rf"a.exr: is another render: {what};"):
            asked.left(path)
    # By any sampler, but with the options of none
    with pytest.raises(NgptError, match="options lamps=uniform, not none"):
        Asked("box 1", 3, spp=9).left(path)
    there(path, adaptive="wcv")
    for what, asked in {
        r"samples for 'wcv' \(--adaptive\), not alike for all pixels": Asked("box 1", 3, "gpt", spp=9),
        "samples for 'wcv', not for 'l2'": Asked("box 1", 3, "gpt", spp=9, adaptive="l2"),
    }.items():
        with pytest.raises(NgptError, match=what):
            asked.left(path)
    assert Asked("box 1", 3, spp=9, adaptive="auto").left(path) is None
    with pytest.raises(NgptError, match="has none of the channels that --diagnostics writes"):
        Asked("box 1", 3, spp=9, adaptive="auto", diagnostics=True).left(path)
    ngpt.write(path, np.ones((2, 2, 3), np.float32), overwrite=True)
    with pytest.raises(NgptError, match="seed unknown, not 3"):
        Asked("box 1", 3, spp=1).left(path)


def test_shared_tails_are_as_asked_for_unless_unbiased(tmp_path):
    """Whether they pay is known after the render: the same command must take both, and go on with both."""
    path, whole = tmp_path / "a.exr", there(tmp_path / "b.exr", seed="4")
    for given in ({}, {"sampler": "gpt"}, {"sampler": "gpt", "options": {"tails": "shared"}}):
        for options in ({}, {"samplerOptions": "tails=shared"}):
            there(path, **options)
            assert Asked("box 1", 3, spp=336, **given).left(path) is None
            assert Asked("box 1", 3, spp=400, **given).left(path).spp == 64
    for given in ({"unbiased": True}, {"sampler": "gpt", "unbiased": True}, {"sampler": "gpt", "options": TAILS}):
        with pytest.raises(NgptError, match=r"tails shared, not of each path \(--unbiased\)"):
            Asked("box 1", 3, spp=336, **given).left(path)
        assert Asked("box 1", 4, spp=336, **given).left(whole) is None
    # Whole paths and then shared ones are biased too, and go on as either.
    merged = ngpt.merge([ngpt.read(whole), ngpt.read(path)])
    assert merged.attributes["ngpt:samplerOptions"] == "tails=shared, tails=paths"
    there(path, samplerOptions="tails=shared, tails=paths")
    assert Asked("box 1", 3, spp=400).left(path).spp == 64
    with pytest.raises(NgptError, match=r"tails shared, not of each path \(--unbiased\)"):
        Asked("box 1", 3, spp=336, unbiased=True).left(path)


def test_parts_and_frames_have_seeds_of_their_own(tmp_path):
    seeds = [part_seed(seed, part) for seed in range(4) for part in range(5)]
    frames = [frame_seed(seed, frame, use) for seed in range(4) for frame in range(5) for use in (0, 1)]
    assert len({*seeds, *frames}) == len(seeds) + len(frames) and seeds[5] == 1
    scene = tmp_path / "box.xml"
    scene.write_text("<scene/>")
    names = [scene_name(str(scene), {}), scene_name(str(scene), {"a": "1"})]
    scene.write_text("<scene> </scene>")
    names.append(scene_name(str(scene), {}))
    assert len(set(names)) == 3 and all(name.startswith("box.xml ") for name in names)


def test_the_same_command_goes_on_and_then_is_done(renderer, command):
    assert begun.SHARED == LEAST
    command(f"{GPT} --seed 3 --spp 16 -o it.exr")
    first, on = ngpt.read("it.exr"), f"{GPT} --seed 3 --spp 48 --skip-existing -o it.exr"
    assert "has 16 samples per pixel; going on with it" in command(on)
    whole = ngpt.read("it.exr")
    assert whole.attributes["ngpt:spp"] == 48 and whole.attributes["ngpt:seed"] == f"3 {part_seed(3, 1)}"
    # The samples that were there, and others: to the bit what merging them gives.
    command(f"{GPT} --seed {part_seed(3, 1)} --spp 32 -o rest.exr")
    merged = ngpt.merge([first, ngpt.read("rest.exr")])
    assert all(np.array_equal(whole[name], merged[name], equal_nan=True) for name in merged.names)
    data = Path("it.exr").read_bytes()
    assert "skipped: the stack is there" in command(on)
    assert "seed 3 " in command(f"{on} --seed 4", 1)
    assert "another render: scene" in command(f"{on} -D a=1", 1)
    assert Path("it.exr").read_bytes() == data
    # In place of a file that is not whole
    Path("it.exr").write_bytes(data[: len(data) // 2])
    command(on)
    assert len(Path("it.exr").read_bytes()) > len(data) // 2 and ngpt.read("it.exr").attributes["ngpt:spp"] == 48


@pytest.mark.parametrize("more", ["--adaptive", "--error 0.001"])
def test_samples_that_are_shared_out_go_on_so(renderer, command, more):
    for spp in (32, 80):
        command(f"{GPT} {more} --skip-existing -o it.exr --spp {spp}")
    found = ngpt.read("it.exr")
    assert found.attributes["ngpt:spp"] == 80 and len(found.attributes["ngpt:seed"].split()) == 2
    assert found.attributes["ngpt:adaptive"] and "samples" in found


def test_frames_go_on_too(renderer, command):
    words = f"{GPT} --frames 0:3 -o shot"
    command(f"{words} --spp 4")
    Path("shot/diffuse.0001.exr").unlink()
    command(f"{words} --spp 12 --skip-existing")
    stacks = [ngpt.read(f"shot/diffuse.{frame:04d}.exr") for frame in range(3)]
    assert [stack.attributes["ngpt:spp"] for stack in stacks] == [12, 12, 12]
    assert [len(stack.attributes["ngpt:seed"].split()) for stack in stacks] == [2, 1, 2]
    assert all("motion" in stack and stack.attributes["ngpt:frame"] == i for i, stack in enumerate(stacks))
    assert "3 of 3 frames were skipped" in command(f"{words} --spp 12 --skip-existing")
    said = command(f"{words} --spp 12 --seed 1 --skip-existing", 1)
    assert "diffuse.0000.exr: is another render: seed" in said


def test_a_frame_that_is_broken_off_is_kept_and_gone_on_with(renderer, tmp_path, monkeypatch):
    monkeypatch.setattr(passes, "FIRST_LANES", ONE_PASS)
    files = {frame: tmp_path / f"{frame}.exr" for frame in range(2)}
    asked = {"size": (16, 12), "sampler": "gpt", "spp": 64, "skip_existing": True}
    written = write_frames("diffuse", files, stop=lambda: True, **asked)
    assert written.interrupted == 0 and written.frames[0]["spp"] == 16 and not files[1].exists()
    assert ngpt.read(files[0]).attributes["ngpt:unfinished"] == "interrupted"
    written = write_frames("diffuse", files, **asked)
    assert written.interrupted is None and written.skipped == 0
    for file in files.values():
        attributes = ngpt.read(file).attributes
        assert attributes["ngpt:spp"] == 64 and "ngpt:unfinished" not in attributes


def failing(monkeypatch, passes_before):
    """Has the sampler `gpt` fail after so many passes."""
    monkeypatch.setattr(passes, "FIRST_LANES", ONE_PASS)
    end, ended = GradientFilm.end_pass, []

    def end_pass(film, *args):
        if film._pass and len(ended) == passes_before:
            raise RuntimeError("the device is gone")
        ended.append(1) if film._pass else None
        end(film, *args)

    monkeypatch.setattr(GradientFilm, "end_pass", end_pass)


def test_a_pass_that_fails_takes_none_before_it_along(renderer, command, monkeypatch):
    with monkeypatch.context() as patched:
        failing(patched, 1)
        said = command(f"{GPT} --spp 64 -o it.exr", 1)
    assert "the device is gone; it.exr has the 16 samples per pixel done before" in said
    kept = ngpt.read("it.exr")
    assert kept.attributes["ngpt:spp"] == 16 and kept.attributes["ngpt:unfinished"] == "failed"
    command(f"{GPT} --spp 16 -o same.exr")
    assert np.allclose(kept["primal"], ngpt.read("same.exr")["primal"], rtol=0.5, atol=0.1)
    command(f"{GPT} --spp 64 -o it.exr --skip-existing")
    assert ngpt.read("it.exr").attributes["ngpt:spp"] == 64
    # One that fails at first leaves nothing.
    failing(monkeypatch, 0)
    with pytest.raises(RuntimeError):
        command(f"{GPT} --spp 64 -o none.exr")
    assert not Path("none.exr").exists()


def test_nothing_that_comes_after_the_last_sample_takes_the_image_along(renderer, command, monkeypatch):
    from data_gen.frames import shot
    from data_gen.samplers import reused

    def gone(*arguments):
        raise RuntimeError("gone")

    with monkeypatch.context() as patched:
        patched.setattr(reused, "_key", gone)  # whether the next render may have the sampler
        command("render diffuse --size 16x12 --spp 4 --sampler primal -o it.exr")
    command("render diffuse --size 16x12 --spp 4 --sampler primal -o same.exr")
    same(ngpt.read("it.exr"), ngpt.read("same.exr"))
    with monkeypatch.context() as patched:
        patched.setattr(shot, "motion_vectors", gone)
        told = command("render diffuse --size 16x12 --spp 4 --sampler primal --frames 0:2 -o f{frame}.exr", 1)
    assert "frame 0: gone; f0.exr has the samples done before" in told
    frame = ngpt.read("f0.exr")
    assert frame.attributes["ngpt:unfinished"] == "failed" and frame["primal"].mean() > 0.1


def test_hair_with_the_colour_of_melanin_is_rendered(renderer):
    """Of its parameters one is None, which Mitsuba's own list of them cannot give."""
    from stress_scenes import hair

    from data_gen.render import render_stack
    from data_gen.samplers import reused

    scene, made = load(renderer, hair, (16, 12)), reused.Made()
    first, second = (render_stack(scene, 2, 0, "primal", made=made, unbiased=True) for _ in range(2))
    assert first["primal"].mean() > 0.1 and "primal" in made._kept
    same(first, second)


def test_what_was_rendered_is_kept_where_it_cannot_be_written(renderer, command, monkeypatch):
    folder = Path("asked")
    folder.mkdir()

    def moved(*args, **given):
        folder.rename("moved")
        return render_scene(*args, **given)

    monkeypatch.setattr(render, "render_scene", moved)
    said = command(f"{GPT} --sampler primal --spp 4 -o {folder.absolute()}/it.exr", 1)
    assert f"what was made is kept in {Path('it.kept.exr').absolute()}" in said
    assert ngpt.read("it.kept.exr").attributes["ngpt:spp"] == 4


def test_light_that_overflows_ends_no_render_that_somebody_looks_at(renderer, command, monkeypatch):
    Path("nan.xml").write_text(
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"><film type="hdrfilm">'
        '<integer name="width" value="24"/><integer name="height" value="16"/></film></sensor>'
        '<emitter type="constant"><rgb name="radiance" value="3e38 3e38 3e38"/></emitter></scene>'
    )
    words = "render nan.xml --sampler gpt --spp 32 -o it.exr"

    class Page:
        watched, enough, ended = True, False, False

        def tell(self, line):
            pass

        def show(self, preview, caption):
            raise MemoryError

        def close(self, line):
            raise OSError("gone")

    def looking(live, scene, command, console, unit):
        return onlook.Onlookers(Page(), console.say, unit)

    monkeypatch.setattr(onlook, "onlookers", looking)
    told = [line for line in command(f"{words} --live").splitlines() if "the render goes on" in line]
    assert len(told) == 1 and told[0].startswith("no image for who looks on: ")
    Path("it.exr").unlink()
    assert "; it.exr has the 16 samples per pixel done before" in command(f"{words} --adaptive", 1)
    assert ngpt.read("it.exr").attributes["ngpt:spp"] == 16
