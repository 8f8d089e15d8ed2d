"""Runs networks of ngpt in ONNX Runtime: without PyTorch, in tiles within a given memory, on a chosen device.

export/CONTRACT.md specifies the files.
"""

import logging
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ngpt.classical.bases import BASES
from ngpt.errors import NgptError
from ngpt.network import tiles
from ngpt.network.exposure import statistics
from ngpt.system.forks import until_fork
from ngpt.system.install import package_command
from ngpt.system.limits import free_address_space, processors

_LOG = logging.getLogger(__name__)

# MiB that the network may use in addition to the image's layers. An image of 1280x720 pixels fits into one tile; in two
# tiles it would take a quarter longer.
MEMORY = 3072
DEVICES = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "directml": "DmlExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
}
# ONNX Runtime's names of types -> types of NumPy.
_FLOATS = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64}

# Light that is subtracted from the layers before a network reads them; its variance, and a denoised image of it.
_APART = ("direct", "caustic", "caustic_var", "denoised_caustic")

Progress = Callable[[int, int], None]


class Cancelled(NgptError):
    """The caller's ``stop`` has ended a reconstruction."""


class _OutOfMemory(NgptError):
    """ONNX Runtime could not get the memory for a run."""


class Network:
    """A loaded network file. It is thread-safe, works in forked children, and can be pickled.

    ``path``     an .onnx file of ``ngpt export``
    ``device``   one of ``DEVICES``; "auto" is "cpu"
    ``threads``  threads of the CPU; 0: one per core, or as many as ``ngpt.limit_threads`` allows

    Raises NgptError for any other file, and for a device that cannot be used. No other device silently takes its place.
    """

    def __init__(self, path: str | Path, device: str = "auto", threads: int = 0):
        self.path, self.device, self.threads = Path(path), "cpu" if device == "auto" else device, threads
        metadata = self.session.get_modelmeta().custom_metadata_map
        try:
            names = metadata["ngpt.inputs"].split(", ")
            self.alignment = int(metadata["ngpt.alignment"])
            self.base = metadata["ngpt.base"]
            self.overlap = int(metadata["ngpt.overlap with base" if self.base else "ngpt.overlap"])
            self.bytes = int(metadata["ngpt.bytes per pixel"])
        except (KeyError, ValueError) as error:
            raise NgptError(
                f"{path}: lacks the metadata {error} of an ngpt network; write it anew: ngpt export"
            ) from error
        # In other hosts, the graph subtracts this light itself. Here callers have subtracted it already, so these
        # inputs get zeros. Graphs of earlier versions have fewer of these inputs.
        self.apart = tuple(name for name in names if name in _APART)
        self.inputs = tuple(name for name in names if name not in _APART)
        optional = metadata.get("ngpt.optional", "direct").split(", ")
        if metadata.get("ngpt.emission") == "true" or not set(optional) <= set(_APART):
            raise NgptError(f"{path}: this network reads only colour, as in earlier versions of ngpt; use a newer one")
        self._check()

    @property
    def session(self) -> Any:
        """The session of ONNX Runtime, which all networks of the file share.

        It is not stored, because it must not survive a fork.
        """
        return session(self.path, self.device, self.threads)

    def _check(self) -> None:
        """Raises NgptError unless the metadata are valid and match the graph."""
        for name, value, most in (("alignment", self.alignment, 2**12), ("overlap", self.overlap, 2**12)):
            if not (name == "overlap" or value) or not 0 <= value <= most:
                raise NgptError(f"{self.path}: its {name} is {value}; it must be at most {most}: export it anew")
        if self.bytes < 1 or self.base not in ("", *BASES):
            raise NgptError(f"{self.path}: {self.bytes} bytes per pixel, base '{self.base}': export it anew")
        own = {*self.inputs, *self.apart, "statistics"} | ({"base"} if self.base else set())
        graph = {given.name for given in self.session.get_inputs()}
        # Inputs that a host may leave out have a default in the graph.
        optional = {given.name for given in self.session.get_overridable_initializers()}
        self.types, self.output = floats(self.session, self.path)
        if not graph <= own <= graph | optional:
            raise NgptError(
                f"{self.path}: its inputs are {', '.join(sorted(graph | optional))}, but its metadata list "
                f"{', '.join(sorted(own))}; export it again"
            )

    def reconstruct(
        self,
        layers: Mapping[str, np.ndarray],
        base: np.ndarray | None = None,
        *,
        memory: int = MEMORY,
        batch: int = 1,
        progress: Progress = lambda done, total: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> np.ndarray:
        """The image (H, W, 3) float32, scene-linear, without direct emission.

        ``layers``    (H, W, C) float32, all of ``inputs``; radiance without direct emission
        ``base``      (H, W, 3), the reconstruction that the network starts from, if there is one
        ``memory``    MiB that tiles may take. Smaller tiles take longer, and give the same image to 1e-5. If the
                      machine has less memory, the tiles become smaller
        ``batch``     the number of tiles in one run; a GPU is used better with several
        ``progress``  is called with (tiles done, all tiles)
        ``stop``      is called before each run; if it returns True, ``Cancelled`` is raised

        Raises NgptError if the smallest tile needs more than ``memory``, or more than the machine has.
        """
        memory = min(memory, free_address_space() // 2)
        while True:
            try:
                return self._reconstruct(layers, base, memory, batch, progress, stop)
            except _OutOfMemory as error:
                memory = self._less(layers["primal"].shape[:2], memory, batch, error)

    def _less(self, size: tuple[int, int], memory: int, batch: int, error: NgptError) -> int:
        """Half of the MiB that the last tiles took, or those of the smallest tile.

        Raises ``error`` if that is not less than the last tiles took.
        """
        _, (rows, columns) = self.plan(*size, memory, batch)
        areas = rows * columns, tiles.smallest(size, self.alignment, self.overlap)
        used, least = (area * self.bytes * batch / 2**20 for area in areas)
        less = max(int(used / 2), math.ceil(least))
        if less >= used:
            raise error
        return less

    def _reconstruct(
        self,
        layers: Mapping[str, np.ndarray],
        base: np.ndarray | None,
        memory: int,
        batch: int,
        progress: Progress,
        stop: Callable[[], bool],
    ) -> np.ndarray:
        names = (*self.inputs, "base") if self.base else self.inputs
        layers = layers if base is None else {**layers, "base": base}
        missing = [name for name in names if name not in layers]
        if missing:
            raise NgptError(f"network {self.path} needs layers {', '.join(missing)}, which are not given")
        height, width = layers["primal"].shape[:2]
        pieces, (rows, columns) = self.plan(height, width, memory, batch)
        _LOG.debug("%s: %d tiles of %dx%d", self.path, len(pieces), columns, rows)
        shared = statistics(layers)
        image = np.empty((height, width, 3), np.float32)
        session = self.session
        progress(0, len(pieces))
        for first in range(0, len(pieces), batch):
            if stop():
                raise Cancelled(f"network {self.path}: stopped after {first} of {len(pieces)} tiles")
            group = pieces[first : first + batch]
            windows = [np.s_[y : y + rows, x : x + columns] for _, _, y, x in group]
            feed = {name: np.stack([planes(layers[name][window]) for window in windows]) for name in names}
            feed |= dict.fromkeys(self.apart, np.zeros_like(feed["primal"]))
            last = first + batch >= len(pieces)
            results = self._run(session, feed | {"statistics": shared}, last)
            for (inner_y, inner_x, y, x), result in zip(group, results, strict=True):
                part = result[:, inner_y.start - y : inner_y.stop - y, inner_x.start - x : inner_x.stop - x]
                image[inner_y, inner_x] = np.moveaxis(part, 0, -1)
            progress(min(first + batch, len(pieces)), len(pieces))
        return image

    def plan(self, height: int, width: int, memory: int, batch: int = 1) -> tuple[list[tuple], tuple[int, int]]:
        """The result of ``ngpt.network.tiles.plan`` for ``memory`` MiB. Raises NgptError if no tile fits."""
        size = height, width
        if found := tiles.plan(size, self.alignment, self.overlap, memory * 2**20 // (self.bytes * batch)):
            return found
        needed = -(-tiles.smallest(size, self.alignment, self.overlap) * self.bytes * batch // 2**20)
        raise NgptError(
            f"network {self.path}: its smallest tile takes {needed} MiB, and {memory} MiB are allowed; "
            "allow more (--memory, ulimit -v)"
        )

    def _run(self, session, feed: dict[str, np.ndarray], last: bool) -> np.ndarray:
        """The output of one run. After the ``last`` run of an image, ONNX Runtime frees the memory that it keeps."""
        options = runtime().RunOptions()
        if last and self.device == "cpu":
            options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
        try:
            feed = {name: values.astype(self.types[name], copy=False) for name, values in feed.items()}
            result = session.run([self.output], feed, options)[0]
        except Exception as error:
            if isinstance(error, MemoryError) or "allocate memory" in str(error) or "bad_alloc" in str(error):
                raise _OutOfMemory(
                    f"network {self.path}: out of memory with the smallest tiles; free some, or give it more"
                ) from error
            raise NgptError(f"network {self.path}: ONNX Runtime cannot run it: {one_line(error)}") from error
        expected = (len(feed["primal"]), 3, *feed["primal"].shape[2:])
        if result.shape != expected:
            raise NgptError(
                f"network {self.path}: its output has shape {result.shape} instead of {expected}; export it again"
            )
        return result


def floats(session, path: Path) -> tuple[dict[str, type], str]:
    """The type of each input of a network, by name, and the name of its first output.

    Raises NgptError for inputs and outputs that are not floats of half, single or double precision.
    """
    inputs = [*session.get_inputs(), *session.get_overridable_initializers()]
    output = next(iter(session.get_outputs()))
    for what, given in [*(("input", given) for given in inputs), ("output", output)]:
        if given.type not in _FLOATS:
            raise NgptError(
                f"{path}: its {what} '{given.name}' is {given.type}; it must be one of {', '.join(_FLOATS)}: export it "
                "anew"
            )
    return {given.name: _FLOATS[given.type] for given in inputs}, output.name


def session(path: Path, device: str, threads: int):
    """The session of a file, kept until the file changes. Raises NgptError if ONNX Runtime cannot load it."""
    # From a pipe or a device, ONNX Runtime would read forever.
    if not path.is_file():
        raise NgptError(f"{path}: no such file; `ngpt export` writes it")
    return _made(str(path), path.stat().st_mtime_ns, device, threads or processors())


def runtime() -> Any:
    """The module of ONNX Runtime with its telemetry off. Raises NgptError if it is not installed."""
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise NgptError(f"ONNX Runtime is not installed: {package_command('onnxruntime')}") from error
    # ngpt/__init__.py also switches telemetry off, but a program may have loaded ONNX Runtime before.
    onnxruntime.disable_telemetry_events()
    return onnxruntime


@until_fork(8)
def _made(path: str, _modified: int, device: str, threads: int):
    onnxruntime = runtime()
    if device not in DEVICES:
        raise NgptError(f"device '{device}' is unknown; ONNX Runtime has: {', '.join(DEVICES)}")
    provider, available = DEVICES[device], onnxruntime.get_available_providers()
    if provider not in available:
        have = [name for name, provider in DEVICES.items() if provider in available]
        raise NgptError(f"device '{device}': this build of ONNX Runtime has only: {', '.join(have)}; install another")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Planning the reuse of buffers takes six times as long as the rest of loading. It saves neither time nor memory,
    # because the arena reuses buffers anyway.
    options.enable_mem_reuse = False
    # Spinning threads keep their cores busy while they wait. This is a fifth of the processor time of ngpt-fast.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Errors are raised as exceptions, so the log would only repeat them.
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(path, options, providers=[provider])
    except Exception as error:
        raise NgptError(f"{path}: ONNX Runtime cannot load it: {one_line(error)}") from error
    if session.get_providers()[0] != provider:
        raise NgptError(f"device '{device}': ONNX Runtime cannot use it here (drivers?); use device 'cpu'")
    _LOG.info("%s: ONNX Runtime %s, %s", path, onnxruntime.__version__, provider)
    return session


def planes(layer: np.ndarray) -> np.ndarray:
    """(H, W, C) as (C, H, W), contiguous."""
    return np.ascontiguousarray(np.moveaxis(layer, -1, 0), np.float32)


def one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
