"""What a method is given: a kind of stack, by a sampler."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

# Kind of stack -> the sampler that renders it unless another is named:
#   gradients  a gradient stack
#   features   the image with albedo, normal and depth, no gradients
#   path       the image alone
KINDS = {"gradients": "auto", "features": "primal", "path": "primal"}


@dataclass(frozen=True)
class Render:
    """A kind of stack by a sampler; ``name`` is what files, costs and results call it."""

    kind: str
    sampler: str

    @property
    def name(self) -> str:
        return self.kind if self.sampler == KINDS[self.kind] else f"{self.kind} {self.sampler}"

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of ``data_gen.render.render_stack``."""
        return {"sampler": self.sampler} | ({"with_features": False} if self.kind == "path" else {})


# What every scene is measured with, so that tables say what gradients cost.
DEFAULTS = tuple(Render(kind, sampler) for kind, sampler in KINDS.items())
