"""The input of a method: a kind of stack, by a sampler."""

from dataclasses import dataclass
from typing import Any

# Kind of stack -> the sampler that renders it unless another is named:
#   gradients  a gradient stack
#   features   the image with albedo, normal and depth, no gradients
#   path       only the image
KINDS = {"gradients": "auto", "features": "primal", "path": "primal"}


@dataclass(frozen=True)
class Render:
    """A kind of stack by a sampler, with options of it that are not its defaults: "radius=1, photons=2, subpixels=2".

    ``name`` is what files, costs and results call it.
    """

    kind: str
    sampler: str
    given: str = ""

    @property
    def name(self) -> str:
        return f"{self.kind} {self.by}".strip()

    @property
    def by(self) -> str:
        """Sampler and options where they are not the usual ones of the kind, else ""."""
        usual = self.sampler == KINDS[self.kind] and not self.given
        return "" if usual else " ".join([self.sampler, *filter(None, self.given.split(", "))])

    @property
    def options(self) -> dict[str, Any]:
        """The options for the renderer: ``ngpt.renderer.Options``."""
        given: dict[str, Any] = dict(option.split("=") for option in self.given.split(", ") if option)
        return {"sampler": self.sampler} | given | ({"with_features": False} if self.kind == "path" else {})


# Every scene is measured with these, so that tables show the cost of gradients.
DEFAULTS = tuple(Render(kind, sampler) for kind, sampler in KINDS.items())
