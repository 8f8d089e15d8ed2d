"""The stacks that methods read: each is of one kind, and rendered by one sampler."""

from dataclasses import dataclass
from typing import Any

# Kind of stack -> the sampler that renders it unless another is named:
#   gradients  a gradient stack
#   features   the image with albedo, normal and depth, no gradients
#   path       only the image
KINDS = {"gradients": "auto", "features": "primal", "path": "primal"}


@dataclass(frozen=True)
class Render:
    """A kind of stack, rendered by a sampler. ``given`` has options that are not defaults: "radius=1, subpixels=2".

    ``name`` is the name of the render in files, costs and results.
    """

    kind: str
    sampler: str
    given: str = ""

    @property
    def name(self) -> str:
        return f"{self.kind} {self.by}".strip()

    @property
    def by(self) -> str:
        """The sampler and its options; "" if they are the usual ones of the kind."""
        usual = self.sampler == KINDS[self.kind] and not self.given
        return "" if usual else " ".join([self.sampler, *filter(None, self.given.split(", "))])

    @property
    def options(self) -> dict[str, Any]:
        """The options for the renderer: ``ngpt.renderer.Options``."""
        given: dict[str, Any] = dict(option.split("=") for option in self.given.split(", ") if option)
        return {"sampler": self.sampler} | given | ({"with_features": False} if self.kind == "path" else {})


# The usual renders. They are measured in every scene, so that tables can show the cost of gradients.
DEFAULTS = tuple(Render(kind, sampler) for kind, sampler in KINDS.items())
