"""The request for a render: one frozen record, made once by the command line or by Python, and passed down whole.

The header of each stack contains its request in canonical form. A render can continue a file if its request and the
file's differ at most in their budgets, and the file has fewer samples (``data_gen.begun``).
"""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field, fields
from pathlib import Path
from typing import Any

from data_gen.backend import DEFAULT_VARIANT
from data_gen.budget import DEFAULT_MEMORY, Budget, Watch, wall
from data_gen.pattern import filled
from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS, check_options, find
from ngpt.errors import NgptError, WrongUse
from ngpt.merging import REQUEST
from ngpt.options import as_text
from ngpt.subpixels import choice

DEFAULT_SPP = 32
# Parts of a variant's name for its backend and precision, which do not change the light
_MACHINES = {"scalar", "llvm", "cuda", "metal", "ad", "double"}


@dataclass(frozen=True)
class RenderRequest:
    """Everything that is requested of a render.

    ``scene``      a scene file, a built-in scene by name, or a Mitsuba scene; of frames also a ``frames.shot.Shot``
    ``spp``        base paths per pixel (32 if nothing else ends the render); with ``adaptive`` their mean
    ``sampler``    "auto", one of ``data_gen.samplers.SAMPLERS``, or for frames one of ``FRAME_SAMPLERS``; ``options``
                   are its options, which may be texts

    Film and camera, for scene files and built-in scenes:

    ``size``       (width, height) in pixels; None: the scene's own
    ``sensor``     number or id of the sensor to render; None: the first
    ``parameters`` the ``<default>`` values of a scene file
    ``variant``    variant of Mitsuba; None: the current one, or llvm_ad_rgb if none is set
    ``subpixels``  2 or 4: keeps 2x2 or 4x4 subpixels of each pixel, for denoisers; 1: none; "auto": where they are
                   known to help (docs/use/subpixels.md)
    ``diagnostics`` adds rates of failed shifts and discarded values as channels

    Budget; the limit that is reached first ends the render:

    ``seconds``    wall-clock time of each frame, compilation included; with ``method``, also pilot and method
    ``cpu_seconds`` as ``seconds``, but processor time of this process, on all cores: other work hardly changes it
    ``error``      adaptive samples until the result is expected to have this relative error (0.05: 5 %)
    ``memory``     MiB for paths and film, beside the scene (6144)

    How samples are distributed, and what the stack is for:

    ``adaptive``   more samples where the error of the result is large
    ``method``     the method that will denoise the stack. Adaptive samples follow its error. With only ``seconds``, a
                   pilot chooses the sampler for it, and for "auto" the method too
    ``unbiased``   turns off the cache of tails that paths share (docs/samplers/tails.md), which lowers the noise of
                   most renders and adds a small bias
    ``gradients``  whether sampler "auto" must render dx and dy, even if a sampler without them leaves less error
    ``needs_features`` False: albedo, normal and depth may be left out if a lens blurs them too much to be useful

    Shots, whose scene and parameters may contain {frame}, {frame:04d} or {frame * 3}:

    ``frames``     their numbers; () for a single image
    ``camera``     its path: key frames (.json), or a file with an animated camera (.glb, .gltf) at so many ``fps``
    ``dt``         pairs of paths per pixel, 2 or more, for differences to the previous frame; 0: none

    Raises NgptError for values that make no sense for any scene.
    """

    scene: Any
    spp: int | None = None
    seed: int = 0
    sampler: str = "auto"
    _: KW_ONLY
    options: Mapping[str, Any] = field(default_factory=dict)
    size: tuple[int, int] | None = None
    sensor: int | str | None = None
    parameters: Mapping[str, str] = field(default_factory=dict)
    variant: str | None = None
    subpixels: int | str = "auto"
    diagnostics: bool = False
    seconds: float | None = None
    cpu_seconds: float | None = None
    error: float | None = None
    memory: int | None = None
    adaptive: bool = False
    method: str | None = None
    unbiased: bool = False
    gradients: bool = False
    needs_features: bool = True
    frames: tuple[int, ...] = ()
    camera: Any = None
    fps: float = 24.0
    dt: int = 0

    def __post_init__(self) -> None:
        for each in FIELDS.keys() - {"scene", "camera", "options", "parameters"}:
            self._set(each, _plain(getattr(self, each)))
        mitsuba = sys.modules.get("mitsuba")
        self._set("variant", self.variant or (mitsuba.variant() if mitsuba else None) or DEFAULT_VARIANT)
        self._set("scene", str(self.scene) if isinstance(self.scene, Path) else self.scene)
        self._set("parameters", dict(self.parameters or {}))
        self._set("options", dict(self.options or {}))
        self._set("subpixels", choice(self.subpixels))
        # A method that denoises a shot over time may need gradients.
        self._set("gradients", self.gradients or bool(self.frames))
        remembers = FRAME_SAMPLERS.get(self.sampler) if self.frames else None
        timed = self.seconds is not None or self.cpu_seconds is not None
        if self.spp is None and (remembers or not (timed or self.error is not None)):
            self._set("spp", remembers.spp if remembers else DEFAULT_SPP)
        self._check(remembers, timed)

    def _check(self, remembers: Any, timed: bool) -> None:
        for each in ("spp", "seed", "memory", "dt"):
            if not isinstance(value := getattr(self, each), int | None):
                raise WrongUse(f"{each} {value!r} is not a whole number")
        if not isinstance(self.scene, str) and (self.size or self.parameters or self.sensor is not None):
            raise NgptError("size, parameters and sensor of a loaded scene are fixed; give them to data_gen.load_scene")
        if self.seconds is not None and self.cpu_seconds is not None:
            raise WrongUse("--cpu-time and --time are two limits of time; give one of them")
        if self.cpu_seconds is not None and not str(self.variant).startswith("llvm"):
            raise WrongUse(f"--cpu-time: variant '{self.variant}' does not render on processors; give --time")
        self.budget.check()
        for option, given in {"--camera": self.camera, "--dt": self.dt}.items():
            if given and not self.frames:
                raise WrongUse(f"{option} belongs to a shot; name its frames: --frames 0:120")
        if not 0 <= self.seed < 2**64:
            raise WrongUse(f"seed {self.seed} is out of range; use 0 .. 2^64 - 1")
        if remembers is None and self.sampler != "auto":
            find(self.sampler)
        check_options(self.sampler, self.options)
        if self.method is not None and not (self.shares or (timed and self.sampler == "auto" and self.spp is None)):
            raise WrongUse(
                "--for needs --adaptive or --error; or give --time without --sampler and --spp, and a pilot chooses "
                "the sampler for it"
            )
        if self.dt == 1:
            raise WrongUse("--dt 1: a variance needs at least 2 pairs; use --dt 2")
        if remembers and self.subpixels not in ("auto", 1):
            raise WrongUse(
                f"sampler '{self.sampler}' reuses earlier frames and has no subpixels: leave --subpixels out"
            )
        if remembers and self.seconds is not None:
            raise NgptError(f"sampler '{self.sampler}' renders a number of samples, not for a time: use --spp")

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    @property
    def shares(self) -> bool:
        """Whether pixels get different numbers of samples."""
        return self.adaptive or self.error is not None

    @property
    def budget(self) -> Budget:
        memory = DEFAULT_MEMORY if self.memory is None else self.memory
        if self.cpu_seconds is None:
            return Budget(self.spp, self.seconds, memory, wall)
        return Budget(self.spp, self.cpu_seconds, memory, time.process_time)

    def header(self, frame: int | None = None) -> dict[str, str]:
        """The header's attribute with the request for a ``frame`` or an image, in canonical form."""
        budget = {"spp": self.spp, "seconds": self.seconds, "error": self.error}
        return {REQUEST: json.dumps(self.identity(frame) | budget, sort_keys=True)}

    def identity(self, frame: int | None = None) -> dict[str, Any]:
        """All that decides which image is rendered: requests of equal identities may continue each other."""
        entry = SAMPLERS.get(self.sampler) or FRAME_SAMPLERS.get(self.sampler)
        return {
            "scene": self._scene(frame) if isinstance(self.scene, str) else None,
            "frame": frame,
            "size": self.size and "{}x{}".format(*self.size),
            "seed": self.seed,
            "sampler": self.sampler,
            "options": (entry.unusual(entry.settings(self.options)) if entry else as_text(self.options)) or None,
            "adaptive": (self.method or "auto") if self.adaptive else None,
            "unbiased": self.unbiased,
            "subpixels": self.subpixels,
            "colours": " ".join(part for part in str(self.variant).split("_") if part not in _MACHINES),
            "diagnostics": self.diagnostics,
        }

    def _scene(self, frame: int | None) -> str:
        """The scene's name, and a checksum of its file and of all arguments that change it. Meshes and textures are
        left out."""
        given = dict(self.parameters) | ({} if self.sensor is None else {"--sensor": str(self.sensor)})
        scene = self.scene
        if frame is not None:
            scene = filled(scene, frame)
            given = {name: filled(text, frame) for name, text in given.items()}
            given |= {"--fps": str(self.fps), "--dt": str(self.dt)}
        digest = hashlib.sha256(repr(sorted(given.items())).encode())
        for file in (scene, None if self.camera is None else str(self.camera)):
            if file is not None and Path(file).is_file():
                try:
                    digest.update(Path(file).read_bytes())
                except OSError as error:
                    raise NgptError(f"{file}: cannot be read: {error.strerror or error}") from error
        return f"{Path(scene).name} {digest.hexdigest()[:16]}"


