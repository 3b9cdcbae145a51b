"""The sentences of tracking, labels and worker that pages say in their own language: all of them are recognised."""

from __future__ import annotations

import ast
import inspect
import re
from types import ModuleType

import pytest

from arview.core.messages import Phrase
from arview.overlay import labels, legend
from arview.station.capture import words
from arview.station.live.stream.phrases import CATALOGUE, messages_of, with_messages
from arview.station.walk import worker
from arview.tracking import diagnosis
from arview.tracking.identity import doubt, monitor

NO_SENTENCES = {"", "; ", "left", "right", "upper", "lower"}


def sentences(module: ModuleType, functions: str, names: str = "") -> set[str]:
    """Texts that functions return or that stand for a reason, with a number for each value; and module constants."""
    found = set()
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.FunctionDef) and re.search(functions, node.name):
            inside = [one.value for one in ast.walk(node) if isinstance(one, ast.Return) and one.value is not None]
            given = [one for one in ast.walk(node) if isinstance(one, ast.Assign)]
            inside += [one.value for one in given if "reason" in ast.unparse(one.targets[0])]
            found |= {text for one in inside for text in texts_in(one)}
        if names and isinstance(node, ast.Assign) and re.search(names, ast.unparse(node.targets[0])):
            found |= set(texts_in(node.value))
    return {text for text in found if " " in text}


def texts_in(node: ast.expr) -> list[str]:
    """The texts among the branches of an expression."""
    if isinstance(node, ast.Constant):
        return [node.value] if isinstance(node.value, str) else []
    if isinstance(node, ast.JoinedStr):
        return ["".join(str(one.value) if isinstance(one, ast.Constant) else "7" for one in node.values)]
    if isinstance(node, ast.IfExp):
        return [*texts_in(node.body), *texts_in(node.orelse)]
    if isinstance(node, ast.BoolOp):
        return [text for one in node.values for text in texts_in(one)]
    return []


@pytest.mark.parametrize(
    ("module", "functions", "names", "least"),
    [
        (diagnosis, "diagnose|outside_range|_too_|_partly|_low_contrast", "", 14),
        (monitor, "_result|_take_serial|_follow_named|.", "^CHECKING$", 4),
        (doubt, "^$", "^(ANOTHER_IN_VIEW|MOVED)$", 2),
    ],
)
def test_reasons_of_the_tracking_are_in_the_catalogue(
    module: ModuleType, functions: str, names: str, least: int
) -> None:
    found = sentences(module, functions, names)
    # The edge of a picture is named; what is said of nothing in view has its distances.
    found = {
        text.replace("at the 7 edge", "at the left edge").replace("picture7", "picture at the left edge")
        for text in found
    }
    found = {text.replace("7, 7 to 7 mm away", "nothing like the part in view, 7 to 7 mm away") for text in found}
    assert len(found) >= least, found
    unknown = {text for text in found if text not in messages_of([text])}
    assert unknown == set()


def test_texts_of_labels_are_in_the_catalogue() -> None:
    said = [labels.CHANGED, labels.UNVERIFIED, labels.UNCERTAIN, labels.OCCLUDED, labels.MEASURING]
    said += [f"measured, {labels.UNVERIFIED}", f"measured, {labels.UNCERTAIN}", f"seen now: {labels.CHANGED}"]
    said += [*legend._ENTRIES.values(), "Labels withheld", "one of two places", "one of 3 places", "≈ 3.1 mm away"]
    said += ["measured on SN 7, not on this one", "measured 45 d ago", "missing", "undetermined", "turned 90°"]
    said += ["MISSING", "DISPLACED", "NOT VERIFIED", "UNCERTAIN", "WITHHELD", "PASS", "NOT MEASURED"]
    assert set(messages_of(said)) == set(said)


def test_texts_of_the_worker_are_in_the_catalogue() -> None:
    found = re.findall(r'text=f?"([^"]+)"', inspect.getsource(worker))
    found = [re.sub(r"\{[^}]*\}+", "7", text) for text in found]
    plain = [text for text in found if "error" not in text and not text.startswith("7;")]
    assert len(plain) >= 4 and set(messages_of(plain)) == set(plain)


def test_a_document_has_key_and_values_of_its_sentences() -> None:
    document = {
        "type": "pose", "state": "lost", "reason": "too dark; mismatch: nut_2 not seen where expected", "remark": "",
        "labels": [{"evidence": "missing", "value": "", "word": "MISSING", "notes": ["as measured"]}],
        "name": "blurred",
    }  # fmt: skip
    told = with_messages(document)
    assert {key: told[key] for key in document} == document
    assert told["messages"] == {
        "too dark": {"key": "tracking.dark", "values": {}},
        "mismatch: nut_2 not seen where expected": {"key": "tracking.mismatch", "values": {"name": "nut_2"}},
        "MISSING": {"key": "label.missing", "values": {}},
        "as measured": {"key": "label.as_measured", "values": {}},
    }
    assert with_messages({"reason": "something else"}) == {"reason": "something else"}


def test_guided_capture_says_key_and_values() -> None:
    sides = [words.LEFT] * 3 + [words.ABOVE] * 2 + [words.RIGHT]
    hidden = words.hidden_message(["bracket_2"])
    assert hidden is not None
    message = words.BOTH(first=words.more_message(6, sides), second=hidden)
    assert message.text == "6 more: 3 from the left, 2 from above; bracket_2 is hidden from here"
    first = message.document()["values"]["first"]
    assert first["key"] == "capture.more_of" and first["values"]["sides"][0] == {
        "key": "capture.from", "values": {"count": 3, "side": {"key": "capture.left", "values": {}}},
    }  # fmt: skip
    assert words.lacking_message(1, True).text == "hidden from here; 1 more photo"
    with pytest.raises(ValueError, match="count"):
        words.MORE()


def test_no_phrase_hides_another() -> None:
    for number, phrase in enumerate(CATALOGUE):
        text = re.sub(r"\{count\}", "7", phrase.english)
        earlier = [one.key for one in CATALOGUE[:number] if isinstance(one, Phrase) and one.pattern.fullmatch(text)]
        assert earlier == [], (phrase.key, earlier)
