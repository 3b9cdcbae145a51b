"""The part of a job as it was when the job began: copies of its part file, its CAD, and the files that these name."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from urllib.parse import unquote

from arview.errors import OutputError

FOLDER = "part"
"""Folder of the copies in that of the job."""
_QUOTED = re.compile(rb"[\"']([^\"'\r\n]{1,200}\.[A-Za-z0-9]{1,8})[\"']")
"""Names of files in part files, glTF and STEP."""


def freeze_part(part_file: Path, job: Path) -> str | None:
    """Copy a part file or CAD file, and the files that it names relative to itself, into the folder of a job.

    Args:
        part_file: the part file, or a CAD file without one.
        job: folder of the job.

    Returns:
        Path of the copy below the folder of the job; None where the part has no file.

    Raises:
        OutputError: a file cannot be copied.
    """
    found = [part_file.resolve()]
    for path in found:
        if not path.is_file():
            continue
        names = {unquote(name.decode("utf-8", "replace")) for name in _QUOTED.findall(path.read_bytes())}
        for name in sorted(name for name in names if "\0" not in name and not Path(name).is_absolute()):
            beside = (path.parent / name.replace("\\", "/")).resolve()
            if beside not in found and beside.is_file():
                found.append(beside)
    root = Path(os.path.commonpath([path.parent for path in found]))
    try:
        for path in filter(Path.is_file, found):
            target = job / FOLDER / path.relative_to(root)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
    except OSError as error:
        raise OutputError(f"{job / FOLDER}: cannot be written to ({error.strerror or error})") from error
    return (Path(FOLDER) / found[0].relative_to(root)).as_posix() if found[0].is_file() else None
