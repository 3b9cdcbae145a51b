"""The errors arview raises on purpose: each message is one line that says what was wrong and what to do."""

import re

_USER = re.compile(r"(\b[a-zA-Z][a-zA-Z0-9+.-]*://)[^\s\"'<>]*@")
_SECRETS = re.compile(
    r"([?&;](?:user(?:name)?|usr|login|pass(?:word|wd)?|pwd|pw|secret|token|api_?key|key|auth)=)[^&;\s\"'<>]+",
    re.IGNORECASE,
)


def without_credentials(text: str) -> str:
    """A text in whose addresses user names, passwords and keys are replaced by ``***``, to be shown or stored."""
    return _SECRETS.sub(r"\1***", _USER.sub(r"\1***@", text))


class ArviewError(Exception):
    """Base of all errors that a user can cause or repair. Its text never holds the password of an address."""

    def __str__(self) -> str:
        return without_credentials(super().__str__())


class InputError(ArviewError):
    """A file, folder, stream or value given by the user cannot be used as it is."""


class MismatchError(ArviewError):
    """Two inputs are fine by themselves but do not belong together (another model, size or version)."""


class MissingDependencyError(ArviewError):
    """A library or system package is absent; the message holds the command that installs it."""


class CannotMeasureError(ArviewError):
    """The inputs can be read, but what they show cannot be measured."""


class OutputError(ArviewError):
    """A result could not be written (read-only folder, full disk)."""
