"""Requests of the clients and the meaning of the responses."""

import contextlib
import csv
import errno
import hashlib
import io
import json
import os
import pathlib
import re
import secrets
import threading
import urllib.parse
from typing import Any, NamedTuple

import numpy

from ._molmesh import Error

# Statuses after which the same request may succeed: 424 archive unavailable, 429 quota, 503 overload; 502 comes from
# proxies during a restart.
RETRY_STATUSES = (424, 429, 502, 503)

ENDED = ("successful", "failed", "dismissed")
DIGEST = re.compile(r"[0-9a-f]{64}")
PDB_ID = re.compile(r"[0-9][0-9a-z]{3}|pdb_[0-9a-z]{8}", re.IGNORECASE)
# Extensions of compressed files, after those of their content.
COMPRESSED = (".gz", ".zst", ".zstd")
# Tables have an apostrophe before a text that a spreadsheet would execute.
ESCAPE = re.compile(r"\A'(?=[=+\-@\t\r\n])")

# Columns of tables of areas that are texts, and the types of those that are integers, as `molmesh.areas` has them.
# Other columns are areas.
TEXTS = {"name", "element", "residue_name", "insertion_code", "chain"}
INTEGERS = {"index": "u4", "residue_number": "i4", "model": "i4", "atoms": "u8"}


class Request(NamedTuple):
    """Request to the service."""

    method: str
    path: str
    query: list[tuple[str, str]] = []
    headers: dict[str, str] = {}
    # Arguments of httpx for the body.
    body: dict[str, Any] = {}
    # `Output` that gets the content of a response with status 200; None for memory.
    output: Any = None
    # True if that content is left to `Read` steps.
    is_stream: bool = False
    # Longest time without progress, s.
    timeout: float = 0.0


class Response(NamedTuple):
    """Response of the service. The content is empty if the output of the request has it, and a stream if the request is
    for one.
    """

    status: int
    headers: Any
    content: Any


class Read(NamedTuple):
    """Wait for the next piece of a stream; it is empty at the end."""

    stream: Any


class Item(NamedTuple):
    """One of several results of an operation, which the client passes on before it continues the operation."""

    value: Any


class Pause(NamedTuple):
    """Time to wait, s."""

    seconds: float


class MapResult(NamedTuple):
    """Result of ``map()`` for one file.

    Attributes
    ----------
    source : str, os.PathLike or bytes
        The file, as it was given to ``map()``.
    content : bytes, pathlib.Path or None
        The mesh or picture, or with ``save`` the path of its file; None after an error.
    error : Exception or None
        The exception that a call for this file alone raises.
    """

    source: Any
    content: Any = None
    error: Any = None


def query_text(value):
    """Returns a value as a query spells it: the items of a sequence are separated by commas."""
    if isinstance(value, (bool, numpy.bool_)):
        return str(value).lower()
    try:
        len(value)
    except TypeError:
        return str(value)
    return str(value) if isinstance(value, (str, bytes)) else ",".join(map(query_text, value))


def query_pairs(parameters):
    """Returns the pairs of a query, without parameters that are None. Their order does not depend on the call."""
    return sorted((name, query_text(value)) for name, value in parameters.items() if value is not None)


def read(file):
    """Returns the content of a file, which is a path or bytes."""
    if isinstance(file, (bytes, bytearray, memoryview)):
        return bytes(file)
    if isinstance(file, (str, os.PathLike)):
        return pathlib.Path(file).read_bytes()
    raise TypeError(f"found {type(file).__name__}, expected a path or bytes")


def name_of(source):
    """Returns the name of a structure in the service: digest, or id of an archive entry; None for a file."""
    if isinstance(source, str) and DIGEST.fullmatch(source):
        return {"structure": source}
    if isinstance(source, str) and PDB_ID.fullmatch(source):
        return {"pdb_id": source.lower()}
    return None


class Input:
    """Structure of a request: content of a file, digest of a stored structure, or id of an archive entry."""

    def __init__(self, source):
        self.name = name_of(source)
        self.content = None if self.name else read(source)

    def body(self, map=None):
        """Returns the body of a request, with a map or without."""
        if map is None:
            return {"json": self.name} if self.name else {"content": self.content}
        if self.name:
            raise ValueError("a map needs a structure file: a stored structure or an archive entry has no place for it")
        return {"files": {"file": ("structure", self.content), "map": ("map", map)}}

    def digest(self, *others):
        """Returns a digest of the structure and of further parts of a request."""
        named = json.dumps(self.name).encode() if self.name else b""
        parts = [named, self.content or b"", *others]
        return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def output_stem(source):
    """Returns the name of an output without its extension. Bytes have the name of their digest."""
    if isinstance(source, (bytes, bytearray, memoryview)):
        return hashlib.sha256(source).hexdigest()
    path = pathlib.Path(source)
    return (path.with_suffix("") if path.suffix.lower() in COMPRESSED else path).stem


