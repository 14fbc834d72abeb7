"""Recognises URLs, and displays them without parts that may be secret."""

import os
import re
from pathlib import Path
from urllib.parse import unquote

# Converting a URL to a `Path` removes one of the two slashes, so one is enough.
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+(?=.)")
_URL_IN_TEXT = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/+[^\s'\"<>]+")
_SECRET = re.compile(r"[@?#]")


def is_url(path: str | os.PathLike[str]) -> bool:
    """Return whether a name is a URL. The name of an existing local file is not one."""
    return bool(_URL.match(os.fspath(path))) and not os.path.lexists(path)


def full(path: str | os.PathLike[str]) -> str:
    """Return a complete URL.

    If it was converted to a `Path`, restore the missing slash.
    """
    return _URL.sub(_with_slashes, os.fspath(path), count=1)


def shown(path: str | os.PathLike[str]) -> str:
    """Return the name of a file for messages and results. Parts of a URL that may be
    secret are omitted."""
    if is_url(path):
        return _without_secrets(full(path))
    return os.fspath(path)


def cleaned(text: str) -> str:
    """Return the text of another program or server. URLs in it are shown without parts
    that may be secret."""
    return _URL_IN_TEXT.sub(_cleaned_match, text)


def beside(path: str | os.PathLike[str]) -> Path:
    """Return the path of a local file. For a URL, return the file's name as a path in
    the working directory."""
    if not is_url(path):
        return Path(path)
    return Path(os.path.basename(unquote(_place_of(full(path))[1])))


def folder_of(path: str | os.PathLike[str]) -> str:
    """Return the name of the folder that contains a local file or a file at a URL. For
    the root, it is empty."""
    if not is_url(path):
        return Path(path).resolve().parent.name
    return os.path.basename(os.path.dirname(unquote(_place_of(full(path))[1])))


def _with_slashes(match: re.Match[str]) -> str:
    scheme = match[1]
    if scheme == "file":
        return f"{scheme}:///"
    return f"{scheme}://"


def _cleaned_match(match: re.Match[str]) -> str:
    text = match[0]
    if not _SECRET.search(text):
        return text
    url = text.rstrip(":;,.)]}")
    return _without_secrets(full(url)) + text[len(url) :]


def _without_secrets(url: str) -> str:
    scheme = url.partition("://")[0]
    host, place = _place_of(url)
    return f"{scheme}://{host}{place}"


def _place_of(url: str) -> tuple[str, str]:
    """Return the host of a URL, including its port, and the path."""
    address = url.partition("://")[2]
    host = re.split("[/?#]", address, maxsplit=1)[0]
    if "@" in host:
        start = host.rindex("@") + 1
    elif "@" in address and not re.fullmatch(r"(\[.*\]|[^:]*)(:[0-9]*)?", host):
        # The password contains a character that looks like the end of the host.
        start = address.rindex("@") + 1
    else:
        start = 0
    shown_part = re.split("[?#]", address[start:], maxsplit=1)[0]
    host, slash, path = shown_part.partition("/")
    return host, slash + path
