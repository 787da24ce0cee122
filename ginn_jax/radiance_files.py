"""Whether a Radiance file (.hdr) is whole: Mitsuba writes past its rows if not.

A run that is longer than its row corrupts the memory of the process there (Mitsuba
3.9.1), so every run is counted before that reader sees the file.
"""

import re

MAGIC = b"#?"
SIZE = re.compile(rb"-Y (\d{1,6}) \+X (\d{1,6})\n")


def is_whole(content: bytes) -> bool:
    """Whether all rows are there and no run is longer than its row."""
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
