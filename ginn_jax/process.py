"""How a process is set up: what makes XLA faster on CPU, and when a worker ends."""

import ctypes
import gc
import logging
import multiprocessing
import os
import threading
from multiprocessing.process import BaseProcess
from pathlib import Path

import jax

LOG = logging.getLogger("ginn_jax")

# Compiler options of what runs on several devices at once: with a device on every core
# none has another to share a kernel with.
ALONE = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}

SHARE_OF_MAPS = 0.5

# glibc's mallopt parameters, from malloc.h.
TRIM_THRESHOLD, TOP_PAD, MMAP_MAX, ARENA_MAX = -1, -2, -4, -8


def tune_process(devices: int | None = None) -> None:
    """Keep freed memory, and make every core a JAX device; call before any JAX work.

    XLA allocates its scratch memory anew for each call; glibc returns blocks that large
    to the kernel, so each call pays a page fault for every 4 KiB it touches: a
    convolution's gradient runs two to three times faster with the memory kept. Sorting,
    scattering and prefix sums use one core; with a device per core a batch is shared
    between them. Where neither applies (no glibc, a GPU) nothing happens.
    """
    try:
        libc = ctypes.CDLL(None)
        libc.mallopt(MMAP_MAX, 0)
        libc.mallopt(TRIM_THRESHOLD, 2**31 - 1)
        libc.mallopt(TOP_PAD, 64 << 20)
        libc.mallopt(ARENA_MAX, 1)
    except (AttributeError, OSError, TypeError):
        pass
    jax.config.update("jax_num_cpu_devices", devices or available_cores())


def forget_programs() -> None:
    """Let go of all that JAX compiled, before much else is.

    Every kernel has memory maps of its own, a training step some thousands; of the
    65,530 that Linux lets a process have none are left after two or three of those.
    """
    jax.clear_caches()
    gc.collect()


def spare_memory_maps() -> None:
    """Let go of all that JAX compiled where it has taken half of the memory maps.

    Without any left LLVM ends the process. Where nothing tells, nothing happens.
    """
    try:
        most = int(Path("/proc/sys/vm/max_map_count").read_bytes())
        taken = Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return
    if taken > SHARE_OF_MAPS * most:
        LOG.warning(
            "compiled programs hold %d of a process's %d memory maps and are let go: "
            "`sysctl -w vm.max_map_count=1000000` spares compiling them again",
            taken,
            most,
        )
        forget_programs()


def end_with_parent() -> None:
    """Let a worker end when the process that started it does, however that ended.

    It would wait for work forever: it holds the other end of its queue itself.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


def on_cpu() -> bool:
    """Whether what is compiled runs on cores with caches to fit, or all at once."""
    return jax.default_backend() == "cpu"


def available_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
