"""Converts errors about URLs to errors of the right type, with one line that contains
no secrets."""

import contextlib
import errno
import http
import socket
import ssl
from collections.abc import Iterator

from v3dg._urls.names import cleaned, shown

_AGAIN = "try again later"
_LONGEST = 200  # number of characters of a library's message that are shown


class DownloadError(Exception):
    """The reason why a file cannot be downloaded, and the type of the error that users
    get. The text does not contain the URL."""

    def __init__(self, kind: type[OSError] | type[ValueError], text: str) -> None:
        super().__init__(text)
        self.kind = kind


def status_error(status: int) -> DownloadError:
    """Return the problem of an answer whose status code is an error."""
    try:
        # The server's own phrase is not used, as it may be any text.
        phrase = f"{status} {http.HTTPStatus(status).phrase}"
    except ValueError:
        phrase = str(status)
    kind, advice = _kind_of_status(status)
    return DownloadError(kind, f"the server answered {phrase}; {advice}")


def _kind_of_status(status: int) -> tuple[type[OSError], str]:
    if status in (404, 410):
        return FileNotFoundError, "check the address"
    if status in (401, 403):
        return (
            PermissionError,
            "check the user, the password or the signature in the URL; a signed URL may have "
            "expired",
        )
    if status in (408, 504):
        return TimeoutError, _AGAIN
    if status == 429 or status >= 500:
        return ConnectionError, _AGAIN
    return ConnectionError, "expected a file; check the address"


@contextlib.contextmanager
def naming_errors(url: str) -> Iterator[None]:
    """Convert any error of a package for URLs to a one-line error, without the secrets
    in its text."""
    try:
        yield
    except (ImportError, MemoryError):
        raise
    except Exception as error:
        # The original error is not chained: its text, and those of its causes, may
        # contain the whole URL.
        raise _failure_of(url, error) from None


def _failure_of(url: str, error: Exception) -> Exception:
    problem = error
    if not isinstance(problem, DownloadError):
        problem = _problem_of(url, error)
    name = f"{shown(url)}: "
    return problem.kind(name + str(problem).removeprefix(name))


def _problem_of(url: str, error: Exception) -> DownloadError:
    """Return the problem that caused an error of the system, of fsspec or of aiohttp.
    The types of aiohttp are recognised by their names, because aiohttp may not be
    installed."""
    names = {kind.__name__ for kind in type(error).__mro__}
    cause = error
    # If aiohttp could not connect, `os_error` is the error of the operating system.
    system_error = getattr(error, "os_error", None)
    if isinstance(system_error, OSError):
        cause = system_error
    text = _text_of(url, error)
    if isinstance(error, ValueError) and "ClientError" not in names:
        return DownloadError(ValueError, text)
    if isinstance(cause, ssl.SSLError | ssl.CertificateError) or "ClientSSLError" in names:
        certificate = getattr(error, "certificate_error", cause)
        reason = (
            getattr(certificate, "verify_message", "")
            or getattr(certificate, "reason", "")
            or "no TLS"
        )
        return DownloadError(
            ConnectionError, f"no secure connection ({reason}); check the server's certificate"
        )
    if isinstance(cause, socket.gaierror):
        return DownloadError(
            ConnectionError, "the name of the host is unknown; check the address and the network"
        )
    # Before Python 3.11, asyncio's TimeoutError is not the built-in one.
    if isinstance(cause, TimeoutError) or "TimeoutError" in names:
        return DownloadError(TimeoutError, f"the server did not answer in time; {_AGAIN}")
    answer = _problem_of_answer(names)
    if answer is not None:
        return answer
    if isinstance(cause, ConnectionError) or "ClientError" in names:
        return _problem_of_connection(cause, text)
    return _problem_elsewhere(cause, text)


def _problem_of_connection(error: Exception, text: str) -> DownloadError:
    if isinstance(error, ConnectionRefusedError):
        return DownloadError(
            ConnectionRefusedError, "the connection was refused; check the host and the port"
        )
    return DownloadError(
        ConnectionError, f"the connection was lost or could not be made ({text}); {_AGAIN}"
    )


def _problem_of_answer(names: set[str]) -> DownloadError | None:
    """Return the problem of an incomplete or invalid answer, by the type names of an
    error; None for other errors."""
    if "ClientPayloadError" in names:
        return DownloadError(ConnectionError, f"the server's answer was incomplete; {_AGAIN}")
    if names & {"ClientResponseError", "BadHttpMessage"}:
        return DownloadError(
            ConnectionError, "the server's answer is not valid HTTP; check the address"
        )
    return None


def _problem_elsewhere(error: Exception, text: str) -> DownloadError:
    if isinstance(error, FileNotFoundError):
        return DownloadError(FileNotFoundError, "there is no such file; check the address")
    if isinstance(error, PermissionError):
        return DownloadError(
            PermissionError, f"reading the file is not permitted ({text}); check the credentials"
        )
    if isinstance(error, IsADirectoryError):
        return DownloadError(IsADirectoryError, "expected a file, got a folder")
    return DownloadError(OSError, f"expected a file, got {type(error).__name__}: {text}")


def _text_of(url: str, error: Exception) -> str:
    text = " ".join(str(error).replace(url, shown(url)).split())
    return cleaned(text)[:_LONGEST] or type(error).__name__


def no_room(folder: str, error: OSError | None = None) -> DownloadError:
    """Return the problem of a disk that is too full for temporary files."""
    reason = "no space left"
    if error is not None:
        reason = error.strerror or reason
        name = errno.errorcode.get(error.errno or 0)
        if name is not None:
            reason += f" ({name})"
    return DownloadError(
        OSError,
        (f"no space for the file in {folder}: {reason}; set TMPDIR to a folder with more space"),
    )
