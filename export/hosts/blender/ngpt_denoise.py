"""ngpt in Blender: denoises the last render by an ngpt network. An add-on of one file.

*Edit > Preferences > Add-ons > Install from Disk* installs this file. Put ``ngpt-colour.onnx``, and for images that
need tiles ``ngpt-colour.statistics.onnx``, wherever you like, and name the first in the panel. Blender's Python needs
ONNX Runtime: the panel shows the command. Then render with Cycles, *Denoising Data* on and denoising off, and press
*Denoise* in the sidebar of the image editor, tab *ngpt*: the result is a new image.

The network is any that reads nothing but colour, albedo, normal and depth. See export/CONTRACT.md.
"""

import contextlib
import math
import struct
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import bpy
import numpy as np

bl_info = {
    "name": "ngpt Denoise",
    "author": "ngpt",
    "version": (1, 0, 0),
    "blender": (4, 2, 0),
    "location": "Image Editor > Sidebar > ngpt",
    "description": "Denoises the last render by an ngpt network (ONNX)",
    "category": "Render",
}

RESULT = "ngpt denoised"
# Layer of the network -> names of Cycles' passes, the first that is there counts, and their channels.
PASSES = {
    "primal": (("Noisy Image", "Combined"), "RGB"),
    "albedo": (("Denoising Albedo", "Diffuse Color", "DiffCol"), "RGB"),
    "normal": (("Denoising Normal", "Normal"), "XYZ"),
    "depth": (("Denoising Depth", "Depth"), "Z"),
}
# What tiles may take of the memory.
MEMORY = 2**31


class NgptError(Exception):
    """Something that the user can put right; shown in one line."""


# --- the render, as arrays -------------------------------------------------------------------------------------------


def render_layers(scene, view_layer: str = "") -> dict[str, np.ndarray]:
    """Those of ``PASSES``, and ``alpha``, that the last render has: (1, C, H, W) float32, row 0 on top.

    Python sees no pixels of *Render Result*, so that it is saved and read again.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "render.exr"
        save_render(scene, path)
        channels = read_exr(path)
    layers = list(dict.fromkeys(name.rsplit(".", 2)[0] for name in channels if name.count(".") >= 2))
    if not layers:
        raise NgptError("the last render holds no passes: render with Cycles")
    layer = view_layer if view_layer in layers else layers[0]
    found = {}
    for name, (passes, suffixes) in PASSES.items():
        for known in passes:
            names = [f"{layer}.{known}.{suffix}" for suffix in suffixes]
            if all(channel in channels for channel in names):
                found[name] = np.stack([channels[channel] for channel in names])[None]
                if name == "primal" and f"{layer}.{known}.A" in channels:
                    found["alpha"] = channels[f"{layer}.{known}.A"][None, None]
                break
    if "primal" not in found:
        raise NgptError(f"view layer {layer} has no Combined pass: enable it, and render again")
    return found


def save_render(scene, path: Path) -> None:
    """Saves *Render Result* as one part of 32-bit floats, not compressed; the scene's own settings stay as they are."""
    settings = scene.render.image_settings
    wanted = {
        "media_type": "MULTI_LAYER_IMAGE",  # since Blender 5.0; must come first
        "file_format": "OPEN_EXR_MULTILAYER",
        "color_management": "FOLLOW_SCENE",
        "color_depth": "32",
        "exr_codec": "NONE",
        "use_exr_interleave": True,  # since Blender 5.0
    }
    wanted = {name: value for name, value in wanted.items() if hasattr(settings, name)}
    before = {name: getattr(settings, name) for name in wanted}
    try:
        for name, value in wanted.items():
            setattr(settings, name, value)
        bpy.data.images["Render Result"].save_render(str(path), scene=scene)
    except (KeyError, RuntimeError) as error:
        raise NgptError("there is no render yet: press F12 first") from error
    finally:
        for name, value in before.items():
            # A codec, say, that the format of before does not know.
            with contextlib.suppress(TypeError):
                setattr(settings, name, value)
    if not path.is_file():
        raise NgptError("there is no render yet: press F12 first")


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """The channels (H, W) of a file as ``save_render`` makes it: one part, scanlines, 32-bit floats, not compressed."""
    data, at, header = path.read_bytes(), 8, {}
    while data[at]:
        name, at = _text(data, at)
        _, at = _text(data, at)  # its type
        (size,) = struct.unpack_from("<i", data, at)
        header[name], at = data[at + 4 : at + 4 + size], at + 4 + size
    listed, names = header["channels"], []
    kinds, end = set(), 0
    while listed[end]:
        name, end = _text(listed, end)
        names.append(name)
        kinds.add(struct.unpack_from("<i", listed, end)[0])
        end += 16
    if header["compression"] != b"\0" or kinds != {2}:
        raise NgptError(f"Blender {bpy.app.version_string} wrote the render in a form that this add-on does not read")
    x0, y0, x1, y1 = struct.unpack("<4i", header["dataWindow"])
    width, height = x1 - x0 + 1, y1 - y0 + 1
    # After the header a table of positions; then each row: its number, its size, one channel after another.
    count = height * (8 + 4 * width * len(names))
    rows = np.frombuffer(data, np.uint8, count, at + 1 + 8 * height).reshape(height, -1)
    numbers = rows[:, :4].copy().view("<i4")[:, 0] - y0
    pixels = np.empty((len(names), height, width), np.float32)
    pixels[:, numbers] = rows[:, 8:].copy().view("<f4").reshape(height, len(names), width).swapaxes(0, 1)
    return dict(zip(names, pixels, strict=True))


