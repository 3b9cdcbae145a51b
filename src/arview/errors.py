"""The errors arview raises on purpose: each message is one line that says what was wrong and what to do."""


class ArviewError(Exception):
    """Base of all errors that a user can cause or repair."""


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
