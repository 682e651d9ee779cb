"""The blink driver's protocol, against a stand-in of the board at the other end of a pseudo-terminal."""

from __future__ import annotations

import importlib.util
import os
import re
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tapetum.errors import InputError, MissingExtraError
from tapetum.record.blinker import Blinker
from tapetum.record.laser import BlinkCode

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
SKETCH = Path(__file__).parents[2] / "docs" / "examples" / "blinker" / "blinker.ino"


class Board:
    """What the sketch does, in Python: answers lines, and remembers what it was told."""

    def __init__(self, *, version: str = "1", mute: bool = False) -> None:
        import pty
        import tty

        self.version, self.mute = version, mute
        self.told: list[str] = []
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        kept = b""
        while True:
            try:
                kept += os.read(self.master, 256)
            except OSError:
                return
            while b"\n" in kept:
                line, _, kept = kept.partition(b"\n")
                words = line.decode()
                self.told.append(words)
                if not self.mute:
                    os.write(self.master, (self._answer(words) + "\r\n").encode())

    def _answer(self, words: str) -> str:
        if words == "hello":
            return f"ok tapetum-blinker {self.version}"
        if words in ("on", "off"):
            return f"ok {words}"
        found = re.fullmatch(r"code (\d+) ([01]{2,64})(?: (\d+))?", words)
        fits = found and (found[3] is None or int(found[3]) >= int(found[1]) * len(found[2]))
        return "ok code" if fits else "error: hello, on, off, or code BIT_MS WORD [EVERY_MS]"

    def line(self) -> Line:
        return Line(self.port)

    def close(self) -> None:
        os.close(self._slave)
        os.close(self.master)


class Line:
    """The port without pyserial: raw, and read for a tenth of a second at most."""

    def __init__(self, port: str) -> None:
        self.file = os.open(port, os.O_RDWR | os.O_NOCTTY)

    def write(self, data: bytes, /) -> None:
        os.write(self.file, data)

    def readline(self) -> bytes:
        import select

        kept = b""
        while not kept.endswith(b"\n") and select.select([self.file], [], [], 0.3)[0]:
            kept += os.read(self.file, 1)
        return kept

    def close(self) -> None:
        os.close(self.file)


@pytest.fixture
def board() -> Iterator[Board]:
    one = Board()
    yield one
    one.close()


def test_on_off_and_code(board: Board) -> None:
    code = BlinkCode(bit=0.2, word=(0, 1, 1, 0), every=10.041)
    with Blinker(board.port, board.line()) as driver:
        driver.on()
        driver.code(code)
        driver.off()
    assert board.told == ["hello", "on", "code 200 0110 10041", "off"]


def test_codes_that_the_board_cannot_hold_are_refused(board: Board) -> None:
    with Blinker(board.port, board.line()) as driver:
        for code in (BlinkCode(bits=65), BlinkCode(bit=0.0004), BlinkCode(bit=0.00025)):
            with pytest.raises(InputError, match="cannot be sent; give 2 to 64 bits"):
                driver.code(code)
        with pytest.raises(InputError, match=r"answered 'error: hello.*' to 'code 0 1'"):
            driver._say("code 0 1")


def test_what_answers_otherwise_is_no_driver() -> None:
    newer, mute = Board(version="2"), Board(mute=True)
    for board, complaint in ((newer, "speaks version 2"), (mute, "no blink driver answers")):
        with pytest.raises(InputError, match=complaint):
            Blinker(board.port, board.line())
    for board in (newer, mute):
        board.close()


def test_the_port_is_opened_by_pyserial(board: Board) -> None:
    if importlib.util.find_spec("serial") is None:
        with pytest.raises(MissingExtraError, match=r"serial is not installed; pip install 'tapetum\[cameras\]'"):
            Blinker(board.port)
        pytest.skip("pyserial is not installed")
    with Blinker(board.port) as driver:
        driver.on()
    assert board.told == ["hello", "on"]
    with pytest.raises(InputError, match="cannot be opened"):
        Blinker("/dev/none")


def test_the_sketch_is_short_and_speaks_the_protocol() -> None:
    text = SKETCH.read_text("utf-8")
    assert len(text.splitlines()) <= 40
    for words in ("ok tapetum-blinker 1", "ok on", "ok off", "ok code", '"code %lu %64[01] %lu"'):
        assert words in text
