"""The choice of libLLVM."""

import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ginn_jax import libllvm

NAMES = {
    "debian": "/usr/lib/x86_64-linux-gnu/libLLVM-{}.so.1",
    "debian_new": "/usr/lib/x86_64-linux-gnu/libLLVM.so.{}.1",
    "patch": "/usr/lib/x86_64-linux-gnu/libLLVM-{}.0.6.so.1",
    "fedora": "/usr/lib64/libLLVM-{}.so",
    "folder": "/usr/lib/llvm-{}/lib/libLLVM.so.1",
    "homebrew": "/opt/homebrew/Cellar/llvm/{}.1.7/lib/libLLVM.dylib",
    "homebrew_old": "/opt/homebrew/Cellar/llvm@{0}/{0}.1/lib/libLLVM.dylib",
}


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from(sorted(NAMES)), st.integers(7, 40))))
def test_newest_usable_libllvm_is_chosen(installed):
    paths = [NAMES[name].format(version) for name, version in installed]
    chosen = libllvm.choose_libllvm(paths)
    usable = [version for _, version in installed if version >= 17]
    if usable:
        assert chosen in paths
        assert libllvm.llvm_version(str(chosen))[0] == max(usable)
    else:
        assert chosen is None


def test_a_name_without_version_is_not_usable():
    assert libllvm.llvm_version("/usr/lib/libLLVM.so.1") == ()
    assert libllvm.choose_libllvm(["/usr/lib/libLLVM.so.1", "libLLVM.so"]) is None


OLD_ONLY = """
import sys
from ginn_jax import libllvm, renderer
from ginn_jax.errors import InputError
renderer._cuda_usable = lambda: False
libllvm.installed_libllvm = lambda: ["/usr/lib/llvm-14/lib/libLLVM-14.so.1"]
try:
    renderer.use_mitsuba()
except InputError as error:
    print(error)
assert "drjit" not in sys.modules
"""


@pytest.mark.parametrize("named", [None, "/nowhere/libLLVM.so.19.1"])
def test_old_or_missing_libllvm_is_one_line_and_no_abort(monkeypatch, named):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    if named:
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", named)
    done = subprocess.run(
        [sys.executable, "-c", OLD_ONLY], capture_output=True, text=True, check=True
    )
    (line,) = done.stdout.splitlines()
    assert ("names no file" if named else "libLLVM-14.so.1): `apt-get install") in line
