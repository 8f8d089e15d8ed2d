"""Writes the result of a render: the stack, or the image that a method makes of the stack.

The image has the same bits as the image that `ngpt denoise` makes of the stack. An OpenEXR file with the image also
holds the whole stack, so an unfinished render can be continued from it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from data_gen.begun import joined_or_kept, kept_apart, rest_of
from data_gen.request import RenderRequest
from data_gen.samplers import FRAME_SAMPLERS, SAMPLERS
from ngpt.errors import NgptError, WrongUse
from ngpt.image.pictures import check_size
from ngpt.io.exr import write
from ngpt.io.openexr import read_header
from ngpt.io.whole import finished
from ngpt.methods import reconstruct, runnable
from ngpt.result_file import Look, check_image, seen, write_result
from ngpt.stack import GradientStack
from ngpt.system.files import save
from ngpt.system.text import by_names


@dataclass(frozen=True)
class Denoising:
    """How a stack is denoised. ``method`` is a name, or "auto": see ``ngpt.methods.choose``."""

    method: str = "auto"
    look: Look = field(default_factory=Look)  # of a picture

    @property
    def needs_gradients(self) -> bool:
        return self.method != "auto" and "dx" in runnable(self.method).needs

    def check(self, sampler: str, spp: int | None, begun: str = "") -> None:
        """Raises an error for a method that does not run here, or that needs layers which the render does not have.

        If the render continues an earlier one, ``begun`` is the file of the earlier render, and ``sampler`` its
        sampler.
        """
        if self.method == "auto":
            return
        needs, entry = runnable(self.method).needs, SAMPLERS.get(sampler)
        if self.needs_gradients and (sampler in FRAME_SAMPLERS or (entry and not entry.gradients)):
            raise WrongUse(
                f"method '{self.method}' needs gradients, and sampler '{sampler}'{f' of {begun}' if begun else ''} "
                "renders none; name another"
            )
        if spp == 1 and any(name.endswith("_var") for name in needs):
            raise WrongUse(
                f"method '{self.method}' needs variances, and one sample per pixel has none: --spp 2 or more"
            )


@dataclass(frozen=True)
class Output:
    """The files of a request.

    ``file``   holds the stack or, with ``denoising``, the image
    ``kept``   also holds the stack, if ``file`` holds an image; None: there is no such file
    ``frame``  the number of the frame of a shot; None for a single image
    """

    request: RenderRequest
    file: Path
    denoising: Denoising | None = None
    kept: Path | None = None
    frame: int | None = None
    header: dict[str, str] = field(init=False)  # the attribute of the stack's header with the request

    def __post_init__(self) -> None:
        # Made before the render, since it contains a checksum of the scene's file
        object.__setattr__(self, "header", self.request.header(self.frame))

    @property
    def stack(self) -> Path:
        return self.kept or self.file

    def check(self, skip_existing: bool) -> None:
        """Raises WrongUse for files that cannot be written, and, with ``skip_existing``, for files that do not say how
        much of the render they hold."""
        if self.denoising is not None:
            check_image(self.file, self.denoising.look.transform)
        for path in (self.kept, None if self.denoising else self.file):
            if path is not None and path.suffix.lower() != ".exr":
                raise WrongUse(
                    f"{path}: stacks are OpenEXR; let the name end in .exr, or for an image in .png .jpg .webp"
                )
        if self.kept is not None and self.kept.resolve() == self.file.resolve():
            raise WrongUse(f"--keep {self.kept}: is the file of the image; give another name, or leave --keep out")
        if skip_existing and self.request.cpu_seconds is not None:
            raise WrongUse("--skip-existing: no file says how much processor time it took; give --time or --spp")
        if skip_existing and self.stack.suffix.lower() != ".exr":
            raise WrongUse(
                f"{self.file}: --skip-existing checks only OpenEXR files; keep the stack too: --keep FILE.exr"
            )

    def left(self) -> RenderRequest | None:
        """The request for what is left to render: the whole request if there is no complete file, else the rest; None
        if nothing is left.

        Raises NgptError if the stack in the file belongs to another request, or cannot be denoised as requested.
        """
        if not finished(self.stack):
            return self.request
        attributes, _ = read_header(self.stack)
        rest = rest_of(self.request, self.stack, attributes, self.frame)
        for_whom = self.denoising or Denoising(self.request.method or "auto")
        for_whom.check(str(attributes.get("ngpt:sampler", "")), None, str(self.stack))
        return rest

    def done(self) -> bool:
        """Whether all that was requested exists.

        Raises NgptError if the file holds a stack without an image, or an image by another method.
        """
        try:
            if self.left() is not None:
                return False
        except NgptError:
            return False
        by = read_header(self.file)[0].get("ngpt:method") if _readable(self.file) else None
        if self.denoising is not None and by and self.denoising.method not in ("auto", by):
            raise NgptError(
                f"{self.file}: is the image of method '{by}', not '{self.denoising.method}'; `ngpt denoise` makes "
                "another of the stack, or give another name, or --force in place of --skip-existing to replace it"
            )
        if self.kept is not None:
            there = self.file.exists() and (self.file.suffix.lower() != ".exr" or _readable(self.file))
            # If the stack has more samples than when the image was made, the image is out of date.
            return there and self.file.stat().st_mtime_ns >= self.kept.stat().st_mtime_ns
        if self.denoising is not None and not by:
            raise NgptError(
                f"{self.file}: has all samples, and no image: it is a stack; `ngpt denoise` makes one of it, or give "
                "another name"
            )
        return True

    def write(
        self, stack: GradientStack, overwrite: bool, begun: GradientStack | None = None
    ) -> tuple[GradientStack, dict[str, Any]]:
        """Writes a stack, or its image, or both. The header contains the request.

        If there is a ``begun`` stack of an earlier render, both are merged first, and the file of the begun stack is
        replaced. Returns the whole stack, and the attributes that describe the image. If writing fails, the samples are
        kept in another file.
        """
        stack.attributes |= self.header
        if begun is not None:
            stack, overwrite = joined_or_kept(self.stack, stack, begun), True
        if self.denoising is None or self.kept is not None:
            save(self.stack, lambda path, overwrite: write(path, stack, overwrite=overwrite), overwrite)
        return stack, self.image(stack, overwrite) if self.denoising else {}

    def image(self, stack: GradientStack, overwrite: bool) -> dict[str, Any]:
        """Makes and writes the image, and returns the attributes that describe it.

        If the method fails and the stack was not written to ``kept``, the stack is written to a file beside the image.
        """
        assert self.denoising is not None
        # Dr.Jit keeps the memory of a render for the next render. At 1920x1080 this is more than a method takes, so it
        # is freed.
        import drjit as dr

        dr.flush_malloc_cache()
        file, method, look = self.file, self.denoising.method, self.denoising.look
        try:
            pixels = seen(stack.place)
            check_size(file, pixels.width, pixels.height)
            result = reconstruct(stack, method)
        except Exception as error:  # methods may come from other packages, and fail in any way
            if self.kept is not None:
                raise
            why = str(error)
            if not isinstance(error, NgptError):
                why = f"method '{method}' failed: {type(error).__name__}: {error}".rstrip(": ")
            # The temporary file that stands for standard output is deleted when the command ends.
            lasting = file if by_names(str(file)) == str(file) else Path(file.name)
            raise kept_apart(why, stack, lasting.with_name(f"{file.stem}.stack.exr")) from error
        views, made = [(result.image, stack)], result.attributes
        save(file, lambda path, overwrite: write_result(path, views, made, look, overwrite), overwrite)
        return made


def _readable(file: Path) -> bool:
    """Whether this is a complete OpenEXR file."""
    return file.suffix.lower() == ".exr" and file.is_file() and finished(file)
