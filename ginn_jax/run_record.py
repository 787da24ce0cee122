"""What made a training run, as JSON beside its checkpoints: settings and capacities."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ginn_jax.architecture import Conv, Network
from ginn_jax.checks import LARGEST_INDEX, whole
from ginn_jax.errors import InputError
from ginn_jax.files import writing
from ginn_jax.limits import Limits
from ginn_jax.recipe import Training
from ginn_jax.room import Room
from ginn_jax.searches import limit_names

RECORD = "run.json"
RESULTS = ("metrics.json", "report.md")
OLD = "{} is of another version of ginn_jax: train again"
UNSPENT = {"compile": 0.0, "train": 0.0}


def save_run(
    folder: Path,
    config: Training,
    room: Room,
    extra: dict[str, Any],
    seconds: Mapping[str, float] = UNSPENT,
    raised: Mapping[str, int] | None = None,
) -> None:
    """Write what a resumed run must agree with, its capacities and the time spent.

    What was reported of an earlier run there is removed: it is of other weights.
    """
    record = {"training": asdict(config), "seconds": dict(seconds), **extra}
    record |= {"limits": dict(room.most.sizes), "usual": dict(room.usual.sizes)}
    record |= {"raised": dict(raised or {})}
    text = json.dumps(record, indent=1, sort_keys=True)
    with writing(folder / RECORD) as new:
        new.write_text(text)
        for name in RESULTS:
            (folder / name).unlink(missing_ok=True)


def load_run(
    folder: Path, config: Training, extra: dict[str, Any]
) -> tuple[Room, dict[str, float], dict[str, int]]:
    """Capacities of the run to be resumed, the seconds it took by purpose, and which
    capacities it raised on the way.

    Raises:
        InputError: no run there, an unreadable record, or other settings than now.
    """
    path = folder / RECORD
    record = read_record(path, "no run to resume: leave out --resume")
    if isinstance(record, dict) and "limits" in record and "usual" not in record:
        raise InputError(OLD.format(path))
    with damaged(path, "delete it and start anew"):
        training = dict(record["training"])
        room = Room(limits_from(record, "usual"), limits_from(record))
        spent = record.get("seconds", UNSPENT)
        seconds = UNSPENT | {name: float(spent[name]) for name in spent}
        raised = {name: int(n) for name, n in record.get("raised", {}).items()}
    wanted = json.loads(json.dumps({"training": asdict(config), **extra}))
    for name in sorted(wanted["training"]):
        if training.get(name) != wanted["training"][name]:
            raise InputError(
                f"{path} was made with another {name}: resume with the same"
            )
    for name in sorted(extra):
        if record.get(name) != wanted[name]:
            raise InputError(
                f"{path} was made with another {name}: resume with the same"
            )
    for limits in room.each():
        check_names(path, config.network, limits)
    return room, seconds, raised


def check_names(path: Path, network: Network, limits: Limits) -> None:
    """Raise `InputError` unless these are the capacities that the network needs."""
    if {name for name, _ in limits.sizes} != set(limit_names(network)):
        raise InputError(OLD.format(path))


def read_record(path: Path, missing: str) -> Any:
    """What `save_run` wrote; None where that is not JSON."""
    try:
        with open(path, "rb") as file:
            if file.read(1) != b"{":
                return None
            return json.loads(b"{" + file.read())
    except FileNotFoundError:
        raise InputError(f"{path.parent} holds {missing}") from None
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror}): mend that or choose another"
        ) from None
    except (ValueError, RecursionError):
        return None


@contextmanager
def damaged(path: Path, mend: str) -> Iterator[None]:
    """Say of a record without what should be in it that it is damaged."""
    try:
        yield
    except (ValueError, KeyError, AttributeError, TypeError, OverflowError):
        raise InputError(f"{path} is damaged: {mend}") from None


def limits_from(record: dict[str, Any], name: str = "limits") -> Limits:
    """The capacities that `save_run` wrote."""
    sizes = record[name].items()
    return Limits(tuple((name, whole(name, n, 1, LARGEST_INDEX)) for name, n in sizes))


def training_from(record: dict[str, Any]) -> Training:
    """The configuration that `save_run` wrote."""
    network = dict(record["network"])
    network["levels"] = tuple(network["levels"])
    network["encoder"] = tuple(Conv(**row) for row in network["encoder"])
    network["query"] = Conv(**network["query"])
    return Training(**{**record, "network": Network(**network)})
