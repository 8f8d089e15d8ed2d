"""Renders a scene made by this script in Cycles, as ``PYTHON_WITH_BPY blender_scene.py FOLDER NAME=SPP:SEED ...``.

Each ``NAME.exr`` is a multi-layer file with the denoising passes, as a user gets it who ticks *Denoising Data*. It runs
in Blender's Python, where ngpt is not installed.

Options before the folder: ``--blur`` opens the lens, ``--interleaved`` writes one part instead of one for each pass,
``--denoised`` has Cycles denoise, ``--size WIDTHxHEIGHT``. ``--moving`` writes the pass *Vector*, and the camera goes
right and up by some pixels a frame; ``NAME=SPP:SEED:FRAME`` renders one frame. ``--stereo`` writes two eyes.
"""

import argparse
import math
from pathlib import Path

import bpy  # isort: split

import addon_utils  # found only once bpy is there


def material(name, colour=(0.8, 0.8, 0.8), roughness=1.0, metallic=0.0, transmission=0.0, texture=None, glow=0.0):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Base Color"].default_value = (*colour, 1)
    surface.inputs["Roughness"].default_value = roughness
    surface.inputs["Metallic"].default_value = metallic
    surface.inputs["Transmission Weight"].default_value = transmission
    surface.inputs["Emission Color"].default_value = (*colour, 1)
    surface.inputs["Emission Strength"].default_value = glow
    if texture:
        pattern = nodes.new("ShaderNodeTex" + texture[0])
        pattern.inputs["Scale"].default_value = texture[1]
        for name, shade in zip(("Color1", "Color2", "Mortar"), texture[2:], strict=False):
            pattern.inputs[name].default_value = (*shade, 1)
        place = nodes.new("ShaderNodeTexCoord")
        links.new(place.outputs["Object"], pattern.inputs["Vector"])
        links.new(pattern.outputs["Color"], surface.inputs["Base Color"])
    return made


def box(name, centre, size, surface, turn=0.0):
    bpy.ops.mesh.primitive_cube_add(size=1, location=centre, scale=size, rotation=(0, 0, turn))
    bpy.context.object.name = name
    bpy.context.object.data.materials.append(surface)


def ball(name, centre, radius, surface):
    bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24, radius=radius, location=centre)
    bpy.ops.object.shade_smooth()
    bpy.context.object.name = name
    bpy.context.object.data.materials.append(surface)


CHECKS = ("Checker", 3, (0.7, 0.65, 0.5), (0.1, 0.12, 0.2))
BRICKS = ("Brick", 4, (0.55, 0.25, 0.15), (0.4, 0.18, 0.12), (0.6, 0.6, 0.58))
WOOD = ("Brick", 9, (0.5, 0.3, 0.1), (0.4, 0.22, 0.08), (0.2, 0.1, 0.05))


