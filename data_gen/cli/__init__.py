"""The verbs of ``ngpt`` that render. ``ngpt`` finds them by the entry points of group "ngpt.verbs" in
pyproject.toml.
"""

from ngpt.cli import CONTINUES, Verb

ROOM = "data_gen.cli"

# Shown during the first pass of a render, which takes long unless an earlier render left its kernels
KERNELS = "compiling kernels ..."

VERBS = {
    "render": Verb("render a scene to a gradient stack, or to a denoised image", ROOM, heading="rendering"),
    "advise": Verb("find the sampler, method and number of samples for a time or an error", ROOM, heading="rendering"),
    "demo": Verb(
        "render built-in scenes, reconstruct with every method, and write a report to open in a browser",
        ROOM,
        heading="rendering",
    ),
    "dataset": Verb("make a training set, or continue one", ROOM, "train", CONTINUES, "networks"),
}
