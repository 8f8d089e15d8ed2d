"""Sequences: a frame is the same bits whatever others are rendered, and scenes are loaded no more than they must be."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_gen.frames.camera_path import CameraPath, Key, horizontal, look_at, read_camera_path
from ngpt.errors import NgptError
from ngpt.windows import Place, Window

pytest.importorskip("mitsuba")

import data_gen
from data_gen.pattern import filled

XML = """<scene version="3.0.0"><default name="angle" value="0"/><integrator type="path"/>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,1,4" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film></sensor>
<emitter type="constant"/><shape type="cube"><transform name="to_world"><rotate y="1" angle="$angle"/></transform>
</shape></scene>"""


def look(origin, target=(0, 0, 0), up=(0, 1, 0)):
    return np.array([origin, target, up], float)


def shot(tmp_path, camera=None, update=None, moving=True):
    from data_gen.frames.shot import Shot

    path = tmp_path / "scene.xml"
    path.write_text(XML)
    return Shot(lambda frame: (str(path), {"angle": str(5 * frame if moving else 0)}), camera=camera, update=update)


def rendered(shot, frames, **options):
    return dict(data_gen.render_frames(shot, frames, 2, 7, **{"sampler": "primal", "subpixels": 1} | options))


def test_a_frame_is_the_same_whatever_others_are_rendered(renderer, tmp_path):
    """And whether differences in time, for which scenes of before are loaded again, are rendered beside it."""
    paired = rendered(shot(tmp_path), range(1, 4), dt=2)
    last = rendered(shot(tmp_path), range(1, 4), skip=lambda frame: frame == 2, dt=2)
    farm = rendered(shot(tmp_path), range(3, 4))
    assert list(last) == [1, 3] and list(farm) == [3]
    assert all(np.array_equal(last[3][name], paired[3][name], equal_nan=True) for name in paired[3].names)
    assert set(paired[3].names) - set(farm[3].names) == {"dt", "dt_var"}
    assert all(np.array_equal(farm[3][name], paired[3][name], equal_nan=True) for name in farm[3].names)
    assert np.abs(farm[3]["motion"]).max() > 0.1
    assert paired[3].attributes["ngpt:pairs"] == 2 and not np.array_equal(paired[2]["dt"], paired[3]["dt"])
    assert np.isfinite(last[3]["dt"]).mean() > 0.5 and np.nanmax(np.abs(last[3]["dt"])) > 0


@pytest.mark.parametrize("sampler", ["primal", "gpt"])
def test_too_little_memory_is_refused_before_motion_is_computed(renderer, tmp_path, monkeypatch, sampler):
    assert_too_little_memory_is_refused_first(tmp_path, monkeypatch, sampler)


def assert_too_little_memory_is_refused_first(tmp_path, monkeypatch, sampler):
    from data_gen.frames import shot as module

    for name in ("seen", "motion_vectors"):
        monkeypatch.setattr(module, name, lambda *arguments: pytest.fail("motion was computed"))
    moving = shot(tmp_path)
    moving.size = (160, 120)
    with pytest.raises(NgptError, match=r"160x120 pixels need \d+ MiB of memory .* pass --memory \d+"):
        rendered(moving, range(1, 3), sampler=sampler, memory=1)


def test_frames_have_seeds_of_their_own_and_say_who_they_are(renderer, tmp_path):
    stacks = rendered(shot(tmp_path, moving=False), [0, 2, 5])
    assert not np.array_equal(stacks[0]["primal"], stacks[2]["primal"])
    assert len({stack.attributes["ngpt:seed"] for stack in stacks.values()}) == 3
    found = [(s.attributes["ngpt:frame"], s.attributes["ngpt:previousFrame"]) for s in stacks.values()]
    assert found == [(0, -2), (2, 0), (5, 2)]


CROP = """<integer name="crop_offset_x" value="$x"/><integer name="crop_offset_y" value="2"/>
<integer name="crop_width" value="$width"/><integer name="crop_height" value="8"/></film>"""


def cropped(tmp_path, x="{frame}", width="8"):
    """A shot at rest; crop windows show a part of it: a farm's frames, or a subject that is followed."""
    from data_gen.frames.shot import Shot

    path, defaults = tmp_path / "cropped.xml", '<default name="x" value="0"/><default name="width" value="8"/>'
    path.write_text(XML.replace("</film>", CROP).replace("<integrator", f"{defaults}<integrator", 1))
    return Shot(lambda frame: (str(path), {"x": filled(x, frame), "width": filled(width, frame)}))


