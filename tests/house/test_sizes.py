"""No file, function or folder grows beyond what is read in one sitting."""

from __future__ import annotations

from collections import Counter

from helpers.source_tree import functions, lab_files, label, source_files

MAX_FILE_LINES = 500
MAX_FUNCTION_LINES = 80
MAX_FOLDER_FILES = 20
EXCEPTIONS: dict[str, str] = {}
"""What may be larger, at most six, each with its reason: ``path``, ``path:function`` or ``folder/``."""


def too_large() -> set[str]:
    found = set()
    files = [*source_files(), *lab_files()]
    for path in files:
        if len(path.read_text(encoding="utf-8").splitlines()) > MAX_FILE_LINES:
            found.add(label(path))
        for name, node in functions(path):
            assert node.end_lineno is not None
            # Without decorators, with the signature and the docstring.
            if node.end_lineno - node.lineno + 1 > MAX_FUNCTION_LINES:
                found.add(f"{label(path)}:{name}")
    folders = Counter(path.parent for path in files if path.name != "__init__.py")
    return found | {f"{label(folder)}/" for folder, count in folders.items() if count > MAX_FOLDER_FILES}


def test_sizes() -> None:
    assert len(source_files()) > 250
    assert too_large() == set(EXCEPTIONS)


def test_exceptions_are_few_and_have_reasons() -> None:
    assert len(EXCEPTIONS) <= 6
    assert all(len(reason.split()) >= 4 for reason in EXCEPTIONS.values())
