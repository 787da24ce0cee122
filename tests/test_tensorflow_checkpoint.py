"""Checkpoints of TensorFlow are read whole, or refused in one line."""

from contextlib import suppress

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tensorflow_files import crc32c, masked, write_checkpoint

from benchmarks.tensorflow_checkpoint import masked_crc32c, read_tensors
from ginn_jax.errors import InputError

NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1)
SHAPES = hnp.array_shapes(min_dims=0, max_dims=3, max_side=4)
TENSORS = st.dictionaries(
    NAMES, hnp.arrays("<f4", SHAPES, elements=st.floats(-9, 9, width=32)), max_size=9
)


@pytest.fixture(scope="module")
def prefix(tmp_path_factory):
    return tmp_path_factory.mktemp("checkpoint") / "net.ckpt"


@given(TENSORS)
def test_what_was_written_is_read(prefix, tensors):
    whole = {"global_step": np.array(7, np.int64)}
    write_checkpoint(prefix, {f"f/{n}": t for n, t in tensors.items()} | whole)
    found = read_tensors(prefix)
    assert set(found) == {f"f/{n}" for n in tensors}
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(found[f"f/{name}"], tensor)


@given(st.binary(max_size=40))
def test_checksum_is_castagnolis(content):
    assert crc32c(b"123456789") == 0xE3069283  # as RFC 3720 has it
    assert masked_crc32c(content) == masked(content)


@given(st.integers(0, 10**6), st.integers(1, 255), st.booleans())
def test_nothing_damaged_is_read(prefix, place, change, in_index):
    tensors = {f"t{n}": np.arange(n + 1, dtype="<f4") for n in range(8)}
    path = write_checkpoint(prefix, tensors)
    path = prefix.with_name("net.ckpt.index") if in_index else path
    whole = path.read_bytes()
    data = bytearray(whole)
    data[place % len(data)] ^= change
    path.write_bytes(data)
    with suppress(InputError):
        found = read_tensors(prefix)
        # Its filters, and the padding of the footer, say nothing of tensors.
        assert in_index
        assert all(np.array_equal(found[name], tensors[name]) for name in tensors)


@given(st.integers(0, 10**6))
def test_cut_files_are_refused(prefix, place):
    tensors = {f"t{n}": np.arange(n + 1, dtype="<f4") for n in range(8)}
    shard = write_checkpoint(prefix, tensors)
    for path in (prefix.with_name("net.ckpt.index"), shard):
        content = path.read_bytes()
        path.write_bytes(content[: place % len(content)])
        with pytest.raises(InputError, match=r"net\.ckpt is damaged"):
            read_tensors(prefix)
        path.write_bytes(content)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"gi\.ckpt\.index cannot be read: give a"):
        read_tensors(tmp_path / "gi.ckpt")
