"""The choice of libLLVM, which Dr.Jit compiles its CPU kernels with.

It has to be made before Dr.Jit is imported: Dr.Jit takes whatever the system calls
libLLVM, and one older than 17 aborts the whole process on AVX-512 machines.
"""

import glob
import os
import re
import sys
import sysconfig
from collections.abc import Iterable

from ginn_jax.errors import InputError

OLDEST_LLVM = 17


def choose_libllvm(paths: Iterable[str]) -> str | None:
    """The path with the newest LLVM of at least `OLDEST_LLVM`, or None.

    Versions are read off names: links must be resolved. Older ones abort the process
    on AVX-512 machines. Equal versions: the first in alphabetical order.
    """
    usable = [(llvm_version(p), p) for p in sorted(paths)]
    usable = [(v, p) for v, p in usable if v >= (OLDEST_LLVM,)]
    return max(usable, key=lambda pair: pair[0])[1] if usable else None


def llvm_version(path: str) -> tuple[int, ...]:
    """The LLVM version in a resolved path: of the file, else of its folders, else ().

    libLLVM-15.so.1 is 15, libLLVM.so.19.1 is 19.1, llvm/19.1.7/lib/libLLVM.dylib is
    19.1.7. A bare libLLVM.so.1 says nothing: the 1 is no LLVM version.
    """
    folder, name = os.path.split(path)
    patterns = [(r"libLLVM-(\d[\d.]*)", name), (r"libLLVM\.so\.(\d\d[\d.]*)", name)]
    patterns += [(r".*\bllvm[-/@]?(\d[\d.]*)", folder)]
    for pattern, text in patterns:
        if found := re.match(pattern, text):
            return tuple(int(n) for n in found[1].strip(".").split("."))
    return ()


def installed_libllvm() -> list[str]:
    """Resolved paths of every libLLVM in the places where systems keep it."""
    triple = sysconfig.get_config_var("MULTIARCH") or "lib"
    folders = os.environ.get("LD_LIBRARY_PATH", "").split(":")
    folders += [f"{sys.prefix}/lib", f"/usr/lib/{triple}", "/usr/local/lib"]
    folders += ["/usr/lib/llvm*/lib*", "/usr/lib/llvm/*/lib*", "/usr/lib64/llvm*/lib*"]
    folders += ["/usr/lib64", "/usr/lib", "/opt/homebrew/opt/llvm*/lib"]
    folders += ["/usr/local/opt/llvm*/lib"]
    names = ("libLLVM*.so*", "libLLVM*.dylib")
    found = [p for f in folders if f for n in names for p in glob.glob(f"{f}/{n}")]
    return sorted({os.path.realpath(p) for p in found})


def use_libllvm() -> None:
    """Name a libLLVM to Dr.Jit, which loads it when imported; the user's goes first."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named and not os.path.exists(named):
        raise InputError(f"DRJIT_LIBLLVM_PATH names no file: {named}; unset or mend it")
    paths = [os.path.realpath(named)] if named else installed_libllvm()
    chosen = choose_libllvm(paths)
    if chosen is None and not (named and llvm_version(paths[0]) == ()):
        raise llvm_missing(", ".join(paths) or "none")
    os.environ["DRJIT_LIBLLVM_PATH"] = named or str(chosen)


def llvm_missing(found: str) -> InputError:
    """The error to raise where only `found` is there."""
    return InputError(
        f"ray tracing, and networks in lanes, need libLLVM >= {OLDEST_LLVM} "
        f"(found: {found}): `apt-get install libllvm19` or `brew install llvm`"
    )
