"""Motion vectors where their exact values are known, and as a law: what is seen here was seen there."""

import numpy as np
import pytest
from renders import mi
from unbiased import load

from data_gen.frames.motion import motion_vectors, seen, snapshot
from data_gen.scenes.geometry import Triangles, geometry, geometry_of, put_vertices, vertices, vertices_name
from data_gen.scenes.load import set_film_size
from ngpt.errors import NgptError

SIZE = (32, 24)


def floats(*values):
    return [float(value) for value in values]


def scene_of(origin=(0, 0, 5), target=(0, 0, 0), **objects):
    to_world = mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=[0, 1, 0])
    camera = {"type": "perspective", "fov": 30, "to_world": to_world}
    scene = load(mi, {"type": "scene", "sensor": camera, "light": {"type": "constant"}, **objects})
    set_film_size(scene, SIZE)
    return scene


def move_camera(scene, origin, target):
    params = mi.traverse(scene.sensors()[0])
    params["to_world"] = mi.Transform4f().look_at(floats(*origin), floats(*target), floats(0, 1, 0))
    params.update()


def wall(z=0.0):
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, z]).scale(20)}


def pixel_width(distance, fov=30):
    """The width of a pixel in the world, at a distance from the camera."""
    return 2 * distance * np.tan(np.radians(fov) / 2) / SIZE[0]


def moved(scene, change):
    """Motion from the state of a scene to that after ``change``, which is thus the current one."""
    before = snapshot(scene)
    change()
    return motion_vectors(scene, snapshot(scene), before)


@pytest.mark.parametrize("across, up", [(1, 0), (-2, 0.5)])
def test_a_camera_that_moves_by_pixels_sees_a_wall_move_by_pixels(renderer, across, up):
    scene = scene_of(wall=wall())
    step = pixel_width(5)
    origin = (across * step, up * step, 5)
    motion = moved(scene, lambda: move_camera(scene, origin, (*origin[:2], 0)))
    # What the camera sees now it saw to the right of here before it moved to the right; y points down.
    assert np.allclose(motion, [across, -up], atol=1e-3)


def test_a_sky_turns_with_the_camera_and_stays_when_that_moves(renderer):
    scene = scene_of()
    assert np.allclose(moved(scene, lambda: move_camera(scene, (3, 1, 5), (3, 1, 0))), 0, atol=1e-3)
    angle = np.arctan(pixel_width(1))
    right = (3 + np.tan(angle), 1, 4)
    motion = moved(scene, lambda: move_camera(scene, (3, 1, 5), right))
    assert np.allclose(motion[12, 16], [1, 0], atol=0.02)


def test_a_sphere_moves_in_front_of_a_wall_at_rest(renderer):
    scene = scene_of(wall=wall(-1), ball={"type": "sphere", "radius": 0.5})
    params = mi.traverse(scene)
    key = next(filter(lambda name: name.endswith("ball.to_world"), params.keys()))

    def change():
        params[key] = mi.Transform4f().translate(floats(2 * pixel_width(5), 0, 0)).scale(0.5)
        params.update()

    motion = moved(scene, change)
    assert np.allclose(motion[1, 1], 0) and np.allclose(motion[12, 18], [-2, 0], atol=0.3)
    assert (np.abs(motion).max(axis=-1) > 0).sum() > 20


def test_vertices_have_the_names_of_this_mitsuba_and_of_the_next(renderer):
    """Mitsuba 3.10 has "positions", a tensor (V, 3); what is installed is asked for its own."""
    box = mi.load_dict({"type": "cube"})
    installed, found = mi.traverse(box), geometry(box)
    name = vertices_name(installed)
    rows = vertices(installed, name)
    assert isinstance(found, Triangles) and np.array_equal(found.vertices, rows) and rows.shape[1] == 3
    new = {"positions": mi.TensorXf(rows.astype(np.float32)), "faces": mi.TensorXu(found.faces)}
    for params, mesh in ((installed, ""), (new, ""), ({f"box.{key}": value for key, value in new.items()}, "box")):
        name = vertices_name(params, mesh)
        put_vertices(params, name, 2 * rows)
        assert np.array_equal(vertices(params, name), 2 * rows)
    assert np.array_equal(geometry_of(new).vertices, 2 * rows) and np.array_equal(geometry_of(new).faces, found.faces)
    assert vertices_name(new, "ball") == "" and geometry_of({"faces": new["faces"]}) is None


