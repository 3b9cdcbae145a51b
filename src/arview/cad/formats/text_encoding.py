"""Encoding of names in text files that do not declare one: UTF-8, or what Windows has in some part of the world."""

from __future__ import annotations

import codecs
import re

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_RUN = re.compile(rb"[\x80-\xff]+")
_FOREIGN = re.compile(rb"(?<![A-Za-z])[\x80-\xff]{2,}+|[\x80-\xff]{2,}+(?![A-Za-z])")
_CYRILLIC = re.compile(rb"[\xab\xb9]?(?:[\xc0-\xdf\xa8]?[\xe0-\xff\xb8]+|[\xc0-\xdf]+)\xbb?|\xb9")
"""A word in CP1251: small, with a capital, or of capitals, maybe in quotes; or the sign of a number."""
_JAPANESE = re.compile(rb"(?:[\x81-\x9f\xe0-\xef][\x40-\x7e\x80-\xfc]){2,}")
_HANGUL = frozenset(
    "가개고구그기나너노다단대도동두둥드라레로록루리링마면모미바반베벨보볼부브블비사상샤서선소수스시아안어연오용우유이인일"
    "임자장재전접정제조종주중지징차체축치카커켓코크클타터토트파판패포품프플핀하형홀회후"
)
"""The commonest syllables: of those that letters of another language make by chance, few are among them."""
_CHINESE = (("gb2312", "gb18030"), ("big5", "big5"), ("gb18030", "gb18030"))
"""Encodings that are tried, and taken: simplified letters have no second bytes in ASCII, as Big5 has."""
MAX_LOST = 0.05
"""Share of bytes beyond ASCII that need not fit: names that were cut off, or the author's."""
LATIN = "cp1252"
COMMAS = "its numbers have decimal commas"


def text_encoding(data: bytes) -> str:
    """The encoding of a text: by its byte order mark, UTF-8 where it fits, else by what its words look like.

    Letters beyond ASCII stand alone in words of most European languages, whose other letters are ASCII. In a Cyrillic
    word small ones follow the first, or all are capitals; two Chinese letters look so once in twenty times.
    """
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return encoding
    lines = b"\n".join(line for line in data.split(b"\n") if not line.isascii())
    if _fits(lines, "utf-8"):
        return "utf-8"
    runs = _RUN.findall(lines)
    high = sum(map(len, runs))
    words = [run for run in runs if _CYRILLIC.fullmatch(run)]
    is_told = any(len(word) > 2 and word[-1] >= 0xE0 for word in words) or high > 5 or not _fits(lines, "gb2312")
    if is_told and max(map(len, words), default=0) > 2 and sum(map(len, words)) > 0.7 * high:
        return "cp1251"
    if sum(map(len, _JAPANESE.findall(lines))) > 0.5 * high and _fits(lines, "cp932"):
        return "cp932"
    if sum(map(len, _FOREIGN.findall(lines))) <= 0.5 * high:
        return LATIN
    letters = [letter for letter in lines.decode("cp949", errors="replace") if letter > "\x7f"]
    if sum(letter in _HANGUL for letter in letters) > 0.3 * len(letters) and min(letters) >= "가":
        return "cp949"
    return next((name for tried, name in _CHINESE if _fits(lines, tried)), LATIN)


def decode_text(data: bytes, encoding: str | None = None) -> str:
    """The text of bytes in an encoding, by default that of `text_encoding`; what cp1252 lacks becomes Latin-1's."""
    encoding = encoding or text_encoding(data)
    try:
        return data.decode(encoding)
    except UnicodeDecodeError:
        return data.decode("latin-1") if encoding == LATIN else data.decode(encoding, errors="replace")


def with_decimal_points(data: bytes, line: bytes) -> tuple[bytes, list[str]]:
    """A text with points for decimal commas in its lines that begin with a pattern, and a remark where it has some.

    Where there are points, too, a comma may stand between thousands: it is left, and is no number.
    """
    lines = re.compile(rb"^[ \t]*" + line + rb"[^\r\n]*", re.MULTILINE | re.IGNORECASE)
    found = b"\n".join(lines.findall(data)) if b"," in data else b""
    if not re.search(rb"\d,\d", found) or re.search(rb"\d\.\d", found):
        return data, []
    return lines.sub(lambda match: match[0].replace(b",", b"."), data), [COMMAS]


def _fits(data: bytes, encoding: str) -> bool:
    """Whether few bytes of a text are none in an encoding."""
    bad = data.decode(encoding, errors="replace").count("\ufffd")
    return bad <= MAX_LOST * sum(map(len, _RUN.findall(data)))
