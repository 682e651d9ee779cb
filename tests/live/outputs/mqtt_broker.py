"""A broker of MQTT 3.1.1 for tests: connections, wills, publications of quality 0 and 1, one subscription."""

from __future__ import annotations

import socket
import struct
import threading
from contextlib import suppress


def _text(body: bytes, at: int) -> tuple[str, int]:
    size = struct.unpack_from(">H", body, at)[0]
    return body[at + 2 : at + 2 + size].decode(), at + 2 + size


class Broker:
    """Keeps what is published; `kick` cuts all connections as a crash would, `close` ends the broker."""

    def __init__(self, port: int = 0, refuses: int = 0) -> None:
        self.got: list[tuple[str, str, bool]] = []
        self.logins: list[tuple[str, str]] = []
        self.subscribed: list[str] = []
        self.refuses = refuses
        self._connections: list[socket.socket] = []
        self._server = socket.create_server(("127.0.0.1", port))
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def texts(self, topic: str) -> list[str]:
        return [text for one, text, _ in self.got if one == topic]

    def send(self, topic: str, text: str) -> None:
        body = struct.pack(">H", len(topic)) + topic.encode() + text.encode()
        self._connections[-1].sendall(bytes([0x30, len(body)]) + body)

    def kick(self) -> None:
        for one in self._connections:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self.kick()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._server.accept()
            except OSError:
                return
            self._connections.append(connection)
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        will, stream = None, connection.makefile("rb")
        try:
            while first := stream.read(1):
                size = shift = 0
                while True:
                    byte = stream.read(1)[0]
                    size, shift = size | (byte & 127) << shift, shift + 7
                    if byte < 128:
                        break
                kind, flags, body = first[0] >> 4, first[0] & 15, stream.read(size)
                if kind == 1:
                    will = self._connect(body)
                    connection.sendall(bytes([0x20, 2, 0, self.refuses]))
                elif kind == 3:
                    topic, at = _text(body, 0)
                    if flags & 6:
                        connection.sendall(b"\x40\x02" + body[at : at + 2])
                        at += 2
                    self.got.append((topic, body[at:].decode(), bool(flags & 1)))
                elif kind == 8:
                    self.subscribed.append(_text(body, 2)[0])
                    connection.sendall(b"\x90\x03" + body[:2] + b"\x01")
                elif kind == 12:
                    connection.sendall(b"\xd0\x00")
                elif kind == 14:
                    will = None
        except OSError:
            pass
        finally:
            connection.close()
            if will is not None:
                self.got.append(will)

    def _connect(self, body: bytes) -> tuple[str, str, bool] | None:
        _, at = _text(body, 0)
        flags, at = body[at + 1], at + 4
        values, will = [], None
        while at < len(body):
            text, at = _text(body, at)
            values.append(text)
        if flags & 4:
            will = values[1], values[2], bool(flags & 32)
            del values[1:3]
        if flags & 128:
            self.logins.append((values[1], values[2] if flags & 64 else ""))
        return will
