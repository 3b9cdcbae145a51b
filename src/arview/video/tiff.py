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
    try:
        if path.suffix.lower() not in SUFFIXES:
            return [0]
        with path.open("rb") as file:
            head = file.read(16)
            order = ">" if head.startswith(b"MM") else "<"
            is_big = head[2:4] in (b"\0+", b"+\0")
            (offset,) = struct.unpack_from(order + ("Q" if is_big else "I"), head, 8 if is_big else 4)
            count_code, entry_size, value, next_code = ("Q", 20, 12, "Q") if is_big else ("H", 12, 8, "I")
            while offset and offset not in seen and len(seen) < MAX_PAGES:
                file.seek(offset)
                (count,) = struct.unpack(order + count_code, file.read(struct.calcsize(count_code)))
                entries = file.read(min(count, 0xFFFF) * entry_size)
                starts = range(0, len(entries), entry_size)
                # A tag is followed by its type, the number of values, and the value.
                tags = {entries[k : k + 2]: entries[k + value : k + value + 4] for k in starts}
                (kind,) = struct.unpack(order + "I", tags.get(struct.pack(order + "H", _SUBFILE_TYPE), bytes(4)))
                if not kind & _REDUCED_OR_MASK:
                    pages.append(len(seen))
                seen.add(offset)
                (offset,) = struct.unpack(order + next_code, file.read(struct.calcsize(next_code)))
    except (OSError, struct.error, OverflowError):
        pass  # what is there is read; a page that is cut short cannot be decoded, which is told
    return pages or [0]