def _text(data: bytes, at: int) -> tuple[str, int]:
    """The text that begins at ``at`` and ends with a zero, and what comes after it."""
    end = data.index(0, at)
    return data[at:end].decode(), end + 1


# --- the network -----------------------------------------------------------------------------------------------------


class Network:
    """A network's file in ONNX Runtime, whole or in tiles (export/CONTRACT.md)."""

    def __init__(self, path: Path):
        if problem := missing():
            raise NgptError(problem)
        if not path.is_file():
            raise NgptError(f"there is no network at '{path}': name ngpt-colour.onnx in the panel")
        self.path, self.session = path, session(path)
        metadata = self.session.get_modelmeta().custom_metadata_map
        if "ngpt.inputs" not in metadata:
            raise NgptError(f"{path.name} is no network of ngpt")
        self.inputs = metadata["ngpt.inputs"].split(", ")
        self.optional = [name for name in metadata.get("ngpt.optional", "").split(", ") if name]
        self.alignment, self.overlap = int(metadata["ngpt.alignment"]), int(metadata["ngpt.overlap"])
        self.bytes = int(metadata["ngpt.bytes per pixel"])
        unknown = [name for name in self.inputs if name not in (*PASSES, *self.optional)]
        if unknown:
            raise NgptError(f"{path.name} needs {', '.join(unknown)}, which Cycles does not give: use ngpt-colour.onnx")

    def run(self, layers: dict[str, np.ndarray], memory: int = MEMORY, progress=lambda done, all: None) -> np.ndarray:
        """The image (1, 3, H, W) of layers (1, C, H, W); those that the network can do without may be left out."""
        height, width = layers["primal"].shape[2:]
        feed = {name: layers[name] for name in self.inputs if name in layers}
        for name in self.inputs:
            if name not in feed and name not in self.optional:
                raise NgptError(f"{self.path.name} needs the pass {PASSES[name][0][0]}: enable Denoising Data")
            feed.setdefault(name, np.zeros((1, len(PASSES.get(name, ("", "RGB"))[1]), height, width), np.float32))
        if height * width * self.bytes <= memory:
            return self.session.run(["image"], feed)[0]
        # All tiles share the statistics of the whole image, so that no seam shows.
        whole = self.path.with_suffix(".statistics.onnx")
        if not whole.is_file():
            raise NgptError(f"{width}x{height} goes in tiles, which need {whole.name}: put it beside {self.path.name}")
        reader = session(whole)
        statistics = reader.run(["statistics"], {given.name: feed[given.name] for given in reader.get_inputs()})[0]
        side = int(math.sqrt(memory / self.bytes)) - 2 * self.overlap
        side = max(side - side % self.alignment, self.alignment)
        image = np.empty((1, 3, height, width), np.float32)
        corners = [(y, x) for y in range(0, height, side) for x in range(0, width, side)]
        for done, (y, x) in enumerate(corners):
            progress(done, len(corners))
            top, left = max(0, y - self.overlap), max(0, x - self.overlap)
            window = np.s_[:, :, top : y + side + self.overlap, left : x + side + self.overlap]
            part = {name: np.ascontiguousarray(layer[window]) for name, layer in feed.items()}
            made = self.session.run(["image"], part | {"statistics": statistics})[0]
            image[:, :, y : y + side, x : x + side] = made[:, :, y - top : y - top + side, x - left : x - left + side]
        return image


