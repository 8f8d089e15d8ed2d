"""``ngpt denoise --temporal -m wcv`` with differences in time, and ``ngpt render --dt``."""

import json

import numpy as np
import pytest

import ngpt
from ngpt.cli import main
from ngpt.io.exr import read_image
from ngpt.methods import METHODS
from ngpt.sequence.flicker import flicker
from ngpt.sequence.windows import HOP, LENGTH, reconstruct_shot
from ngpt.stack import GradientStack

COUNT, SIZE = LENGTH + 4, (16, 20, 3)


@pytest.fixture
def stacks(rng):
    """Frames of a wall that grows brighter, with noise that no gradient tells from light."""
    found = []
    for i in range(COUNT):
        image = np.full(SIZE, 1 + 0.1 * i)
        layers = {
            "primal": image + rng.normal(0, 0.2, SIZE),
            "dx": np.zeros(SIZE) + rng.normal(0, 0.2, SIZE),
            "dy": np.zeros(SIZE) + rng.normal(0, 0.2, SIZE),
            "dt": np.full(SIZE, 0.1) + rng.normal(0, 0.01, SIZE),
            "motion": np.zeros((*SIZE[:2], 2)),
        }
        variances = {"primal_var": 0.04, "dx_var": 0.04, "dy_var": 0.04, "dt_var": 0.0001}
        layers |= {name: np.full(SIZE, value) for name, value in variances.items()}
        found.append(GradientStack(layers, {"ngpt:frame": i, "ngpt:previousFrame": i - 1}))
    return found


@pytest.fixture
def shot(tmp_path, stacks):
    folder = tmp_path / "shot"
    folder.mkdir()
    for i, stack in enumerate(stacks):
        ngpt.write(folder / f"w.{i:04d}.exr", stack)
    return folder


def results(stacks, **options):
    found = {number: result for number, _, result in reconstruct_shot(stacks, **options)}
    assert all(result.options.keys() <= METHODS[result.method].options.keys() for result in found.values())
    return {number: result.image for number, result in found.items()}


def test_windows_pass_over_into_each_other(stacks):
    """Frames of two windows: the mean of both, by how far they are from the ends of each."""
    both, first, second = results(stacks), results(stacks[:LENGTH]), results(stacks[HOP:])
    for i in range(HOP, LENGTH):
        near, far = LENGTH - i, min(i - HOP + 1, COUNT - i)
        assert np.allclose(both[i], (near * first[i] + far * second[i - HOP]) / (near + far), atol=1e-5)
    assert np.array_equal(both[0], first[0]) and np.allclose(both[COUNT - 1], second[COUNT - HOP - 1], atol=1e-6)


def squares(images):
    return np.mean([np.square(image - 1 - 0.1 * i).mean() for i, image in images.items()])


def test_frames_are_better_together(stacks):
    alone = {i: ngpt.denoise(stack, "wcv") for i, stack in enumerate(stacks)}
    together = results(stacks)
    assert list(together) == list(range(COUNT)) and squares(together) < 0.4 * squares(alone)
    truth = [np.full(SIZE, 1 + 0.1 * i) for i in together]
    still = [stack["motion"] for stack in stacks]
    assert flicker(list(together.values()), truth, still) < 0.1 * flicker(list(alone.values()), truth, still)


def test_direct_light_and_caustics_are_added_back(stacks):
    direct = np.zeros(SIZE)
    direct[4:8, 4:8] = 5
    lamp = [stack.replace(primal=stack["primal"] + direct, direct=direct) for stack in stacks[:3]]
    for i, image in results(lamp).items():
        assert np.allclose((image - direct)[4:8, 4:8].mean(), 1 + 0.1 * i, atol=0.15)
        assert np.allclose(image[10:], results(stacks[:3])[i][10:], atol=0.1)
    light = np.full(SIZE, 2.0)
    caustic = [stack.replace(primal=stack["primal"] + light, caustic=light) for stack in stacks[:3]]
    for i, image in results(caustic).items():
        assert np.allclose(image, results(stacks[:3])[i] + light, atol=1e-3)


@pytest.mark.parametrize("cut", ["dt", "dt_var", "motion", "previous", "size", "file"])
def test_a_cut_parts_a_shot_in_two(stacks, cut):
    second = stacks[4]
    changed = {
        "dt": lambda: GradientStack({n: second[n] for n in second.names if n != "dt"}, second.attributes),
        "dt_var": lambda: GradientStack({n: second[n] for n in second.names if n != "dt_var"}, second.attributes),
        "motion": lambda: GradientStack({n: second[n] for n in second.names if n != "motion"}, second.attributes),
        "previous": lambda: GradientStack(second.layers, {"ngpt:frame": 4, "ngpt:previousFrame": 9}),
        "size": lambda: GradientStack({n: second[n][:8] for n in second.names}, second.attributes),
        "file": lambda: None,
    }[cut]()
    found = results([*stacks[:4], changed, *stacks[5:7]])
    expected = results(stacks[:4])
    assert all(np.array_equal(found[i], image) for i, image in expected.items())
    assert (4 in found) == (cut != "file") and {5, 6} <= found.keys()


def test_frames_do_not_depend_on_those_that_are_not_wanted(stacks):
    whole = results(stacks)
    for only in (0, HOP, COUNT - 1):
        found = results(stacks, wanted=lambda number, only=only: number == only)
        assert list(found) == [only] and np.array_equal(found[only], whole[only])


def test_the_command_uses_them_and_goes_on(shot, tmp_path, stacks, capsys):
    out = tmp_path / "clean"
    words = ["denoise", str(shot), "-o", f"{out}/", "--temporal", "-m", "wcv"]
    assert main([*words, "--json"]) == 0
    reports = json.loads(capsys.readouterr().out)["files"]
    assert [report["method"] for report in reports] == ["wcv"] * COUNT
    assert all(report["output"].endswith(f"{i:04d}.exr") for i, report in enumerate(reports))
    whole = {path.name: read_image(path) for path in sorted(out.iterdir())}
    for image, expected in zip(whole.values(), results(stacks).values(), strict=True):
        assert np.allclose(image, expected, atol=1e-5)
    (out / "w.0007.exr").unlink()
    assert main([*words, "--skip-existing"]) == 0
    assert f"{COUNT - 1} of {COUNT} stacks were skipped" in capsys.readouterr().err
    assert np.array_equal(read_image(out / "w.0007.exr"), whole["w.0007.exr"])


def test_a_file_that_cannot_be_read_is_a_cut(shot, tmp_path, capsys):
    (shot / "w.0003.exr").write_bytes(b"nothing")
    out = tmp_path / "clean"
    assert main(["denoise", str(shot), "-o", f"{out}/", "--temporal", "-m", "wcv"]) == 1
    assert "w.0003.exr" in capsys.readouterr().err and len(list(out.iterdir())) == COUNT - 1


def test_one_pair_is_refused_and_two_are_rendered(renderer, tmp_path, capsys):
    words = ["render", "diffuse", "--size", "16x12", "--spp", "1", "--sampler", "primal", "-o", str(tmp_path / "shot")]
    assert main([*words, "--frames", "0:2", "--dt", "1"]) == 2
    assert "use --dt 2" in capsys.readouterr().err
    assert main([*words[:-1], str(tmp_path / "a.exr"), "--dt", "2"]) == 2
    assert "--dt belongs to a sequence" in capsys.readouterr().err
    assert main([*words, "--frames", "0:2", "--dt", "2"]) == 0
    stack = ngpt.read(tmp_path / "shot/diffuse.0001.exr")
    assert not stack["dt"].any() and stack["dt_var"].shape == stack["primal"].shape
