"""Rules of all random walks: the largest depth, Russian roulette, and whether an escaping path sees the environment.

Each rule is written once, because samplers must agree: if their paths ended differently, their images would differ.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from data_gen.paths.vertex import NULL
from data_gen.scenes.load import path_depths
from ngpt.errors import NgptError

UNLIMITED = 0xFFFFFFFF

# The largest probability of survival, even at a perfect mirror: below 1, so that all paths end.
_MOST = 0.95


@dataclass
class Limits:
    """The parameters that our integrators share with Mitsuba's ``path``."""

    max_depth: int = UNLIMITED  # the largest number of edges of a path; with 1, only emission that the camera sees
    rr_depth: int = 5  # number of the first vertex with Russian roulette
    hide_emitters: bool = False  # whether emitters are hidden from the camera

    @classmethod
    def read(cls, props: mi.Properties) -> Limits:
        """Reads the limits of a plugin. Raises NgptError for values that ``path`` refuses too."""
        depth, rr_depth = props.get("max_depth", -1), props.get("rr_depth", cls.rr_depth)
        for name, value, least, meaning in (
            ("max_depth", depth, -1, "0 or more, or -1 for no limit"),
            ("rr_depth", rr_depth, 1, "1 or more"),
        ):
            if type(value) is not int or not least <= value < 1 << 31:
                raise NgptError(f"{name} is {value!r}: give an integer of {meaning}")
        return cls(UNLIMITED if depth < 0 else depth, rr_depth, props.get("hide_emitters", False))

    @classmethod
    def of(cls, path: mi.SamplingIntegrator) -> Limits:
        """The limits of Mitsuba's ``path``, or of an integrator like it. Raises NgptError where they cannot be read."""
        depths = path_depths(path)
        if not depths:
            raise NgptError(
                f"cannot read max_depth and rr_depth from the integrator, which describes itself as {str(path)!r}; "
                "use --sampler gpt-basic"
            )
        depth = depths["max_depth"]
        return cls(UNLIMITED if depth < 0 else depth, depths["rr_depth"], path.hide_emitters)

    def parameters(self) -> dict[str, int | bool]:
        depth = self.max_depth if self.max_depth < UNLIMITED else -1
        return {"max_depth": depth, "rr_depth": self.rr_depth, "hide_emitters": self.hide_emitters}

    @property
    def shows(self) -> bool:
        """Whether emission that the camera sees directly is in the image."""
        return not self.hide_emitters and self.max_depth > 0


def roulette(throughput: mi.Float, plays: mi.Bool | bool, η: mi.Float | None = None) -> mi.Float:
    """Russian roulette: the probability of survival, by which the weight of a survivor must be divided. It is 1 where
    ``plays`` is false.

    For a path from the camera, ``throughput`` is the largest channel of its weight after the step, and ``η`` the
    product of the relative indices of refraction so far. η² undoes the change of radiance by refraction, as in
    Mitsuba's ``path``. For a path from a light, ``throughput`` is relative to the initial weight of the path.
    """
    if η is not None:
        throughput = throughput * dr.square(η)
    return dr.select(plays, dr.fmin(throughput, _MOST), 1)


def brightest(paths: Iterable[Any]) -> mi.Float:
    """The largest channel of the throughputs ``β`` of those paths that are ``alive``."""
    largest = mi.Float(0)
    for path in paths:
        largest = dr.fmax(largest, dr.select(path.alive, dr.max(path.β), 0))
    return largest


@dataclass
class Sky:
    """Whether a path that escapes sees the environment.

    An environment that is hidden from the camera stays hidden behind surfaces that a path passes straight through
    (null events), because such a path has not been scattered yet.
    """

    seen: mi.Bool

    @classmethod
    def from_camera(cls, hides: bool, lanes: int = 1) -> Sky:
        """For the first edge of a path; ``hides``: emitters are hidden from the camera."""
        return cls(dr.full(mi.Bool, not hides, lanes))

    def behind(self, kind: mi.UInt32, found: mi.Bool | bool = True) -> Sky:
        """The state for the edge that follows an event of this ``kind`` (``vertex.event_kind``).

        ``found`` says in which lanes there was an event.
        """
        return Sky(self.seen | (found & (kind != NULL)))

    def meets(self, x: mi.SurfaceInteraction3f) -> mi.Bool:
        """Whether the next vertex ``x`` may emit light: it is on a surface, or the path sees the environment."""
        return x.is_valid() | self.seen
