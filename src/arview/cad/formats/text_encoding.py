"""Encoding of names in text files that do not declare one: UTF-8, GB18030 or Windows' Latin-1."""

from __future__ import annotations

import codecs
import re

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_WORD = re.compile(rb"[A-Za-z\x80-\xff]*[\x80-\xff][A-Za-z\x80-\xff]*")
_HIGH = re.compile(rb"[\x80-\xff]")
LATIN = "cp1252"


def text_encoding(data: bytes) -> str:
    """The encoding of a text: by its byte order mark, UTF-8 where it is valid, else GB18030 or Latin-1.

    Letters beyond ASCII are a minority in words of European languages, whose other letters are ASCII. Chinese words
    hold none, so GB18030 is taken where the text is valid in it and most letters of such words are beyond ASCII.
    """
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return encoding
    if _is_valid(data, "utf-8"):
        return "utf-8"
    words = _WORD.findall(data)
    high = sum(len(_HIGH.findall(word)) for word in words)
    plain = sum(map(len, words)) - high
    return "gb18030" if high > plain and _is_valid(b"\n".join(words), "gb18030") else LATIN


def decode_text(data: bytes, encoding: str | None = None) -> str:
    """The text of bytes in an encoding, by default that of `text_encoding`; bytes that it lacks become Latin-1's."""
    encoding = encoding or text_encoding(data)
    try:
        return data.decode(encoding)
    except UnicodeDecodeError:
        return data.decode("latin-1")


def with_decimal_points(data: bytes, line: bytes) -> tuple[bytes, list[str]]:
    """A text with points for decimal commas in its lines that begin with a pattern, and a remark where it has some.

    Where there are points, too, a comma may stand between thousands: it is left, and is no number.
    """
    lines = re.compile(rb"^[ \t]*" + line + rb"[^\r\n]*", re.MULTILINE | re.IGNORECASE)
    found = b"\n".join(lines.findall(data)) if b"," in data else b""
    if not re.search(rb"\d,\d", found) or re.search(rb"\d\.\d", found):
        return data, []
    return lines.sub(lambda match: match[0].replace(b",", b"."), data), ["its numbers have decimal commas"]


def _is_valid(data: bytes, encoding: str) -> bool:
    try:
        data.decode(encoding)
    except UnicodeDecodeError:
        return False
    return True