def test_motion_is_that_of_the_picture_where_crop_windows_move(renderer, tmp_path):
    stacks = rendered(cropped(tmp_path, "{2 * frame}"), range(2), dt=4)
    assert [stack.place for stack in stacks.values()] == [
        Place(Window(2 * frame, 2, 8, 8), Window(0, 0, 16, 12)) for frame in range(2)
    ]
    assert np.abs(stacks[1]["motion"]).max() < 1e-3
    # Its partner is in the crop window of before, but for the last two columns.
    known = np.isfinite(stacks[1]["dt"]).all(axis=(0, 2))
    assert known.tolist() == 6 * [True] + 2 * [False] and np.abs(stacks[1]["dt"][:, :6]).max() < 1e-5


def test_crop_windows_of_other_sizes_move_too(renderer, tmp_path):
    stacks = rendered(cropped(tmp_path, "{3 - frame}", "{6 + frame}"), range(2))
    assert [stack.width for stack in stacks.values()] == [6, 7]
    assert all(np.abs(stack["motion"]).max() < 1e-3 for stack in stacks.values())
    assert_sizes_may_not_change(tmp_path, dt=2)


def assert_sizes_may_not_change(tmp_path, **options):
    with pytest.raises(NgptError, match=r"frame 0 is 6x8 at \(3, 2\) and frame -1 5x8 at \(4, 2\): --dt"):
        rendered(cropped(tmp_path, "{3 - frame}", "{6 + frame}"), range(2), **options)


def test_a_scene_is_loaded_again_only_where_its_parameters_change(renderer, tmp_path):
    camera = CameraPath([Key(0, look_at(*look((0, 1, 4))), look((0, 1, 4))), Key(4, np.eye(4))])
    still = shot(tmp_path, camera, moving=False)
    assert still.at(0) is still.at(1)
    moving = shot(tmp_path)
    first = moving.at(0)
    assert moving.at(1) is not first


def test_a_twin_looks_through_the_same_camera(renderer, tmp_path):
    """Samplers that remember frames look at the frame before in a twin, if more than the camera changes."""
    from data_gen.frames.shot import Shot

    path, (first, camera) = tmp_path / "scene.xml", XML.split("<sensor")
    second, rest = camera.split("</sensor>")
    sensors = (f"<sensor{which}</sensor>" for which in (second, second.replace("0,1,4", "3,1,0")))
    path.write_text(first + "".join(sensors) + rest)
    wanted, other = (Shot(lambda frame: (str(path), {}), sensor=number) for number in (1, 0))
    films = [each.snapshot(0).film for each in (wanted, wanted.twin(), other)]
    assert np.array_equal(films[0], films[1]) and not np.array_equal(films[0], films[2])


def test_a_first_frame_with_nothing_before_it_has_no_motion(renderer, tmp_path):
    from data_gen.frames.shot import Shot

    for frame in (1, 2):
        (tmp_path / f"{frame}.xml").write_text(XML)
    stacks = rendered(Shot(lambda frame: (str(tmp_path / f"{frame}.xml"), {})), [1, 2])
    assert np.isnan(stacks[1]["motion"]).all() and np.array_equal(stacks[2]["motion"], np.zeros((12, 16, 2)))


def test_cameras_between_keys():
    path = CameraPath(
        [Key(f, look_at(*v), v, fov) for f, v, fov in [(0, look((0, 0, 4)), 40), (4, look((4, 0, 4)), 60)]]
    )
    middle = path.at(1)
    assert np.allclose(middle.to_world, look_at((1, 0, 4), (0, 0, 0), (0, 1, 0))) and middle.fov == 45
    assert path.at(-3) is path.keys[0] and path.at(9) is path.keys[1]


