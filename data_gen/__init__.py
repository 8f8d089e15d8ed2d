"""data_gen: renders gradient stacks with Mitsuba 3. The only package of ngpt that imports mitsuba and drjit.

stack, plan = data_gen.render_scene("scene.xml", spp=64)                       # what `ngpt render` does
for frame, stack in data_gen.render_frames("shot.xml", range(120), spp=16):    # what `ngpt render --frames` does
    ...
scene = mi.load_dict({..., "integrator": {"type": "gpt"}})                     # our integrators are Mitsuba's plugins
"""

from importlib import import_module
from typing import TYPE_CHECKING

from data_gen.plugins import register_when_ready

if TYPE_CHECKING:
    from data_gen.backend import use_variant
    from data_gen.choosing.plans import Plan
    from data_gen.request import RenderRequest
    from data_gen.scenes.load import load_scene
    from data_gen.session import render_frames, render_scene, stop_on_ctrl_c
    from data_gen.shot_files import write_frames, write_frames_on_cluster

__all__ = [
    "Plan",
    "RenderRequest",
    "load_scene",
    "render_frames",
    "render_scene",
    "stop_on_ctrl_c",
    "use_variant",
    "write_frames",
    "write_frames_on_cluster",
]

# Imported on first use, because Mitsuba and its libraries take a second.
_HOMES = {"Plan": "choosing.plans", "load_scene": "scenes.load", "use_variant": "backend"}
_HOMES |= {"RenderRequest": "request"}
_HOMES |= dict.fromkeys(("render_frames", "render_scene", "stop_on_ctrl_c"), "session")
_HOMES |= dict.fromkeys(("write_frames", "write_frames_on_cluster"), "shot_files")


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'data_gen' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(f"data_gen.{_HOMES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_when_ready()
