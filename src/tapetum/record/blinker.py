"""A driver that switches the laser by a serial line: on, off, and the blink code that aligns two cameras.

The protocol, version 1: lines of ASCII that end with a newline, 115200 baud, 8N1. The board answers every line with one
of its own that begins with `ok` or `error`, and sends nothing else.

    hello                            ok tapetum-blinker 1
    on | off                         ok on | ok off           and ends a code
    code BIT_MS WORD [EVERY_MS]      ok code                  the word, first bit first, 1 for on; 2 to 64 bits

A code begins when its line has arrived: bits of BIT_MS milliseconds, then on; with EVERY_MS again after so many. The
board is off until told otherwise, and so is the laser. `docs/examples/blinker/blinker.ino` is a sketch for an Arduino.
"""

from __future__ import annotations

from types import TracebackType
from typing import Any, Protocol, Self

from tapetum.errors import InputError, need
from tapetum.record.laser import BlinkCode

__all__ = ["BAUD", "Blinker", "Line"]

BAUD = 115200
_PATIENCE = 3.0  # s; an Arduino restarts when its port is opened, and takes two
_MOST_BITS = 64


class Line(Protocol):
    """An opened serial line, such as pyserial's."""

    def write(self, data: bytes, /) -> Any: ...

    def readline(self) -> bytes: ...

    def close(self) -> None: ...


class Blinker:
    """The laser's switch at a serial port.

    Parameters
    ----------
    port
        `/dev/ttyACM0`, `COM3`.
    line
        An opened line in place of the port.

    Raises
    ------
    MissingExtraError
        When pyserial is not installed (extra: cameras).
    InputError
        When the port cannot be opened, or no driver answers.
    """

    def __init__(self, port: str, line: Line | None = None) -> None:
        self.port = port
        self._line: Line = _opened(port) if line is None else line
        try:
            self._greet()
        except BaseException:
            self._line.close()
            raise

    def _greet(self) -> None:
        answer = ""
        for _ in range(3):
            self._line.write(b"hello\n")
            answer = self._read()
            if answer.startswith("ok tapetum-blinker"):
                version = answer.rpartition(" ")[2]
                if version != "1":
                    remedy = "load the sketch of docs/examples/blinker"
                    raise InputError(f"speaks version {version} of the protocol", where=self.port, remedy=remedy)
                return
        what = f"no blink driver answers (it said {answer!r})" if answer else "no blink driver answers"
        raise InputError(what, where=self.port, remedy="check port and baud rate, and load docs/examples/blinker")

    def _read(self) -> str:
        return self._line.readline().decode("ascii", "replace").strip()

    def _say(self, words: str) -> None:
        try:
            self._line.write(f"{words}\n".encode("ascii"))
            answer = self._read()
        except OSError as error:
            raise InputError(f"is gone ({error})", where=self.port, remedy="plug the driver in again") from error
        if not answer.startswith("ok"):
            what = f"answered {answer!r} to {words!r}" if answer else f"did not answer {words!r}"
            raise InputError(what, where=self.port, remedy="restart the driver, or load docs/examples/blinker again")

    def on(self) -> None:
        """Switch the laser on."""
        self._say("on")

    def off(self) -> None:
        """Switch the laser off."""
        self._say("off")

    def code(self, code: BlinkCode) -> None:
        """Blink a code now; its `start` is not used. Raises an InputError for words that the driver cannot hold."""
        word = "".join(str(bit) for bit in code.sent)
        bit = round(1000 * code.bit)
        if len(word) > _MOST_BITS or abs(bit - 1000 * code.bit) > 1e-6 or not 1 <= bit <= 60_000:
            what = f"{len(word)} bits of {1000 * code.bit:g} ms cannot be sent"
            raise InputError(
                what, where=self.port, remedy=f"give 2 to {_MOST_BITS} bits of whole milliseconds, 1 to 60000"
            )
        every = "" if code.every is None else f" {round(1000 * code.every)}"
        self._say(f"code {bit} {word}{every}")

    def close(self) -> None:
        """Release the port; the laser stays as it is."""
        self._line.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _opened(port: str) -> Line:
    serial = need("serial", "cameras")
    try:
        return serial.Serial(port, BAUD, timeout=_PATIENCE, write_timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        remedy = (
            "plug the driver in, see `python -m serial.tools.list_ports`, and be in the group that may use it (dialout)"
        )
        raise InputError(f"cannot be opened ({error})", where=port, remedy=remedy) from error