def build(blur):
    """A room: lamp and window in view, checked floor, coloured walls, bricks, metal, glass, gloss, small things."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    box("floor", (0, 0, -0.05), (6, 6, 0.1), material("checks", roughness=0.35, texture=CHECKS))
    box("ceiling", (0, 0, 3.05), (6, 6, 0.1), material("white"))
    box("left", (-3.05, 0, 1.5), (0.1, 6, 3), material("red", (0.65, 0.06, 0.05)))
    box("right", (3.05, 0, 1.5), (0.1, 6, 3), material("green", (0.08, 0.5, 0.12)))
    box("back", (0, 3.05, 1.5), (6, 0.1, 3), material("bricks", texture=BRICKS))
    box("lamp", (0.8, 1.0, 2.9), (0.9, 0.6, 0.05), material("lamp", (1, 0.85, 0.6), glow=14))
    box("strip", (-2.95, 1.4, 1.9), (0.02, 1.0, 0.5), material("strip", (0.4, 0.6, 1), glow=6))
    ball("metal", (-1.3, 0.9, 0.75), 0.75, material("metal", (0.9, 0.8, 0.6), 0.12, metallic=1))
    ball("mirror", (1.9, 1.8, 0.6), 0.6, material("mirror", (0.95, 0.95, 0.95), 0.0, metallic=1))
    ball("glass", (0.5, -0.5, 0.45), 0.45, material("glass", (1, 1, 1), 0.0, transmission=1))
    box("crate", (1.5, 0.3, 0.4), (0.8, 0.8, 0.8), material("wood", texture=WOOD), 0.5)
    for i in range(24):  # thin and small things, which denoisers like to lose
        x, y = math.cos(2.4 * i), math.sin(2.4 * i)
        bead = material(f"bead{i}", (0.5 + 0.5 * x, 0.5, 0.5 + 0.5 * y), 0.3)
        ball(f"bead{i}", (-0.2 + 0.08 * i * x, 0.2 + 0.05 * i * y, 0.07), 0.07, bead)
        if i % 4 == 0:
            box(f"rod{i}", (-2.6 + 0.2 * i, 2.6, 1.2), (0.03, 0.03, 2.4), material(f"rod{i}", (0.8, 0.7, 0.1)))
    camera = bpy.data.cameras.new("camera")
    camera.lens, camera.dof.use_dof, camera.dof.focus_distance, camera.dof.aperture_fstop = 26, blur, 4.6, 0.25
    seen = bpy.data.objects.new("camera", camera)
    seen.location, seen.rotation_euler = (0, -3.9, 1.5), (math.radians(86), 0, 0)
    scene = bpy.context.scene
    scene.collection.objects.link(seen)
    scene.camera = seen
    scene.world = bpy.data.worlds.new("night")


def prepare(size, interleaved=False, blur=False):
    """Makes the scene the one that is open, with Cycles, the passes and the file format set."""
    addon_utils.enable("cycles")
    build(blur)
    scene, layer = bpy.context.scene, bpy.context.view_layer
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = "CPU", False, False
    scene.render.resolution_x, scene.render.resolution_y = map(int, size.split("x"))
    layer.cycles.denoising_store_passes = True
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_diffuse_color = True
    written = scene.render.image_settings
    if bpy.app.version >= (5, 0):  # those before write one part
        written.media_type, written.use_exr_interleave = "MULTI_LAYER_IMAGE", interleaved
    written.file_format, written.color_depth, written.exr_codec = "OPEN_EXR_MULTILAYER", "32", "ZIP"


def move():
    """The camera goes right and up, evenly from frame 1 to 5."""
    camera = bpy.context.scene.camera
    bpy.context.view_layer.use_pass_vector = True
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    for frame, place in ((1, (0, -3.9, 1.5)), (5, (0.6, -3.9, 1.9))):
        camera.location = place
        camera.keyframe_insert("location", frame=frame)


def render(path, spp, seed, frame=1):
    scene = bpy.context.scene
    scene.frame_set(frame)
    scene.cycles.samples, scene.cycles.seed = spp, seed
    scene.render.filepath = str(path.resolve())
    bpy.ops.render.render(write_still=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--blur", action="store_true")
    parser.add_argument("--interleaved", action="store_true")
    parser.add_argument("--denoised", action="store_true")
    parser.add_argument("--moving", action="store_true")
    parser.add_argument("--stereo", action="store_true")
    parser.add_argument("--size", default="480x270")
    parser.add_argument("folder", type=Path)
    parser.add_argument("renders", nargs="+")
    given = parser.parse_args()
    prepare(given.size, given.interleaved, given.blur)
    bpy.context.scene.cycles.use_denoising = given.denoised
    if given.moving:
        move()
    if given.stereo:
        bpy.context.scene.render.use_multiview = True
        bpy.context.scene.render.image_settings.views_format = "MULTIVIEW"
    for wanted in given.renders:
        name, _, how = wanted.partition("=")
        render(given.folder / f"{name}.exr", *map(int, how.split(":")))


if __name__ == "__main__":
    main()
