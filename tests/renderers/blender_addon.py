"""Installs and runs the add-on in Blender: ``PYTHON_WITH_BPY blender_addon.py ADD-ON NETWORKS FOLDER``.

Leaves in FOLDER the renders and, as .npy, what the add-on made of them; and ``report.json``: what it said. It runs in
Blender's Python, where ngpt is not installed.
"""

import importlib.util
import json
import sys
import traceback
from pathlib import Path
from unittest.mock import MagicMock

import bpy  # isort: split

import blender_scene
import numpy as np

ADDON, NETWORKS, FOLDER = map(Path, sys.argv[1:])
said = {}


def press():
    """Presses the button; returns what the user reads, "" where all went well."""
    try:
        assert bpy.ops.render.ngpt_denoise() == {"FINISHED"}
    except RuntimeError as error:
        return str(error).strip()
    return ""


def pixels():
    """The image of the add-on, (H, W, 4), row 0 on top."""
    image = bpy.data.images["ngpt denoised"]
    values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1]


def settings():
    written = bpy.context.scene.render.image_settings
    names = ("media_type", "file_format", "color_mode", "color_depth", "exr_codec", "use_exr_interleave")
    return {name: getattr(written, name) for name in names if hasattr(written, name)}


def hidden(name, package=None, _find=importlib.util.find_spec):
    return None if name == "onnxruntime" else _find(name, package)


def main():
    blender_scene.prepare("96x54")
    scene, layer = bpy.context.scene, bpy.context.view_layer
    bpy.ops.preferences.addon_install(filepath=str(ADDON), overwrite=True)
    bpy.ops.preferences.addon_enable(module="ngpt_denoise")
    addon = sys.modules["ngpt_denoise"]
    said["installed"] = addon.__file__
    chosen = bpy.context.preferences.addons["ngpt_denoise"].preferences
    network = str(NETWORKS / "ngpt-colour.onnx")

    said["no network"] = press()
    chosen.network = network
    said["no render"] = press()
    blender_scene.render(FOLDER / "passes.exr", 4, 1)
    before = settings()
    said["passes"] = press()
    said["settings stay"] = settings() == before
    np.save(FOLDER / "passes.npy", pixels())
    image = bpy.data.images["ngpt denoised"]
    said["image"] = [image.is_float, image.colorspace_settings.name, image.packed_file is not None]

    # In tiles: of the least size that there is, and with the statistics of the whole.
    layers = addon.render_layers(scene, layer.name)
    np.save(FOLDER / "tiles.npy", addon.Network(Path(network)).run(layers, memory=0)[0].transpose(1, 2, 0))

    chosen.network = str(NETWORKS / "ngpt-fast.onnx")
    said["needs gradients"] = press()
    chosen.network = network
    addon.find_spec = hidden
    said["no onnxruntime"] = press()
    addon.find_spec = importlib.util.find_spec

    # Another size, and a picture as the format; only colour, transparent where there is nothing.
    layer.cycles.denoising_store_passes = False
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_diffuse_color = False
    scene.render.resolution_x, scene.render.film_transparent = 80, True
    bpy.data.objects.remove(bpy.data.objects["back"])
    blender_scene.render(FOLDER / "colour.exr", 4, 2)
    written = scene.render.image_settings
    if bpy.app.version >= (5, 0):
        written.media_type = "IMAGE"
    written.file_format, written.color_depth = "PNG", "16"
    before = settings()
    said["colour"] = press()
    said["settings stay"] &= settings() == before
    np.save(FOLDER / "colour.npy", pixels())
    panel = MagicMock()
    bpy.types.IMAGE_PT_ngpt.draw(panel, bpy.context)
    column = panel.layout.column.return_value
    said["panel"] = [call.args[1] for call in column.prop.mock_calls] + [
        call.args[0] for call in column.operator.mock_calls
    ]
    bpy.ops.preferences.addon_disable(module="ngpt_denoise")
    said["removed"] = not hasattr(bpy.types, "IMAGE_PT_ngpt")


try:
    main()
except Exception:
    said["failed"] = traceback.format_exc()
(FOLDER / "report.json").write_text(json.dumps(said))