def check_folder(path, method):
    """Rejects the output of several files unless it is an existing folder."""
    if not os.path.isdir(path):
        raise NotADirectoryError(errno.ENOTDIR, f"the output of {method}() must be an existing folder", str(path))


class Output:
    """Destination of a result: memory, or a new file that replaces `path` at the end of a ``with`` block. After an
    error, `path` is as it was before.
    """

    def __init__(self, path=None):
        self.path, self.file, self.is_discarded, self.lock = path, None, False, threading.Lock()
        if path is not None:
            # Resolves links, so that the target is replaced instead of the link.
            self.target = pathlib.Path(os.path.realpath(path))
            if not self.target.parent.is_dir():
                raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
            if self.target.exists() and not self.target.is_file():
                raise OSError(f"{path} is not a regular file")
            self.staged = self.target.with_name(f".molmesh-{secrets.token_hex(8)}.part")

    def restart(self):
        """Returns the file, which is empty. An earlier response may have been incomplete."""
        if self.path is None:
            return io.BytesIO()
        with self.lock:
            if self.is_discarded:
                raise OSError(f"{self.path} is not needed any more")
            if self.file is None:
                try:
                    self.file = open(self.staged, "xb")
                except OSError as error:
                    raise OSError(error.errno, error.strerror, str(self.path)) from None
            self.file.seek(0)
            self.file.truncate()
            return self.file

    def discard(self):
        """Removes the file unless it is complete. Any thread may do so."""
        with self.lock:
            self.is_discarded = True
            if self.file is not None:
                # Windows removes no file that another thread writes.
                with contextlib.suppress(PermissionError):
                    self.staged.unlink(missing_ok=True)

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        if self.file is None:
            return
        try:
            self.file.close()
            with self.lock:
                if kind is None and not self.is_discarded:
                    os.replace(self.staged, self.target)
        finally:
            self.discard()

    def result(self, content):
        """Returns the result of an operation: the content, or the path that has it."""
        return content if self.path is None else pathlib.Path(self.path)


def to_exception(problem):
    """Returns the exception of a problem document: that of the local functions."""
    kind, message = problem["type"].rpartition("/")[2], str(problem.get("detail") or problem.get("title"))
    if kind == "bad-parameter":
        return ValueError(message)
    if problem.get("status") == 500:
        message += f" (request {problem.get('instance')})"
    error = Error(message)
    error.type = kind
    error.value = problem.get("value", problem.get("actual"))
    for field in ("limit", "suggested_resolution", "line", "column"):
        setattr(error, field, problem.get(field))
    return error


def parse_json(response):
    """Returns the JSON document of a response, None if it is none."""
    try:
        return json.loads(response.content)
    except ValueError:
        return None


def parse_problem(response):
    """Returns the problem document of a response, None if it has none."""
    problem = parse_json(response)
    return problem if isinstance(problem, dict) and isinstance(problem.get("type"), str) else None


def retry_delay(response):
    """Returns the seconds until a rejected request may be sent again, None if it must not be repeated."""
    if response.status not in RETRY_STATUSES:
        return None
    seconds = response.headers.get("retry-after", "")
    # Proxies and rejected connections give no time. Without it, an archive or a quota is not available soon.
    return float(seconds) if seconds.isdecimal() else 1.0 if response.status in (502, 503) else None


def is_spent(job):
    """Returns true if a new job may end differently: this one was cancelled, or failed because of the service. A batch
    is spent if it has ended, and a job was cancelled or one of the files on the first page is spent.
    """
    if "members" in job:
        return job["status"] in ENDED and (job["counts"]["dismissed"] > 0 or any(map(is_spent, job["members"])))
    problem = job["problem"] or {}
    return job["status"] == "dismissed" or (job["status"] == "failed" and problem.get("status", 500) >= 500)


def parse_areas(content):
    """Returns the columns of a table of areas."""
    names, *rows = csv.reader(io.StringIO(content.decode()))
    table = {}
    for name, column in zip(names, zip(*rows) if rows else [()] * len(names)):
        if name in TEXTS:
            table[name] = numpy.array([ESCAPE.sub("", text) for text in column], dtype=str)
        else:
            table[name] = numpy.array(column, dtype=INTEGERS.get(name, "f8"))
    return table


def job_path(id):
    """Returns the path of a job."""
    return f"/v1/jobs/{urllib.parse.quote(id, safe='')}"


def batch_path(id):
    """Returns the path of a batch."""
    return f"/v1/batches/{urllib.parse.quote(id, safe='')}"
