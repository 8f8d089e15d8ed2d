"""Samplers as Mitsuba's integrators: ``mi.load_dict({"type": "gpt"})`` after ``import data_gen``, whatever the variant.

Samplers of other packages are registered too, by their entry points.

Plugins belong to a variant of Mitsuba and can be registered only after it is set. So each time a variant is set,
constructors are registered that need only the name of a sampler. The classes themselves are made on first use, since
making them takes half a second.
"""

from __future__ import annotations

import importlib.util
import sys
from importlib.abc import MetaPathFinder
from types import ModuleType
from typing import Any

_made_for = ""


def register_when_ready() -> None:
    """Registers our integrators with each variant of Mitsuba that is set, in the past or future, once it is imported.

    This function does not import Mitsuba.
    """
    if sys.modules.get("mitsuba"):
        _follow_variants()
    else:
        sys.meta_path.insert(0, _UntilMitsubaComes())


class _UntilMitsubaComes(MetaPathFinder):
    """Finds no module itself. It notices the first import of Mitsuba, and calls ``_follow_variants`` after it."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        if name != "mitsuba":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_follow(module: Any) -> None:
                execute(module)
                _follow_variants()

            spec.loader.exec_module = execute_and_follow  # type: ignore[method-assign]
        return spec


def _follow_variants() -> None:
    import mitsuba as mi

    mi.detail.add_variant_callback(lambda old, new: _register())
    if mi.variant() is not None:
        _register()


def _register() -> None:
    """Registers the names of our integrators with the current variant."""
    import mitsuba as mi

    from data_gen.samplers.registry import SAMPLERS, plugin_of

    for name in SAMPLERS.names():
        mi.register_integrator(plugin_of(name), lambda props, name=name: _construct(name, props))


def _construct(name: str, props: Any) -> Any:
    """Makes the integrator of a sampler. Raises NgptError if the sampler is not an integrator of Mitsuba."""
    from data_gen.samplers.registry import SAMPLERS, integrator_of
    from ngpt.errors import NgptError

    make_classes()
    module = SAMPLERS[name].module
    kind = integrator_of(module) if isinstance(module, str) else None
    if kind is None:
        raise NgptError(
            f"sampler '{name}' is no integrator of Mitsuba; use data_gen.render_scene(scene, sampler='{name}')"
        )
    return kind(props)


def make_classes() -> None:
    """Makes samplers derive from the classes of the current variant, since each variant of Mitsuba has its own classes.

    Modules that were imported for another variant are reloaded. Raises NgptError for a variant that is not vectorised.
    """
    global _made_for
    import mitsuba as mi

    from ngpt.errors import NgptError

    variant = mi.variant()
    if variant.startswith("scalar"):
        able = ", ".join(name for name in mi.variants() if not name.startswith("scalar"))
        raise NgptError(f"variant '{variant}' is not vectorised, as our integrators must be; choose one of: {able}")
    if variant == _made_for:
        return
    for module in _modules_with_classes():
        importlib.reload(module)
    _made_for = variant


def _modules_with_classes() -> list[ModuleType]:
    """All imported modules that define an integrator. Modules with base classes come first."""
    common = sys.modules.get("data_gen.samplers.common")
    if not common:
        return []
    from data_gen.samplers.registry import SAMPLERS

    homes = {str(entry.module).partition(".")[0] for entry in SAMPLERS.values()}
    depth = {}
    for name, module in list(sys.modules.items()):
        for value in list(vars(module).values()) if name.partition(".")[0] in homes else ():
            if isinstance(value, type) and value.__module__ == name and issubclass(value, common.GradientIntegrator):
                depth[name] = len(value.__mro__)
    return [sys.modules[name] for name in sorted(depth, key=lambda name: depth[name])]
