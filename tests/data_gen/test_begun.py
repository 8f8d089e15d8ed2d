"""What is there of a render counts as far as it goes: the same command goes on with it, and takes no other for it."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from stress_scenes import hair
from unbiased import load, same

import ngpt
from ngpt.errors import NgptError, WrongUse
from ngpt.io.openexr import read_header
from ngpt.stack import GradientStack

pytest.importorskip("mitsuba")

from data_gen import begun, passes
from data_gen.adaptive import LEAST
from data_gen.begun import frame_seed, part_seed
from data_gen.cli import onlook, render
from data_gen.film import GradientFilm
from data_gen.frames.camera_path import CameraPath, Key
from data_gen.render import render_stack
from data_gen.request import RenderRequest, said_by
from data_gen.samplers import reused
from data_gen.session import render_frames, render_scene
from data_gen.shot_files import write_frames

RENDER = "render diffuse --size 16x12 --sampler primal"
ONE_PASS = 16 * 12 * 16  # lanes


def there(path, asked=None, **attributes):
    """A file of a render of 16x12 pixels by `gpt`, with what was ``asked`` in its header."""
    names = {"spp": 336, "seed": "3", "sampler": "gpt", "seconds": 14.0} | attributes
    stack = GradientStack({"primal": np.ones((12, 16, 3), np.float32)})
    stack.attributes.update({f"ngpt:{name}": value for name, value in names.items()})
    stack.attributes |= asked.header() if asked else {}
    return ngpt.write(path, stack, overwrite=True)


def box(**given):
    return RenderRequest("box", **{"seed": 3, "sampler": "gpt"} | given)


def left(path, frame=None, **given):
    return rest_of(box(**given), path, frame)


def rest_of(asked, path, frame=None):
    return begun.rest_of(asked, path, read_header(path)[0], frame)


def test_a_file_is_finished_where_it_has_what_is_asked_for(tmp_path):
    path = there(tmp_path / "a.exr", box(spp=336))
    assert left(path, spp=336) is None
    rest = left(path, spp=100_000)
    assert rest == box(spp=99_664, seed=part_seed(3, 1), subpixels=1)
    # What was left open stays as the file has it.
    there(path, box(sampler="auto"))
    assert left(path, sampler="auto", spp=100_000) == rest
    # A time that is over, though a few seconds of it were left; one that was broken off; and a longer one.
    there(path, box(seconds=15.0))
    assert left(path, seconds=15.0) is None
    assert left(path, seconds=20.0).seconds == 5.0
    there(path, box(seconds=15.0), unfinished="interrupted")
    assert left(path, seconds=15.0).seconds == pytest.approx(1.0)
    assert left(path, spp=300, seconds=15.0) is None
    # An error: of two parts with 0.1 and e together it is 0.06.
    there(path, box(error=0.1), error=0.1, adaptive="wcv")
    assert left(path, error=0.1) is None
    rest = left(path, error=0.06)
    assert rest.adaptive and rest.method == "wcv" and 1 / math.hypot(1 / rest.error, 10) == pytest.approx(0.06)
    rest = left(path, spp=340, error=0.06)
    assert rest == box(spp=4, seed=part_seed(3, 1), subpixels=1)
    # An adaptive render that was broken off before a sample was shared out
    there(path, box(adaptive=True), unfinished="interrupted")
    rest = left(path, spp=400, adaptive=True)
    assert rest.adaptive and rest.method is None
    there(path, box(), seed=f"3 {part_seed(3, 1)}", samplerOptions="points=rounds")
    assert left(path, spp=400).seed == part_seed(3, 2)


def test_a_file_of_another_render_is_neither_taken_nor_replaced(tmp_path):
    uniform, file = {"lamps": "uniform"}, tmp_path / "box"
    file.write_text("<scene/>")
    asked = RenderRequest(str(file), 9, 3, "gpt", options=uniform, variant="cuda_ad_rgb")
    path = there(tmp_path / "a.exr", asked)
    for what, changes in {
        r"scene box \w+, not ball \w+": {"scene": "ball"},
        r"scene box \w+, not box \w+ \(its file, -D, --sensor, .* was another\)": {"parameters": {"a": "1"}},
        "size none, not 16x16": {"size": (16, 16)},
        "seed 3, not 4": {"seed": 4},
        "sampler gpt, not primal": {"sampler": "primal"},
        "sampler gpt, not auto": {"sampler": "auto"},
        "options lamps=uniform, not none": {"options": {"lamps": "power"}},
        "options lamps=uniform, not reuse=true, lamps=uniform": {"options": uniform | {"reuse": True}},
        "colours rgb, not spectral": {"variant": "llvm_ad_spectral"},
        "adaptive none, not wcv": {"adaptive": True, "method": "wcv", "spp": 32},
        "unbiased false, not true": {"unbiased": True},
        "subpixels auto, not 2": {"subpixels": 2},
        "diagnostics false, not true": {"diagnostics": True},
    }.items():
        with pytest.raises(
            NgptError, match=f"a.exr: is another render: {what}; ask for the same, give another name, or --force"
        ):
            rest_of(replace(asked, **changes), path)
    assert rest_of(replace(asked, variant="llvm_ad_rgb_double", gradients=True, memory=99), path) is None
    with pytest.raises(NgptError, match=r"another render: scene box \w+, not box \w+"):
        file.write_text("<scene> </scene>")
        rest_of(asked, path)
    shot = RenderRequest("box", 9, 3, "gpt", frames=(7, 8))
    there(path, request=shot.header(7)["ngpt:request"])
    assert rest_of(shot, path, 7) is None
    with pytest.raises(NgptError, match="frame 7, not 8"):
        rest_of(shot, path, 8)


@pytest.mark.parametrize(
    "request_",
    [{}, {"request": "no json"}, {"request": "[1]"}, {"request": 9**5 * "["}, {"scene": "box 1", "time": 9.0}],
)
def test_a_file_without_a_request_is_neither_taken_nor_replaced(tmp_path, request_):
    path = there(tmp_path / "a.exr", **request_)
    with pytest.raises(NgptError, match=r"a.exr: is another render: its header has no request.* or --force in place"):
        left(path, spp=9)


def test_a_number_beyond_floats_in_a_header_counts_as_none(tmp_path):
    said = box(seconds=15.0).header()["ngpt:request"]
    path = there(tmp_path / "a.exr", request=said.replace("15.0", "1" + 400 * "0"))
    assert left(path, seconds=20.0).seconds == 6.0


def test_a_scene_or_camera_without_a_file_goes_on_with_nothing(tmp_path, renderer):
    """Its header does not say which one it is, and samples of two must not be mixed."""
    from data_gen.frames.shot import Shot

    path = tmp_path / "a.exr"
    for what, asked in {
        "scene": RenderRequest(Shot(lambda frame: ("diffuse", {})), 9, frames=(7,)),
        "camera": RenderRequest("diffuse", 9, frames=(7,), camera=CameraPath([Key(0, np.eye(4))])),
    }.items():
        there(path, spp=4, request=asked.header(7)["ngpt:request"])
        with pytest.raises(NgptError, match=f"a.exr: whether it is of this {what} cannot be known"):
            rest_of(asked, path, 7)


@pytest.mark.parametrize("given", [{"spp": 2.0}, {"spp": "2"}, {"seed": 0.5}, {"memory": "lots"}])
def test_what_is_counted_is_a_whole_number(given):
    with pytest.raises(WrongUse, match=f"{next(iter(given))} .* is not a whole number"):
        RenderRequest("diffuse", **given)


def test_a_request_holds_plain_values_of_its_own():
    options = {"reuse": True}
    plain = {"spp": 9, "seed": 2**63, "size": (16, 12), "error": 0.5, "seconds": 2.0, "subpixels": 2, "unbiased": True}
    kinds = (np.int64, np.uint64, np.array, np.float32, np.float64, np.int64, np.bool_)
    odd = {name: kind(value) for kind, (name, value) in zip(kinds, plain.items(), strict=True)}
    request, same = box(**odd, options=options, frames=np.arange(2)), box(**plain, options=options, frames=(0, 1))
    options["reuse"] = False
    assert request == same and request.options == {"reuse": True}
    assert request.header(0) == same.header(0) and said_by(request.header(0))["seed"] == 2**63
    assert box(size=[16, 12]) == box(size=(16, 12))


def test_nothing_that_is_asked_for_is_left_out_without_a_word(renderer):
    one, shot = RenderRequest("diffuse", 2, size=(16, 12)), RenderRequest("diffuse", 2, size=(16, 12), frames=(0, 1))
    loaded = RenderRequest(load(renderer, "diffuse", (16, 12)), 2, sampler="primal")
    for call, message in [
        (lambda: render_scene("diffuse", 2, camera="path.json"), "belongs to a shot"),
        (lambda: render_scene("diffuse", 2, dt=2), "belongs to a shot"),
        (lambda: render_scene(shot), "2 frames were asked for, and one image is rendered"),
        (lambda: render_scene("diffuse", 2, frames=(0, 1)), "2 frames were asked for, and one image is rendered"),
        (lambda: render_frames(one), "there are no frames to render"),
        (lambda: render_frames("diffuse", []), "there are no frames to render"),
        (lambda: render_frames(one, range(2)), "a RenderRequest says all"),
        (lambda: render_frames(shot, (0, 2)), "a RenderRequest says all"),
        (lambda: write_frames(shot, {2: Path("a.exr")}), "a RenderRequest says all"),
        (lambda: render_stack(loaded, adaptive=True), "a RenderRequest says all"),
        (lambda: render_stack(loaded, with_features=False), "a RenderRequest says all"),
    ]:
        with pytest.raises(WrongUse, match=message):
            call()
    assert [frame for frame, _ in render_frames(shot, (0, 1))] == [0, 1]


def test_the_header_says_the_same_of_the_same_request(tmp_path):
    """Whatever the options' spelling, and what stack and image are for; and the budget beside it."""
    one = box(spp=64, options={"reuse": "true", "lamps": "power"}, seconds=9.0)
    other = box(spp=64, options={"reuse": True}, seconds=9.0, needs_features=False, gradients=True, memory=99)
    assert one.header() == other.header() and said_by(one.header())["seconds"] == 9.0
    assert one.identity() == box(spp=1, options={"reuse": True}).identity()
    shot = RenderRequest("box{frame}", parameters={"a": "{frame * 2}"}, frames=range(3))
    assert shot.spp == 32 and shot.gradients and len({str(shot.header(frame)) for frame in range(3)}) == 3
    assert shot.identity(2)["scene"].startswith("box2 ") and shot.identity(2)["frame"] == 2


