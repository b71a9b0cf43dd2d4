"""Archives of batches: of the files that a request sends, and of the results. Like ``_session``, this module does not
use the network.
"""

import contextlib
import hashlib
import io
import json
import os
import pathlib
import tarfile
import tempfile
from collections.abc import Mapping
from typing import Any, NamedTuple

from ._messages import Read, name_of, read

# Size above which an archive is a temporary file, and of the pieces in which files are sent and written, bytes.
SPOOLED, PIECE = 8 << 20, 64 << 10
# Size of the blocks of a tar archive, bytes.
BLOCK = 512


class BatchInput(NamedTuple):
    """Body of a request for a batch as arguments of httpx, its headers, and a digest of the names and contents."""

    body: dict[str, Any]
    headers: dict[str, str]
    digest: bytes


class FileBody:
    """Content of an open file in pieces, from its start again for each request."""

    def __init__(self, file):
        self.file = file

    def __iter__(self):
        self.file.seek(0)
        while piece := self.file.read(PIECE):
            yield piece

    async def __aiter__(self):
        for piece in self:
            yield piece


@contextlib.contextmanager
def batch_input(files):
    """Yields the input of a batch: an archive of files, or a list of the ids of archive entries."""
    sources = files if isinstance(files, Mapping) else list(files)
    # The names in a dictionary are those of files.
    names = [] if isinstance(files, Mapping) else [name_of(source) for source in sources]
    if any(name and "pdb_id" not in name for name in names):
        raise ValueError("a batch has no place for stored structures: expected files, or ids of archive entries")
    if any(names):
        if not all(names):
            number = names.index(None)
            raise ValueError(f"a batch has files or ids of archive entries, not both: source {number} is a file")
        ids = [name["pdb_id"] for name in names]
        yield BatchInput({"json": {"pdb_ids": ids}}, {}, json.dumps(ids).encode())
        return
    with tempfile.SpooledTemporaryFile(SPOOLED) as file:
        digest = write_archive(file, files_by_name(sources))
        headers = {"Content-Length": str(file.tell()), "Content-Type": "application/octet-stream"}
        yield BatchInput({"content": FileBody(file)}, headers, digest)


def write_archive(output, files):
    """Writes a compressed tar archive of files by name. Returns a digest of the names and contents."""
    digest = hashlib.sha256()
    # The service limits the size of a request. A higher level takes longer than the smaller archive saves.
    with tarfile.open(fileobj=output, mode="w:gz", compresslevel=1) as archive:
        for name, source in files.items():
            content, member = read(source), tarfile.TarInfo(name)
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
            for part in (name.encode(), content):
                digest.update(hashlib.sha256(part).digest())
    return digest.digest()


def files_by_name(sources):
    """Returns the files of a batch by their names in the archive."""
    if isinstance(sources, Mapping):
        for name in sources:
            if not isinstance(name, str) or not name.strip("/") or name.endswith("/") or "\0" in name:
                raise ValueError(f"{name!r} is not the name of a file")
        return dict(sources)
    files = {}
    for source in sources:
        is_path = isinstance(source, (str, os.PathLike))
        name = pathlib.Path(source).name if is_path else hashlib.sha256(read(source)).hexdigest()
        if name in files:
            raise ValueError(f"two files have the name {name}; name them with a dictionary: {{name: file}}")
        files[name] = source
    return files


class ArchiveReader:
    """Reader of a tar archive that arrives in a stream. Its methods are operations, which wait for pieces. `cut_off` is
    the message of the error if the stream ends before the archive.
    """

    def __init__(self, stream, cut_off):
        self.stream, self.cut_off, self.buffer, self.left = stream, cut_off, bytearray(), 0

    def take(self, size):
        """Returns the next bytes."""
        while len(self.buffer) < size:
            piece = yield Read(self.stream)
            if not piece:
                raise ConnectionError(self.cut_off)
            self.buffer += piece
        taken = bytes(self.buffer[:size])
        del self.buffer[:size]
        return taken

    def next(self):
        """Returns the header of the next file, None at the end of the archive: an empty block."""
        name = None
        while any(block := (yield from self.take(BLOCK))):
            member = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
            self.left = member.size
            if member.isreg():
                member.name = name or member.name
                return member
            if member.type != tarfile.GNUTYPE_LONGNAME:
                raise tarfile.HeaderError(f"{member.name} is not a file")
            file = io.BytesIO()
            yield from self.copy(file)
            name = file.getvalue().rstrip(b"\0").decode("utf-8", "surrogateescape")

    def copy(self, output=None):
        """Writes the content of the file whose header was read last, or skips it."""
        padding = -self.left % BLOCK
        while self.left > 0:
            piece = yield from self.take(min(self.left, PIECE))
            if output is not None:
                output.write(piece)
            self.left -= len(piece)
        yield from self.take(padding)


def member_path(member, folder):
    """Returns the path of a file of an archive in a folder, and creates the folders between them."""
    path = pathlib.Path(folder, tarfile.data_filter(member, folder).name)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
