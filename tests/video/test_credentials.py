"""Passwords in addresses of streams: never in an error, a name, a message or the name of a file."""

from __future__ import annotations

import pytest

from arview.cli.annotate import _default_output
from arview.cli.common import say
from arview.errors import InputError, without_credentials
from arview.video import open_source

SECRETS = ("jane", "s3cret", "p@ss")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("rtsp://jane:s3cret@host:554/1", "rtsp://***@host:554/1"),
        ("rtsp://jane:p@ss/w@host/1: no answer", "rtsp://***@host/1: no answer"),
        ("no http://jane@host and 'https://jane:s3cret@b/c'", "no http://***@host and 'https://***@b/c'"),
        ("rtsp://host/live?user=jane&password=s3cret&channel=1", "rtsp://host/live?user=***&password=***&channel=1"),
        ("http://host/x?usr=jane&PWD=s3cret", "http://host/x?usr=***&PWD=***"),
        ("rtsp://host/1", "rtsp://host/1"),
        ("write to a@b.c", "write to a@b.c"),
    ],
)
def test_credentials_are_masked_and_nothing_else(text: str, shown: str) -> None:
    assert without_credentials(text) == shown
    assert str(InputError(text)) == shown


@pytest.mark.slow
def test_a_stream_that_cannot_be_opened_does_not_tell_its_password(capfd: pytest.CaptureFixture[str]) -> None:
    address = "rtsp://jane:s3cret@127.0.0.1:9/live?password=s3cret"
    with pytest.raises(InputError) as raised, open_source(address, open_timeout_s=3.0) as source:
        list(source)
    assert not any(secret in f"{raised.value} {raised.value.args}" for secret in SECRETS)
    say(f"reading {address}")
    captured = capfd.readouterr()
    assert "rtsp://***@127.0.0.1:9" in captured.err
    assert not any(secret in captured.out + captured.err for secret in SECRETS)


def test_the_default_name_of_a_video_has_no_password() -> None:
    for address in ("rtsp://jane:s3cret@cam.local", "rtsp://jane:p@ss@cam.local/live?user=jane&password=s3cret"):
        name = _default_output(address)
        assert name.endswith("_annotated.mp4") and not any(secret in name for secret in SECRETS)
