"""Pages of TIFF files, which some cameras and microscopes write instead of films."""

from __future__ import annotations

import struct
from pathlib import Path

SUFFIXES = frozenset({".tif", ".tiff"})
MAX_PAGES = 100_000
"""Pages that are read; the chain of a damaged file may have no end."""
_SUBFILE_TYPE, _REDUCED_OR_MASK = 254, 0b101


def tiff_pages(path: Path) -> list[int]:
    """Numbers of the pages of a TIFF file that are pictures of their own, not previews or masks; 0 for other files.

    Source: TIFF 6.0, section 2, and BigTIFF, whose fields are wider.
    """
    pages, seen = list[int](), set[int]()
    if path.suffix.lower() not in SUFFIXES:
        return [0]
    try:
        with path.open("rb") as file:
            head = file.read(16)
            order, is_big = ">" if head.startswith(b"MM") else "<", b"+" in head[2:4]
            # The code of an offset, where the first is, that of the number of tags, their size, where their value is.
            code, at, count_code, size, value = ("Q", 8, "Q", 20, 12) if is_big else ("I", 4, "H", 12, 8)
            (offset,) = struct.unpack_from(order + code, head, at)
            while offset and offset not in seen and len(seen) < MAX_PAGES:
                file.seek(offset)
                (count,) = struct.unpack(order + count_code, file.read(struct.calcsize(count_code)))
                data = file.read(min(count, 0xFFFF) * size)
                tags = {data[k : k + 2]: data[k + value : k + value + 4] for k in range(0, len(data), size)}
                (kind,) = struct.unpack(order + "I", tags.get(struct.pack(order + "H", _SUBFILE_TYPE), bytes(4)))
                pages += [] if kind & _REDUCED_OR_MASK else [len(seen)]
                seen.add(offset)
                (offset,) = struct.unpack(order + code, file.read(struct.calcsize(code)))
    except (OSError, struct.error, OverflowError):
        pass  # what is there is read; a page that is cut short cannot be decoded, which is told
    return pages or [0]
