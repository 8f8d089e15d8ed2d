"""Chooses the Mitsuba variant, and checks that it can start."""

import logging

from data_gen.llvm import use_llvm
from data_gen.plugins import make_classes
from ngpt.errors import NgptError, WrongUse, did_you_mean, stop_if_interrupted
from ngpt.system.install import install_command
from ngpt.system.limits import limited, processors

_LOG = logging.getLogger(f"ngpt.{__name__}")

DEFAULT_VARIANT = "llvm_ad_rgb"


def use_variant(name: str = DEFAULT_VARIANT) -> None:
    """Makes ``name`` the current Mitsuba variant and registers our integrators with it.

    Any JIT variant will do (``llvm_*`` runs on the CPU, ``cuda_*`` on an NVIDIA GPU). Raises NgptError when Mitsuba is
    not installed, the variant does not exist or is not a JIT variant, or its machinery (LLVM, CUDA driver) is absent.
    """
    try:
        import mitsuba as mi
    except ModuleNotFoundError as error:
        raise NgptError(f"rendering needs Mitsuba 3, which is not installed; `{install_command('render')}`") from error
    except (ImportError, NameError) as error:
        # If a system library is missing, Dr.Jit raises a NameError, whose context is the cause.
        cause = error.__context__ or error
        raise NgptError(
            f"Mitsuba is installed but cannot be loaded: {cause}; if a library is missing, install it, "
            "e.g. libatomic.so.1 by `apt-get install libatomic1` (as root)"
        ) from error
    jit_variants = [v for v in mi.variants() if not v.startswith("scalar")]
    if name not in jit_variants:
        raise WrongUse(
            f"variant '{name}' is no vectorised variant of this Mitsuba; {did_you_mean(name, jit_variants)}"
            f"choose one of: {', '.join(jit_variants)}"
        )
    if name.startswith("llvm"):
        use_llvm()
    try:
        mi.set_variant(name)
        make_classes()
    except (ImportError, RuntimeError) as error:
        stop_if_interrupted(error)
        message = " ".join(str(error).split())
        if name.startswith("cuda") and "hasn't been initialized" in message:
            message = f"no NVIDIA driver was found; use {DEFAULT_VARIANT}, which runs on the CPU"
        raise NgptError(f"variant '{name}' cannot start: {message}") from error
    _LOG.info("Mitsuba %s, variant %s", mi.__version__, name)
    # Without this, every scene loaded prints its timings.
    mi.set_log_level(mi.LogLevel.Error)
    import drjit as dr

    if limited():
        dr.set_thread_count(processors())
    elif dr.thread_count() < 2:  # see data_gen.scenes.load: scenes need two threads to load
        dr.set_thread_count(2)
