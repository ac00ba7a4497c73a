"""What can end a run, each with the exit code the README promises."""

import contextlib
from collections.abc import Iterator


def printable(text: str) -> str:
    """Returns lines that a terminal shows as they are: it obeys nothing in them.

    A name or a text from the folder of a stranger may hold control characters.
    """
    safe = (x if x == "\n" or x.isprintable() else ascii(x)[1:-1] for x in text)
    return "".join(safe)


class RunEnd(BaseException):
    """What ends a run and is not a bug; its message is one line for the user."""

    exit_code = 1

    def __str__(self) -> str:
        return printable(super().__str__()).replace("\n", "\\n")


class RunError(RunEnd, Exception):
    """A failure that is not a bug."""


class UsageError(RunError):
    """A flag or a combination of flags that cannot work."""

    exit_code = 2


class CheckpointError(RunError):
    """A checkpoint that is missing, damaged, incompatible or locked."""

    exit_code = 3


class DivergedError(RunError):
    """A model that is no longer finite, or a robot that is not from the start."""

    exit_code = 4


class StorageError(RunError):
    """A disk that is full, read-only or not there."""

    exit_code = 5


class OutOfMemoryError(RunError):
    """A plan too large for the device."""

    exit_code = 6


class InterruptedRun(RunEnd, KeyboardInterrupt):
    """A signal; the same command goes on from the last checkpoint.

    It may be raised anywhere, and is no Exception, as others forgive those: jax, for
    one, where it writes to its cache. It is a KeyboardInterrupt, as asyncio lets that
    through. Orbax saves in asyncio, which logs any other error of a callback, and
    forgets it.
    """

    exit_code = 75


class StoppedTogether(InterruptedRun):
    """A signal that all processes know of, and stop for at the same point."""


class ExitCode(int):
    """The exit code of an error, which it keeps until the process is gone.

    Programs of XLA that still run may use what the frames of the error hold.
    """

    error: RunEnd

    def __new__(cls, error: RunEnd) -> "ExitCode":
        """Takes the number from the error."""
        code = super().__new__(cls, error.exit_code)
        code.error = error
        return code


def stop_behind(error: BaseException | None) -> InterruptedRun | None:
    """Returns the signal that an error comes from, if it does.

    C code that calls Python and gets an exception back may raise one of its own.
    """
    while error is not None and not isinstance(error, InterruptedRun):
        error = error.__cause__
    return error and type(error)(*error.args)


def last_line(error: RunEnd) -> str:
    """Returns what the user is told of the end of a run."""
    if isinstance(error, InterruptedRun):
        return (
            f"stopped: {error}; at most the trial under way is lost. Continue with the "
            "same command."
        )
    return f"error: {error}"


def reason(error: BaseException) -> str:
    """Returns in one line why a run ended."""
    if isinstance(error, RunEnd):
        return str(error)
    line, *_ = [*str(error).splitlines(), ""]
    return f"{type(error).__name__}: {line}".rstrip(": ")


@contextlib.contextmanager
def storage_errors(doing: str) -> Iterator[None]:
    """Turns an OSError into a StorageError: `cannot <doing> (<reason>). ...`."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise StorageError(
            f"cannot {doing} ({reason}). Free the disk, check its permissions, or "
            "choose another run directory."
        ) from error
