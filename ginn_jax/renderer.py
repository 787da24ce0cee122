"""Mitsuba, the ray tracer behind every reference, and Dr.Jit, which compiles it and
networks on a CPU: imported on first use, here alone."""

import ctypes
import functools
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from ginn_jax import libllvm
from ginn_jax.errors import InputError


def _cuda_usable() -> bool:
    """Whether there is an NVIDIA GPU whose driver brings OptiX, which Mitsuba needs."""
    try:
        ctypes.CDLL("libnvoptix.so.1")
        driver, count = ctypes.CDLL("libcuda.so.1"), ctypes.c_int(0)
    except OSError:
        return False
    return (
        driver.cuInit(0) == 0
        and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
        and count.value > 0
    )


@functools.cache
def use_drjit() -> Any:
    """Dr.Jit's module, with a libLLVM to compile for the CPU."""
    if "drjit" not in sys.modules:
        libllvm.use_libllvm()
    with _explained("Dr.Jit"):
        import drjit
    # The caller may have imported Dr.Jit before, with what it found (-1: nothing).
    major = drjit.detail.llvm_version()[0]
    if major < libllvm.OLDEST_LLVM:
        found = "none usable" if major < 0 else f"LLVM {major}, loaded"
        raise libllvm.llvm_missing(found)
    return drjit


@functools.cache
def use_mitsuba() -> tuple[Any, str]:
    """Mitsuba's module and the variant to use: on the GPU if there is a usable one."""
    variant = "cuda_ad_rgb" if _cuda_usable() else "llvm_ad_rgb"
    if variant == "llvm_ad_rgb":
        use_drjit()
    elif "drjit" not in sys.modules:
        with suppress(InputError):  # f_2D on the CPU may want one later
            libllvm.use_libllvm()
    with _explained("Mitsuba"):
        import mitsuba
    if mitsuba.variant() is None:  # `variant_context` cannot put back no variant
        mitsuba.set_variant(variant)
    return mitsuba, variant


@contextmanager
def _explained(name: str) -> Iterator[None]:
    """Say of a module that cannot be imported what is missing."""
    try:
        yield
    except (ImportError, NameError) as error:  # Dr.Jit hides what it misses
        raise InputError(
            f"{name} cannot be loaded ({error.__context__ or error}): install what is "
            "missing, such as `apt-get install libatomic1`"
        ) from error
