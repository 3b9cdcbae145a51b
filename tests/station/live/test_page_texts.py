"""The texts of the live page: all of them are in the catalogue, in every language, and none stands elsewhere."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import pytest

from arview.core.messages import CATALOGUE
from arview.station.live.protocol import NOTICE_CODES
from helpers.paths import ROOT

PAGE = ROOT / "src" / "arview" / "station" / "live" / "page"
LANGUAGES = ("en", "de")
ENTRY = re.compile(r'^\s*("[^"]+"):\s*\n?\s*("(?:[^"\\]|\\.)*")', re.MULTILINE)
LITERAL = re.compile(r"""//[^\n]*|/\*.*?\*/|"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*'|`(?:[^`\\]|\\.)*`""", re.DOTALL)
PROSE = re.compile(r"[A-Za-z]{2,}[,.:;]? [A-Za-z]{2,}|^[A-Z][a-z]{2,}$")
"""Two words in a row, or one with a capital letter."""
TECHNICAL = re.compile(  # names, classes, queries, and words of the server that are compared
    r"^(?:[A-Z]\w*Error|Content-Type|Retry-After|X-Arview-Answer|Arrow\w+|Escape|Enter|Bad|GET|POST|PATCH|DELETE|"
    r"(?:[\w-]+ )+|[a-z]+: [\w-]+|\(prefers-[\w-]+: \w+\)|NOT YET CHECKED|translate\(.*|"
    r"matching again|finding the part|reading photos|fitting the CAD)$"
)
SENTENCES = re.compile(r"^(?:" + "|".join({key.split(".")[0] for key in CATALOGUE}) + r")\.")
"""Keys of sentences of the station, which arrive in English."""
ATTRIBUTES = {"aria-label": "data-label", "alt": "data-alt", "title": "data-title", "placeholder": "data-placeholder"}


@cache
def catalogue(language: str) -> dict[str, str]:
    """The texts of a language by key, those of the job and the station included."""
    sources = [(PAGE / "texts" / f"{language}.js").read_text(encoding="utf-8")]
    for more in (PAGE / "job" / "texts.js", PAGE / "texts" / "station.js"):
        sections = re.split(r"^const (\w\w) = \{$", more.read_text(encoding="utf-8"), flags=re.MULTILINE)
        sources.append(dict(zip(sections[1::2], sections[2::2], strict=True))[language])
    entries = [(json.loads(key), json.loads(text)) for source in sources for key, text in ENTRY.findall(source)]
    texts = dict(entries)
    assert len(texts) == len(entries), "a key stands twice"
    return texts


def scripts() -> list[Path]:
    """The scripts of the page without its catalogues."""
    return [path for path in sorted(PAGE.rglob("*.js")) if "texts" not in path.relative_to(PAGE).as_posix()]


def literals(path: Path) -> Iterator[tuple[str, str]]:
    """The string literals of a script, without quotes, each with the code before it on its line."""
    source = path.read_text(encoding="utf-8")
    for found in LITERAL.finditer(source):
        if not found.group().startswith(("//", "/*")):
            yield found.group()[1:-1], source[source.rfind("\n", 0, found.start()) + 1 : found.start()]


