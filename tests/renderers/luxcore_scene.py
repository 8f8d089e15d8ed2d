"""Renders a small room in LuxCore: ``PYTHON_WITH_PYLUXCORE luxcore_scene.py FOLDER SPP SEED``, a file for each buffer.

``colour.exr``, ``albedo.exr``, ``normal.exr`` and ``depth.exr``, as LuxCore names and writes their channels. It runs
where ngpt is not installed.
"""

import os
import sys
import time
from pathlib import Path

import pyluxcore

WIDTH, HEIGHT = 192, 108
BUFFERS = {
    "colour": "RGB_IMAGEPIPELINE",
    "albedo": "ALBEDO",
    "normal": "AVG_SHADING_NORMAL",
    "depth": "DEPTH",
}


def properties(prefix, values):
    made = pyluxcore.Properties()
    for name, value in values.items():
        made.Set(pyluxcore.Property(f"{prefix}.{name}", value))
    return made


def room():
    scene = pyluxcore.Scene()
    scene.Parse(
        properties(
            "scene.camera",
            {"type": "perspective", "lookat.orig": [0, -3.9, 1.5], "lookat.target": [0, 0, 1.3], "fieldofview": 60},
        )
    )
    colours = {"white": [0.8, 0.8, 0.8], "red": [0.6, 0.05, 0.05], "green": [0.1, 0.5, 0.1]}
    for name, colour in colours.items():
        scene.Parse(properties(f"scene.materials.{name}", {"type": "matte", "kd": colour}))
    checks = {"type": "checkerboard2d", "texture1": 0.7, "texture2": 0.1}
    checks |= {"mapping.type": "uvmapping2d", "mapping.uvscale": [8, 8]}
    scene.Parse(properties("scene.textures.checks", checks))
    scene.Parse(properties("scene.materials.checks", {"type": "matte", "kd": "checks"}))
    scene.Parse(properties("scene.materials.lamp", {"type": "matte", "kd": [0, 0, 0], "emission": [9, 8, 6]}))
    squares = {
        "checks": [(-3, -3, 0), (3, -3, 0), (3, 3, 0), (-3, 3, 0)],
        "white": [(-3, 3, 0), (3, 3, 0), (3, 3, 3), (-3, 3, 3)],
        "red": [(-3, -3, 0), (-3, 3, 0), (-3, 3, 3), (-3, -3, 3)],
        "green": [(3, 3, 0), (3, -3, 0), (3, -3, 3), (3, 3, 3)],
        "lamp": [(-0.5, 0.5, 2.7), (-0.5, 1.5, 2.7), (0.5, 1.5, 2.7), (0.5, 0.5, 2.7)],
    }
    for name, corners in squares.items():
        corners = [tuple(map(float, corner)) for corner in corners]
        places = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
        scene.DefineMesh(f"{name} shape", corners, [(0, 1, 2), (0, 2, 3)], None, places, None, None)
        scene.Parse(properties(f"scene.objects.{name}", {"shape": f"{name} shape", "material": name}))
    return scene


def main():
    folder, spp, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    pyluxcore.Init(lambda *_: None)
    given = {
        "renderengine.type": "PATHCPU",
        "sampler.type": "RANDOM",
        "renderengine.seed": seed,
        "path.pathdepth.total": 6,
        "film.width": WIDTH,
        "film.height": HEIGHT,
        "film.imagepipelines.0.0.type": "NOP",
        "batch.haltspp": spp,
    }
    for number, (name, kind) in enumerate(BUFFERS.items()):
        given[f"film.outputs.{number}.type"] = kind
        given[f"film.outputs.{number}.filename"] = str(folder / f"{name}.exr")
    config = pyluxcore.Properties()
    for name, value in given.items():
        config.Set(pyluxcore.Property(name, value))
    session = pyluxcore.RenderSession(pyluxcore.RenderConfig(config, room()))
    session.Start()
    while not session.HasDone():
        time.sleep(0.1)
        session.UpdateStats()
    session.GetFilm().SaveOutputs()
    session.Stop()
    # Taken down in an order of Python's own, LuxCore ends with a segmentation fault.
    sys.stdout.flush()
    os._exit(0)


main()
