"""HTTP/2 client in raw frames that requests many bodies and takes a byte of each now and then (RFC 9113, RFC 7541)."""

import socket
import struct

DATA, HEADERS, RST_STREAM, SETTINGS, GOAWAY, WINDOW_UPDATE = 0, 1, 3, 4, 7, 8
END_STREAM, END_HEADERS, ACK = 1, 4, 1


def frame(kind, flags, stream, payload):
    return struct.pack(">I", len(payload))[1:] + bytes([kind, flags]) + struct.pack(">I", stream) + payload


def literal(text):
    assert len(text) < 127
    return bytes([len(text)]) + text.encode()


class SlowReader:
    """Connection with `streams` requests for `path` and a flow-control window of 0."""

    def __init__(self, port, path, streams, authority):
        self.socket = socket.create_connection(("127.0.0.1", port))
        self.unread, self.bytes = b"", 0
        self.open = {2 * n + 1 for n in range(streams)}
        # SETTINGS_INITIAL_WINDOW_SIZE = 0. GET and http are indexed; `:path` and `:authority` are literals.
        start = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + frame(SETTINGS, 0, 0, struct.pack(">HI", 4, 0))
        head = b"\x82\x86\x04" + literal(path) + b"\x01" + literal(authority)
        self.socket.sendall(start + b"".join(frame(HEADERS, END_HEADERS | END_STREAM, n, head) for n in sorted(self.open)))
        self.socket.setblocking(False)

    def grant(self):
        """Takes one more byte of every body."""
        self.send(b"".join(frame(WINDOW_UPDATE, 0, n, struct.pack(">I", 1)) for n in sorted(self.open)))

    def send(self, data):
        try:
            self.socket.sendall(data)
        except OSError:
            self.open.clear()

    def read(self):
        """Reads what has arrived. Removes streams that the server has reset from `open`."""
        try:
            while some := self.socket.recv(1 << 16):
                self.unread += some
            self.open.clear()
        except BlockingIOError:
            pass
        except OSError:
            self.open.clear()
        while len(self.unread) >= 9:
            length = int.from_bytes(self.unread[:3], "big")
            if len(self.unread) < 9 + length:
                return
            kind, flags, stream = self.unread[3], self.unread[4], int.from_bytes(self.unread[5:9], "big")
            self.unread = self.unread[9 + length :]
            if kind == DATA:
                self.bytes += length
            if kind == RST_STREAM or kind in (DATA, HEADERS) and flags & END_STREAM:
                self.open.discard(stream)
            if kind == GOAWAY:
                self.open.clear()
            if kind == SETTINGS and not flags & ACK:
                self.send(frame(SETTINGS, ACK, 0, b""))