def said_by(attributes: Mapping[str, Any]) -> dict[str, Any] | None:
    """The canonical request in the header of a file, with its budget; None if the header has no request."""
    try:
        said = json.loads(str(attributes.get(REQUEST, "")))
    except (ValueError, RecursionError):  # the file may come from another program
        return None
    return said if isinstance(said, dict) else None


def _plain(value: Any) -> Any:
    """NumPy values as Python values, and sequences as tuples: these can be compared and written to headers."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return tuple(map(_plain, value)) if isinstance(value, list | tuple | range) else value


FIELDS = {each.name: each.default for each in fields(RenderRequest)}
_WATCHED = {each.name for each in fields(Watch)}


def asked(scene: Any, given: Mapping[str, Any], frames: Iterable[int] = ()) -> tuple[RenderRequest, Watch]:
    """The request and the watch of a call by keywords. Keywords that are fields of neither are options of the sampler.

    If ``scene`` is a request already, it is returned as it is; raises WrongUse if ``given`` would change it.
    """
    watch = Watch(**{name: value for name, value in given.items() if name in _WATCHED})
    known = {name: value for name, value in given.items() if name in FIELDS}
    options = {name: value for name, value in given.items() if name not in _WATCHED | FIELDS.keys()}
    if frames := tuple(frames):
        known["frames"] = frames
    if not isinstance(scene, RenderRequest):
        options = {**known.pop("options", {}), **options}
        return RenderRequest(scene, options=options, **known), watch
    if options or any(value not in (FIELDS[name], getattr(scene, name)) for name, value in known.items()):
        raise WrongUse("a RenderRequest says all that is asked for: use dataclasses.replace to change it")
    return scene, watch