def test_a_request_is_checked_where_it_is_made_and_given_whole(renderer):
    request = RenderRequest("diffuse", 2, 3, "gpt", size=(16, 12))
    stack, plan = render_scene(request)
    same(stack, render_scene("diffuse", 2, 3, "gpt", size=(16, 12)).stack)
    assert plan.sampler == "gpt" and stack.attributes["ngpt:request"] == request.header()["ngpt:request"]
    with pytest.raises(WrongUse, match=r"use dataclasses\.replace"):
        render_scene(request, 4)
    with pytest.raises(WrongUse, match="no option 'reus'; did you mean 'reuse'"):
        replace(request, options={"reus": True})


def test_shared_tails_are_as_asked_for_unless_unbiased(tmp_path):
    """Whether they pay is known after the render: the same command must take both, and go on with both."""
    path = tmp_path / "a.exr"
    for given in ({}, {"sampler": "auto"}, {"options": {"tails": "shared"}}):
        for options in ({}, {"samplerOptions": "tails=shared"}, {"samplerOptions": "tails=shared, tails=paths"}):
            there(path, box(**given), **options)
            assert left(path, spp=336, **given) is None and left(path, spp=400, **given).spp == 64
            with pytest.raises(NgptError, match="unbiased false, not true"):
                left(path, spp=336, unbiased=True, **given)
    # Whole paths and then shared ones are biased too. Nobody asked for what is merged by hand.
    there(path, box(), samplerOptions="tails=shared")
    merged = ngpt.merge([ngpt.read(there(tmp_path / "b.exr", box(seed=4), seed="4")), ngpt.read(path)])
    assert merged.attributes["ngpt:samplerOptions"] == "tails=shared, tails=paths"
    assert said_by(merged.attributes) is None


