"""Every test runs with the library's annotations checked and no silent promotion."""

import gc
import math
import os

# XLA says of every compiled function that it finds in the cache that it may not fit.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax
import pytest
from hypothesis import settings
from jaxtyping import config, install_import_hook

install_import_hook("ginn_jax", "beartype.beartype")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tracing makes many objects that stay, through all of which each collection goes.
gc.set_threshold(100_000, 20, 20)

settings.register_profile(
    "ginn_jax", deadline=None, max_examples=25, derandomize="CI" in os.environ
)
settings.load_profile("ginn_jax")


def pytest_configure(config):
    """What XLA compiled is kept for other processes, their children and other runs."""
    try:
        folder = str(config.cache.mkdir("xla"))
    except (AttributeError, OSError):  # no cache, or none that can be written
        return
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"


# What takes longest begins first, so that the processes end together.
LONGEST = (
    "pretrained",
    "lit_experiments",
    "released",
    "relight",
    "training_stress",
    "killed_runs",
    "capacities",
    "train",
    "experiments",
    "benchmarks",
    "benchmark_networks",
    "geometry",
    "limits",
    "image",
    "network",
    "mcconv",
    "mcconv_gradients",
    "receptive_field",
    "hierarchy",
    "stability",
    "figures",
    "compare",
)


def pytest_collection_modifyitems(items):
    rank = {f"test_{name}": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture
def unchecked():
    """No annotation is checked: wrong input meets the library as a user's would."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)


@pytest.fixture(scope="module")
def cheap_compiling():
    """For modules that test wiring: XLA compiles quickly and does not optimise."""
    import tiny  # brings in the package, which the hook has to be there for

    with tiny.cheap_compiling():
        yield


@pytest.fixture
def full_compiling(cheap_compiling):
    """For tests of such modules whose results have to be those of users' programs."""
    import tiny

    with tiny.full_compiling():
        yield


@pytest.fixture(scope="module")
def in_blocks():
    """f_3D and f_2D by JAX, as on a GPU."""
    from ginn_jax import image, inference  # after the hook, as above

    with pytest.MonkeyPatch.context() as patch:
        for module in (image, inference):
            patch.setattr(module, "lanes_for", lambda network: False)
        patch.setattr(inference, "encodes_in_lanes", lambda network: False)
        yield


@pytest.fixture
def small_programs(monkeypatch):
    """For whole scripts: few programs, all small, and no process beside this one."""
    import tiny

    from ginn_jax import blocks, limits, scenes

    # Each is tested where it belongs: processes with the scenes, fitting with images.
    monkeypatch.setattr(scenes, "ProcessPoolExecutor", tiny.Here)
    monkeypatch.setattr(limits, "LOOSE", math.inf)
    # Every picture has full blocks, so one shape is compiled.
    monkeypatch.setattr(blocks, "BLOCK", 128)


@pytest.fixture
def at_once(monkeypatch):
    """Nothing is warmed up: times are not looked at."""
    from benchmarks import timing  # after the hook, as above

    monkeypatch.setattr(timing, "WARM", 0.0)


@pytest.fixture
def far_in_few(monkeypatch):
    """Points far from others are looked for in clouds of any size."""
    from ginn_jax import outlying  # after the hook, as above

    for name, value in (("MANY", 2), ("ASKED", 2), ("WIDE", 0), ("FAR_OFF", 2)):
        monkeypatch.setattr(outlying, name, value)


@pytest.fixture(autouse=True, scope="module")
def _forget_compilations():
    """Each module's own: thousands of kernels exhaust the maps a process may have."""
    yield
    from ginn_jax.process import forget_programs  # after the hook, as above

    forget_programs()