def missing() -> str:
    """What Blender's Python lacks, and how to get it; "" for nothing."""
    if find_spec("onnxruntime"):
        return ""
    return f'ONNX Runtime is not installed; in a terminal run: "{sys.executable}" -m pip install onnxruntime'


def session(path: Path):
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise NgptError(f"ONNX Runtime cannot load {path.name}: {' '.join(str(error).split())[:200]}") from error


# --- Blender ---------------------------------------------------------------------------------------------------------


def show(image: np.ndarray, alpha: np.ndarray | None):
    """The image datablock ``RESULT`` with the pixels of (1, 3, H, W), scene-linear, made anew if its size changed."""
    height, width = image.shape[2:]
    held = bpy.data.images.get(RESULT)
    if held and (tuple(held.size) != (width, height) or not held.is_float):
        bpy.data.images.remove(held)
        held = None
    # A new image of floats is in the scene's linear space.
    held = held or bpy.data.images.new(RESULT, width, height, alpha=True, float_buffer=True)
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = np.moveaxis(image[0], 0, -1)
    if alpha is not None:
        pixels[..., 3] = alpha[0, 0]
    held.alpha_mode = "PREMUL"
    held.pixels.foreach_set(pixels[::-1].ravel())  # Blender's row 0 is the lowest
    held.update()
    held.pack()  # kept in the .blend
    return held


class NgptPreferences(bpy.types.AddonPreferences):
    bl_idname = __name__

    network: bpy.props.StringProperty(
        name="Network",
        description="An .onnx file of ngpt that reads colour, albedo, normal and depth",
        subtype="FILE_PATH",
        default=str(Path(__file__).resolve().with_name("ngpt-colour.onnx")),
    )

    def draw(self, context):
        self.layout.prop(self, "network")


def preferences(context) -> NgptPreferences:
    return context.preferences.addons[__name__].preferences


class RENDER_OT_ngpt_denoise(bpy.types.Operator):
    """Denoise the last render by an ngpt network, into a new image"""

    bl_idname = "render.ngpt_denoise"
    bl_label = "Denoise"

    def execute(self, context):
        scene, manager = context.scene, context.window_manager
        try:
            network = Network(Path(bpy.path.abspath(preferences(context).network)))
            layers = render_layers(scene, context.view_layer.name)
            manager.progress_begin(0, 1)
            try:
                image = network.run(layers, progress=lambda done, all: manager.progress_update(done / all))
            finally:
                manager.progress_end()
        except NgptError as error:
            self.report({"ERROR"}, f"ngpt: {error}")
            return {"CANCELLED"}
        made = show(image, layers.get("alpha"))
        for area in context.screen.areas if context.screen else ():
            if area.type == "IMAGE_EDITOR":
                area.spaces.active.image = made
        if network.optional and not any(name in layers for name in network.optional):
            self.report({"WARNING"}, "ngpt: colour alone; enable Denoising Data and render again for finer texture")
        return {"FINISHED"}


class IMAGE_PT_ngpt(bpy.types.Panel):
    bl_label = "ngpt Denoise"
    bl_space_type, bl_region_type, bl_category = "IMAGE_EDITOR", "UI", "ngpt"

    def draw(self, context):
        column = self.layout.column()
        if problem := missing():
            column.label(text=problem.split(";")[0], icon="ERROR")
            column.label(text=problem.partition(": ")[2])
        column.prop(preferences(context), "network")
        if hasattr(context.view_layer, "cycles"):
            column.prop(context.view_layer.cycles, "denoising_store_passes", text="Denoising Data")
        column.operator(RENDER_OT_ngpt_denoise.bl_idname)


CLASSES = (NgptPreferences, RENDER_OT_ngpt_denoise, IMAGE_PT_ngpt)


def register():
    for made in CLASSES:
        bpy.utils.register_class(made)


def unregister():
    for made in reversed(CLASSES):
        bpy.utils.unregister_class(made)
