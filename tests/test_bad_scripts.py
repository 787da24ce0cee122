"""Scripts that are told wrong, or fail.

Who typed a command sees no traceback: one line, and 2 for their mistakes, 1 for ours.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import tyro
from damaged import contents

from benchmarks import f2d, neighbors, relight, scaling
from experiments import animation, ao_train, evaluate, gi_train
from ginn_jax import (
    commandline,
)
from ginn_jax.errors import InputError

ROOT = Path(__file__).parents[1]


def ends(monkeypatch, capsys, script, *words, main=None):
    """The exit code of a script and the one line that it ends in."""
    monkeypatch.setattr(sys, "argv", ["script", *map(str, words)])
    for name in ("tune_process", "silence_threads"):
        monkeypatch.setattr(commandline, name, lambda: None)
    with pytest.raises(SystemExit) as stopped:
        commandline.start(script.Options, main or script.main, {})
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return stopped.value.code, lines[0]


@pytest.mark.parametrize("words", [["--help"], ["--scan", "no.ply"]])
def test_scripts_end_in_silence_where_nobody_reads(words):
    """After `| head`, say; what goes to the terminal all the same still does."""
    given = [sys.executable, "-m", "experiments.shade", *words]
    kinds = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(given, cwd=ROOT, **kinds) as process:
        process.stdout.close()
        said = process.stderr.read()
    expected = "" if words == ["--help"] else "error: no.ply: no such file"
    assert said.startswith(expected)
    assert len(said.splitlines()) == bool(expected)
    assert process.returncode == (2 if expected else 1)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--steps", "0"), "--steps is 0: give at least 1"),
        (("--steps", "-3"), "--steps is -3: give at least 1"),
        (("--points", 10**13), "--points is 10000000000000: give at most"),
        (("--steps", "1.5"), "--steps"),
        (("--steps", "many"), "--steps"),
        (("--seed", "-1"), "--seed is -1"),
        (("--seed", "100"), "--seed 100"),
        (("--learning-rate", "nan"), "--learning-rate is nan: give it above 0"),
        (("--disk", "0"), "--disk is 0.0: give it above 0"),
        (("--disk", "3"), r"Poisson radius 0\.0.: must lie between 0 and the f_2D"),
        (("--resolution-scale", "0"), r"resolution scale 0\.0: give 1 over"),
        (("--preset", "none"), "--preset"),
        (("--no-such-option",), "no-such-option"),
        (("--test-meshes", "gone"), "gone: no such file or folder"),
    ],
)
@pytest.mark.parametrize("script", [ao_train, gi_train], ids=["ao", "gi"])
def test_mistakes_in_options_end_in_code_2(
    script, words, message, tmp_path, monkeypatch, capsys
):
    words = ("--out", tmp_path / "out", *words)
    code, line = ends(monkeypatch, capsys, script, *words)
    assert code == 2
    assert re.search(message, line)
    assert not contents(tmp_path)


SEVERAL = [
    (evaluate, ("--counts", "4", "0"), "--counts is 0: give at least 1"),
    (evaluate, ("--fewer-looks", "0"), "--fewer-looks is 0: give at least 1"),
    (evaluate, ("--shares", ".5", "2"), "--shares is 2.0: give it from 0.01 to 1"),
    (evaluate, ("--disks", "1.5", "inf"), "--disks is inf: give it above 0"),
    (animation, ("--disks", "-1"), "--disks is -1.0: give it above 0"),
    (neighbors, ("--radii", ".1", "0"), "--radii is 0.0: give it above 0"),
    (scaling, ("--points", "1000", "-4"), "--points is -4: give at least 100"),
    (scaling, ("--points", "1000"), "--points has 1 values: give at least 2"),
    (f2d, ("--disks", ".01"), "--disks are 1, --radii 4: give as many"),
    (
        evaluate,
        ("--disks", "9"),
        "Poisson radius 0.18: must lie between 0 and the",
    ),
    (evaluate, ("--beside", "nope"), "nope"),
    (relight, ("--networks",), "--networks has 0 values: give at least 1"),
]


@pytest.mark.parametrize(("script", "words", "message"), SEVERAL)
def test_each_of_several_values_is_looked_at(
    script, words, message, tmp_path, monkeypatch, capsys
):
    words = ("--out", tmp_path / "out", *words)
    code, line = ends(monkeypatch, capsys, script, *words)
    assert code == 2
    assert message in line
    assert not contents(tmp_path)


def raising(error):
    def main(_):
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (InputError("a: bad\nb"), 2, "error: a: bad b"),
        (
            OSError(28, "No space left on device", "x/y"),
            2,
            "x/y: No space left on device",
        ),
        (PermissionError(13, "Permission denied", "x"), 2, "x: Permission denied"),
        (MemoryError("Unable to allocate 9 TiB"), 2, "not enough memory"),
        (KeyboardInterrupt(), 130, "stopped"),
        (
            ZeroDivisionError("two\nlines"),
            1,
            "ours, ZeroDivisionError at test_bad_scripts",
        ),
        (OSError("no number"), 1, "a mistake of ours, OSError"),
        (AssertionError(), 1, "a mistake of ours, AssertionError"),
    ],
)
def test_what_ends_a_script_is_one_line(error, code, message, monkeypatch, capsys):
    found = ends(monkeypatch, capsys, ao_train, main=raising(error))
    assert found[0] == code
    assert message in found[1]


def test_our_mistakes_show_their_traceback_when_asked(monkeypatch):
    monkeypatch.setenv("GINN_JAX_TRACEBACK", "1")
    monkeypatch.setattr(sys, "argv", ["script"])
    for name in ("tune_process", "silence_threads"):
        monkeypatch.setattr(commandline, name, lambda: None)
    with pytest.raises(ZeroDivisionError):
        commandline.start(ao_train.Options, raising(ZeroDivisionError()), {})


def test_a_folder_that_is_a_file_ends_in_one_line_and_code_2(tmp_path):
    (tmp_path / "file").write_text("mine")
    words = ("--out", str(tmp_path / "file"), "--shapes", "1", "--points", "1000")
    said = subprocess.run(
        [sys.executable, "-m", "experiments.gi_train", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert said.returncode == 2
    assert len(said.stderr.strip().splitlines()) == 1
    assert str(tmp_path / "file") in said.stderr
    assert (tmp_path / "file").read_text() == "mine"


def test_the_command_that_is_recorded_runs_again():
    """Whatever is in the names of files."""
    options = evaluate.Options(meshes=Path("my meshes"), counts=(1, 2), quick=True)
    words = shlex.split(commandline.command_line("experiments.evaluate", options))
    assert words[:3] == ["python", "-m", "experiments.evaluate"]
    again = tyro.cli(evaluate.Options, args=words[3:])
    assert again == options