def test_any_deformation_of_a_mesh_is_followed(renderer):
    scene = scene_of(box={"type": "cube", "to_world": mi.ScalarTransform4f().scale([1.5, 1.5, 0.1])})
    params = mi.traverse(scene)
    key = vertices_name(params, "box")
    points = vertices(params, key)

    def change():
        # Sheared: x + 0.1 y, so that rows move by different amounts.
        put_vertices(params, key, points + [0.1, 0, 0] * points[:, 1:2])
        params.update()

    motion = moved(scene, change)
    y = (11.5 - np.arange(24)) * pixel_width(4.9)
    assert np.allclose(motion[6:18, 16, 0], -0.1 * y[6:18] / pixel_width(4.9), atol=1e-2)
    assert np.allclose(motion[6:18, 16, 1], 0, atol=1e-3)


def test_instances_move_by_their_own_matrix(renderer):
    def scene(shift):
        instance = {"type": "instance", "to_world": mi.ScalarTransform4f().translate([shift, 0, 0])}
        instance["shapegroup"] = {"type": "ref", "id": "group"}
        return scene_of(group={"type": "shapegroup", "one": {"type": "cube"}}, wall=wall(-1), thing=instance)

    step = 2 * pixel_width(4)  # of its front, 4 from the camera
    now = scene(step)
    motion = motion_vectors(now, snapshot(now), snapshot(scene(0)))
    assert np.allclose(motion[12, 16], [-2, 0], atol=1e-2) and np.allclose(motion[1, 1], 0)


def test_what_is_seen_here_was_seen_there(renderer):
    """Under a turn and a move of camera and box: the hit's place in the scene before is that of the pixel before."""

    def scene(angle, origin):
        box = {"type": "cube", "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], angle)}
        return scene_of(origin, box=box, floor=wall(-3))

    old, new = scene(20, (0, 0.5, 6)), scene(26, (0.2, 0.7, 6))
    before = snapshot(old)
    motion = motion_vectors(new, snapshot(new), before)
    now, then = seen(new), seen(old)
    y, x = np.mgrid[:24, :32] + 0.5
    place = np.rint(np.stack([x, y], axis=-1) + motion - 0.5).astype(int).reshape(-1, 2)
    inside = (place >= 0).all(axis=-1) & (place < SIZE).all(axis=-1)
    row = np.where(inside, place[:, 1] * 32 + place[:, 0], 0)
    box = inside & (now.shape == 0) & (then.shape[row] == 0)

    def on_the_box(points, angle):
        turn = np.array(mi.ScalarTransform4f().rotate([0, 1, 0], angle).matrix)
        return (np.linalg.inv(turn) @ points.T).T[:, :3]

    apart = on_the_box(now.points[box], 26) - on_the_box(then.points[row[box]], 20)
    # Half a pixel to either side, on faces seen at an angle.
    assert box.sum() > 60 and np.median(np.linalg.norm(apart, axis=1)) < 0.8 * pixel_width(5.5)
    still = on_the_box(now.points[box], 26) - on_the_box(then.points[box], 20)
    assert np.median(np.linalg.norm(still, axis=1)) > 2 * np.median(np.linalg.norm(apart, axis=1))


def test_a_plane_mirror_shows_what_stands_behind_it(renderer):
    mirror = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(20), "bsdf": {"type": "conductor"}}
    # The wall is 15 behind the mirror's plane in the mirror: 10 behind the camera, which stands 5 before it.
    back = mi.ScalarTransform4f().translate([0, 0, 15]).rotate([0, 1, 0], 180).scale(60)
    scene = scene_of(mirror=mirror, back={"type": "rectangle", "to_world": back})
    step = pixel_width(5 + 15)
    motion = moved(scene, lambda: move_camera(scene, (step, 0, 5), (step, 0, 0)))
    assert np.allclose(motion, [1, 0], atol=2e-3)


def test_what_was_not_there_or_behind_the_camera_has_no_motion(renderer):
    scene, before = scene_of(wall=wall()), snapshot(scene_of())
    assert np.isnan(motion_vectors(scene, snapshot(scene), before)).all()
    motion = moved(scene, lambda: None)
    before = snapshot(scene_of((0, 0, -5), (0, 0, -9), wall=wall()))
    assert np.isnan(motion_vectors(scene, snapshot(scene), before)).all() and not np.isnan(motion).any()


def test_a_camera_without_a_projection_is_refused(renderer):
    sensor = {"type": "orthographic", "to_world": mi.ScalarTransform4f().translate([0, 0, 5])}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "light": {"type": "constant"}})
    with pytest.raises(NgptError, match="perspective or thinlens"):
        snapshot(scene)
