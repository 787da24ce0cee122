"""What Mitsuba's readers of environment maps do not check of a file before they act.

A run longer than its row, in a Radiance file (.hdr), makes its reader write past the
row and corrupts the process; an OpenEXR file is given as much memory as it says it
needs (both Mitsuba 3.9.1).
"""

import re
import struct

from ginn_jax.checks import MOST_PIXELS

SIZE = re.compile(rb"-Y (\d{1,6}) \+X (\d{1,6})\n")
WINDOW = re.compile(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", re.DOTALL)


def is_sound(content: bytes) -> bool:
    """Whether a file of any format can be given to Mitsuba."""
    if content.startswith(b"#?"):
        return _all_runs_fit(content)
    if content.startswith(b"v/1\x01"):
        return _has_bounds(content)
    return True


def _has_bounds(content: bytes) -> bool:
    """Whether an OpenEXR file says of all its parts that they have so many pixels."""
    boxes = [struct.unpack("<4i", found) for found in WINDOW.findall(content)]
    areas = [(right - x + 1) * (low - y + 1) for x, y, right, low in boxes]
    return bool(areas) and all(0 < area <= MOST_PIXELS for area in areas)


def _all_runs_fit(content: bytes) -> bool:
    """Whether a Radiance file has all its rows, and no run longer than its row."""
    start = content.find(b"\n\n") + 2
    size = SIZE.match(content, start) if start > 1 else None
    if size is None:
        return False
    height, width = int(size[1]), int(size[2])
    place = size.end()
    if height * width == 0 or len(content) - place < height * min(width, 8):
        return False
    packed = 8 <= width < 1 << 15 and content[place : place + 2] == b"\2\2"
    if not packed:
        return len(content) - place >= 4 * width * height
    try:
        for _ in range(height):
            place = _after_row(content, place, width)
    except (IndexError, ValueError):
        return False
    return place <= len(content)


def _after_row(content: bytes, place: int, width: int) -> int:
    """Where the next row starts; raises `ValueError` where runs do not fit this one."""
    if content[place : place + 4] != bytes((2, 2, width >> 8, width & 255)):
        raise ValueError("row")
    place += 4
    for _ in range(4):
        left = width
        while left > 0:
            count = content[place]
            run = count > 128
            left -= count - 128 if run else count
            place += 2 if run else count + 1
            if count == 0:
                raise ValueError("count")
        if left < 0:
            raise ValueError("run")
    return place
