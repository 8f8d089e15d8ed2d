"""Renders a scene made by this script in Cycles, as ``PYTHON_WITH_BPY blender_scene.py FOLDER NAME=SPP:SEED ...``.

Each ``NAME.exr`` is a multi-layer file with the denoising passes, as a user gets it who ticks *Denoising Data*. It runs
in a Python of its own: ``python3.11 -m venv b && b/bin/pip install bpy==5.0.* && b/bin/python blender_scene.py ...``.
In ``files``, all ``--size 32x18``: blender-parts=4:1, and with that option or those blender-interleaved=4:1,
blender-denoised=4:1, blender-stereo=4:1, blender-stereo-interleaved=4:1; moving, blender-before=4:1:3
blender-now=4:1:4.

Options before the folder: ``--blur`` opens the lens, ``--interleaved`` writes one part instead of one for each pass,
``--denoised`` has Cycles denoise, ``--size WIDTHxHEIGHT``. ``--moving`` writes the pass *Vector*, and the camera goes
right and up by some pixels a frame; ``NAME=SPP:SEED:FRAME`` renders one frame. ``--stereo`` writes two eyes.
"""

import argparse
import math
from pathlib import Path

import bpy  # isort: split

import addon_utils  # found only once bpy is there

CHECKS = ("Checker", 3, (0.7, 0.65, 0.5), (0.1, 0.12, 0.2))
BRICKS = ("Brick", 4, (0.55, 0.25, 0.15), (0.4, 0.18, 0.12), (0.6, 0.6, 0.58))


def material(colour=(0.8, 0.8, 0.8), roughness=1.0, metallic=0.0, transmission=0.0, texture=None, glow=0.0):
    made = bpy.data.materials.new("made")
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    surface = nodes["Principled BSDF"].inputs
    values = {"Base Color": (*colour, 1), "Roughness": roughness, "Metallic": metallic}
    values |= {"Transmission Weight": transmission, "Emission Color": (*colour, 1), "Emission Strength": glow}
    for name, value in values.items():
        surface[name].default_value = value
    if texture:
        pattern = nodes.new("ShaderNodeTex" + texture[0])
        pattern.inputs["Scale"].default_value = texture[1]
        for name, shade in zip(("Color1", "Color2", "Mortar"), texture[2:], strict=False):
            pattern.inputs[name].default_value = (*shade, 1)
        links.new(nodes.new("ShaderNodeTexCoord").outputs["Object"], pattern.inputs["Vector"])
        links.new(pattern.outputs["Color"], surface["Base Color"])
    return made


def box(centre, size, **surface):
    bpy.ops.mesh.primitive_cube_add(size=1, location=centre, scale=size)
    bpy.context.object.data.materials.append(material(**surface))


def ball(centre, radius, **surface):
    bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24, radius=radius, location=centre)
    bpy.ops.object.shade_smooth()
    bpy.context.object.data.materials.append(material(**surface))


def build(blur):
    """A room: lamp and window in view, checked floor, coloured walls, bricks, metal, glass, gloss, small things."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    box((0, 0, -0.05), (6, 6, 0.1), roughness=0.35, texture=CHECKS)
    box((0, 0, 3.05), (6, 6, 0.1))
    box((-3.05, 0, 1.5), (0.1, 6, 3), colour=(0.65, 0.06, 0.05))
    box((3.05, 0, 1.5), (0.1, 6, 3), colour=(0.08, 0.5, 0.12))
    box((0, 3.05, 1.5), (6, 0.1, 3), texture=BRICKS)
    box((0.8, 1.0, 2.9), (0.9, 0.6, 0.05), colour=(1, 0.85, 0.6), glow=14)
    box((-2.95, 1.4, 1.9), (0.02, 1.0, 0.5), colour=(0.4, 0.6, 1), glow=6)
    box((1.5, 0.3, 0.4), (0.8, 0.8, 0.8), colour=(0.5, 0.3, 0.1))
    ball((-1.3, 0.9, 0.75), 0.75, colour=(0.9, 0.8, 0.6), roughness=0.12, metallic=1)
    ball((1.9, 1.8, 0.6), 0.6, colour=(0.95, 0.95, 0.95), roughness=0.0, metallic=1)
    ball((0.5, -0.5, 0.45), 0.45, colour=(1, 1, 1), roughness=0.0, transmission=1)
    for i in range(24):  # thin and small things, which denoisers like to lose
        x, y = math.cos(2.4 * i), math.sin(2.4 * i)
        place = (-0.2 + 0.08 * i * x, 0.2 + 0.05 * i * y, 0.07)
        ball(place, 0.07, colour=(0.5 + 0.5 * x, 0.5, 0.5 + 0.5 * y), roughness=0.3)
        if i % 4 == 0:
            box((-2.6 + 0.2 * i, 2.6, 1.2), (0.03, 0.03, 2.4), colour=(0.8, 0.7, 0.1))
    camera = bpy.data.cameras.new("camera")
    camera.lens, camera.dof.use_dof, camera.dof.focus_distance, camera.dof.aperture_fstop = 26, blur, 4.6, 0.25
    seen = bpy.data.objects.new("camera", camera)
    seen.location, seen.rotation_euler = (0, -3.9, 1.5), (math.radians(86), 0, 0)
    scene = bpy.context.scene
    scene.collection.objects.link(seen)
    scene.camera = seen
    scene.world = bpy.data.worlds.new("night")


def main():
    parser = argparse.ArgumentParser()
    for name in ("blur", "interleaved", "denoised", "moving", "stereo"):
        parser.add_argument(f"--{name}", action="store_true")
    parser.add_argument("--size", default="480x270")
    parser.add_argument("folder", type=Path)
    parser.add_argument("renders", nargs="+")
    given = parser.parse_args()
    addon_utils.enable("cycles")
    build(given.blur)
    scene, layer = bpy.context.scene, bpy.context.view_layer
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = "CPU", given.denoised, False
    scene.render.resolution_x, scene.render.resolution_y = map(int, given.size.split("x"))
    layer.cycles.denoising_store_passes = True
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_diffuse_color = True
    written = scene.render.image_settings
    if bpy.app.version >= (5, 0):  # those before write one part
        written.media_type, written.use_exr_interleave = "MULTI_LAYER_IMAGE", given.interleaved
    written.file_format, written.color_depth, written.exr_codec = "OPEN_EXR_MULTILAYER", "32", "ZIP"
    if given.moving:
        layer.use_pass_vector = True
        bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
        for frame, place in ((1, (0, -3.9, 1.5)), (5, (0.6, -3.9, 1.9))):
            scene.camera.location = place
            scene.camera.keyframe_insert("location", frame=frame)
    if given.stereo:
        scene.render.use_multiview = True
        written.views_format = "MULTIVIEW"
    for wanted in given.renders:
        name, _, how = wanted.partition("=")
        spp, seed, frame = [*map(int, how.split(":")), 1][:3]
        scene.frame_set(frame)
        scene.cycles.samples, scene.cycles.seed = spp, seed
        scene.render.filepath = str((given.folder / f"{name}.exr").resolve())
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