def test_parts_and_frames_have_seeds_of_their_own():
    seeds = [part_seed(seed, part) for seed in range(4) for part in range(5)]
    frames = [frame_seed(seed, frame, use) for seed in range(4) for frame in range(5) for use in (0, 1)]
    assert len({*seeds, *frames}) == len(seeds) + len(frames) and seeds[5] == 1


def test_the_same_command_goes_on_and_then_is_done(renderer, command):
    assert begun.SHARED == LEAST
    command(f"{RENDER} --seed 3 --spp 16 -o it.exr")
    first, on = ngpt.read("it.exr"), f"{RENDER} --seed 3 --spp 48 --skip-existing -o it.exr"
    assert "has 16 samples per pixel; going on with it" in command(on)
    whole = ngpt.read("it.exr")
    assert whole.attributes["ngpt:spp"] == 48 and whole.attributes["ngpt:seed"] == f"3 {part_seed(3, 1)}"
    # The samples that were there, and others: to the bit what merging them gives.
    command(f"{RENDER} --seed {part_seed(3, 1)} --spp 32 -o rest.exr")
    merged = ngpt.merge([first, ngpt.read("rest.exr")])
    assert all(np.array_equal(whole[name], merged[name], equal_nan=True) for name in merged.names)
    data = Path("it.exr").read_bytes()
    assert "skipped: the stack is there" in command(on)
    assert "seed 3, not 4" in command(f"{on} --seed 4", 1)
    assert "another render: scene" in command(f"{on} -D a=1", 1)
    assert Path("it.exr").read_bytes() == data
    # In place of a file that is not whole
    Path("it.exr").write_bytes(data[: len(data) // 2])
    command(on)
    assert len(Path("it.exr").read_bytes()) > len(data) // 2 and ngpt.read("it.exr").attributes["ngpt:spp"] == 48


@pytest.mark.parametrize("more", ["--adaptive", "--error 0.001"])
def test_samples_that_are_shared_out_go_on_so(renderer, command, more):
    for spp in (32, 80):
        command(f"{RENDER} --sampler gpt {more} --skip-existing -o it.exr --spp {spp}")
    found = ngpt.read("it.exr")
    assert found.attributes["ngpt:spp"] == 80 and len(found.attributes["ngpt:seed"].split()) == 2
    assert found.attributes["ngpt:adaptive"] and "samples" in found


def test_frames_go_on_too(renderer, command):
    words = f"{RENDER} --frames 0:3 -o shot"
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
    found = [ngpt.read(file).attributes for file in files.values()]
    assert all(attributes["ngpt:spp"] == 64 and "ngpt:unfinished" not in attributes for attributes in found)


def failing(monkeypatch, passes_before):
    """Has renders fail after so many passes."""
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
        said = command(f"{RENDER} --spp 64 -o it.exr", 1)
    assert "the device is gone; it.exr has the 16 samples per pixel done before" in said
    kept = ngpt.read("it.exr")
    assert kept.attributes["ngpt:spp"] == 16 and kept.attributes["ngpt:unfinished"] == "failed"
    command(f"{RENDER} --spp 16 -o same.exr")
    assert np.allclose(kept["primal"], ngpt.read("same.exr")["primal"], rtol=0.5, atol=0.1)
    command(f"{RENDER} --spp 64 -o it.exr --skip-existing")
    assert ngpt.read("it.exr").attributes["ngpt:spp"] == 64
    # One that fails at first leaves nothing.
    failing(monkeypatch, 0)
    with pytest.raises(RuntimeError):
        command(f"{RENDER} --spp 64 -o none.exr")
    assert not Path("none.exr").exists()


def test_nothing_that_comes_after_the_last_sample_takes_the_image_along(renderer, command, monkeypatch):
    def gone(*arguments):
        raise RuntimeError("gone")

    from data_gen.frames import shot

    with monkeypatch.context() as patched:
        patched.setattr(reused, "_key", gone)  # whether the next render may have the sampler
        command(f"{RENDER} --spp 4 -o it.exr")
    command(f"{RENDER} --spp 4 -o same.exr")
    same(ngpt.read("it.exr"), ngpt.read("same.exr"))
    with monkeypatch.context() as patched:
        patched.setattr(shot, "motion_vectors", gone)
        told = command(f"{RENDER} --spp 4 --frames 0:2 -o f{{frame}}.exr", 1)
    assert "frame 0: gone; f0.exr has the samples done before" in told
    frame = ngpt.read("f0.exr")
    assert frame.attributes["ngpt:unfinished"] == "failed" and frame["primal"].mean() > 0.1


def test_hair_with_the_colour_of_melanin_is_rendered(renderer):
    """Of its parameters one is None, which Mitsuba's own list of them cannot give."""
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
    said = command(f"{RENDER} --spp 4 -o {folder.absolute()}/it.exr", 1)
    assert f"what was made is kept in {Path('it.kept.exr').absolute()}" in said
    assert ngpt.read("it.kept.exr").attributes["ngpt:spp"] == 4


def test_light_that_overflows_ends_no_render_that_somebody_looks_at(renderer, command, monkeypatch):
    Path("nan.xml").write_text(
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"/>'
        '<emitter type="constant"><rgb name="radiance" value="3e38 3e38 3e38"/></emitter></scene>'
    )
    words = "render nan.xml --size 24x16 --sampler gpt --spp 32 -o it.exr"

    def fail(error):
        def failing(*_):
            raise error

        return failing

    page = SimpleNamespace(watched=True, enough=False, ended=False, tell=lambda line: None)
    page.show, page.close = fail(MemoryError()), fail(OSError("gone"))
    monkeypatch.setattr(
        onlook, "onlookers", lambda live, scene, command, console, unit: onlook.Onlookers(page, console.say, unit)
    )
    told = [line for line in command(f"{words} --live").splitlines() if "the render goes on" in line]
    assert len(told) == 1 and told[0].startswith("no live image: ")
    Path("it.exr").unlink()
    assert "; it.exr has the 16 samples per pixel done before" in command(f"{words} --adaptive", 1)
    assert ngpt.read("it.exr").attributes["ngpt:spp"] == 16
