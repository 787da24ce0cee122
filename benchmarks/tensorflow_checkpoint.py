"""Tensors of a TensorFlow checkpoint (format V2, one shard), without TensorFlow.

PREFIX.index is a sorted table in LevelDB's format (leveldb/doc/table_format.md) of
messages (tensorflow/core/protobuf/tensor_bundle.proto) that say where in
PREFIX.data-00000-of-00001 each tensor lies. All checksums are compared.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ginn_jax.errors import InputError

SHARD = ".data-00000-of-00001"
FOOTER, MAGIC = 48, bytes.fromhex("57fb808b247547db")
# Of what a message says, by the numbers of its fields.
TYPE, SHAPE, OFFSET, SIZE, CHECKSUM = 1, 2, 4, 5, 6
FLOAT = 1


def read_tensors(prefix: Path) -> dict[str, Float[np.ndarray, "..."]]:
    """The tensors of single precision by their names.

    Raises:
        InputError: files that are not there, damaged, or of another format.
    """
    index, data = (prefix.with_name(prefix.name + end) for end in (".index", SHARD))
    contents = []
    for path in (index, data):
        try:
            contents.append(path.read_bytes())
        except OSError:
            raise InputError(
                f"{path} cannot be read: give a folder that has it"
            ) from None
    try:
        return dict(_tensors(*contents))
    except (IndexError, ValueError, KeyError) as error:
        raise InputError(f"{prefix} is damaged ({error}): download it again") from None


def _tensors(index: bytes, data: bytes) -> Iterator[tuple[str, np.ndarray]]:
    for name, entry in _table(index):
        said = _message(entry)
        if not name or said.get(TYPE) != [FLOAT]:  # the first is of the whole file
            continue
        dimensions = _message(said[SHAPE][0]).get(2, [])
        shape = [_message(dimension).get(1, [0])[0] for dimension in dimensions]
        begin, size = said.get(OFFSET, [0])[0], said[SIZE][0]
        some = data[begin : begin + size]
        if masked_crc32c(some) != int.from_bytes(said[CHECKSUM][0], "little"):
            raise ValueError(f"the checksum of {name.decode()} differs")
        yield name.decode(), np.frombuffer(some, "<f4").reshape(shape)


def _table(index: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Keys and values of a table whose blocks are not compressed."""
    footer = index[-FOOTER:]
    if len(footer) < FOOTER or footer[-len(MAGIC) :] != MAGIC:
        raise ValueError("its index is none")
    place = 0
    for _ in range(2):  # the block of its filters
        _, place = _varint(footer, place)
    for _, handle in _block(index, footer[place:]):
        yield from _block(index, handle)


def _block(index: bytes, handle: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Keys and values of the block at a handle; keys share their beginnings."""
    begin, place = _varint(handle, 0)
    size, _ = _varint(handle, place)
    block, kind = index[begin : begin + size], index[begin + size]
    checksum = index[begin + size + 1 : begin + size + 5]
    if masked_crc32c(block + bytes([kind])) != int.from_bytes(checksum, "little"):
        raise ValueError("the checksum of its index differs")
    if kind != 0:
        raise ValueError("its index is compressed")
    end = len(block) - 4 - 4 * int.from_bytes(block[-4:], "little")
    key, place = b"", 0
    while place < end:
        shared, place = _varint(block, place)
        fresh, place = _varint(block, place)
        length, place = _varint(block, place)
        key = key[:shared] + block[place : place + fresh]
        place += fresh
        yield key, block[place : place + length]
        place += length


def _message(encoded: bytes) -> dict[int, list[Any]]:
    """The fields of a message of Protocol Buffers by their numbers."""
    fields: dict[int, list[Any]] = {}
    place = 0
    while place < len(encoded):
        tag, place = _varint(encoded, place)
        if tag & 7 == 0:
            value, place = _varint(encoded, place)
        elif tag & 7 in (2, 5):
            length, place = (4, place) if tag & 7 == 5 else _varint(encoded, place)
            value = encoded[place : place + length]
            place += length
        else:
            raise ValueError(f"field of type {tag & 7}")
        fields.setdefault(tag >> 3, []).append(value)
    return fields


def _varint(encoded: bytes, place: int) -> tuple[int, int]:
    """A number of seven bits a byte, and where it ends."""
    number = shift = 0
    while True:
        byte = encoded[place]
        place += 1
        number |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return number, place


def masked_crc32c(content: bytes) -> int:
    """The checksum of Castagnoli's polynomial as TensorFlow stores it, turned by 15
    bits and moved, so that it differs from that of content that holds checksums."""
    crc = 0xFFFFFFFF
    for byte in content:
        crc = CASTAGNOLI[(crc ^ byte) & 255] ^ (crc >> 8)
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _castagnoli(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0x82F63B78 if byte & 1 else 0)
    return byte


CASTAGNOLI = tuple(map(_castagnoli, range(256)))