def test_matrices_turn_evenly_between_keys():
    def turned(degrees, scale):
        a = np.radians(degrees)
        matrix = np.eye(4)
        matrix[:3, :3] = scale * np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        matrix[:3, 3] = degrees, 0, 0
        return matrix

    path = CameraPath([Key(0, turned(0, 1)), Key(2, turned(80, 1))])
    assert np.allclose(path.at(1).to_world, turned(40, 1))
    # Scales, which exporters write, are none of a camera's business.
    scaled = CameraPath([Key(0, turned(0, 1e-3)), Key(2, turned(80, np.array([3, 0.5, 70])))])
    assert np.allclose(scaled.at(1).to_world, turned(40, 1)) and np.allclose(scaled.at(2).to_world, turned(80, 1))
    # Mirrored ones stay so.
    side = np.array([-2, 1, 1])
    mirrored = CameraPath([Key(0, turned(0, side)), Key(2, turned(80, side))])
    assert np.allclose(mirrored.at(1).to_world, turned(40, np.sign(side)))
    with pytest.raises(NgptError, match="mirrored in one of the frames 0 and 2"):
        CameraPath([Key(0, turned(0, 1)), Key(2, turned(80, side))])


def test_a_sheared_camera_looks_the_same_way_with_the_same_side_up():
    """As below a parent of uneven scale; as other programs take it."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.diag([1, 3, 1]) @ Rotation.from_euler("xyz", [30, 40, 50], degrees=True).as_matrix()
    (key,) = CameraPath([Key(0, matrix)]).keys
    axes = key.to_world[:3, :3]
    assert np.allclose(axes.T @ axes, np.eye(3)) and np.isclose(np.linalg.det(axes), 1)
    assert np.allclose(np.cross(axes[:, 2], matrix[:3, 2]), 0) and axes[:, 2] @ matrix[:3, 2] > 0
    assert np.isclose(axes[:, 0] @ matrix[:3, 1], 0) and axes[:, 1] @ matrix[:3, 1] > 0


def test_the_look_at_of_a_path_is_that_of_mitsuba(renderer):
    ours = look_at((1, 2, 3), (-1, 0.5, 0), (0, 1, 0.2))
    theirs = renderer.ScalarTransform4f().look_at(origin=[1, 2, 3], target=[-1, 0.5, 0], up=[0, 1, 0.2])
    assert np.allclose(ours, np.array(theirs.matrix), atol=1e-6)


def test_fields_of_view_of_the_height_are_turned_into_those_of_the_width():
    assert horizontal(40, "x", 2) == 40
    assert np.isclose(np.tan(np.radians(horizontal(40, "y", 2) / 2)), 2 * np.tan(np.radians(20)))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "cannot be read: Expecting"),
        ("{}", "holds no camera keys"),
        ("[5]", "key 0 is 5"),
        ('[{"frame": 0, "fow": 3}]', "has 'fow'; known are"),
        ('[{"origin": [0, 0, 1]}]', "key 0 has no target"),
        ('[{"origin": [0, 0, 1], "target": [0, 0]}]', "target is .*must be 3 finite numbers"),
        ('[{"origin": [0, 0, 1], "target": [0, 0, 1]}]', "at its target"),
        ('[{"to_world": [[1, 0, 0, 0]]}]', "must be 4 x 4"),
        ('[{"to_world": [[0,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]', "frame 0: the camera's matrix flattens space"),
        ('[{"origin": [0, 0, 1], "target": [0, 0, 0], "fov": 190}]', "between 0 and 180"),
        ('[{"origin": [0, 0, 1], "target": [0, 0, 0], "fov": NaN}]', "finite number"),
        (
            '[{"frame": 2, "origin": [0,0,1], "target": [0,0,0]}, {"frame": 2, "origin": [0,0,1], "target": [0,0,0]}]',
            "sort",
        ),
        ('[{"origin": [0,0,1], "target": [0,0,0]}, {"origin": [0,0,1], "target": [0,0,0], "fov": 3}]', "no fov"),
    ],
)
def test_a_wrong_path_is_refused_with_its_place(tmp_path, text, complaint):
    path = tmp_path / "path.json"
    path.write_text(text)
    with pytest.raises(NgptError, match=complaint):
        read_camera_path(path)
