"""Python run in a process of its own, in which JAX has two devices."""

import os
import subprocess
import sys
from pathlib import Path

BEGIN = """
from ginn_jax import process
process.tune_process(2)
import jax
assert len(jax.devices()) == 2
import tiny
quickly = tiny.cheap_compiling()
quickly.__enter__()
"""


def check(script: str) -> None:
    """Fail unless the script comes to its end."""
    here = Path(__file__).parent
    paths = os.pathsep.join(
        [str(here), str(here.parent), os.environ.get("PYTHONPATH", "")]
    )
    done = subprocess.run(
        [sys.executable, "-c", BEGIN + script + "print('two devices agree')"],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.stdout == "two devices agree\n", done.stderr[-2000:]