class Texts(HTMLParser):
    """Collects the texts of a page: (text, key) of elements and attributes; the key is None where there is none."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, str | None]] = []
        self._open: list[dict[str, str | None]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        for name, by in ATTRIBUTES.items():
            if given.get(name):
                self.found.append((given[name] or "", given.get(by)))
        if tag not in {"meta", "link", "input", "img", "br"}:
            self._open.append({**given, "tag": tag})

    def handle_endtag(self, tag: str) -> None:
        while self._open and self._open.pop()["tag"] != tag:
            pass

    def handle_data(self, data: str) -> None:
        if self._open and re.search(r"[A-Za-z]{2,}", data):
            self.found.append((data.strip(), self._open[-1].get("data-text")))


def test_every_language_has_every_text() -> None:
    english = catalogue("en")
    assert len(english) > 150
    for language in LANGUAGES[1:]:
        other = catalogue(language)
        assert {key for key in other if key not in CATALOGUE} == {key for key in english if key not in CATALOGUE}
        for key, text in english.items():
            assert sorted(re.findall(r"\{\w+\}", text)) == sorted(re.findall(r"\{\w+\}", other[key])), (language, key)
        assert sum(other[key] != english[key] for key in english) > 0.85 * len(english), "not translated"


def test_texts_that_are_asked_for_exist_and_all_are_used() -> None:
    source = "\n".join(path.read_text(encoding="utf-8") for path in [*scripts(), *PAGE.glob("*.html")])
    asked = set(re.findall(r'\bt\(\s*"([^"]+)"', source)) | set(
        re.findall(r'\bdata-(?:text|label|alt|title)="([^"]+)"', source)
    )
    assert asked <= set(catalogue("en")) and len(asked) > 80
    literal = set(re.findall(r'"([a-z_]+(?:\.[a-z_]+)+)"', source))
    prefixes = tuple(re.findall(r"`([a-z_.]+\.(?:no_)?)\$\{", source))
    by_code = "code.", "error."
    unused = {
        key
        for key in catalogue("en")
        if key not in literal | set(CATALOGUE) and not key.startswith((*prefixes, *by_code))
    }
    assert unused <= {"noscript"}


@pytest.mark.parametrize("name", ["index.html", "watch.html"])
def test_the_document_has_no_text_of_its_own(name: str) -> None:
    parser = Texts()
    parser.feed((PAGE / name).read_text(encoding="utf-8"))
    named = [(text, key) for text, key in parser.found if key is not None]
    assert named
    for text, key in named:
        assert catalogue("en")[str(key)] == text
    # Without scripts there is no catalogue; titles change as soon as the part is known.
    others = {text for text, key in parser.found if key is None}
    assert others <= {catalogue("en")["noscript"], catalogue("en")["watch.alt"], "arview", "arview: watch"}


def test_scripts_have_no_texts_of_their_own() -> None:
    found = []
    for path in scripts():
        for text, before in literals(path):
            is_class = re.search(
                r'(?:make\([^,()]+, |className = |classes = |button\("[\w.]+", |return button\([^,]+, )$', before
            )
            text = re.sub(r"\$\{[^}]*\}", "", text)
            is_shader = path.name == "shaders.js" or "<" in text or "/" in text.strip()
            if (
                PROSE.search(text)
                and not is_class
                and not is_shader
                and not TECHNICAL.match(text)
                and "new NoPhoto(" not in before
            ):
                found.append((path.relative_to(PAGE).as_posix(), text))
    assert [one for one in found if not _is_internal(*one)] == []


def _is_internal(path: str, text: str) -> bool:
    """Errors for developers, which nobody reads on the page."""
    return text.startswith(("the model has no component ", "the snapshot is kept until ")) or path.startswith("texts/")


def test_every_sentence_of_the_station_has_words_in_every_language() -> None:
    english, others = catalogue("en"), [catalogue(language) for language in LANGUAGES[1:]]
    assert len(CATALOGUE) > 100
    for key, text in CATALOGUE.items():
        assert english.get(key, text) == text
        for other in others:
            assert set(re.findall(r"\{(\w+)\}", other[key])) == set(re.findall(r"\{(\w+)\}", text)), key
    gone = {key for other in others for key in other if SENTENCES.match(key) and key not in {**CATALOGUE, **english}}
    assert gone == set()


def test_every_error_of_the_station_has_words_in_every_language() -> None:
    sources = [
        path.read_text(encoding="utf-8") for path in (ROOT / "src" / "arview" / "station" / "live").rglob("*.py")
    ]
    codes = {code for source in sources for code in re.findall(r'Refusal\(\s*\d+,\s*"(\w+)"', source)}
    assert {"disk_full", "no_token", "other_part"} <= codes and len(codes) > 20
    missing = {code for code in codes if f"error.{code}" not in catalogue("de")}
    assert missing == set()


def test_every_notice_has_words_even_where_its_text_is_unknown() -> None:
    """Its text is a sentence of the catalogue, or there is one for its code."""
    sources = [
        path.read_text(encoding="utf-8") for path in (ROOT / "src" / "arview" / "station" / "live").rglob("*.py")
    ]
    made = {
        code: key
        for source in sources
        for code, key in re.findall(r'Notice\(\s*"(\w+)", "\w+", sentence\("([\w.]+)"', source)
    }
    assert len(made) > 6
    for code in NOTICE_CODES:
        assert code in made or f"code.{code}" in catalogue("de"), code
