"""Names are those of the field: no identifier or file name holds a private word that the code once had."""

from __future__ import annotations

import re
from collections import defaultdict

import pytest

from helpers.source_tree import identifiers, label, source_files, tool_files

OLD_WORDS = (
    r"judge[sd]?",
    r"strips?",
    r"climb\w*",
    r"settled",
    r"elsewhere",
    r"at_home",
    r"worth\w*",
    r"\w*_worth",
    r"strangeness",
    r"looks?",
    r"(second_?look|lookedat)\w*",
    r"twins?\w*",
    r"told_apart",
    r"tell_apart",
    r"telling",
    r"(is_)?crowd\w*",
    r"distinct",
    r"(is_)?spar(e|ed|ing)",
    r"why_?not",
    r"borne_out",
    r"seen_by",
    r"snap(?!shot)\w*",
    r"(growths?|efforts?)",
    r"(hop|hops|hopped|spun)",
    r"(living|desks|widening|ahead)",
    r"(unseen|doubtful)",
    r"_(without|common|determined)",
    r"(least|most|largest|fewest)_\w+",
)
"""Patterns of whole identifiers, in any case; an underscore may stand before them."""
OLD = re.compile(rf"_?({'|'.join(OLD_WORDS)})$", re.IGNORECASE)
KEPT: dict[str, str] = {
    "strip": "the frame counter's strip in a live picture, and the method of a text",
    "least_squares": "the method of estimation",
}
"""Words of the list that mean something else where they stand, with what they mean: ``name`` or ``path:name``."""


@pytest.mark.parametrize("word", ["judge", "_climb", "LEAST_LEAD", "climbed_share", "most_px", "Effort", "snap_to"])
def test_old_words_are_known(word: str) -> None:
    assert OLD.match(word)


@pytest.mark.parametrize("word", ["snapshot", "almost", "strip_px", "min_lead", "at_homepage", "Snapshots"])
def test_other_words_are_not(word: str) -> None:
    assert not OLD.match(word)


def test_no_identifier_or_file_name_holds_an_old_word() -> None:
    found = defaultdict(set)
    files = [*source_files(), *tool_files()]
    assert len(files) > 300
    for path in files:
        for name in identifiers(path):
            if OLD.match(name) and not {name, f"{label(path)}:{name}"} & set(KEPT):
                found[label(path)].add(name)
    assert {f"{path}:{name}" for path, names in found.items() for name in names} == set()
