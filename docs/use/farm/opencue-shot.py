"""A shot on OpenCue: python opencue-shot.py SCENE OUT 0-119

Needs OpenCue's pyoutline here, and `ngpt` on the PATH of the hosts.
"""

import shlex
import sys

from outline import Outline, cuerun
from outline.modules.shell import Shell, ShellCommand

scene, out, frames = map(shlex.quote, sys.argv[1:])  # they become a line of a shell
options = ["--spp", "32", "--sampler", "gpt", "--skip-existing"]
job = Outline("ngpt-shot", shot="shot", show="testing")
render = Shell(
    "render",
    command=["ngpt", "render", scene, "--frames", "#FRAMESPEC#", *options, "-o", f"{out}/stacks"],
    range=frames,
    chunk=8,
)
denoise = ShellCommand(
    "denoise",
    command=["ngpt", "denoise", f"{out}/stacks", "-o", f"{out}/clean", "--temporal", "--skip-existing"],
)
denoise.depend_all(render)
job.add_layer(render)
job.add_layer(denoise)
cuerun.launch(job, use_pycuerun=False)
