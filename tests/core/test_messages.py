"""Messages: made once with key and values, from one catalogue of which every sentence is used."""

from __future__ import annotations

import ast
import copy
import json
import pickle
import re

import pytest

from arview.core.messages import CATALOGUE, Message, joined, key_of, messages_of, sentence, with_messages
from arview.station.capture import words
from arview.station.walk.records import WalkState
from helpers.paths import ROOT


def test_a_sentence_is_its_text_and_knows_its_key_and_values() -> None:
    far = sentence("tracking.far", distance="712", limit="640")
    assert far == "too far: about 712 mm, declared up to 640 mm" and json.dumps(far) == f'"{far}"'
    assert key_of(far) == "tracking.far" and key_of("too dark") == ""
    for same in (copy.deepcopy(far), pickle.loads(pickle.dumps(far))):
        assert isinstance(same, Message) and same.document() == far.document()
    assert far.document() == {"key": "tracking.far", "values": {"distance": "712", "limit": "640"}}
    with pytest.raises(KeyError):
        sentence("tracking.far", distance="712")
    with pytest.raises(KeyError):
        sentence("tracking.nothing_of_the_kind")


def test_a_document_has_key_and_values_of_its_sentences() -> None:
    reasons = joined(["", sentence("tracking.dark"), sentence("tracking.mismatch", name="nut_2")])
    document = {
        "type": "pose",
        "reason": reasons,
        "remark": "",
        "labels": [
            {"evidence": "missing", "word": sentence("label.missing"), "notes": (sentence("label.as_measured"),)}
        ],
        "name": "blurred",
    }
    told = with_messages(document)
    assert {key: told[key] for key in document} == document
    assert told["reason"] == "too dark; mismatch: nut_2 not seen where expected"
    assert told["messages"] == {
        "too dark": {"key": "tracking.dark", "values": {}},
        "mismatch: nut_2 not seen where expected": {"key": "tracking.mismatch", "values": {"name": "nut_2"}},
        "MISSING": {"key": "label.missing", "values": {}},
        "as measured": {"key": "label.as_measured", "values": {}},
    }
    assert with_messages({"reason": "something else"}) == {"reason": "something else"}
    assert joined(["a reason"]) == "a reason" and joined([]) == ""


def test_sentences_within_sentences_keep_their_keys() -> None:
    left, above, right = (sentence(f"capture.{side}") for side in ("left", "above", "right"))
    hidden = words.hidden_message(["bracket_2"])
    assert hidden is not None
    more = words.more_message(6, [left] * 3 + [above] * 2 + [right])
    message = sentence("capture.both", first=more, second=hidden)
    assert message == "6 more: 3 from the left, 2 from above, 1 from elsewhere; bracket_2 is hidden from here"
    first = message.document()["values"]["first"]
    assert first["key"] == "capture.more_of"
    assert first["values"]["sides"][0] == {
        "key": "capture.from",
        "values": {"count": 3, "side": {"key": "capture.left", "values": {}}},
    }
    assert words.lacking_message(1, True) == "hidden from here; 1 more photo"


def test_the_state_of_a_job_keeps_its_sentence_in_its_file() -> None:
    state = WalkState(text=sentence("walk.provisional", count=9, placed=8))
    read = WalkState.of_document(json.loads(json.dumps(state.document())))
    assert read == state and messages_of(read.text) == messages_of(state.text) != {}
    assert (
        WalkState.of_document({"stage": "failed", "text": "the photos show no part"}).text == "the photos show no part"
    )


def test_every_sentence_is_said_somewhere_and_no_other() -> None:
    said, prefixes = set(), set()
    for path in (ROOT / "src" / "arview").rglob("*.py"):
        if path.name == "messages.py" and path.parent.name == "core":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                said.update({node.value} & CATALOGUE.keys())
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "sentence":
                if isinstance(node.args[0], ast.JoinedStr):
                    prefixes.add(str(node.args[0].values[0].value))  # type: ignore[attr-defined]
                elif isinstance(node.args[0], ast.Constant):
                    assert node.args[0].value in CATALOGUE, (path, node.lineno)
    assert len(said) > 80 and 3 <= len(prefixes) <= 13
    assert {key for key in CATALOGUE if key not in said and not key.startswith(tuple(prefixes))} == set()


def test_values_of_sentences_have_names() -> None:
    assert len(CATALOGUE) > 100
    for key, text in CATALOGUE.items():
        assert re.fullmatch(r"[a-z]+\.[a-z_]+\d?", key) and "{}" not in text
