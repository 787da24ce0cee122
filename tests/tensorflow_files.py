"""TensorFlow checkpoints written from their specification, for what reads them."""

import struct

import numpy as np


def crc32c(content):
    """Castagnoli's polynomial, divided bit by bit."""
    remainder = 0xFFFFFFFF
    for byte in content:
        for bit in range(8):
            odd = (remainder ^ byte >> bit) & 1
            remainder = remainder >> 1 ^ odd * 0x82F63B78
    return remainder ^ 0xFFFFFFFF


def masked(content):
    crc = crc32c(content)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) % 2**32


def varint(number):
    digits = []
    while number >= 128:
        digits.append(number % 128 + 128)
        number //= 128
    return bytes([*digits, number])


def field(number, value):
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def entry(tensor, offset):
    """What the index says of a tensor; numbers that are 0 are left out."""
    kinds = {"float32": 1, "int64": 9}
    dimensions = b"".join(field(2, field(1, n)) for n in tensor.shape)
    said = field(1, kinds[tensor.dtype.name]) + field(2, dimensions)
    if offset:
        said += field(4, offset)
    checksum = varint(6 << 3 | 5) + struct.pack("<I", masked(tensor.tobytes()))
    return said + field(5, tensor.nbytes) + checksum


def block(pairs):
    """Pairs in a block in which keys share their beginnings, but for each fourth."""
    made, restarts, before = b"", [], b""
    for number, (key, value) in enumerate(pairs):
        shared = 0
        if number % 4 == 0:
            restarts.append(len(made))
        else:
            while shared < min(len(key), len(before)) and key[shared] == before[shared]:
                shared += 1
        lengths = (shared, len(key) - shared, len(value))
        made += b"".join(map(varint, lengths)) + key[shared:] + value
        before = key
    return made + struct.pack(f"<{len(restarts) + 1}I", *restarts, len(restarts))


def write_checkpoint(prefix, tensors):
    """PREFIX.index, of two blocks, and PREFIX.data-00000-of-00001."""
    data, pairs = b"", [(b"", field(1, 1))]
    for name in sorted(tensors):
        pairs.append((name.encode(), entry(tensors[name], len(data))))
        data += tensors[name].tobytes()
    half = len(pairs) // 2
    index, handles = b"", []
    for some in (pairs[:half], pairs[half:]):
        made = block(some)
        handles.append((some[-1][0], varint(len(index)) + varint(len(made))))
        index += made + b"\0" + struct.pack("<I", masked(made + b"\0"))
    ends = b""
    for some in ([], handles):
        made = block(some)
        ends += varint(len(index)) + varint(len(made))
        index += made + b"\0" + struct.pack("<I", masked(made + b"\0"))
    footer = ends.ljust(40, b"\0") + struct.pack("<Q", 0xDB4775248B80FB57)
    prefix.with_name(prefix.name + ".index").write_bytes(index + footer)
    shard = prefix.with_name(prefix.name + ".data-00000-of-00001")
    shard.write_bytes(data)
    return shard


def random_tensors(seed, names_and_shapes):
    rng = np.random.default_rng(seed)
    return {
        name: np.asarray(rng.normal(size=shape), "<f4")
        for name, shape in names_and_shapes.items()
    }
