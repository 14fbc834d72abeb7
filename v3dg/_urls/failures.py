"""Errors of URLs that cannot be read: each has the right type, and one line without
secrets."""

import contextlib
import errno
import http
import socket
import ssl
from collections.abc import Iterator

from v3dg._urls.names import cleaned, shown

_AGAIN = "try again later"
_LONGEST = 200  # characters of a library's message


class Problem(Exception):
    """The reason why a file cannot be fetched, and the type of the error; the text does
    not contain the URL."""

    def __init__(self, kind: type[OSError] | type[ValueError], text: str) -> None:
        super().__init__(text)
        self.kind = kind


def status_problem(status: int) -> Problem:
    """Return the problem of an answer whose status is not a success."""
    try:
        phrase = f"{status} {http.HTTPStatus(status).phrase}"  # a server's own text may be anything
    except ValueError:
        phrase = str(status)
    kind, advice = _kind_of_status(status)
    return Problem(kind, f"the server answered {phrase}; {advice}")


def _kind_of_status(status: int) -> tuple[type[OSError], str]:
    if status in (404, 410):
        return FileNotFoundError, "check the address"
    if status in (401, 403):
        return (
            PermissionError,
            "check user, password or signature in the URL; a signed one may have expired",
        )
    if status in (408, 504):
        return TimeoutError, _AGAIN
    if status == 429 or status >= 500:
        return ConnectionError, _AGAIN
    return ConnectionError, "expected a file; check the address"


@contextlib.contextmanager
def naming_errors(url: str) -> Iterator[None]:
    """Turn any error of a package for URLs into one line, without the secrets in its
    text."""
    try:
        yield
    except (ImportError, MemoryError):
        raise
    except Exception as error:
        # The other error is not shown: its text, and those of its causes, may have the
        # whole URL.
        raise _failure_of(url, error) from None


def _failure_of(url: str, error: Exception) -> Exception:
    problem = error
    if not isinstance(problem, Problem):
        problem = _problem_of(url, error)
    name = f"{shown(url)}: "
    return problem.kind(name + str(problem).removeprefix(name))


def _problem_of(url: str, error: Exception) -> Problem:
    """Return the problem behind an error of the system, of fsspec or of aiohttp, whose
    types are recognised by name."""
    names = {kind.__name__ for kind in type(error).__mro__}
    cause = error
    # Aiohttp's reason why a connection could not be made.
    system_error = getattr(error, "os_error", None)
    if isinstance(system_error, OSError):
        cause = system_error
    text = _text_of(url, error)
    if isinstance(error, ValueError) and "ClientError" not in names:
        return Problem(ValueError, text)
    if isinstance(cause, ssl.SSLError | ssl.CertificateError) or "ClientSSLError" in names:
        certificate = getattr(error, "certificate_error", cause)
        reason = (
            getattr(certificate, "verify_message", "")
            or getattr(certificate, "reason", "")
            or "no TLS"
        )
        return Problem(
            ConnectionError, f"no secure connection ({reason}); check the server's certificate"
        )
    if isinstance(cause, socket.gaierror):
        return Problem(
            ConnectionError, "the name of the host is not known; check the address and the network"
        )
    # Before 3.11, the timeout of asyncio is another type than that of the system.
    if isinstance(cause, TimeoutError) or "TimeoutError" in names:
        return Problem(TimeoutError, f"the server did not answer in time; {_AGAIN}")
    answer = _problem_of_answer(names)
    if answer is not None:
        return answer
    if isinstance(cause, ConnectionError) or "ClientError" in names:
        return _problem_of_connection(cause, text)
    return _problem_elsewhere(cause, text)


def _problem_of_connection(error: Exception, text: str) -> Problem:
    if isinstance(error, ConnectionRefusedError):
        return Problem(ConnectionRefusedError, "the connection was refused; check host and port")
    return Problem(
        ConnectionError, f"the connection was lost or could not be made ({text}); {_AGAIN}"
    )


def _problem_of_answer(names: set[str]) -> Problem | None:
    """Return the problem of a received answer, by the names of an error's types; None
    for other errors."""
    if "ClientPayloadError" in names:
        return Problem(ConnectionError, f"the server's answer was not complete; {_AGAIN}")
    if names & {"ClientResponseError", "BadHttpMessage"}:
        return Problem(ConnectionError, "the server's answer is not valid HTTP; check the address")
    return None


def _problem_elsewhere(error: Exception, text: str) -> Problem:
    if isinstance(error, FileNotFoundError):
        return Problem(FileNotFoundError, "there is no such file; check the address")
    if isinstance(error, PermissionError):
        return Problem(PermissionError, f"the file may not be read ({text}); check the credentials")
    if isinstance(error, IsADirectoryError):
        return Problem(IsADirectoryError, "expected a file, got a folder")
    return Problem(OSError, f"expected a file, got {type(error).__name__}: {text}")


def _text_of(url: str, error: Exception) -> str:
    text = " ".join(str(error).replace(url, shown(url)).split())
    return cleaned(text)[:_LONGEST] or type(error).__name__


def no_room(folder: str, error: OSError | None = None) -> Problem:
    """Return the problem of a full disk for temporary files."""
    reason = "no space left"
    if error is not None:
        reason = error.strerror or reason
        name = errno.errorcode.get(error.errno or 0)
        if name is not None:
            reason += f" ({name})"
    return Problem(
        OSError, f"no room for it in {folder}: {reason}; set TMPDIR to a folder with more"
    )
